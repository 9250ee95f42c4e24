"""Corrected values: every version is kept, the last one counts until its instant is final, and after that
once the store is filtered anew."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from builders.live_case import count_of, live_turbine
from builders.store_case import queried

from hygrokf.data.record import Record
from hygrokf.live.condition import Surface
from hygrokf.live.refilter import refilter
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.payload_formats import Content
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.turbine import Turbine
from hygrokf.live.turbines import Fleet

RECORD = {"seed": 6, "days": 4.0}

T = "cabinet_temperature"
ALARMS = "SELECT id, severity, began, ended, statement FROM alarm ORDER BY id"


@pytest.fixture(scope="module")
def cold(record: Record) -> Turbine:
    return replace(live_turbine(record), surface=Surface(0.0, -2.0))


def filled(folder: Path, turbine: Turbine, record: Record, messages: list[tuple[float, Content]]) -> Store:
    """A store after the messages, in rounds of 40."""
    store = open_store(f"sqlite:{folder / 'live.db'}")
    fleet, mapping = Fleet.from_store({"T1": turbine}, store), record_mapping(record, "T1")
    for first in range(0, len(messages), 40):
        part = [Delivery(content, at) for at, content in messages[first : first + 40]]
        store.commit(fleet.round(part, mapping, "file:"))
    return store


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, record: Record, cold: Turbine) -> Iterator[Store]:
    """A store to which the right values came alone."""
    made = filled(tmp_path_factory.mktemp("right"), cold, record, record_messages(record, "T1"))
    yield made
    made.close()


def results(store: Store) -> list[object]:
    tables = ("estimate WHERE final = 1", "property")
    rows = [queried(store, f"SELECT * FROM {table} ORDER BY time") for table in tables]
    point = store.point("T1")
    return [*rows, point.time, point.state.mean.tobytes(), store.memory("T1", "parameter_shifts")]


def corrected(
    record: Record, after: float
) -> tuple[list[tuple[float, Content]], list[tuple[float, Content]]]:
    """The messages with wrong temperatures for two hours of the third day, corrected after so many seconds,
    and the right ones alone."""
    right = record_messages(record, "T1")
    begin = record.start_s + 2.5 * 86400.0
    wrong = {i for i, (at, one) in enumerate(right) if begin <= at < begin + 7200.0 and T in one}
    false = [(at, {**one, T: one[T] + 50.0 * (i in wrong)}) if T in one else (at, one)
        for i, (at, one) in enumerate(right)]  # fmt: skip
    late = [(right[i][0] + after, right[i][1]) for i in wrong]
    again = [(at + 1.0, false[i][1]) for i in wrong for at in (right[i][0] + after,)]
    return sorted([*false, *late, *again], key=lambda one: one[0]), right


def test_before_its_instant_is_final_the_last_version_counts(
    tmp_path: Path, record: Record, cold: Turbine, alone: Store
) -> None:
    """Bit for bit as if the right value had come alone; the first value that comes again is a repetition."""
    messages, right = corrected(record, 600.0)
    store = filled(tmp_path, cold, record, messages)
    assert results(store) == results(alone) and queried(store, ALARMS) == queried(alone, ALARMS)
    count = (len(messages) - len(right)) // 2
    assert store.counters() == {("T1", "revised"): count, ("T1", "repeated"): count}
    assert store.size()["observation"] == count_of(record) and store.size()["revision"] == 2 * count
    assert queried(store, "SELECT DISTINCT number, late FROM revision WHERE value > 325") == [(0, 0)]
    stamp = queried(store, "SELECT time, received FROM revision WHERE number = 1 ORDER BY time")[0]
    assert stamp[1] == stamp[0] + 600.0  # each version has its own arrival
    # a restart knows the versions, too
    again = Fleet.from_store({"T1": cold}, store)
    at, one = next(pair for pair in messages if pair[1].get(T, 0.0) > 325.0)
    store.commit(again.round([Delivery(one, at)], record_mapping(record, "T1")))
    assert store.counters()["T1", "repeated"] == count + 1 and results(store) == results(alone)
    store.close()


def test_a_greater_mark_counts_whatever_comes_last(record: Record, cold: Turbine) -> None:
    fleet, mapping = Fleet({"T1": cold}), record_mapping(record, "T1")
    at = record.start_s
    for mark, value in ((2.0, 292.0), (3.0, 293.0), (1.0, 291.0)):
        fleet.round([Delivery({"turbine": "T1", "time": at, T: value}, at, mark=mark)], mapping)
    assert [one.value for one in fleet.tracked["T1"].tracker.readings()] == [293.0]
    neither = replace(mapping, revision="neither")
    fleet.round([Delivery({"turbine": "T1", "time": at, T: 294.0}, at)], neither)
    assert [math.isnan(one.value) for one in fleet.tracked["T1"].tracker.readings()] == [True]


def test_a_revision_after_that_changes_nothing_until_the_store_is_filtered_anew(
    tmp_path: Path, record: Record, cold: Turbine, alone: Store
) -> None:
    messages, right = corrected(record, 6.0 * 3600.0)
    (tmp_path / "wrong").mkdir()
    uncorrected = filled(tmp_path / "wrong", cold, record, [o for o in messages if o[0] <= record.end_s])
    store = filled(tmp_path, cold, record, messages)
    count = (len(messages) - len(right)) // 2
    assert store.counters() == {("T1", "revised late"): count, ("T1", "repeated"): count}
    before = queried(store, ALARMS)
    assert before == queried(uncorrected, ALARMS) != queried(alone, ALARMS)
    expected = results(alone)
    assert results(store) != expected
    store.close()

    store = open_store(store.url)
    (told,) = refilter(store, {"T1": cold})
    assert results(store) == expected and told.late == count
    assert queried(store, ALARMS) == before  # they were told: history
    differing = set(before) ^ set(queried(alone, ALARMS))
    assert {row[0] for row in differing} and len(told.differences) == len({row[0] for row in differing})
    assert any("would not have begun" in one for one in told.differences)
    assert refilter(store, {"T1": cold})[0].late == 0
    # the tracker goes on from there
    again = Fleet.from_store({"T1": cold}, store)
    assert again.tracked["T1"].tracker.point.time == store.point("T1").time
    store.close()
    uncorrected.close()


def test_readings_that_came_too_late_are_used_too(
    tmp_path: Path, record: Record, cold: Turbine, alone: Store
) -> None:
    right = record_messages(record, "T1")
    begin = record.start_s + 2.0 * 86400.0
    late = [(at + 7200.0, one) for at, one in right if begin <= at < begin + 3600.0 and T in one]
    rest = [pair for pair in right if pair[1] not in [one for _, one in late]]
    messages = sorted([*rest, *late, *late], key=lambda one: one[0])
    store = filled(tmp_path, cold, record, messages)
    # what comes again is a repetition, also where the tracker has forgotten it
    assert store.counters() == {("T1", "late"): len(late), ("T1", "repeated"): len(late)}
    assert refilter(store, {"T1": cold})[0].late == len(late)
    assert results(store) == results(alone)
    store.close()
