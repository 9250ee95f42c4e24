"""A turbine that is tracked in many tests: its record, its plan, how its messages are read."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from builders.store_case import queried
from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.data.record import Record
from hygrokf.identification.fit import Fit
from hygrokf.live.plan import Plan, SignalReporting, plan
from hygrokf.live.sources.local import Playback
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import open_store
from hygrokf.live.tracker import Point, TrackedCourse, offline_course
from hygrokf.live.turbine import Turbine
from hygrokf.modelling.design import CASCADE, design, merged

SIGNALS = (
    "cabinet_temperature", "cabinet_relative_humidity", "ambient_temperature", "ambient_relative_humidity",
    "active_power",
    "preheating",
)  # fmt: skip


def live_record(folder: Path, seed: int, days: float) -> Record:
    """A synthetic turbine's record, with the signals that its model reads."""
    made = read_case(write_case(synthetic_turbine(seed=seed, days=days), folder))
    return replace(made, series=tuple(s for s in made.series if s.signal in SIGNALS))


def live_fit(record: Record, **known: float) -> Fit:
    """A model at its start values, but for those that are known: what a tracker runs on without an
    identification."""
    base = merged([design(record, kind="thermal"), design(record, kind=CASCADE)])
    return Fit(record.name, base, {p.name: known.get(p.name, p.start) for p in base.model.parameters})


def live_plan(fit: Fit, record: Record, **options: object) -> Plan:
    """The plan of a fit for readings as a record has them."""
    forms = {s.signal: SignalReporting(s.hold, s.interval_s) for s in record.series}
    return plan(fit, forms=forms, site=record.site, rated_power_W=record.rated_power_W, **options)


def live_turbine(record: Record, **known: float) -> Turbine:
    return Turbine(live_plan(live_fit(record, **known), record))


def count_of(record: Record) -> int:
    """How many readings a record has."""
    return sum(int((~s.missing).sum()) for s in record.series)


def expect_state(point: Point, offline: TrackedCourse) -> None:
    """A final state is the offline filter's, bit for bit."""
    last = int(np.searchsorted(offline.seconds, point.time + 1e-3, side="right")) - 1
    assert np.array_equal(point.state.mean, offline.trace.mean[last])
    assert np.array_equal(point.state.covariance, offline.trace.covariance[last])


def expect_offline(url: str, record: Record, turbine: Turbine, name: str = "T1") -> None:
    """Every reading is in the store once, and the state is the offline filter's, bit for bit."""
    store = open_store(url)
    offline = offline_course(turbine.plan, record)
    own = "SELECT COUNT(*) FROM observation WHERE turbine = ?"
    assert queried(store, own, (name,)) == [(count_of(record),)]
    assert queried(store, "SELECT COUNT(*) FROM observation WHERE late = 1 OR contradicted = 1") == [(0,)]
    point = store.point(name)
    expect_state(point, offline)
    rows = queried(
        store, "SELECT time, temperature_K, final FROM estimate WHERE turbine = ? ORDER BY time", (name,)
    )
    times, kelvin, final = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    wrong = (times <= point.time) != (final == 1)
    assert not wrong.any(), (point.time, len(times), times[wrong][:5] - point.time, final[wrong][:5])
    place = np.searchsorted(offline.seconds, times - 1e-3)
    t, states, ratio = (
        offline.run.timeline,
        turbine.plan.model.states,
        turbine.plan.values["resistance_ratio"],
    )
    air = ratio * offline.trace.mean[:, states.index("converter_temperature")]
    air = air + (1.0 - ratio) * t.input("ambient_temperature")
    early = times <= point.time
    assert kelvin[early] == pytest.approx(air[place][early], abs=1e-9)
    seen = np.isfinite(t.y).any(axis=1) & (offline.seconds <= point.time)
    assert set(np.round(offline.seconds[seen])) <= set(np.round(times))
    store.close()


class Halting(Playback):
    """A playback that waits at some shares of its messages, until it is let on or told to end.

    What is done before it is let on happens while messages are still to come, however quick the tracker is.
    """

    def __init__(self, *given: object, halts: Sequence[float] = (), **named: object) -> None:
        super().__init__(*given, **named)
        self._halts = {1 + int(share * len(self.messages)): threading.Event() for share in sorted(halts)}

    def go_on(self) -> None:
        """Pass the first halt at which it was not let on yet."""
        next(one for one in self._halts.values() if not one.is_set()).set()

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        def halted(one: Delivery) -> None:
            halt = self._halts.get(int(one.place))
            while halt is not None and not halt.wait(0.02):
                if self._ended.is_set():
                    return
            put(one)

        super()._deliver(place, halted)


def without_preheating(record: Record) -> Record:
    """Its gaps are bridged for longer than a tracker waits for: what is final would hang on how messages fall
    into rounds."""
    return replace(record, series=tuple(s for s in record.series if s.signal != "preheating"))
