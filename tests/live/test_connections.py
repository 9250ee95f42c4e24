"""What is reported on change holds while its source is connected: live, offline and from an export alike."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from builders.forecast_case import cabinet_record
from builders.live_case import expect_state
from builders.tracker_case import LATENESS_S, planned

from hygrokf.data.record import Record, Series
from hygrokf.data.toml_form import Place, read_form
from hygrokf.live.batch import Batch
from hygrokf.live.config import MappingForm, source_forms, source_mappings
from hygrokf.live.plan import Plan, SignalReporting
from hygrokf.live.refilter import refilter
from hygrokf.live.service import Service
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.stream import Delivery, SourceState, Stream
from hygrokf.live.storage.export import export
from hygrokf.live.storage.store import Store, open_store, prune
from hygrokf.live.tracker import TrackedCourse, Tracker, offline_course
from hygrokf.live.turbine import Turbine
from hygrokf.live.turbines import CONNECTED, SOURCE, Fleet

HOUR_S = 3600.0
DOOR = "door_open"
HOURS, ROUND_S = 36.0, 1200.0
LOST_H, REGAINED_H = 16.0, 21.0
SINCE_H, UNTIL_H = 15.0, 24.0
"""The last change of the door that is told before its source is lost, and the first one after it."""


@pytest.fixture(scope="module")
def whole() -> Record:
    """Three days with a door that is opened and closed every three hours, told when it changes alone."""
    made = cabinet_record(3.0)
    hours = np.arange(0.0, 72.0, 3.0)
    told = (hours <= SINCE_H) | (hours >= UNTIL_H)
    edges, value = made.start_s + HOUR_S * hours[told], (hours[told] / 3.0) % 2.0
    door = Series(DOOR, edges, value, longest_hold_s=math.inf)
    return replace(made, series=(*made.series, door))


@pytest.fixture(scope="module")
def record(whole: Record) -> Record:
    return whole.window(whole.start_s, whole.start_s + HOURS * HOUR_S)


@pytest.fixture(scope="module")
def door_plan(whole: Record) -> Plan:
    made = planned(whole)
    values = {**made.values, "door_conductance": 1.0, "door_exchange": 1.0}
    return replace(
        made, values=values, forms={**made.forms, DOOR: SignalReporting("previous", longest_hold_s=math.inf)}
    )


def tracked(
    folder: Path, plan: Plan, record: Record, noticed_s: float, restarts: int = 0, down_h: float = 0.0
) -> Store:
    """A store after rounds of twenty minutes, with the door's source lost for five hours, which is noticed
    after a time; the tracker begins anew after every so many rounds, and once after `down_h`."""
    store = open_store(f"sqlite:{folder / 'live.db'}")
    turbines, mapping = {"T1": Turbine(plan)}, record_mapping(record, "T1")
    fleet, messages = Fleet.from_store(turbines, store), record_messages(record, "T1")
    lost_s, regained_s = (record.start_s + HOUR_S * hour for hour in (LOST_H, REGAINED_H))
    down = (record.start_s + 28.0 * HOUR_S, record.start_s + (28.0 + down_h) * HOUR_S)
    for number in range(1, 1 + int((record.end_s - record.start_s) / ROUND_S)):
        now = record.start_s + ROUND_S * number
        if down[0] < now < down[1]:
            continue
        if down[0] <= now - ROUND_S < down[1] or (restarts and number % restarts == 0):
            fleet = Fleet.from_store(turbines, store)
            store.commit(fleet.note_connections(now, {"T1": {DOOR: math.inf}}, begins=True))
        while messages and messages[0][0] <= now:
            first = [Delivery(content, now) for at, content in messages[:50] if at <= now]
            del messages[: len(first)]
            store.commit(fleet.round(first, mapping, "mqtt:"))
        for second in (0.0, ROUND_S - 10.0):
            at = now + second
            since = lost_s if lost_s + noticed_s <= at < regained_s else None
            store.commit(fleet.note_connections(at, {"T1": {DOOR: since}}))
            store.commit(fleet.filter_waiting(Batch()))
    return store


def exported(store: Store, folder: Path, record: Record) -> Record:
    """The record that an export holds."""
    export(store, folder)
    readings, losses = (pd.read_csv(folder / f"{one}.csv") for one in ("observation", "connection"))

    def seconds(stamps: pd.Series) -> np.ndarray:
        return (pd.to_datetime(stamps, utc=True) - pd.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy()

    def read(series: Series) -> Series:
        own, lost = (frame[frame.signal == series.signal] for frame in (readings, losses))
        ends = np.nan_to_num(seconds(lost.regained_utc), nan=np.inf)
        spans = tuple(zip(seconds(lost.lost_utc).tolist(), ends.tolist(), strict=True))
        return replace(series, time=seconds(own.time_utc), value=own.value_si.to_numpy(), lost=spans)

    return record.replace_series(*map(read, record.series))


def expect_equal(tracker: Tracker, offline: TrackedCourse) -> None:
    assert tracker.newest - tracker.point.time < LATENESS_S + HOUR_S
    expect_state(tracker.point, offline)


@pytest.mark.parametrize(
    ("noticed_s", "restarts", "begins_h"),
    [(900.0, 7, LOST_H), (2.0 * HOUR_S, 0, None)],
    ids=["with restarts", "later than estimates are final"],
)
def test_a_door_is_unknown_while_its_source_is_lost_live_and_offline(
    tmp_path: Path, record: Record, door_plan: Plan, noticed_s: float, restarts: int, begins_h: float | None
) -> None:
    """A loss begins no earlier than what was final when it was noticed."""
    store = tracked(tmp_path, door_plan, record, noticed_s, restarts)
    ((lost, regained),) = store.losses("T1")[DOOR]
    lost_h, regained_h = ((at - record.start_s) / HOUR_S for at in (lost, regained))
    assert regained_h == pytest.approx(REGAINED_H, abs=0.17)
    expected_h = LOST_H + (noticed_s - LATENESS_S) / HOUR_S if begins_h is None else begins_h
    assert lost_h == pytest.approx(expected_h, abs=0.35 if begins_h is None else 1e-3)
    read = exported(store, tmp_path / "out", record)
    assert read[DOOR].lost == ((lost, regained),)
    offline = offline_course(door_plan, read)
    tracker = Fleet.from_store({"T1": Turbine(door_plan)}, store).tracked["T1"].tracker
    expect_equal(tracker, offline)
    t = offline.run.timeline
    hours, door = (offline.seconds - record.start_s) / HOUR_S, t.input(DOOR)
    assert (door[(hours > SINCE_H + 0.01) & (hours <= lost_h)] == 1.0).all()
    assert (
        door[(hours > lost_h + 0.01) & (hours <= regained_h)] == door_plan.design.actuator_means[DOOR]
    ).all()
    assert (door[(hours > regained_h + 0.01) & (hours < UNTIL_H)] == 1.0).all()
    without = offline_course(door_plan, record)
    assert not np.array_equal(without.trace.mean[-1], offline.trace.mean[-1])
    before = store.point("T1")
    refilter(store, {"T1": Turbine(door_plan)})
    assert store.point("T1").state.mean.tobytes() == before.state.mean.tobytes()
    for until, kept in ((regained, True), (regained + 1.0, False)):
        assert prune(store, "T1", record.end_s, until, 10**6) > 0 and (DOOR in store.losses("T1")) == kept
    store.close()


def test_what_is_not_tracked_is_not_connected(tmp_path: Path, record: Record, door_plan: Plan) -> None:
    """A tracker that is down for three hours has lost its connections from when it last knew them."""
    store = tracked(tmp_path, door_plan, record, math.inf, 9, down_h=3.0)
    ((lost, regained),) = store.losses("T1")[DOOR]
    assert (lost - record.start_s) / HOUR_S == pytest.approx(28.33, abs=0.01)
    assert (regained - record.start_s) / HOUR_S == pytest.approx(31.0, abs=0.02)
    assert store.memory(SOURCE, CONNECTED) > record.end_s - ROUND_S
    tracker = Fleet.from_store({"T1": Turbine(door_plan)}, store).tracked["T1"].tracker
    expect_equal(tracker, offline_course(door_plan, exported(store, tmp_path / "out", record)))
    store.close()


class TurbineMemory(Stream):
    """A source whose state is set by hand."""

    def __init__(self, url: str, *given: object) -> None:
        super().__init__(*given)
        self.url, self._state = url, SourceState("connected", "")


def test_a_signal_is_lost_when_all_its_sources_are(tmp_path: Path, record: Record, door_plan: Plan) -> None:
    now = record.end_s
    mapping = record_mapping(record, "T1")
    sources = [TurbineMemory(f"mqtt://{name}", mapping, lambda: now) for name in "ab"]
    service = Service({"T1": Turbine(door_plan)}, sources, f"sqlite:{tmp_path / 'live.db'}")

    def unreached(later: float) -> dict[str, dict[str, float | None]]:
        return service._unreached(service.reaches(), now + later)

    assert unreached(0.0) == {"T1": {DOOR: None}}
    for source in sources:
        source._state = SourceState("waiting", "")
        assert unreached(59.0) == {"T1": {DOOR: math.inf if source is sources[1] else None}}
    assert unreached(61.0) == {"T1": {DOOR: now}}
    sources[0]._state = SourceState("connected", "")
    assert unreached(61.0) == {"T1": {DOOR: None}}
    sources[0].played_back = sources[1].played_back = True
    assert unreached(61.0) == {}


def test_a_sender_that_has_left_is_lost(record: Record, door_plan: Plan) -> None:
    fleet = Fleet({"T1": Turbine(door_plan)})
    now, reached = record.start_s, {"T1": {DOOR: None}}
    assert fleet.note_connections(now, reached).losses == []
    (loss,) = fleet.note_connections(now + 10.0, reached, ["T1"]).losses
    assert (loss.signal, loss.lost, loss.regained) == (DOOR, now + 10.0, None)
    (loss,) = fleet.note_connections(now + 20.0, reached).losses
    assert (loss.lost, loss.regained) == (now + 10.0, now + 20.0)


def test_what_switches_holds_while_connected_where_changes_are_reported() -> None:
    """Unless an age is stated; from files it is three usual intervals, as that of a power is anywhere."""

    def forms(url: str, **said: str) -> dict[str, SignalReporting]:
        place = Place()
        signals = {
            "Door": {"signal": "door_open", "unit": "1", **said},
            "P": {"signal": "active_power", "unit": "kW"},
        }
        stated = {"signals": signals}
        sources = [{"url": url}, {"url": "file:more.csv"}]
        mappings = source_mappings(read_form(MappingForm, stated, place), stated, sources, place)
        found = source_forms(mappings, sources, place)
        assert place.faults == []
        return {name: form.longest_hold_s for name, form in found.items()}

    for url in ("mqtt://broker", "mqtts://broker", "opc.tcp://server"):
        assert forms(url) == {DOOR: math.inf, "active_power": None}
        assert forms(url, longest_hold="2h")[DOOR] == 7200.0
    assert forms("file:live.csv") == {DOOR: None, "active_power": None}
