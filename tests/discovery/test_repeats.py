"""Readings that repeat those of the day before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hygrokf.data.record import Record, Series
from hygrokf.discovery.repeats import repeated_statement, repeats, without_repeats
from hygrokf.texts.discovery_codes import DiscoveryCode

START = 1_596_499_200.0  # 4 August 2020, 00:00 UTC
STEP_S = 900.0
DAY = 96


def wandering(seed: int, resolution: float = 0.1) -> Series:
    random = np.random.default_rng(seed)
    value = 290.0 + np.cumsum(0.2 * random.standard_normal(40 * DAY))
    value = np.round(value / resolution) * resolution
    return Series("cabinet_temperature", START + STEP_S * np.arange(len(value)), value, resolution=resolution)


def repeated(series: Series, first: int, count: int) -> Series:
    value = series.value.copy()
    value[first : first + count] = value[first - DAY : first - DAY + count]
    return replace(series, value=value)


@pytest.mark.parametrize("seed", range(20))
def test_chance_repeats_nothing(seed: int) -> None:
    assert repeats(wandering(seed)) == []


@pytest.mark.parametrize("count", [8, 14, 40, 90])
def test_a_stretch_that_repeats_is_found_with_its_ends(count: int) -> None:
    series = repeated(wandering(3), 20 * DAY + 5, count)
    ((first, last),) = repeats(series)
    assert first == pytest.approx(series.time[20 * DAY + 5], abs=2 * STEP_S)
    assert last == pytest.approx(series.time[20 * DAY + 4 + count], abs=2 * STEP_S)


def test_frozen_readings_have_not_been_repeated() -> None:
    series = wandering(4)
    value = series.value.copy()
    value[19 * DAY : 22 * DAY] = 300.0
    assert repeats(replace(series, value=value)) == []


def test_gaps_and_steps_that_do_not_divide_a_day() -> None:
    series = repeated(wandering(5), 20 * DAY, 40)
    holes = np.ones(len(series.time), bool)
    holes[10 * DAY : 10 * DAY + 7] = False
    assert len(repeats(replace(series, time=series.time[holes], value=series.value[holes]))) == 1
    assert repeats(replace(series, time=START + 1000.0 * np.arange(len(series.time)))) == []


def test_repeated_readings_of_the_cabinet_are_set_aside() -> None:
    series = repeated(wandering(6), 20 * DAY, 40)
    outside = replace(series, signal="ambient_temperature")
    record, spans = without_repeats(Record("cabinet", (series, outside)))
    assert list(spans) == ["cabinet_temperature"]
    assert np.isnan(record["cabinet_temperature"].value).sum() == pytest.approx(40, abs=2)
    assert np.isfinite(record["ambient_temperature"].value).all()
    (first, last), *rest = spans["cabinet_temperature"]
    values = {"signal": "cabinet_temperature", "days": ("2020-08-24",), "hours": (last - first) / 3600.0}
    assert not rest and repeated_statement(spans) == DiscoveryCode.READINGS_REPEATED(**values)


def test_a_logger_repeats_all_that_it_logs() -> None:
    shown = replace(repeated(wandering(7), 20 * DAY, 40), source="logger.csv, column a")
    beside = replace(wandering(8), signal="cabinet_relative_humidity", source="logger.csv, column b")
    other = wandering(9)
    other = replace(
        other, signal="cabinet_absolute_humidity", value=3e-5 * other.value, source="other.csv, column c"
    )
    record, _ = without_repeats(Record("cabinet", (shown, beside, other)))
    gone = np.isnan(record["cabinet_temperature"].value)
    assert (np.isnan(record["cabinet_relative_humidity"].value) == gone).all() and gone.sum() > 35
    assert np.isfinite(record["cabinet_absolute_humidity"].value).all()
