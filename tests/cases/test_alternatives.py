"""Clocks, units and columns that are wrong are named with the line that corrects them; right ones never."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from other_make import ROWS, make_plant
from other_make.as_record import to_record

from hygrokf.cases.alternatives import EITHER, NAMED_SHIFT, WALL, Readings, alternative_readings, solar_lag
from hygrokf.cases.doubts import all_doubts
from hygrokf.cases.summary import describe
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.shared_clocks import Shift, shifted
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.estimation.lag_model import (
    LAGS_H,
    LARGEST_SHIFT,
    Relation,
    fit_autoregression,
    relations,
    shift_logliks,
)
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.record_text import describe_text
from hygrokf.texts.record_codes import DoubtCode, RecordCode, touched


@cache
def right(days: float = 60.0) -> Record:
    """A plant of another make, moved so that summer time begins in its middle."""
    record = to_record(make_plant(7_000, ROWS["means10"], days))
    sunday = 1648342800.0  # 2022-03-27T01:00Z
    moved = DAY_S * round((sunday - 0.5 * days * DAY_S - record.start_s) / DAY_S)
    return record.replace_series(*(replace(one, time=one.time + moved) for one in record.series))


def of(record: Record, *signals: str) -> Record:
    return replace(record, series=tuple(one for one in record.series if one.signal in signals))


def only(found: Readings) -> tuple[str, str, str]:
    (one,) = found.findings
    return one.verdict, one.alternative.mistake.text, one.alternative.line.text


def test_a_right_record_has_no_better_reading() -> None:
    assert alternative_readings(right()) == Readings()
    assert not [one for one in all_doubts(right()) if "clock" in one.text]


@pytest.mark.parametrize(
    ("source", "hours", "words"),
    [
        ("cabinet.csv", 2.0, "2 h fast"),
        ("ambient.csv", -1.0, "1 h slow"),
        ("scada.csv", 5.5, "5.5 h fast"),
    ],
)
def test_a_wrong_clock_is_named_with_the_line_that_corrects_it(source: str, hours: float, words: str) -> None:
    found = alternative_readings(shifted(right(), Shift(source, HOUR_S * hours)))
    line = f'state clock_correction = "{-hours:+g}h" in that source'
    assert only(found) == (NAMED_SHIFT, f"the clock of {source} seems {words}", line)


@pytest.mark.parametrize("source", ["cabinet.csv", "scada.csv"])
def test_summer_time_that_is_ignored_is_named(source: str) -> None:
    fault = Shift(source, -HOUR_S, summer=True)
    verdict, name, line = only(alternative_readings(shifted(right(), fault)))
    assert (verdict, name) == (
        NAMED_SHIFT,
        f"the clock of {source} seems right in winter and 1 h slow in summer",
    )
    assert "it has no summer time although its stamps are read with it" in line


def test_the_named_reading_is_the_right_record() -> None:
    wrong = shifted(right(), Shift("ambient.csv", -7200.0))
    (found,) = alternative_readings(wrong).findings
    assert found.alternative.signals == ("ambient_temperature", "ambient_relative_humidity")
    assert found.alternative.reading(wrong) == right()
    assert found.gain > 100.0


def test_a_doubt_about_a_clock_touches_every_time_constant() -> None:
    doubts = all_doubts(shifted(right(), Shift("cabinet.csv", 7200.0)))
    (doubt,) = (one for one in doubts if one.code is DoubtCode.READ_OTHERWISE)
    assert doubt.values["remedy"] == RecordCode.STATE_CORRECTION(correction="-2h")
    assert touched(doubt) == ("thermal", "hygric")


def test_a_cabinet_that_only_seems_late_needs_a_second_witness() -> None:
    alone = of(right(), "cabinet_temperature", "ambient_temperature")
    late = shifted(alone, Shift("cabinet.csv", 7200.0))
    (found,) = alternative_readings(late).findings
    assert found.verdict == WALL
    assert found.doubt().code is DoubtCode.CLOCK_OR_WALL
    (found,) = alternative_readings(shifted(alone, Shift("cabinet.csv", -7200.0))).findings
    assert found.verdict == EITHER and found.rival is not None  # two sources: either may be wrong
    assert {one.signals[0] for one in (found.alternative, found.rival)} == {
        "cabinet_temperature",
        "ambient_temperature",
    }


def test_the_sun_tells_which_of_two_clocks_is_wrong() -> None:
    site = Site(50.0, 0.0)
    pair = of(right(), "cabinet_temperature", "ambient_temperature")
    time = pair["ambient_temperature"].time
    light = np.clip(800.0 * np.cos(2.0 * np.pi * (time / DAY_S - 0.5)), 0.0, None)
    sunny = Series("global_horizontal_irradiance", time, light, source="ambient.csv, column 3")
    record = replace(pair, series=(*pair.series, sunny), site=site)
    for hours in (-2.0, 2.0):
        found = alternative_readings(shifted(record, Shift("cabinet.csv", HOUR_S * hours)))
        assert [one.alternative.signals for one in found.findings] == [("cabinet_temperature",)]
    (found,) = alternative_readings(shifted(record, Shift("ambient.csv", -7200.0))).findings
    assert (found.verdict, found.alternative.signals[0]) == (NAMED_SHIFT, "ambient_temperature")
    assert "the sun" in found.witnesses


@pytest.mark.parametrize("hours", [-11.0, -6.0, 0.0, 3.0, 9.0])
def test_the_sun_tells_half_a_day(hours: float) -> None:
    time = 1.6e9 + 600.0 * np.arange(40 * 144)
    light = np.clip(800.0 * np.cos(2.0 * np.pi * (time / DAY_S - 0.5)), 0.0, None)
    series = Series("global_horizontal_irradiance", time + HOUR_S * hours, light)
    found = solar_lag(Record("x", (series,), Site(50.0, 0.0)))
    assert found == pytest.approx(HOUR_S * hours, abs=1000.0)  # the equation of time


def fahrenheit(record: Record, *signals: str) -> Record:
    shown = {name: 1.8 * (record[name].value - ZERO_CELSIUS_K) + 32.0 for name in signals}
    return record.replace_series(
        *(replace(record[name], value=value + ZERO_CELSIUS_K) for name, value in shown.items())
    )


def exchanged(record: Record, one: str, other: str) -> Record:
    return record.replace_series(replace(record[other], signal=one), replace(record[one], signal=other))


def with_humidity_as_temperature(record: Record) -> Record:
    t, rh = record["cabinet_temperature"], record["cabinet_relative_humidity"]
    return record.replace_series(
        replace(t, value=100.0 * rh.value + ZERO_CELSIUS_K),
        replace(rh, value=0.01 * (t.value - ZERO_CELSIUS_K)),
    )


@pytest.mark.parametrize(
    ("spoilt", "words", "line"),
    [
        (
            lambda r: fahrenheit(r, "cabinet_temperature"),
            "cabinet_temperature seems in °F, called °C",
            'unit = "degF"',
        ),
        (
            lambda r: fahrenheit(r, "cabinet_temperature", "ambient_temperature"),
            "cabinet_temperature and ambient_temperature seem in °F, called °C",
            'unit = "degF"',
        ),
        (
            lambda r: exchanged(r, "cabinet_temperature", "ambient_temperature"),
            "cabinet_temperature and ambient_temperature seem exchanged",
            "exchange their columns",
        ),
        (
            with_humidity_as_temperature,
            "cabinet_temperature and cabinet_relative_humidity seem exchanged",
            "exchange their columns",
        ),
    ],
)
def test_another_unit_or_column_is_named(spoilt: Callable[[Record], Record], words: str, line: str) -> None:
    found = alternative_readings(spoilt(right()))
    rows = [one.alternative for one in found.findings]
    assert (words, line) in [(one.mistake.text, one.line.text) for one in rows]


def test_what_cannot_be_told_is_said() -> None:
    short = right().window(right().start_s, right().start_s + 10.0 * DAY_S)
    assert alternative_readings(short).untold == (RecordCode.CLOCKS_TOO_SHORT(),)
    still = right()["ambient_temperature"]
    constant = right().replace_series(replace(still, value=np.full(len(still), 283.15)))
    found = describe(of(constant, "cabinet_temperature", "ambient_temperature"))
    assert found.untold and found.untold[0].text in describe_text(found)


def relation() -> Relation:
    return next(one for one in relations(right()) if one.name == "temperature")


@pytest.mark.parametrize(("quarters", "more"), [(0, 0), (-40, 0), (8, 4)])
def test_all_shifts_together_are_each_shift_alone(quarters: int, more: int) -> None:
    one = relation()
    summer = np.arange(len(one.time)) > len(one.time) // 2
    move = (frozenset({"ambient_temperature"}), more)
    phi = fit_autoregression(one, 2.0)[0]
    together = shift_logliks(one, phi, {move}, summer)[move]
    # the autoregression is estimated anew for each shift alone, which can only gain
    alone = fit_autoregression(one, 2.0, move, quarters, summer)[1].sum()
    assert together.shape == (2 * LARGEST_SHIFT + 1, len(LAGS_H))
    gap = alone - together[LARGEST_SHIFT + quarters, LAGS_H.index(2.0)]
    assert -0.5 < gap < 0.05 * abs(alone)
    if (quarters, more) == (0, 0):
        assert gap == pytest.approx(0.0, abs=0.5)
