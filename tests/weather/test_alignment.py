"""Lags, offsets and clock errors between two weather series: simulated pairs, seeds 5000 on, and the measured
French ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import builders.weather_case as made
import numpy as np
import pytest
from builders.measured import DATA, measured

from hygrokf.data.record import Record, Series, Site
from hygrokf.data.timestamps import summer_time
from hygrokf.texts.record_codes import DoubtCode, RecordCode
from hygrokf.weather.clock_comparison import (
    UNKNOWN_BOUNDS,
    Bounded,
    ClockError,
    align,
    alignments,
    clock_doubts,
    clock_errors,
    rounded,
)

SPRING = 1393632000.0  # 2014-03-01


def error(one: Series, other: Series):
    (found,) = clock_errors([align(one, other)])
    return found


@pytest.mark.parametrize("late_s", [0.0, -3600.0, 1800.0, 5.5 * 3600.0, -11 * 3600.0])
def test_a_lag_is_found_with_its_sign(late_s: float) -> None:
    one, other = made.weather_pair(5000, 120, late_s, sun=0.0)
    found = align(one, other)
    assert abs(found.whole.weather.value - late_s) < 300.0
    assert abs(found.whole.mean_day.value - late_s) < 1800.0
    assert found.whole.weather.high - found.whole.weather.low < 1200.0
    back = align(other, one)
    assert back.whole.weather.value == pytest.approx(-found.whole.weather.value, abs=60.0)


@pytest.mark.parametrize(
    ("late_s", "kind", "correction"),
    [(0.0, "right", 0.0), (-3600.0, "constant", 3600.0), (7200.0, "constant", -7200.0)],
)
def test_constant_clock_errors(late_s: float, kind: str, correction: float) -> None:
    """A housing that follows in 10 min and stands in the sun: right clocks give no alarm, wrong ones are
    named."""
    kinds = []
    for seed in range(5100, 5108):
        found = error(*made.weather_pair(seed, 90, late_s, housing_s=600.0, start_s=SPRING + 86400 * 60))
        assert found.kind in (kind, "unclear") and found.corrections_s in ((correction,) * 2, (0.0, 0.0))
        kinds.append(found.kind)
    assert kinds.count(kind) >= 7


@pytest.mark.parametrize(("late_s", "summer_s"), [(-3600.0, -3600.0), (0.0, 3600.0)])
def test_seasonal_clock_errors(late_s: float, summer_s: float) -> None:
    for seed in range(5200, 5204):
        found = error(*made.weather_pair(seed, 300, late_s, summer_s, 0.3, 600.0, summer_time))
        assert found.kind == "seasonal" and found.corrections_s == (-late_s, -(late_s + summer_s))


def test_the_sun_on_a_housing_is_no_clock_error() -> None:
    """It moves the mean day by more than an hour, the weather hardly."""
    found = error(*made.weather_pair(5300, 120, sun=1.5, start_s=SPRING + 86400 * 60))
    assert found.kind == "right" and found.alignments[0].whole.mean_day.value > 2400.0
    assert clock_doubts([found]) == []


def test_a_distant_station_is_no_clock_error() -> None:
    """Fronts that come two hours later, and a sun that is no later: the witnesses contradict each other."""
    one, other = made.weather_pair(5400, 200, 7200.0, sun=0.0)
    wave = 6.0 * np.cos(2 * np.pi * (one.time / 86400 - 15 / 24)) - 6.0 * np.cos(
        2 * np.pi * ((one.time - 7200) / 86400 - 15 / 24)
    )
    found = error(replace(one, value=one.value + wave), replace(other, value=other.value))
    assert found.winter.value == pytest.approx(7200.0, abs=600.0)
    assert found.kind == "unclear" and clock_doubts([found]) == []


def test_unrelated_weather_tells_nothing() -> None:
    """A typical year against a measured one: the sun sets both, no front is common."""
    one, _ = made.weather_pair(5500, 200)
    _, other = made.weather_pair(5501, 200)
    found = error(one, other)
    assert found.kind == "unclear" and not found.winter.known and found.alignments[0].whole.mean_day.known


@pytest.mark.slow
def test_bounds_hold_and_right_clocks_give_no_alarm() -> None:
    """200 pairs of 90 days, seeds 7000 on, no sun on the housing; counts: docs/validation/coverage.md."""
    inside, alarms, missed, wrong = 0, 0, 0, 0
    for seed in range(7000, 7200):
        late_s = float(np.random.default_rng(seed).choice([0.0, 0.0, -3600.0, 3600.0, 1800.0]))
        found = align(*made.weather_pair(seed, 90, late_s, sun=0.0))
        inside += found.whole.weather.low <= late_s <= found.whole.weather.high
        corrected, _ = clock_errors([found])[0].corrections_s
        alarms += late_s == 0.0 and corrected != 0.0
        missed += late_s != 0.0 and corrected == 0.0
        wrong += late_s != 0.0 and corrected not in (0.0, -late_s)
    assert inside >= 180  # of 190 expected; 3.3 standard deviations below
    assert (alarms, wrong) == (0, 0) and missed <= 6


def test_offset_and_amplitude() -> None:
    one, other = made.weather_pair(5600, 90, sun=0.0)
    changed = replace(one, value=281.0 + 0.5 * (one.value - 281.0) + 2.0)
    found, plain = align(changed, other), align(one, other)
    both = np.interp(one.time, other.time, other.value)
    assert found.offset.value == pytest.approx(np.mean(changed.value - both), abs=0.02)
    assert found.offset.low < found.offset.value < found.offset.high
    assert found.amplitude == pytest.approx(0.5 * plain.amplitude, rel=1e-6)
    assert found.other_amplitude == plain.other_amplitude


def test_the_daily_wave_is_that_of_a_least_squares_fit() -> None:
    time = 3600.0 * np.arange(24 * 60)
    wave = 285.0 + 3.0 * np.cos(2 * np.pi * (time / 86400 - 0.6))
    later = 285.0 + 2.0 * np.cos(2 * np.pi * ((time - 2700.0) / 86400 - 0.6))
    found = align(Series("ambient_temperature", time, later), Series("ambient_temperature", time, wave))
    assert found.whole.mean_day.value == pytest.approx(2700.0, abs=20.0)
    assert (found.amplitude, found.other_amplitude) == (
        pytest.approx(2.0, rel=0.015),
        pytest.approx(3.0, rel=0.015),
    )
    assert found.whole.weather == UNKNOWN_BOUNDS  # no weather but the mean day


def test_means_stand_in_the_middle_of_their_interval() -> None:
    _, other = made.weather_pair(5700, 60, sun=0.0)
    hours = other.time
    means = np.interp(hours - 1800.0, other.time, other.value)
    held = Series("ambient_temperature", hours, means, "mean", 3600.0)
    assert align(held, other).whole.weather.value == pytest.approx(0.0, abs=90.0)


def test_too_little_in_common() -> None:
    one, other = made.weather_pair(5800, 15)
    assert align(one, other) is None
    one, other = made.weather_pair(5800, 40)
    assert align(one, replace(other, time=other.time + 50 * 86400.0)) is None
    assert align(one, replace(other, value=np.full(len(other), np.nan))) is None
    value = one.value.copy()
    value[: len(value) * 2 // 3] = np.nan
    assert align(replace(one, value=value), other) is None
    with pytest.raises(ValueError, match="one signal"):
        align(one, replace(other, signal="nacelle_temperature"))


def test_gaps_change_little() -> None:
    one, other = made.weather_pair(5900, 90, -3600.0, sun=0.0)
    value = one.value.copy()
    gone = np.random.default_rng(5900).integers(0, len(value) - 300, 12)
    for start in gone:
        value[start : start + 300] = np.nan
    found = align(replace(one, value=value), other)
    assert found.whole.weather.low - 60.0 <= -3600.0 <= found.whole.weather.high + 60.0


@pytest.mark.parametrize(
    ("seconds", "correction"),
    [
        (0, 0),
        (900, 0),
        (3240, 3600),
        (6500, 7200),
        (-3700, -3600),
        (1750, 1800),
        (19900, 19800),
        (2600, 2700),
        (2340, 1800),
        (4580, 4500),
    ],
)
def test_corrections_are_rounded_as_clocks_are_set(seconds: float, correction: float) -> None:
    assert rounded(seconds) == correction


# -- a record that holds both --------------------------------------------------------------------------------
def test_the_longer_step_is_what_is_held_against() -> None:
    one, other = made.weather_pair(5960, 60, -3600.0, sun=0.0)
    for used, second in ((one, other), (other, one)):
        record = Record("x", (used,), Site(48.0, 5.0), compared=(second,))
        (found,) = alignments(record)
        assert (found.one, found.other) == ("scada.csv", "era5.nc")
    (doubt,) = clock_doubts(clock_errors([found]))
    assert doubt.code is DoubtCode.CLOCK_RUNS
    assert (doubt.values["source"], doubt.values["other"]) == ("scada.csv", "era5.nc")
    assert doubt.values["pace"] == RecordCode.CLOCK_SLOW(by=3600.0)
    assert doubt.values["remedy"] == RecordCode.STATE_CORRECTION(correction="+1h")
    (error,) = clock_errors([found])
    assert error.corrections_s == (3600.0, 3600.0) and error.kind == "constant"


@pytest.mark.parametrize("late_s", [43200.0, -43200.0, 45000.0])
def test_a_clock_that_is_off_by_half_a_day(late_s: float) -> None:
    """Morning and afternoon exchanged: the daily wave alone cannot tell early from late."""
    found = error(*made.weather_pair(4300, 90, late_s))
    assert found.kind == "constant" and found.corrections_s == (-late_s, -late_s)


def test_the_seasons_of_the_south_are_named_by_months() -> None:
    def told(first: float, second: float) -> str:
        lags = [Bounded(value, value - 300.0, value + 300.0) for value in (first, second)]
        found = ClockError("logger.csv", "era5.nc", "seasonal", *lags, ())
        return clock_doubts([found], south=True)[0].text

    zone = told(39600.0, 36000.0)  # UTC+11 in the southern summer, UTC+10 in its winter, both read as UTC
    assert "11 h fast from November to March and 10 h fast from April to October" in zone
    assert "follows summer time although" in zone and "by name" in zone and " in winter" not in zone
    assert "has no summer time although" in told(-3600.0, 0.0)


def test_sentences_of_seasonal_errors() -> None:
    one, other = made.weather_pair(5970, 300, -3600.0, -3600.0, 0.0, 0.0, summer_time)
    (doubt,) = clock_doubts([error(one, other)])
    sentence = doubt.text
    assert "runs 1 h slow in winter and 2 h slow in summer against era5.nc" in sentence
    assert (
        "need +1 h in winter and +2 h in summer: it has no summer time" in sentence
        and "ignore_offset" in sentence
    )
    one, other = made.weather_pair(5970, 300, 0.0, 3600.0, 0.0, 0.0, summer_time)
    (doubt,) = clock_doubts([error(one, other)])
    sentence = doubt.text
    assert "runs right in winter and 1 h fast in summer" in sentence and "it follows summer time" in sentence


def test_several_signals_are_weighed() -> None:
    from hygrokf.weather.clock_comparison import _combined

    joint = _combined(
        [Bounded(10.0, 10.0 - 196.0, 10.0 + 196.0), Bounded(110.0, 110.0 - 196.0, 110.0 + 196.0)]
    )
    assert joint.value == pytest.approx(60.0)
    assert joint.high - joint.value == pytest.approx(1.96 * 100.0 / np.sqrt(2.0), rel=0.01)
    apart = _combined([Bounded(0.0, -196.0, 196.0), Bounded(2000.0, 1804.0, 2196.0)])
    assert apart.high - apart.low > 1900.0  # contradicting ones widen the bounds
    assert (
        _combined([UNKNOWN_BOUNDS, Bounded(1.0, 0.0, 2.0)]).value == 1.0 and _combined([]) == UNKNOWN_BOUNDS
    )


# -- measured ------------------------------------------------------------------------------------------------
FRENCH = """name = "R80736"
rated_power_kW = 2050.0
[site]
latitude_deg = 48.45
longitude_deg = 5.59
[[source]]
file = "{data}/la_haute_borne_R80736_10min_2014_2015.csv.gz"
time = "Date_time"
stamp = "start"
{clock}
signals.ambient_temperature = {{ column = "Ot_avg", unit = "degC" }}
signals.wind_speed = {{ column = "Ws_avg", unit = "m/s" }}
[[source]]
file = "{data}/la_haute_borne_era5_hourly_2014_2015.csv.gz"
time = "datetime"
timezone = "UTC"
compare = true
signals.ambient_temperature = {{ column = "t_2m", unit = "K" }}
signals.wind_speed = {{ column = "ws_100m", unit = "m/s" }}
"""


@measured
def test_the_french_wind_farm_runs_on_utc(tmp_path: Path, capsys) -> None:
    """Its stamps say +01:00 and +02:00; the reanalysis says that they are UTC."""
    from hygrokf.commands.main import main

    case = tmp_path / "case.toml"
    case.write_text(FRENCH.format(data=DATA.resolve(), clock=""))
    assert main(["check", str(case)]) == 0
    shown = capsys.readouterr().out
    (sentence,) = [line for line in shown.splitlines() if "the clock of" in line]
    assert "runs 1 h slow in winter and 2 h slow in summer against" in sentence
    assert "need +1 h in winter and +2 h in summer" in sentence and "ignore_offset = true" in sentence
    case.write_text(FRENCH.format(data=DATA.resolve(), clock='timezone = "UTC"\nignore_offset = true'))
    assert main(["check", str(case)]) == 0
    shown = capsys.readouterr().out
    assert "the clock of" not in shown and "lag in summer" in shown


@measured
def test_the_reanalysis_as_a_weather_file_says_the_same(tmp_path: Path) -> None:
    """The same file read with its format, by its own names; what the turbine measures itself is taken from
    there."""
    from hygrokf.cases.case_file import read_case

    head = FRENCH.format(data=DATA.resolve(), clock="").partition("[[source]]\nfile")
    turbine = (head[1] + head[2]).rpartition("[[source]]")[0]
    case = tmp_path / "case.toml"
    file = DATA.resolve() / "la_haute_borne_era5_hourly_2014_2015.csv.gz"
    case.write_text(head[0] + turbine + f'[[source]]\nfile = "{file}"\nformat = "era5"\n')
    record = read_case(case, cabinet=False)
    assert {one.signal for one in record.compared} == {"ambient_temperature", "wind_speed"}
    (found,) = clock_errors(alignments(record))
    assert found.kind == "seasonal" and found.corrections_s == (3600.0, 7200.0)


@measured
def test_measured_weather_shifted_on_purpose() -> None:
    """ERA5 of the UK site against itself, smoothed, with noise and a wrong clock."""
    import pandas as pd

    table = pd.read_csv(DATA / "kelmarsh_2018_2019_era5_power_hourly.csv.gz")
    time = 1514764800.0 + 3600.0 * np.arange(len(table))
    random = np.random.default_rng(77)
    for name, column in (("ambient_temperature", "T2m_C"), ("wind_speed", "ws100_mps")):
        value = table[column].to_numpy(dtype=float) + (273.15 if name == "ambient_temperature" else 0.0)
        other = Series(name, time, value)
        noisy = np.fmax(value + 0.5 * random.normal(size=len(value)), 0.0)
        for late in (0.0, -3600.0, 5400.0):
            found = align(Series(name, time + late, noisy), other)
            assert found.whole.weather.value == pytest.approx(late, abs=120.0)
            assert found.whole.weather.low <= late + 120.0 and found.whole.weather.high >= late - 120.0
