"""Stated changes: the tracker equals the offline filter with the same change, and shifts are judged anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders.live_case import expect_state, live_record, live_turbine
from builders.service_case import Acknowledging, in_small_rounds, running
from builders.store_case import queried
from builders.tracker_case import arriving, planned, readings_of
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.live import service as service_module
from hygrokf.live.batch import Alarm, Batch, Event
from hygrokf.live.notification.notices import acknowledge
from hygrokf.live.properties import WATCHED, ParameterShift, TrackedState, deviations, parameter_shifts
from hygrokf.live.service import Service
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import open_store
from hygrokf.live.traces import SETTLED_S, jump_variance, references_after
from hygrokf.live.tracker import Tracker, offline_course
from hygrokf.live.turbine import Turbine
from hygrokf.live.turbines import Fleet


def expect_same(tracker: Tracker, record: Record, changes: list[float]) -> None:
    """The final state is the offline filter's with the same changes, bit for bit."""
    expect_state(tracker.point, offline_course(tracker.plan, record, changes))


@pytest.mark.parametrize(
    ("share", "late_s"), [(0.3, -2 * HOUR_S), (0.5, 0.0), (0.5, 0.2 * DAY_S), (0.9, 0.2 * DAY_S)]
)
def test_a_change_acts_as_in_the_offline_filter(record: Record, share: float, late_s: float) -> None:
    """Known ahead of its time, at it, or hours later, with readings late, repeated and out of order."""
    plan = planned(record)
    readings = arriving(readings_of(record), 3, 1500.0)
    tracker, taken = Tracker(plan), 0
    stated = record.start_s + share * (record.end_s - record.start_s)
    changes: list[float] = []
    for number in range(0, len(readings), 97):
        part = readings[number : number + 97]
        tracker.take(part)
        tracker.advance()
        if not changes and tracker.newest >= stated + late_s:
            changes.append(tracker.note_change(stated))
        if number % 5 == 0:  # a restart
            tracker = Tracker(plan, tracker.point, tracker.readings(), tracker.changes)
        taken += len(part)
    assert len(changes) == 1 and changes[0] >= stated
    assert taken == len(readings)
    expect_same(tracker, record, changes)
    with pytest.raises(AssertionError):
        expect_same(tracker, record, [])


