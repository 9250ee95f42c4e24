"""The stretches chosen for a closer look, on records whose interesting stretches are known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hygrokf.report.figures.course_panels import choose_excerpts, hourly

DAY = 86400.0


def _record(days: float = 80.0, step: float = 1800.0) -> dict[str, np.ndarray]:
    time = 1.6e9 + np.arange(0.0, days * DAY, step)
    day = (time - time[0]) / DAY
    n = len(time)
    # a strong daily cycle from day 10 to 18, lively temperature from 30 to 36, standstill from 50 to 55
    ambient = 283.0 + np.where((day > 10) & (day < 18), 8.0, 1.0) * np.sin(2 * np.pi * day)
    lively = np.where((day > 30) & (day < 36), 6.0, 0.3) * np.sign(np.sin(2 * np.pi * day * 6))
    still = (day > 50) & (day < 55)
    return {
        "time_s": time,
        "temperature_measured": ambient + 8.0 + lively,
        "temperature_simulated": ambient + 8.0 + np.where((day > 60) & (day < 66), 9.0, 0.0),
        "absolute_humidity_measured": np.full(n, np.nan),
        "absolute_humidity_simulated": np.full(n, np.nan),
        "ambient_temperature": ambient,
        "power": np.where(still, 0.0, 0.4),
        "operating": (~still).astype(float),
        "preheating": ((day > 54.5) & (day < 55)).astype(float),
        "scored": np.ones(n),
    }


def _days(series: dict, excerpt) -> tuple[float, float]:
    first = series["time_s"][0]
    return (excerpt.start_s - first) / DAY, (excerpt.end_s - first) / DAY


def test_the_three_interesting_stretches_are_found() -> None:
    series = _record()
    found = {e.reason: _days(series, e) for e in choose_excerpts(series)}
    assert list(found) == ["part load, day-night cycle", "most dynamic", "standstill and pre-heating"]
    a, b, c = found.values()
    assert a[0] >= 9.5 and a[1] <= 18.5
    assert b[0] >= 29.5 and b[1] <= 36.5
    assert c[0] <= 54.5 and c[1] > 55.0
    assert all(end - start == pytest.approx(6.0, abs=0.05) for start, end in (a, b, c))


def test_stretches_do_not_overlap() -> None:
    for days in (3.0, 9.0, 30.0):
        chosen = choose_excerpts(_record(days))
        assert 1 <= len(chosen) <= 3
        assert all(one.end_s <= two.start_s for one, two in itertools.pairwise(chosen))


def test_without_preheating_without_standstill_without_power() -> None:
    series = _record()
    series["preheating"] *= 0
    assert "standstill" in {e.reason for e in choose_excerpts(series)}
    series["operating"] = np.ones_like(series["operating"])
    series["power"] = np.where((series["time_s"] - series["time_s"][0]) / DAY > 70, 0.99, 0.4)
    reasons = {e.reason: _days(series, e) for e in choose_excerpts(series)}
    assert reasons["operation close to rated power"][0] >= 69.5
    series["operating"] *= 0
    reasons = {e.reason: _days(series, e) for e in choose_excerpts(series)}
    assert set(reasons) == {"largest errors of the free run", "most dynamic", "pronounced day-night cycle"}
    assert reasons["largest errors of the free run"][0] == pytest.approx(60.0, abs=0.6)


def test_unread_and_unscored_stretches_are_passed_over() -> None:
    series = _record()
    day = (series["time_s"] - series["time_s"][0]) / DAY
    series["temperature_measured"][(day > 30) & (day < 36)] = np.nan
    series["scored"][(day > 10) & (day < 18)] = 0.0
    for excerpt in choose_excerpts(series):
        start = _days(series, excerpt)[0]
        assert not (29 < start < 34) and not (9.5 < start < 14.5), excerpt


@pytest.mark.parametrize("n", [0, 1, 2, 20])
def test_short_records(n: int) -> None:
    series = {name: value[:n] for name, value in _record().items()}
    assert len(choose_excerpts(series)) == (1 if n > 1 else 0)


def test_all_missing() -> None:
    series = _record(20.0)
    blank = {name: np.full_like(value, np.nan) for name, value in series.items() if name != "time_s"}
    assert len(choose_excerpts({**blank, "time_s": series["time_s"]})) <= 3


def test_hourly_means() -> None:
    time = 7.0 + np.arange(0.0, 4 * 3600.0, 600.0)
    value = np.arange(24.0)
    value[6:12] = np.nan
    value[13] = np.nan
    np.testing.assert_allclose(hourly(time, value, 4), [2.5, np.nan, (12 + 14 + 15 + 16 + 17) / 5, 20.5])
