"""The store: a batch whole or not at all, every bit back, nothing damaged or foreign overwritten."""

from __future__ import annotations

import math
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.store_case import T0, a_condition, a_state, everything, observed, queried, refused

from hygrokf.live.batch import Alarm, Assessment, Batch, Estimates, Event, Notice, Observation, Shelf
from hygrokf.live.notification import notices as outbox
from hygrokf.live.plan import BEFORE
from hygrokf.live.storage.schema import VERSION
from hygrokf.live.storage.store import Store, open_store, state_of, state_text
from hygrokf.live.tracker import NEITHER, Reading


@pytest.fixture
def store(store_url: str) -> Store:
    made = open_store(store_url)
    yield made
    made.close()


def test_a_batch_comes_back(store: Store) -> None:
    store.add_turbines({"T1": "digest"})
    store.commit(everything())
    assert store.size() == {
        "turbine": 1, "observation": 2, "point": 1, "estimate": 2, "forecast": 0, "weather": 0, "property": 1,
        "alarm": 1, "memory": 1,
        "counter": 2, "source": 1, "claim": 0,
        "held": 0, "assessment": 0, "shelf": 0, "event": 0, "outbox": 0, "revision": 0,
            "connection": 0,
    }  # fmt: skip
    assert store.place("file:live.csv") == "1200" and store.place("file:other.csv") is None
    assert (
        store.memory("T1", "parameter_shifts") == {"hygric_k": [1.0, 2.0]} and store.memory("T1", "x") is None
    )
    assert [one.value for one in store.readings("T1", T0)] == [290.25, 290.5]
    assert store.readings("T1", T0 + 601.0)[-1] == Reading("cabinet_temperature", T0 + 600, 290.5)
    assert store.readings("T2", T0) == []
    assert queried(
        store, "SELECT final, temperature_K, frost_point_K, condensation FROM estimate ORDER BY time"
    ) == [
        (1, 290.0, None, 0.25),
        (0, 290.0, None, 0.25),
    ]
    store.commit(Batch(counters={("T1", "late"): 3}))
    assert store.counters() == {("T1", "late"): 5, ("", "malformed"): 1}


def test_every_bit_of_a_state_comes_back(store: Store) -> None:
    for seed in range(20):
        state = a_state(seed)
        again = state_of(state_text(state))
        assert np.array_equal(again.mean, state.mean) and np.array_equal(again.covariance, state.covariance)
    store.commit(everything())
    point = store.point("T1")
    assert point.time == T0 and np.array_equal(point.state.covariance, a_state().covariance)
    assert store.point("T2") is None


def test_a_batch_that_fails_leaves_nothing(store: Store) -> None:
    store.commit(everything())
    before = store.size()
    broken = everything()
    broken.observations = [observed("rain", T0, 0.0), observed("rain", T0 + 1, None)]  # type: ignore[arg-type]
    broken.place = {"file:live.csv": "9999"}
    with pytest.raises(store.database.errors, match=r"(?i)not.null"):
        store.commit(broken)
    assert store.size() == before and store.place("file:live.csv") == "1200"
    store.commit(Batch(observations=[observed("rain", T0, 0.0)]))
    assert store.size()["observation"] == before["observation"] + 1


def test_repeated_contradicting_and_late_observations(store: Store) -> None:
    """The last version counts, by its mark or by arrival, unless it came too late; all are kept."""

    def committed(at: float, value: float, late: bool = False, mark: float = math.nan) -> None:
        known = store.versions("T1", [("rain", at)]).get(("rain", at), [])
        new = known and value not in [one.value for one in known]
        one = Observation("T1", Reading("rain", at, value, mark), at + 3.0 + len(known), late, bool(new))
        store.commit(Batch(observations=[one, one]))  # committing once more changes nothing

    for at, value in ((1.0, 5.0), (1.0, 5.0), (2.0, 5.0), (2.0, 6.0), (2.0, 5.0)):
        committed(at, value)
    committed(3.0, 7.0, late=True)
    committed(1.0, 9.0, late=True)
    for mark, value in ((7.0, 1.0), (9.0, 2.0), (8.0, 3.0)):
        committed(4.0, value, mark=mark)
    for value in (1.0, 2.0, 1.0):
        committed(5.0, value, mark=NEITHER)
    found = {one.time: one.value for one in store.readings("T1", 0.0)}
    assert sorted(found) == [1.0, 2.0, 4.0, 5.0]  # what came too late was not used
    assert (found[1.0], found[2.0], found[4.0]) == (5.0, 6.0, 2.0) and math.isnan(found[5.0])
    versions = "SELECT time, value, received, late, number FROM revision ORDER BY time, number"
    assert queried(store, versions) == [
        (1.0, 5.0, 4.0, 0, 0), (1.0, 9.0, 5.0, 1, 1), (2.0, 5.0, 5.0, 0, 0), (2.0, 6.0, 6.0, 0, 1),
        (4.0, 1.0, 7.0, 0, 0), (4.0, 2.0, 8.0, 0, 1), (4.0, 3.0, 9.0, 0, 2), (5.0, 1.0, 8.0, 0, 0),
        (5.0, 2.0, 9.0, 0, 1),
    ]  # fmt: skip
    assert queried(store, "SELECT received, mark FROM observation WHERE value = ?", (2.0,)) == [(8.0, 9.0)]
    assert store.revised("T1", 4.5) == {("rain", 5.0): [Reading("rain", 5.0, 1.0), Reading("rain", 5.0, 2.0)]}