def test_only_the_tracked_properties_jump(record: Record) -> None:
    plan = planned(record)
    variance = dict(zip(plan.model.states, jump_variance(plan.model), strict=True))
    assert {state for state, one in variance.items() if one} == {one.state for one in WATCHED}
    offline = offline_course(plan, record)
    at = float(offline.seconds[len(offline.seconds) // 2])
    changed = offline_course(plan, record, [at])
    early = offline.seconds <= at
    assert np.array_equal(offline.trace.mean[early], changed.trace.mean[early])
    for one in WATCHED:
        i = plan.model.states.index(one.state)
        after = changed.trace.prior_covariance[np.flatnonzero(~early)[0], i, i]
        before = offline.trace.prior_covariance[np.flatnonzero(~early)[0], i, i]
        assert after - before == pytest.approx(one.blind**2, rel=1e-6)


def test_shifts_count_from_the_settled_property() -> None:
    x = {"hygric_k": TrackedState(0.5, 0.02)}
    assert references_after({}, 0.0, SETTLED_S - 1.0, x) == {}
    assert references_after({}, 0.0, SETTLED_S, {"hygric_k": TrackedState(0.5, 0.3)}) == {}
    found = references_after({}, 0.0, SETTLED_S, x)
    assert (
        found == x
        and references_after(found, 0.0, SETTLED_S + 1.0, {"hygric_k": TrackedState(0.9, 0.02)}) == x
    )
    assert parameter_shifts({}, 0.0, deviations(x, {}, {})) == {}
    assert parameter_shifts({}, 0.0, deviations(x, {}, found)) == {}
    assert list(parameter_shifts({}, 0.0, deviations(x, {}))) == ["hygric_k"]
    moved = {"hygric_k": TrackedState(0.8, 0.02)}
    shift = parameter_shifts({}, 0.0, deviations(moved, {}, found))["hygric_k"]
    assert shift == ParameterShift("hygric_k", 0.0, False, pytest.approx(0.3))


def played(fleet: Fleet, record: Record, store_url: str, since: float, until: float) -> None:
    """Rounds of a record's messages, committed."""
    store = open_store(store_url)
    messages = [one for one in record_messages(record, "T1") if since <= one[0] < until]
    mapping = record_mapping(record, "T1")
    for number in range(0, len(messages), 200):
        part = messages[number : number + 200]
        store.commit(fleet.round([Delivery(content, at) for at, content in part], mapping))
    store.close()


def test_an_event_ends_what_it_explains_and_survives_a_restart(tmp_path: Path) -> None:
    """A filter that exchanges half of the air that the cabinet does: shifted, until somebody says so."""
    record = live_record(tmp_path / "record", seed=7, days=16.0)
    turbine: Turbine = live_turbine(record, hygric_k=1.2)
    url = f"sqlite:{tmp_path / 'live.db'}"
    store = open_store(url)
    fleet = Fleet.from_store({"T1": turbine}, store)
    day = record.start_s + 6.0 * DAY_S
    played(fleet, record, url, 0.0, day)
    assert fleet.tracked["T1"].parameter_shifts
    event = Event("e1", "T1", day - HOUR_S, "settings changed", "", day, "me")
    store.note_event(event)
    batch = fleet.take_events(store.all_events())
    store.commit(batch)
    assert fleet.tracked["T1"].parameter_shifts == {} and fleet.take_events(store.all_events()).empty
    fleet = Fleet.from_store({"T1": turbine}, store)
    assert fleet.take_events(store.all_events()).empty
    played(fleet, record, url, day, day + 4.0 * DAY_S)
    assert fleet.tracked["T1"].parameter_shifts == {} and fleet.tracked["T1"].references == {}
    fleet = Fleet.from_store({"T1": turbine}, store)
    played(fleet, record, url, day + 4.0 * DAY_S, record.end_s)
    assert fleet.tracked["T1"].references and fleet.tracked["T1"].parameter_shifts == {}
    again = Fleet.from_store({"T1": turbine}, store)
    assert again.tracked["T1"].references == fleet.tracked["T1"].references
    kept = again.tracked["T1"].reference_point
    assert kept.time == fleet.tracked["T1"].reference_point.time >= day - HOUR_S + SETTLED_S
    (change,) = again.tracked["T1"].changes
    assert change.event == "e1"
    expect_same(fleet.tracked["T1"].tracker, record, [change.time])
    store.close()


def test_a_running_tracker_takes_what_people_state(
    store_url: str, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An event and an alarm that is due again, written over another connection while the tracker runs."""
    monkeypatch.setattr(service_module, "TICK_S", 0.05)
    in_small_rounds(monkeypatch, 100)
    stream = Acknowledging(record, halts=[0.5])
    told: list[Batch] = []
    service = Service({"T1": turbine}, [stream], store_url, told.append)
    with running(service, until_ended=True):
        page = eventually(lambda: service.store is not None) and open_store(store_url)
        eventually(lambda: page.point("T1"))
        stated = record.start_s + 0.4 * (record.end_s - record.start_s)
        page.note_event(Event("e1", "T1", stated, "settings changed", "", stated, "me"))
        alarm = Alarm("a1", "T1", "condensation", "warning", stated, "wet", "dry it")
        page.commit(Batch(alarms=[alarm]))
        assert acknowledge(page, "a1", "me", stated, "look again", look_again_s=1.0) == "T1"
        eventually(lambda: page.memory("T1", "changes"))
        eventually(lambda: queried(page, "SELECT acknowledged FROM alarm WHERE id = 'a1'") == [(None,)])
        assert [one.id for batch in told for one in batch.reopened] == ["a1"]
        stream.go_on()
    (change,) = page.memory("T1", "changes")
    assert change["event"] == "e1" and change["time"] >= stated
    tracker = Tracker(turbine.plan, page.point("T1"))
    page.close()
    expect_same(tracker, record, [change["time"]])
