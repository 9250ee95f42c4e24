"""Rounds of a fleet into a store: what is stored is the offline filter's, also after crashes anywhere."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from builders.live_case import expect_offline, expect_state
from builders.store_case import queried

from hygrokf.data.record import Record, Series
from hygrokf.data.signals import from_si
from hygrokf.data.timestamps import HOUR_S, zone_named
from hygrokf.live.batch import Batch
from hygrokf.live.condition import Surface
from hygrokf.live.sources.local import record_messages
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_values import Clock
from hygrokf.live.sources.stream import Delivery, Reach
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.tracker import offline_course
from hygrokf.live.turbine import Turbine, conditions
from hygrokf.live.turbines import Fleet
from hygrokf.texts.live_codes import AlarmCode

RECORD = {"seed": 6, "days": 2.0}

SOURCE = "replay:"


def deliveries(record: Record) -> list[Delivery]:
    """One message a signal and stamp, in the order of time."""
    return [
        Delivery(json.dumps(content), received=t + 2.0, place=str(i + 1))
        for i, (t, content) in enumerate(record_messages(record, "T1"))
    ]


def opened(tmp_path: Path) -> Store:
    return open_store(f"sqlite:{tmp_path / 'live.db'}")


@pytest.mark.parametrize("seed", [0, 2])
def test_a_crash_anywhere_loses_nothing_and_counts_nothing_twice(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: PayloadMapping, seed: int
) -> None:
    """The process dies before or after a commit; the source delivers again what was not acknowledged, and
    some more."""
    random = np.random.default_rng(seed)
    store, messages = opened(tmp_path), deliveries(record)
    fleet, first, crashes = Fleet.from_store({"T1": turbine}, store), 0, 0
    while first < len(messages):
        count = int(random.integers(1, 120))
        batch = fleet.round(messages[first : first + count], mapping, SOURCE)
        dies = random.random()
        if dies > 0.15:
            store.commit(batch)
        if dies < 0.3:
            crashes += 1
            store.close()
            store = opened(tmp_path)
            fleet = Fleet.from_store({"T1": turbine}, store)
            # at least once: a broker may deliver again what was committed and not acknowledged
            first = max(int(store.place(SOURCE) or 0) - int(random.integers(0, 60)), 0)
        else:
            first += count
    assert crashes >= 5
    expect_offline(store.url, record, turbine)
    assert set(store.counters()) == {("T1", "repeated")}
    hours = len(queried(store, "SELECT DISTINCT time FROM property"))
    assert 28 <= hours <= 49  # one an hour over two days at most; the point moves in steps of up to two
    store.close()


def test_local_stamps_of_the_repeated_hour_follow_the_order_of_their_own_source(
    turbine: Turbine, mapping: PayloadMapping
) -> None:
    """Delivered 50 min late; another source, or the tracker after a restart, does not know the order."""
    berlin = zone_named("Europe/Berlin")
    mapping = replace(mapping, clock=Clock(berlin))
    name = next(name for name, one in mapping.fields.items() if one.signal == "cabinet_temperature")
    value = float(from_si(300.0, mapping.fields[name].unit, "cabinet_temperature"))
    begin = 1_792_879_200.0  # 2026-10-24T22:00Z: 00:00 in Berlin, three hours before the clocks go back

    def delivery(at: float) -> Delivery:
        local = datetime.fromtimestamp(at, berlin).replace(tzinfo=None).isoformat()
        return Delivery({"turbine": "T1", "time": local, name: value}, at + 3_000.0)

    fleet, times = Fleet({"T1": turbine}), begin + 600.0 * np.arange(30)
    for at in times:
        batch = fleet.round([delivery(at)], mapping, SOURCE, filter_s=0.0)
        assert [one.reading.time for one in batch.observations] == [at]
    for one, source in ((fleet, "file:other"), (Fleet({"T1": turbine}), SOURCE)):
        for at in times[[16, 22]]:  # 02:40, twice
            batch = one.round([delivery(at)], mapping, source, filter_s=0.0)
            assert not batch.observations and sum(batch.counters.values()) == 1
            assert next(iter(batch.counters))[1] == "ambiguous time"


def test_turbines_that_find_no_time_wait_and_lose_nothing(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    """A round filters one turbine of three; the process dies now and then; what was taken is in the store at
    once."""
    names = ("T1", "T2", "T3")
    turbines = dict.fromkeys(names, turbine)
    mapping = replace(mapping, turbines={name: name for name in names})
    rows = [
        (at, {**content, "turbine": name}) for at, content in record_messages(record, "") for name in names
    ]
    messages = [Delivery(content, at + 2.0, place=str(i + 1)) for i, (at, content) in enumerate(rows)]
    store = opened(tmp_path)
    fleet, waited = Fleet.from_store(turbines, store), 0
    for number, first in enumerate(range(0, len(messages), 97)):
        piece = messages[first : first + 97]
        batch = fleet.round(piece, mapping, SOURCE, filter_s=0.0)
        assert len(batch.observations) == len(piece) and len(batch.estimates) <= 1
        store.commit(batch)
        waited += len(fleet.waiting) == 2
        if number % 15 == 14:
            store.close()
            store = opened(tmp_path)
            fleet = Fleet.from_store(turbines, store)
            assert list(fleet.waiting) == list(names)
    assert waited > 20
    while fleet.waiting:
        store.commit(fleet.filter_waiting(Batch(), filter_s=0.0))
    for name in names:
        expect_offline(store.url, record, turbine, name)
    store.close()


def test_what_the_inputs_alone_told_is_final_once_the_point_has_passed_it(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    """Twenty hours with one reading of the cabinet, which arrives with two hours of the inputs after it: the
    point moves to that reading from estimates that were made without it."""
    begin = record.start_s + 18.0 * HOUR_S
    reading_s = begin + 10.0 * HOUR_S

    def thinned(series: Series) -> Series:
        silent = (series.time > begin) & (series.time <= begin + 20.0 * HOUR_S)
        kept = ~silent | (np.abs(series.time - reading_s) < 300.0)
        return replace(series, time=series.time[kept], value=series.value[kept])

    cabinet = [series for series in record.series if series.signal.startswith("cabinet_")]
    record = record.replace_series(*map(thinned, cabinet))
    messages = deliveries(record)
    received = np.array([message.received for message in messages])
    together = np.searchsorted(received, [reading_s - HOUR_S, reading_s + 2.0 * HOUR_S])
    edges = [
        *range(0, together[0], 40),
        *together,
        *range(together[1] + 40, len(messages), 40),
        len(messages),
    ]
    store = opened(tmp_path)
    fleet = Fleet.from_store({"T1": turbine}, store)
    for first, end in pairwise(edges):
        store.commit(fleet.round(messages[first:end], mapping, SOURCE))
    expect_offline(store.url, record, turbine)
    store.close()


def test_turbines_of_one_model_are_looked_at_together(record: Record, turbine: Turbine) -> None:
    """Values, surfaces and instants of their own: the same as each alone."""
    other = replace(
        turbine,
        plan=replace(turbine.plan, values={**turbine.plan.values, "resistance_ratio": 0.7, "hygric_k": 0.9}),
        surface=Surface(0.8, -1.5),
    )
    blind = replace(record, series=tuple(s for s in record.series if not s.signal.startswith("cabinet_")))
    courses = {
        "T1": (turbine, offline_course(turbine.plan, record)),
        "T2": (other, offline_course(other.plan, record.window(record.start_s, record.start_s + 86400.0))),
        "T3": (turbine, offline_course(turbine.plan, blind)),
    }
    assert turbine.plan.model is other.plan.model
    together = conditions(courses)
    for name, course in courses.items():
        (alone,) = conditions({name: course}).values()
        for field, one in vars(alone).items():
            found = getattr(together[name], field)
            if isinstance(one, np.ndarray):
                np.testing.assert_allclose(found, one, rtol=1e-12)
            else:
                np.testing.assert_allclose(found.value, one.value, rtol=1e-12)
                np.testing.assert_allclose(found.sd, one.sd, rtol=1e-9)
    assert len({len(one.time_s) for one in together.values()}) == 3


def test_what_is_refused_is_counted_and_changes_nothing(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    messages = deliveries(record)[:600]
    clean = Fleet.from_store({"T1": turbine}, store)
    dirty = Fleet({"T1": turbine})
    rubbish = [
        Delivery(b"\x00\xff", 1e9), Delivery('{"turbine": "T2", "time": 1.6e9}', 1.7e9),
        Delivery("[" * 5000, 1e9),
        Delivery(json.dumps({"turbine": "T1", "time": messages[0].received, "cabinet_temperature": 1e9}),
            1.7e9),
    ]  # fmt: skip
    for first in range(0, len(messages), 50):
        piece = messages[first : first + 50]
        expected = clean.round(piece, mapping)
        found = dirty.round([*rubbish, *piece], mapping)
        assert found.counters == {
            ("", "malformed"): 1, ("", "unknown turbine"): 1, ("", "too deep"): 1,
            ("T1", "impossible value"): 1,
        }  # fmt: skip
        assert found.observations == expected.observations
    assert np.array_equal(
        dirty.tracked["T1"].tracker.point.state.mean, clean.tracked["T1"].tracker.point.state.mean
    )


def test_another_model_is_filtered_anew_from_what_is_stored(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    messages = deliveries(record)
    fleet = Fleet.from_store({"T1": turbine}, store)
    half = len(messages) // 2
    for first in range(0, half, 100):
        store.commit(fleet.round(messages[first : first + 100], mapping))
    other = replace(turbine, plan=replace(turbine.plan, values={**turbine.plan.values, "hygric_k": 0.7}))
    again = Fleet.from_store({"T1": other}, store)
    assert again.tracked["T1"].tracker.point is None
    for first in range(half, len(messages), 100):
        store.commit(again.round(messages[first : first + 100], mapping))
    expect_state(store.point("T1"), offline_course(other.plan, record))


def test_data_that_stop_and_a_source_that_is_lost_raise_alarms(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    fleet = Fleet.from_store({"T1": turbine, "T2": turbine}, store)
    store.commit(fleet.round(deliveries(record), mapping))
    end, hour = record.end_s, 3600.0

    def ticked(now: float, since: float | None = None) -> list[tuple[str, str, bool]]:
        batch = fleet.tick(now, {"mqtt://broker": Reach(since, 60.0, "refused")})
        if not batch.empty:
            store.commit(batch)
        return [(a.turbine, a.kind, a.ended is None) for a in batch.alarms]

    assert ticked(end + 0.5 * hour) == []
    lost = end + 2.1 * hour - 59.0
    assert ticked(end + 2.1 * hour, lost) == []  # old, but not yet for five minutes; not reached for 59 s
    found = ticked(end + 2.3 * hour, lost)
    assert ("T1", "data stale", True) in found and ("", "source lost", True) in found
    # a turbine that never delivered is stale from the first look on
    assert ("T2", "data stale", True) in ticked(end + 2.8 * hour, lost) + ticked(end + 2.9 * hour, lost)
    again = Fleet.from_store({"T1": turbine, "T2": turbine}, store)
    assert sorted(a.kind for a in again.open_alarms()) == ["data stale", "data stale", "source lost"]
    (stale,) = queried(store, "SELECT statement, remedy FROM alarm WHERE turbine = 'T1'")
    assert stale[0].startswith("no signal has arrived for 2.") and "logger" in stale[1]
    fresh = {"turbine": "T1", "time": end + 3.0 * hour, "cabinet_temperature": 300.0}
    store.commit(fleet.round([Delivery(json.dumps(fresh), end + 3.0 * hour)], mapping))
    assert ("", "source lost", False) in ticked(end + 3.1 * hour)  # the source is back


def test_data_are_stale_once_their_sender_has_left_for_five_minutes(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    fleet = Fleet.from_store({"T1": turbine}, store)
    store.commit(fleet.round(deliveries(record), mapping))
    end, left = record.end_s, {"T1": AlarmCode.SENDER_LEFT(sender="Farm/N1", at=record.end_s)}
    assert fleet.tick(end + 60.0, {}, left).empty or not fleet.open_alarms()
    (alarm,) = fleet.tick(end + 400.0, {}, left).alarms
    assert (alarm.kind, alarm.statements, alarm.ended) == ("data stale", (left["T1"],), None)
    fleet.tick(end + 500.0, {}, {})
    (alarm,) = fleet.tick(end + 900.0, {}, {}).alarms
    assert alarm.ended is not None


def test_a_weather_forecast_is_kept_for_one_turbine_or_for_all(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    fleet = Fleet.from_store({"T1": turbine}, store)
    coming = replace(mapping, weather=True)
    now = record.end_s

    def told(**content: object) -> None:
        store.commit(fleet.round([Delivery(json.dumps(content), now)], coming))

    told(time=now + 86400.0, ambient_temperature=283.15, ambient_relative_humidity=0.8)
    told(time=now + 90000.0, ambient_temperature=284.15)
    assert {(row[0], row[1] - now) for row in store.weather("T1", now)} == {
        ("ambient_temperature", 86400.0), ("ambient_temperature", 90000.0),
        ("ambient_relative_humidity", 86400.0)
    }  # fmt: skip
    told(turbine="T1", time=now + 86400.0, ambient_temperature=285.0)
    assert store.weather("T1", now) == [("ambient_temperature", now + 86400.0, 285.0)]
    told(time=now + 30 * 86400.0, ambient_temperature=283.15)
    assert store.counters() == {("", "impossible time"): 1}
    assert store.size()["observation"] == 0 and fleet.tracked["T1"].tracker.newest == -float("inf")
