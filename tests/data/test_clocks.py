"""Clocks of sources: summer time by the calendar, and stamps set right."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from hygrokf.data.record import Record, Series, Site
from hygrokf.data.shared_clocks import Shift, shifted, sources
from hygrokf.data.timestamps import summer_time

HOUR_S = 3600.0


@pytest.mark.parametrize(("zone", "america"), [("Europe/Berlin", False), ("America/Chicago", True)])
@pytest.mark.parametrize("year", [2011, 2019, 2020, 2023, 2024, 2026])
def test_summer_time_is_that_of_the_zone(zone: str, america: bool, year: int) -> None:
    first = datetime(year, 1, 1, tzinfo=UTC).timestamp()
    time = np.arange(first, first + 365.0 * 86400.0, 1800.0)
    where = ZoneInfo(zone)
    known = [datetime.fromtimestamp(t, where).dst() != timedelta(0) for t in time]
    assert (summer_time(time, america) == np.array(known)).all()


def written_locally(time: np.ndarray) -> np.ndarray:
    """Stamps of a logger that follows summer time; those that come twice are written once."""
    told = time + HOUR_S * summer_time(time)
    return told[np.concatenate([[True], told[1:] > np.maximum.accumulate(told)[:-1]])]


def test_stamps_in_summer_time_are_set_right() -> None:
    true = datetime(2020, 3, 1, tzinfo=UTC).timestamp() + 600.0 * np.arange(6 * 24 * 260)
    told = written_locally(true)
    series = Series("cabinet_temperature", told, np.zeros(len(told)), source="logger.csv, column 2")
    other = replace(
        series, signal="ambient_temperature", time=true, value=np.zeros(len(true)), source="met.csv"
    )
    record = Record("cabinet", (series, other), site=Site(52.0, 8.0, None))
    assert sources(record) == {"logger.csv": ("cabinet_temperature",), "met.csv": ("ambient_temperature",)}
    right = shifted(record, Shift("logger.csv", -HOUR_S, summer=True))
    found = right["cabinet_temperature"].time
    assert np.isin(found, true).all()
    assert len(true) - len(found) <= 6  # the hour that was written once
    assert (right["ambient_temperature"].time == true).all()


def test_a_shift_that_would_turn_time_back_drops_what_comes_twice() -> None:
    time = datetime(2020, 3, 28, tzinfo=UTC).timestamp() + 600.0 * np.arange(6 * 48)
    record = Record(
        "cabinet", (Series("cabinet_temperature", time, 273.15 + 0.1 * np.arange(len(time)), source="a"),)
    )
    late = shifted(record, Shift("a", -HOUR_S, summer=True))["cabinet_temperature"]
    assert (np.diff(late.time) > 0).all() and len(late.time) < len(time)
