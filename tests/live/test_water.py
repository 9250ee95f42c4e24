"""Water or a humidity sensor that errs: condensation is never told less than the sensor itself tells, until a
person says that the sensor is wrong."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.live_case import live_record, live_turbine
from builders.store_case import queried

from hygrokf.data.record import Record
from hygrokf.data.timestamps import HOUR_S
from hygrokf.live.batch import Event
from hygrokf.live.condition import Surface, carry_forward, vapour_from_readings
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import open_store
from hygrokf.live.traces import SENSOR_WRONG, StatedChange, humidity_sensor_trusted
from hygrokf.live.tracker import offline_course
from hygrokf.live.turbine import Turbine, TurbineMemory, conditions
from hygrokf.live.turbines import Fleet
from hygrokf.physics.psychrometrics import GAS_CONSTANT_VAPOUR, dew_point, saturation_pressure_water

SURFACE = Surface(0.0)


@pytest.fixture(scope="module")
def wet(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """A record whose humidity sensor reads three times the humidity from its last day on: the reading itself
    is above the dew point of a wall at ambient temperature at times."""
    record = live_record(tmp_path_factory.mktemp("turbine"), seed=7, days=3.0)
    air = record["cabinet_relative_humidity"]
    late = air.time > record.start_s + 48.0 * HOUR_S
    moist = replace(air, value=np.where(late, np.minimum(3.0 * air.value, 0.99), air.value))
    return record.replace_series(moist)


@pytest.fixture(scope="module")
def turbine(wet: Record) -> Turbine:
    return replace(live_turbine(wet), surface=SURFACE)


def own_margin(record: Record, seconds: np.ndarray) -> np.ndarray:
    """The wall at ambient temperature above the dew point of the readings [K] at times (T,), NaN between."""
    read = {}
    for signal in ("cabinet_temperature", "cabinet_relative_humidity"):
        series = record[signal]
        there = dict(zip(series.time.tolist(), series.value.tolist(), strict=True))
        read[signal] = np.array([there.get(at, np.nan) for at in seconds.tolist()])
    outside = np.interp(seconds, record["ambient_temperature"].time, record["ambient_temperature"].value)
    pressure = read["cabinet_relative_humidity"] * saturation_pressure_water(read["cabinet_temperature"])
    return outside - dew_point(pressure)


def test_the_probability_is_never_below_the_readings_own(wet: Record, turbine: Turbine) -> None:
    course = offline_course(turbine.plan, wet)
    found = conditions({"T1": (turbine, course)})["T1"]
    margin = own_margin(wet, found.time_s)
    assert np.sum(margin < -0.1) > 20
    assert (found.condensation[margin < -0.01] >= 0.5).all()
    assert (found.margin_K.value[margin < -0.1] < 0.0).all()  # the other quantities fit to it
    stated = TurbineMemory(changes=[StatedChange("e1", wet.start_s, SENSOR_WRONG)])
    alone = conditions({"T1": (turbine, course)}, {"T1": stated})["T1"]
    assert (alone.condensation <= found.condensation).all() and not np.isfinite(alone.excess_g_m3).any()
    assert alone.condensation[margin < -0.1].min() < 0.5  # the filter takes it for the sensor's error


def test_the_excess_of_the_newest_reading_is_carried_on(wet: Record, turbine: Turbine) -> None:
    excess = np.array([np.nan, 1.0, np.nan, np.nan, -0.5, np.nan])
    assert np.array_equal(carry_forward(excess), [np.nan, 1.0, 1.0, 1.0, -0.5, -0.5], equal_nan=True)
    assert np.array_equal(carry_forward(excess, 2.0), [2.0, 1.0, 1.0, 1.0, -0.5, -0.5])
    # a silent sensor clears nothing: the excess stays
    silent_s = wet.end_s - 6.0 * HOUR_S
    early = wet.window(wet.start_s, silent_s)
    cut = wet.replace_series(*(s for s in early.series if s.signal.startswith("cabinet_")))
    course = offline_course(turbine.plan, cut)
    found = conditions({"T1": (turbine, course)})["T1"]
    after = found.time_s > silent_s
    assert after.sum() >= 34 and len(set(found.excess_g_m3[after])) == 1


def test_what_readings_show() -> None:
    """Equation (5): c* = e/(R_v T_amb); of two sensors the moister one."""
    kelvin, outside = np.array([293.15, 293.15, 293.15]), np.array([283.15, 283.15, 283.15])
    readings = {
        "cabinet_relative_humidity": np.array([0.5, np.nan, 0.5]),
        "cabinet_absolute_humidity": np.array([np.nan, 9.0, 9.0]),
    }
    own = 0.5 * 2339.0 / (1e-3 * GAS_CONSTANT_VAPOUR * 283.15)  # e_s(20 °C) = 2339 Pa (Sonntag 1990)
    expected = [own, 9.0 * 293.15 / 283.15, 9.0 * 293.15 / 283.15]
    assert vapour_from_readings(readings, kelvin, outside) == pytest.approx(expected, rel=1e-3)
    assert np.isnan(vapour_from_readings({}, kelvin, outside)).all()


@pytest.mark.parametrize(
    ("kinds", "trusted"),
    [
        ((), [True, True, True]),
        (("settings changed", "defect repaired"), [True, True, True]),
        ((SENSOR_WRONG,), [True, False, False]),
        ((SENSOR_WRONG, "defect repaired"), [True, False, True]),
    ],
)
def test_only_a_statement_about_the_sensor_takes_its_word_away(
    kinds: Sequence[str], trusted: list[bool]
) -> None:
    changes = [StatedChange(f"e{i}", 100.0 * (i + 1), kind) for i, kind in enumerate(kinds)]
    assert humidity_sensor_trusted(changes, np.array([50.0, 150.0, 250.0])).tolist() == trusted


def test_a_fleet_tells_it_until_a_person_says_otherwise(
    tmp_path: Path, wet: Record, turbine: Turbine
) -> None:
    """In pieces, over restarts and after other events as in one; from the statement on the model's."""
    store = open_store(f"sqlite:{tmp_path / 'live.db'}")
    mapping = record_mapping(wet, "T1")
    rows = list(record_messages(wet, "T1"))
    stated = wet.start_s + 60.0 * HOUR_S
    kinds = {56.0: "settings changed", 60.0: SENSOR_WRONG}
    fleet = Fleet.from_store({"T1": turbine}, store)
    for hours in range(0, 72, 4):
        if kind := kinds.get(float(hours)):
            at = wet.start_s + hours * HOUR_S
            store.note_event(Event(f"e{hours}", "T1", at, kind, "", at, "me"))
            store.commit(fleet.take_events(store.all_events()))
        begin = wet.start_s + hours * HOUR_S
        part = [row for row in rows if begin <= row[0] < begin + 4.0 * HOUR_S]
        store.commit(fleet.round([Delivery(json.dumps(row), at) for at, row in part], mapping))
        if hours % 12 == 8:
            fleet = Fleet.from_store({"T1": turbine}, store)
    query = "SELECT time, condensation FROM estimate WHERE turbine = 'T1' ORDER BY time"
    time, chance = np.array(queried(store, query)).T
    margin = own_margin(wet, time)
    condenses = (margin < -0.01) & (time > wet.start_s + 48.0 * HOUR_S)
    assert (condenses & (time < stated)).any() and (chance[condenses & (time < stated)] >= 0.5).all()
    assert store.memory("T1", "excess") is None and not np.isfinite(fleet.tracked["T1"].tracker.excess)
    store.close()
