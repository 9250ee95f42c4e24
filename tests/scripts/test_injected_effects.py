"""Known effects that are put into measured records."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from plants.injection import EFFECTS

from hygrokf.data.record import Record, Series

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture(scope="module", autouse=True)
def path() -> Iterator[None]:
    sys.path.insert(0, str(SCRIPTS))
    yield
    sys.path.remove(str(SCRIPTS))


def part(name: str) -> ModuleType:
    """That module of the battery."""
    return importlib.import_module(f"battery.{name}")


@pytest.fixture(scope="module")
def indoors() -> Record:
    """60 days of hours: a room and a weather station."""
    time = 1.3e9 + 3600.0 * np.arange(1440)
    day, random = 2.0 * np.pi * time / 86400.0, np.random.default_rng(4)
    slow = np.cumsum(random.normal(0.0, 0.3, time.size))
    values = {
        "cabinet_temperature": 285.0 + 3.0 * np.sin(day) + 0.5 * slow,
        "cabinet_relative_humidity": np.clip(0.6 - 0.1 * np.sin(day) + 0.01 * slow, 0.1, 0.95),
        "ambient_temperature": 280.0 + 4.0 * np.sin(day + 0.5) + slow,
    }
    values["cabinet_temperature"][100:110] = np.nan
    series = tuple(
        Series(name, time, value, source="inside" if name.startswith("cabinet") else "station")
        for name, value in values.items()
    )
    return Record("attic R2", series, until_s=float(time[960]))


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_is_put_into_the_readings_inside(indoors: Record, effect: str) -> None:
    measured = part("measured")
    made, account = measured.injected(indoors, effect, 3)
    assert made["ambient_temperature"] == indoors["ambient_temperature"]
    changed = {name for name in measured.INSIDE if made[name] != indoors[name]}
    humidity, temperature = {"cabinet_relative_humidity"}, {"cabinet_temperature"}
    assert (
        changed
        == {
            "clock_shift": humidity | temperature,
            "humidity_drift": humidity,
            "temperature_step": temperature,
            "sorption": humidity,
        }[effect]
    )
    given = account["parameters"]
    heat, damp = account["added_temperature_K"], account["added_absolute_humidity_g_m3"]
    assert account["cause"] == measured.CAUSE_OF[effect] and damp > 0.02
    if effect == "clock_shift":
        moved = made["cabinet_temperature"].time - indoors["cabinet_temperature"].time
        assert np.all(moved == 60.0 * given["late_min"]) and abs(given["late_min"]) == 60.0
    elif effect == "temperature_step":
        assert indoors.start_s < given["date_s"] < indoors.until_s
        jump = made["cabinet_temperature"].value - indoors["cabinet_temperature"].value
        assert np.nanmax(np.abs(jump)) == pytest.approx(abs(given["offset_K"]))
        after = np.mean(indoors["cabinet_temperature"].time >= given["date_s"])
        assert heat == pytest.approx(abs(given["offset_K"]) * math.sqrt(after * (1.0 - after)), rel=0.02)
    elif effect == "sorption":
        low, high = measured.SORPTION_G_M3
        assert 0.9 * low < damp < 1.1 * high
    assert measured.injected(indoors, effect, 3)[1] == account
    assert measured.injected(indoors, effect, 4)[1] != account or effect == "clock_shift"
