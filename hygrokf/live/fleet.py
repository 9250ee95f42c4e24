"""All tracked turbines: one round takes what was delivered and gives the batch that the store is to keep.

A round has no side effect but on the trackers.  Where the store refuses a batch, the fleet is opened anew from the store,
and the source delivers again what was not acknowledged.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Mapping as MappingOf
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from hygrokf.live.alarms import Standing, condensation_level, departure_levels, judged
from hygrokf.live.condition import Condition, Quantity, Surface, condition
from hygrokf.live.payload import Mapping, Refused, parsed, taken
from hygrokf.live.plan import Plan
from hygrokf.live.properties import Departure, departures, properties, states_of
from hygrokf.live.store import Alarm, Batch, Observation, Store
from hygrokf.live.tracker import Course, Tracker

PROPERTY_S = 3600.0
"""[s] for which the store keeps one row of each property."""
THIN_S = 600.0
"""[s] between two estimates of a turbine whose cabinet nobody measures."""
SOURCE = ""
"""Turbine under which what belongs to no turbine is counted."""


@dataclass(frozen=True)
class Delivery:
    """What a source hands over: a payload, its topic, where the source goes on after it, and when it came [s]."""

    content: bytes | str | MappingOf[str, object]
    received: float
    topic: str = ""
    place: str = ""


@dataclass(frozen=True)
class Turbine:
    """A turbine to be tracked: its plan, its coldest surface, and the fit's own uncertainty of its properties."""

    plan: Plan
    surface: Surface = field(default_factory=Surface)
    errors: MappingOf[str, float] = field(default_factory=dict)


class Fleet:
    """Trackers by turbine, and what each remembers between rounds."""

    def __init__(self, turbines: MappingOf[str, Turbine], mapping: Mapping) -> None:
        self.turbines = dict(turbines)
        self.mapping = mapping
        self.trackers = {name: Tracker(one.plan) for name, one in turbines.items()}
        self.departures: dict[str, dict[str, Departure]] = defaultdict(dict)
        self.standings: dict[str, dict[str, Standing]] = defaultdict(dict)
        self.faults: dict[str, str] = {}
        self._slots: dict[str, float] = {}
        self._counted: dict[str, Counter] = defaultdict(Counter)

    @classmethod
    def opened(cls, turbines: MappingOf[str, Turbine], mapping: Mapping, store: Store) -> Fleet:
        """The fleet as the store has it."""
        store.add_turbines({name: digest(one.plan) for name, one in turbines.items()})
        fleet = cls(turbines, mapping)
        for name, one in turbines.items():
            point = store.point(name)
            since = -1e18 if point is None else point.time - one.plan.context_s
            fleet.trackers[name] = Tracker(one.plan, point, store.readings(name, since))
            known = store.memory(name, "departures") or {}
            fleet.departures[name] = {key: Departure(**data) for key, data in known.items()}
            known = store.memory(name, "alarms") or {}
            fleet.standings[name] = {key: standing_of(data) for key, data in known.items()}
        return fleet

    def round(self, deliveries: Sequence[Delivery], source: str = "") -> Batch:
        """Take deliveries in and filter every turbine that they touch."""
        batch = Batch()
        counts: Counter = Counter()
        touched: dict[str, list[Observation]] = defaultdict(list)
        for one in deliveries:
            try:
                content = parsed(one.content) if isinstance(one.content, bytes | str) else one.content
                found = taken(content, self.mapping, one.received, one.topic)
            except Refused as fault:
                counts[SOURCE, fault.kind] += 1
                continue
            counts.update({(found.turbine, kind): n for kind, n in found.counts.items()})
            tracker = self.trackers[found.turbine]
            touched[found.turbine] += [
                Observation(found.turbine, r, one.received, tracker.is_late(r)) for r in found.readings
            ]
        for name, observations in touched.items():
            tracker = self.trackers[name]
            tracker.take(one.reading for one in observations)
            batch.observations += observations
            self._filter(name, tracker, batch)
            counts.update({(name, kind): n for kind, n in (tracker.counts - self._counted[name]).items()})
            self._counted[name] = Counter(tracker.counts)
        batch.counters = dict(counts)
        if source and deliveries and deliveries[-1].place:
            batch.place[source] = deliveries[-1].place
        return batch

    def _filter(self, name: str, tracker: Tracker, batch: Batch) -> None:
        one = self.turbines[name]
        try:
            course = tracker.advance()
        except (
            ValueError
        ) as fault:  # nothing of the readings is lost: they are in the tracker, and in the batch
            self.faults[name] = str(fault)
            return
        self.faults.pop(name, None)
        if course is None:
            return
        found, final = conditions(one, course, -np.inf if tracker.point is None else tracker.point.time)
        if len(found.time_s):
            batch.estimates[name] = (found, final, float(course.seconds[0]))
        if tracker.point is None:
            return
        batch.points[name] = tracker.point
        states = states_of(one.plan.model, tracker.point.state.mean, tracker.point.state.covariance)
        at = tracker.point.time
        slot = at // PROPERTY_S
        if states and slot != self._slots.get(name):
            self._slots[name] = slot
            batch.properties.append((name, at, properties(states, one.plan.values, one.errors)))
            self.departures[name] = departures(self.departures[name], at, states, one.errors)
            batch.memories[name, "departures"] = {k: asdict(d) for k, d in self.departures[name].items()}
        self._judge(name, found, batch)

    def _judge(self, name: str, found: Condition, batch: Batch) -> None:
        """Alarms by the newest estimate and the properties."""
        before = self.standings[name]
        levels = condensation_level(found) + departure_levels(self.departures[name])
        after, changed = judged(name, before, float(found.time_s[-1]), levels)
        if after != before:
            self.standings[name] = after
            batch.memories[name, "alarms"] = {key: asdict(one) for key, one in after.items()}
        batch.alarms += changed


def standing_of(data: MappingOf) -> Standing:
    """A standing from what the store has of it."""
    alarm = data["alarm"]
    return Standing(data["since"], None if alarm is None else Alarm(**alarm))


def conditions(one: Turbine, course: Course, final_s: float) -> tuple[Condition, int]:
    """The condition at the instants of a course that the store keeps, and how many of them are final."""
    t, trace = course.run.timeline, course.trace
    seconds = course.seconds
    kept = np.isfinite(t.y).any(axis=1)
    if not kept.any():
        slot = np.floor(seconds / THIN_S)
        kept = np.append(True, np.diff(slot) > 0)
    kept[-1] = True
    found = condition(one.plan.model, one.plan.values, t, trace.mean, trace.covariance, one.surface)
    quantities = {
        name: Quantity(q.value[kept], q.sd[kept])
        for name, q in vars(found).items()
        if isinstance(q, Quantity)
    }
    chance = None if found.condensation is None else found.condensation[kept]
    found = replace(found, time_s=found.time_s[kept], condensation=chance, **quantities)
    return found, int(np.sum(found.time_s <= final_s + 1e-3))


def digest(plan: Plan) -> str:
    """What a point belongs to: the model, its values, and how readings are given."""
    said = {
        "design": plan.design.to_json(),
        "values": dict(plan.values),
        "fastest": plan.fastest,
        "forms": {name: asdict(form) for name, form in sorted(plan.forms.items())},
    }
    return hashlib.sha256(json.dumps(said, sort_keys=True, default=str).encode()).hexdigest()
