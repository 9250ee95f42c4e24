"""Rounds of a fleet into a store: what is stored is the offline filter's, also after crashes anywhere."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hygrokf.case import read_case
from hygrokf.design import CASCADE, design, merged
from hygrokf.fit import Fit
from hygrokf.live.fleet import Delivery, Fleet, Turbine
from hygrokf.live.payload import Field, Mapping
from hygrokf.live.plan import Form, plan
from hygrokf.live.store import Store, open_store
from hygrokf.live.tracker import whole
from hygrokf.record import Record
from hygrokf.synthetic import synthetic_turbine, write_case

SOURCE = "replay:"


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return read_case(write_case(synthetic_turbine(seed=6, days=4.0), tmp_path_factory.mktemp("turbine")))


@pytest.fixture(scope="module")
def turbine(record: Record) -> Turbine:
    base = merged([design(record, kind="thermal"), design(record, kind=CASCADE)])
    fit = Fit(record.name, base, {p.name: p.start for p in base.model.parameters}, {})
    forms = {s.signal: Form(s.hold, s.interval_s) for s in record.series}
    return Turbine(plan(fit, forms=forms, site=record.site, rated_power_W=record.rated_power_W))


@pytest.fixture(scope="module")
def mapping(record: Record) -> Mapping:
    """SI units, and stamps as the record has them."""
    units = {"cabinet_temperature": "K", "ambient_temperature": "K", "active_power": "W", "wind_speed": "m/s"}
    fields = {
        s.signal: Field(s.signal, units.get(s.signal, "1"), Form(s.hold, s.interval_s))
        for s in record.series
        if s.signal in units or "humidity" in s.signal or s.signal == "preheating"
    }
    return Mapping(fields, turbines={"T1": "T1"})


def deliveries(record: Record, mapping: Mapping) -> list[Delivery]:
    """One message a signal and stamp, in the order of time."""
    found = []
    for s in record.series:
        if s.signal in mapping.fields:
            found += [
                (t, s.signal, v) for t, v in zip(s.time.tolist(), s.value.tolist(), strict=True) if v == v
            ]
    found.sort()
    return [
        Delivery(json.dumps({"turbine": "T1", "time": t, signal: v}), received=t + 2.0, place=str(i + 1))
        for i, (t, signal, v) in enumerate(found)
    ]


def opened(tmp_path: Path) -> Store:
    return open_store(f"sqlite:{tmp_path / 'live.db'}")


def used(record: Record, mapping: Mapping) -> Record:
    """The record as messages carry it."""
    from dataclasses import replace

    return replace(record, series=tuple(s for s in record.series if s.signal in mapping.fields))


def check(store: Store, record: Record, turbine: Turbine, mapping: Mapping, messages: list[Delivery]) -> None:
    """Every message is in the store once, and the state is the offline filter's, bit for bit."""
    offline = whole(turbine.plan, used(record, mapping))
    assert store.size()["observation"] == len(messages)
    assert store.rows("SELECT COUNT(*) FROM observation WHERE late = 1 OR contradicted = 1") == [(0,)]
    point = store.point("T1")
    last = int(np.searchsorted(offline.seconds, point.time + 1e-3, side="right")) - 1
    assert np.array_equal(point.state.mean, offline.trace.mean[last])
    assert np.array_equal(point.state.covariance, offline.trace.covariance[last])
    rows = store.rows("SELECT time, temperature_K, final FROM estimate WHERE turbine = 'T1' ORDER BY time")
    times, kelvin, final = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    assert np.all(final[times <= point.time] == 1) and np.all(final[times > point.time] == 0)
    place = np.searchsorted(offline.seconds, times - 1e-3)
    states = turbine.plan.model.states
    ratio = turbine.plan.values["resistance_ratio"]
    t = offline.run.timeline
    air = ratio * offline.trace.mean[:, states.index("converter_temperature")]
    air = air + (1.0 - ratio) * t.input("ambient_temperature")
    early = times <= point.time
    assert kelvin[early] == pytest.approx(air[place][early], abs=1e-9)
    seen = np.isfinite(t.y).any(axis=1) & (offline.seconds <= point.time)
    assert set(np.round(offline.seconds[seen])) <= set(np.round(times))


