"""A reading that the filter's prediction excludes is flagged at once; ordinary data are not."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hygrokf.data.record import Record
from hygrokf.live.alarms import CONTRADICTION_SD, Innovation, contradiction_level, innovations
from hygrokf.live.batch import Batch
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import offline_course
from hygrokf.live.turbines import Fleet, Turbine
from hygrokf.live.web.views import turbine_view

RECORD = {"seed": 7, "days": 4.0}

HUMIDITY = "cabinet_relative_humidity"


def test_the_level_is_that_of_the_prediction_s_own_bounds() -> None:
    level = contradiction_level(Innovation(HUMIDITY, 0.0, 0.45, 0.77, 0.004))
    assert level.level == pytest.approx(0.32 / 0.004 / CONTRADICTION_SD)
    (statement,) = level.statements
    assert statement.text.endswith("reads 45.0 %, where the estimate expects 77.0 (76.2 … 77.8)")
    assert contradiction_level(Innovation(HUMIDITY, 0.0, 0.45, 0.77, 0.2)).level < 0.5  # wide bounds say less


def test_a_humidity_sensor_at_its_ceiling_reads_at_least_its_reading() -> None:
    assert Innovation(HUMIDITY, 0.0, 1.02, 1.10, 0.005).deviations == 0.0
    assert Innovation(HUMIDITY, 0.0, 1.02, 0.70, 0.005).deviations == pytest.approx(0.295 / 0.005)


def test_ordinary_data_and_steps_of_a_sensor(record: Record, turbine: Turbine) -> None:
    """Of 1,200 ordinary readings none is flagged, of those with a step of 15 % or 3 K 99 % and more."""
    found = innovations(offline_course(turbine.plan, record))
    assert len(found) > 600
    assert all(abs(one.deviations) < CONTRADICTION_SD for one in found)
    for signal, step in ((HUMIDITY, 0.15), ("cabinet_temperature", 3.0)):
        some = [one for one in found if one.signal == signal]
        for side in (-step, step):
            beyond = [abs(one.deviations + side / one.sd) >= CONTRADICTION_SD for one in some]
            assert np.mean(beyond) > 0.98


def test_a_reading_that_contradicts_is_flagged_once_its_estimate_is_final(
    store: Store, record: Record, turbine: Turbine
) -> None:
    mapping = record_mapping(record, "T1")
    fleet = Fleet.from_store({"T1": turbine}, store)
    rows = record_messages(record, "T1")
    places = [i for i, (_, content) in enumerate(rows) if HUMIDITY in content]
    place = places[int(0.6 * len(places))]
    at = rows[place][0]
    store.commit(fleet.round([Delivery(json.dumps(c), at) for _, c in rows[:place]], mapping, "file"))
    assert fleet.open_alarms() == []
    step = 0.3 if rows[place][1][HUMIDITY] < 0.5 else -0.3
    wrong = rows[place][1][HUMIDITY] + step
    # for an hour: what returns within half an hour, the gate keeps out
    stepped = [
        (t, {**c, HUMIDITY: c[HUMIDITY] + step} if HUMIDITY in c and t < at + 3600.0 else c)
        for t, c in rows[place:]
    ]
    alarms = []
    for stamp, content in stepped:
        batch = fleet.round([Delivery(json.dumps(content), stamp + 2.0)], mapping, "file")
        store.commit(batch)
        alarms += batch.alarms
        if alarms:
            break
    assert 1800.0 <= stamp - at <= 2700.0  # the lateness, and the ambient, on another clock, at its time
    (alarm,) = alarms
    assert (alarm.kind, alarm.began) == ("reading contradicts", at)
    assert f"reads {100.0 * wrong:.1f} %, where the estimate expects" in alarm.statement
    view = turbine_view(store, "T1", at - 3600.0, at, needs=turbine.plan.needs)
    assert [one["signal"] for one in view["signals"] if one["contradicts"]] == [HUMIDITY]
    # a reading that is too high may be water, and counts as such
    assert view["state"] == ("at risk" if step > 0.0 else "alarm")
    # a restart does not judge it again
    again = Fleet.from_store({"T1": turbine}, store)
    store.commit(again.filter_waiting(Batch()))
    assert [one.kind for one in again.open_alarms()] == ["reading contradicts"]
    # the estimate follows the ordinary readings that come later, and the alarm ends
    done = next(i for i, (t, _) in enumerate(stepped) if t > stamp)
    later = [Delivery(json.dumps(c), t + 2.0) for t, c in stepped[done:300]]
    store.commit(again.round(later, mapping, "file"))
    assert again.open_alarms() == []