def test_a_restart_reads_each_signal_from_some_readings_before(store: Store) -> None:
    """However old those are, and without those that came too late, by signal and time."""
    store.commit(
        Batch(
            observations=[
                *(observed("rain", T0 + i, float(i)) for i in range(-2000, 500, 100)),
                observed("rain", T0 + 250.0, 7.0, late=True),
                observed("active_power", T0 - 1e6, 1.0),
                observed("wind_speed", T0 + 400.0, 3.0),
                Observation("T0", Reading("rain", T0 + 260.0, 9.0), T0),
            ]
        )
    )
    found = [(one.signal, one.time - T0) for one in store.readings("T1", T0 + 270.0)]
    rain = [("rain", 100.0 * i) for i in range(3 - BEFORE, 5)]
    assert found == [("active_power", -1e6), *rain, ("wind_speed", 400.0)]
    assert len(store.readings("T1", -math.inf)) == 27 and store.readings("T9", 0.0) == []


def test_provisional_estimates_are_overtaken(store: Store) -> None:
    store.commit(Batch(estimates={"T1": Estimates(a_condition([T0, T0 + 600, T0 + 900]), 1, T0)}))
    store.commit(Batch(estimates={"T1": Estimates(a_condition([T0 + 600, T0 + 1200], 291.0), 1, T0 + 300)}))
    assert queried(store, "SELECT time, final, temperature_K FROM estimate ORDER BY time") == [
        (T0, 1, 290.0),
        (T0 + 600, 1, 291.0),
        (T0 + 1200, 0, 291.0),
    ]


def test_another_model_begins_anew_from_the_observations(store: Store) -> None:
    store.add_turbines({"T1": "one"})
    store.commit(everything())
    store.add_turbines({"T1": "one"})
    assert store.point("T1") is not None
    store.add_turbines({"T1": "two"})
    assert store.point("T1") is None and store.memory("T1", "parameter_shifts") is None
    assert len(store.readings("T1", 0.0)) == 2


def test_alarms_are_acknowledged_once(store: Store) -> None:
    store.commit(everything())
    known = replace(
        everything().alarms[0], acknowledged=T0 + 5.0, acknowledged_by="control room", cause="look again",
        note="filter ordered", look_again=T0 + 7 * 86400.0,
    )  # fmt: skip
    assert store.acknowledge(known)
    assert not store.acknowledge(replace(known, acknowledged_by="someone else"))
    assert not store.acknowledge(replace(known, id="a2"))
    # a later round ends it and leaves the acknowledgement
    ended = Alarm("a1", "T1", "condensation", "warning", T0, "water condensed", "dry it", ended=T0 + 60.0)
    store.commit(Batch(alarms=[ended]))
    assert queried(store, "SELECT ended, acknowledged_by, cause, note, look_again, statement FROM alarm") == [
        (T0 + 60.0, "control room", "look again", "filter ordered", T0 + 7 * 86400.0, "water condensed")
    ]


def test_readings_ahead_of_the_clock_are_kept_apart_until_they_are_released(store: Store) -> None:
    ahead = [observed("rain", T0 + i, float(i)) for i in range(3)]
    store.commit(Batch(held=ahead))
    store.commit(Batch(held=ahead[:1]))
    assert store.held("T1") == ahead
    assert store.held("T2") == [] and store.readings("T1", 0.0) == []
    assert store.held("T1", T0 + 1.0) == ahead[:2]
    assert store.held_count("T1") == 3 and store.held_count("T2") == 0
    ((turbine, signal, ahead_s),) = store.held_ahead()
    latest, arrival = max(one.reading.time for one in ahead), max(one.received for one in ahead)
    assert (turbine, signal, ahead_s) == ("T1", "rain", pytest.approx(latest - arrival))
    store.commit(Batch(observations=ahead[:2], released=ahead[:2]))
    assert store.held("T1") == ahead[2:] and len(store.readings("T1", 0.0)) == 2


def test_what_an_assessment_resumes_from(store: Store) -> None:
    assert store.newest_estimate("T1") is None and store.outlook("T1") == []
    store.commit(everything())
    newest = queried(store, "SELECT MAX(time) FROM estimate WHERE turbine = 'T1'")[0][0]
    assert store.newest_estimate("T1") == (newest, 0.25)
    assert store.outlook("T1") == []