def test_rounds_end_in_the_offline_filter(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: Mapping
) -> None:
    store, messages = opened(tmp_path), deliveries(record, mapping)
    fleet = Fleet.opened({"T1": turbine}, mapping, store)
    for first in range(0, len(messages), 37):
        store.commit(fleet.round(messages[first : first + 37], SOURCE))
    check(store, record, turbine, mapping, messages)
    assert store.place(SOURCE) == str(len(messages))
    assert store.counters() == {}
    hours = len(store.rows("SELECT DISTINCT time FROM property"))
    assert 60 <= hours <= 97  # one an hour over four days at most; the point moves in steps of up to two
    store.close()


@pytest.mark.parametrize("seed", range(3))
def test_a_crash_anywhere_loses_nothing_and_counts_nothing_twice(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: Mapping, seed: int
) -> None:
    """The process dies before or after a commit; the source delivers again what was not acknowledged, and some more."""
    random = np.random.default_rng(seed)
    store, messages = opened(tmp_path), deliveries(record, mapping)
    fleet, first, crashes = Fleet.opened({"T1": turbine}, mapping, store), 0, 0
    while first < len(messages):
        count = int(random.integers(1, 120))
        batch = fleet.round(messages[first : first + count], SOURCE)
        dies = random.random()
        if dies > 0.15:
            store.commit(batch)
        if dies < 0.3:
            crashes += 1
            store.close()
            store = opened(tmp_path)
            fleet = Fleet.opened({"T1": turbine}, mapping, store)
            # at least once: a broker may deliver again what was committed and not acknowledged
            first = max(int(store.place(SOURCE) or 0) - int(random.integers(0, 60)), 0)
        else:
            first += count
    assert crashes >= 5
    check(store, record, turbine, mapping, messages)
    store.close()


def test_what_is_refused_is_counted_and_changes_nothing(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: Mapping
) -> None:
    store, messages = opened(tmp_path), deliveries(record, mapping)[:600]
    clean = Fleet.opened({"T1": turbine}, mapping, store)
    dirty = Fleet({"T1": turbine}, mapping)
    rubbish = [
        Delivery(b"\x00\xff", 1e9), Delivery('{"turbine": "T2", "time": 1.6e9}', 1.7e9), Delivery("[" * 5000, 1e9),
        Delivery(json.dumps({"turbine": "T1", "time": messages[0].received, "cabinet_temperature": 1e9}), 1.7e9),
    ]  # fmt: skip
    for first in range(0, len(messages), 50):
        piece = messages[first : first + 50]
        expected = clean.round(piece)
        found = dirty.round([*rubbish, *piece])
        assert found.counters == {
            ("", "malformed"): 1, ("", "unknown turbine"): 1, ("", "too deep"): 1, ("T1", "impossible value"): 1,
        }  # fmt: skip
        assert found.observations == expected.observations
    assert np.array_equal(dirty.trackers["T1"].point.state.mean, clean.trackers["T1"].point.state.mean)
    store.close()


def test_another_model_is_filtered_anew_from_what_is_stored(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: Mapping
) -> None:
    from dataclasses import replace

    store, messages = opened(tmp_path), deliveries(record, mapping)
    fleet = Fleet.opened({"T1": turbine}, mapping, store)
    for first in range(0, 2000, 100):
        store.commit(fleet.round(messages[first : first + 100]))
    other = replace(turbine, plan=replace(turbine.plan, values={**turbine.plan.values, "hygric_k": 0.7}))
    again = Fleet.opened({"T1": other}, mapping, store)
    assert again.trackers["T1"].point is None
    for first in range(2000, len(messages), 100):
        store.commit(again.round(messages[first : first + 100]))
    offline = whole(other.plan, used(record, mapping))
    point = store.point("T1")
    last = int(np.searchsorted(offline.seconds, point.time + 1e-3, side="right")) - 1
    assert np.array_equal(point.state.mean, offline.trace.mean[last])
    store.close()
