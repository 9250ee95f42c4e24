"""A backlog that is played in raises no alarm about silent data; a source that falls silent does."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from hygrokf.data.record import Record
from hygrokf.live.batch import Batch
from hygrokf.live.clock_levels import GAINED_S, QUIET_S, Backlogs
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Reading
from hygrokf.live.turbine import Turbine
from hygrokf.live.turbines import Fleet

RECORD = {"seed": 6, "days": 2.0}

HOUR_S, DAY_S = 3600.0, 86400.0


def reading(at: float) -> list[Reading]:
    return [Reading("cabinet_temperature", at, 300.0)]


def test_stamps_that_outrun_the_clock_are_a_backlog() -> None:
    found = Backlogs()
    for minute in range(0, 600, 10):  # always an hour late
        found.note("mqtt", "A", reading(60.0 * minute), HOUR_S + 60.0 * minute)
        assert not found.delivering("mqtt", HOUR_S + 60.0 * minute)
    now = HOUR_S + 36_000.0
    found.note("mqtt", "A", reading(36_000.0), now)
    found.note("mqtt", "A", reading(36_000.0 + GAINED_S + 1.0), now + 1.0)
    assert found.delivering("mqtt", now + 2.0) and not found.delivering("file", now)
    assert found.awaited("A", now + QUIET_S) and not found.awaited("A", now + QUIET_S + 2.0)
    found.note("file", "C", reading(now), now)
    assert found.awaited("B", now + 2.0)  # its source is not known yet
    assert not found.awaited("C", now + 2.0)  # its source delivers no backlog


def test_repeated_readings_and_a_clock_that_is_set_back_are_no_backlog_for_long() -> None:
    found = Backlogs()
    for _ in range(5):
        for at in (0.0, 600.0, 1200.0):
            found.note("mqtt", "A", reading(at), 1200.0)
    assert found.delivering("mqtt", 1200.0)  # two readings at once
    for minute in range(0, 120, 10):
        found.note("mqtt", "A", reading(1800.0 + 60.0 * minute), 1800.0 - HOUR_S + 60.0 * minute)
    assert not found.delivering("mqtt", 1800.0 - HOUR_S + 7200.0)


@pytest.mark.parametrize("order", ["by time", "by turbine"])
def test_a_day_that_is_played_in_raises_no_alarm(
    store: Store, record: Record, turbine: Turbine, order: str
) -> None:
    """The tracker was away for a day, and its broker delivers it within twenty minutes; one turbine has been
    silent since before, and after the backlog another one falls silent."""
    names = ("T1", "T2", "T3")
    mapping = replace(record_mapping(record, "T1"), turbines={name: name for name in names})
    rows = record_messages(record, "")
    away = [row for row in rows if row[0] > record.end_s - DAY_S]
    before = [row for row in rows if row[0] <= record.end_s - DAY_S]

    def deliveries(part: list, name: str, now: float) -> list[Delivery]:
        return [Delivery(json.dumps({**content, "turbine": name}), now) for _, content in part]

    fleet = Fleet.from_store(dict.fromkeys(names, turbine), store)
    for name in names:
        store.commit(fleet.round(deliveries(before, name, before[-1][0] + 2.0), mapping, "mqtt"))
    store.commit(fleet.tick(before[-1][0] + 10.0, {}))
    fleet = Fleet.from_store(dict.fromkeys(names, turbine), store)
    now, alarms = record.end_s, []
    pieces = [(name, away[i : i + 60]) for name in names[:2] for i in range(0, len(away), 60)]
    if order == "by time":
        pieces.sort(key=lambda one: one[1][0][0])

    def passed(batch: Batch) -> None:
        store.commit(batch)
        alarms.extend((one.turbine, one.kind, one.ended is None) for one in batch.alarms)

    for name, part in pieces:
        passed(fleet.round(deliveries(part, name, now), mapping, "mqtt"))
        passed(fleet.tick(now, {}))
        old = fleet.tracked["T3"].assessment
        assert (old.state, old.reason) == ("stale", "the estimate is old; a backlog is being delivered")
        now += 1200.0 / len(pieces)
    assert not [one for one in alarms if one[1] in ("data stale", "signal missing")]
    assert fleet.tracked["T1"].assessment.state in ("ok", "off")
    # the backlog is delivered: T1 goes on, T2 falls silent, T3 has been silent all the time
    until = now + 3.0 * HOUR_S
    while now < until:
        live = {"turbine": "T1", "time": now, **{s.signal: float(s.value[-1]) for s in record.series}}
        passed(fleet.round([Delivery(json.dumps(live), now)], mapping, "mqtt"))
        passed(fleet.tick(now, {}))
        now += 120.0
        if now < record.end_s + 1200.0 + 0.5 * HOUR_S:
            assert ("T2", "data stale", True) not in alarms
    assert ("T3", "data stale", True) in alarms and ("T2", "data stale", True) in alarms
    assert ("T1", "data stale", True) not in alarms
    assert {name: fleet.tracked[name].assessment.state for name in names[1:]} == {
        "T2": "stale",
        "T3": "stale",
    }