def test_a_turbine_has_one_state(store: Store) -> None:
    for state, at in (("no estimate", T0), ("ok", T0 + 60.0)):
        store.commit(Batch(assessments=[Assessment("T1", state, "why", at)]))
    assert store.assessments() == {"T1": Assessment("T1", "ok", "why", T0 + 60.0)}
    store.add_turbines({"T1": "digest"})
    assert queried(store, "SELECT turbine, state, reason FROM turbine_now") == [("T1", "ok", "why")]


def test_a_shelf_ends_by_time_or_by_hand(store: Store) -> None:
    first = Shelf("T1", "condensation", T0 + 60.0, T0, "control room", "door open for works")
    later = replace(first, until=T0 + 120.0)
    store.shelve(first)
    store.shelve(later)
    store.shelve(replace(first, turbine="T2"))
    assert store.shelves(T0 + 60.0) == [later] and store.shelves(T0 + 120.0) == []
    assert store.unshelve("T1", "condensation") and not store.unshelve("T1", "condensation")
    assert [one.turbine for one in store.shelves(T0)] == ["T2"]


def test_events_of_a_turbine(store: Store) -> None:
    event = Event("e1", "T1", T0, "settings changed", "heater at 5 °C", T0 + 60.0, "control room")
    store.note_event(event)
    store.note_event(event)
    earlier = replace(event, id="e0", time=T0 - 60.0)
    store.note_event(earlier)
    assert store.events("T1") == [earlier, event] and store.events("T2") == []


def test_a_notice_is_written_once_and_sent_once(store: Store) -> None:
    notices = [Notice(f"n{i}", "mail", '{"alarm": "a1"}', T0, T0 + i) for i in range(3)]
    store.commit(Batch(notices=notices))
    assert outbox.due(store, "mail", T0 + 1.0, 100) == notices[:2]
    outbox.mark_failed(store, ["n0"], "connection refused", T0 + 60.0)
    outbox.mark_sent(store, ["n1"], T0 + 2.0)
    store.commit(Batch(notices=notices))  # the same batch once more, after a restart
    assert outbox.due(store, "mail", T0 + 10.0, 100) == notices[2:]
    failed = replace(notices[0], due=T0 + 60.0, attempts=1, failure="connection refused")
    assert outbox.due(store, "mail", T0 + 60.0, 100) == [notices[2], failed]


def test_what_is_no_store_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    text = tmp_path / "notes.db"
    text.write_text("this is no database, it is a note\n" * 200)
    other = tmp_path / "other.db"
    with sqlite3.connect(other) as connection:
        connection.execute("CREATE TABLE mine (x)")
    connection.close()
    for path, word in ((text, "cannot be read as a store"), (other, "another database")):
        before = path.read_bytes()
        assert word in refused(f"sqlite:{path}")
        assert path.read_bytes() == before
    assert "does not exist" in refused(f"sqlite:{tmp_path / 'none' / 'live.db'}")
    assert "found a directory" in refused(f"sqlite:{tmp_path}")
    assert "expected a store as" in refused("mysql://here/live")


def test_a_folder_without_rights_is_no_damaged_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(path: Path, mode: str) -> None:
        raise sqlite3.OperationalError("unable to open database file")

    monkeypatch.setattr("hygrokf.live.storage.sqlite.connect", refusing)
    monkeypatch.setattr("hygrokf.live.storage.sqlite.os.access", lambda path, mode: False)
    said = refused(f"sqlite:{tmp_path / 'live.db'}")
    assert "write-protected" in said and "restore" not in said


@pytest.mark.parametrize("number", [VERSION - 1, VERSION + 1])
def test_a_store_of_another_schema_is_refused_and_left_as_it_is(store_url: str, number: int) -> None:
    store = open_store(store_url)
    store.commit(everything())
    with store.transaction():
        queried(store, f"UPDATE schema_version SET version = {number}")
    tables = store.size()
    if store_url.startswith("postgresql:"):
        said = refused(store_url)
        assert store.size() == tables
        assert queried(store, "SELECT version FROM schema_version") == [(number,)]
        store.close()
    else:
        # its log is not yet in the file: a copy of both is what a killed tracker leaves
        path = Path(store_url.removeprefix("sqlite:"))
        left = [path.with_name(f"left.db{end}") for end in ("", "-wal")]
        for file, end in zip(left, ("", "-wal"), strict=True):
            shutil.copy(f"{path}{end}", file)
        store.close()
        before = [file.read_bytes() for file in left]
        assert len(before[1]) > 0
        said = refused(f"sqlite:{left[0]}")
        assert [file.read_bytes() for file in left] == before
    assert f"expected a store with schema {VERSION}, found schema {number}" in said
