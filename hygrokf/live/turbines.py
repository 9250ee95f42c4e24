"""All tracked turbines: one round takes what was delivered and gives the batch that the store is to keep.

A round has no side effect but on the trackers.  Where the store refuses a batch, the fleet is opened anew from the store,
and the source delivers again what was not acknowledged.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from collections.abc import Mapping as MappingOf
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from hygrokf.live.alarms import (
    CHANGED,
    CONDENSATION,
    LOST,
    STALE,
    SUSPECT,
    Level,
    Standing,
    condensation_level,
    departure_levels,
    judged,
    resting_on,
    source_levels,
    stale_levels,
)
from hygrokf.live.condition import Condition, Surface, air_condition, inputs_of, only
from hygrokf.live.fault_isolation import EVERY_S as INQUIRE_S
from hygrokf.live.fault_isolation import Finding
from hygrokf.live.forecast import LIMIT
from hygrokf.live.plan import Plan
from hygrokf.live.properties import LASTING_S, Departure, departures, properties, states_of
from hygrokf.live.sources.payload import Mapping, Refused, parsed, taken
from hygrokf.live.storage.store import Alarm, Batch, Observation, Store
from hygrokf.live.tracker import SAME_S, Course, Tracker

PROPERTY_S = 3600.0
"""[s] for which the store keeps one row of each property."""
THIN_S = 600.0
"""[s] between two estimates of a turbine whose cabinet nobody measures."""
WARNED = (CONDENSATION.kind, CHANGED.kind, SUSPECT.kind)
"""Kinds of alarms that estimates raise."""
STALE_S = 7200.0
SOURCE = ""
"""Turbine under which what belongs to no turbine is counted."""


@dataclass(frozen=True)
class Delivery:
    """What a source hands over: a payload, its topic, where the source goes on after it, and when it came [s].

    `token` is the source's own: what it needs to acknowledge this delivery.
    """

    content: bytes | str | MappingOf[str, object]
    received: float
    topic: str = ""
    place: str = ""
    token: Any = field(default=None, compare=False)


@dataclass(frozen=True)
class Turbine:
    """A turbine to be tracked: its plan, its coldest surface, and the fit's own uncertainty of its properties.

    `limit` [1] relative humidity that forecasts and the advice for a restart ask for; `stale_s` [s] age from which its data
    are stale; `verdicts` on the numbers of the fit, as it hands them on.
    """

    plan: Plan
    surface: Surface = field(default_factory=Surface)
    errors: MappingOf[str, float] = field(default_factory=dict)
    limit: float = LIMIT
    stale_s: float = STALE_S
    verdicts: MappingOf[str, MappingOf] = field(default_factory=dict)


class Fleet:
    """Trackers by turbine, and what each remembers between rounds."""

    def __init__(self, turbines: MappingOf[str, Turbine]) -> None:
        self.turbines = dict(turbines)
        self.trackers = {name: Tracker(one.plan) for name, one in turbines.items()}
        self.departures: dict[str, dict[str, Departure]] = defaultdict(dict)
        self.standings: dict[str, dict[str, Standing]] = defaultdict(dict)
        self.faults: dict[str, str] = {}
        self.looked: dict[str, float] = {}
        self.findings: dict[str, Finding] = {}
        self.waiting: dict[
            str, None
        ] = {}  # turbines with readings that are not filtered yet, the longest waiting first
        self._slots: dict[str, float] = {}
        self._warned: dict[str, float] = {}
        self._began = math.inf
        self._counted: dict[str, Counter] = defaultdict(Counter)

    @classmethod
    def opened(cls, turbines: MappingOf[str, Turbine], store: Store) -> Fleet:
        """The fleet as the store has it."""
        store.add_turbines({name: digest(one.plan) for name, one in turbines.items()})
        fleet = cls(turbines)
        for name, one in turbines.items():
            point = store.point(name)
            since = -1e18 if point is None else point.time - one.plan.context_s
            fleet.trackers[name] = Tracker(one.plan, point, store.readings(name, since))
            fleet.waiting[name] = None  # what was committed may not have been filtered yet
            known = store.memories(name)
            fleet.departures[name] = {k: Departure(**d) for k, d in known.get("departures", {}).items()}
            fleet.standings[name] = {k: standing_of(d) for k, d in known.get("alarms", {}).items()}
            if "finding" in known:
                fleet.findings[name] = Finding(
                    **{**known["finding"], "alike": tuple(known["finding"]["alike"])}
                )
            if "forecast" in known:
                fleet.looked[name] = known["forecast"]["made"]
        alarms = store.memory(SOURCE, "alarms") or {}
        fleet.standings[SOURCE] = {k: standing_of(d) for k, d in alarms.items()}
        return fleet

    def round(
        self, deliveries: Sequence[Delivery], mapping: Mapping, source: str = "", filter_s: float = math.inf
    ) -> Batch:
        """Take deliveries of one source in, read by its mapping, and filter the turbines that they touch.

        All of them are taken and are in the batch; turbines that are not filtered within `filter_s` [s] wait for the next
        round.
        """
        batch = Batch()
        counts: Counter = Counter()
        touched: dict[str, list[Observation]] = defaultdict(list)
        for one in deliveries:
            try:
                content = parsed(one.content) if isinstance(one.content, bytes | str) else one.content
                found = taken(content, mapping, one.received, one.topic)
            except Refused as fault:
                counts[SOURCE, fault.kind] += 1
                continue
            for kind, n in found.counts.items():
                counts[found.turbine, kind] += n
            if mapping.weather:
                batch.weather += [Observation(found.turbine, r, one.received) for r in found.readings]
                continue
            tracker = self.trackers[found.turbine]
            touched[found.turbine] += [
                Observation(found.turbine, r, one.received, tracker.is_late(r)) for r in found.readings
            ]
        for name, observations in touched.items():
            tracker = self.trackers[name]
            tracker.take(one.reading for one in observations)
            batch.observations += observations
            self.waiting.setdefault(name)
            if tracker.counts != self._counted[name]:
                counts.update({(name, kind): n for kind, n in (tracker.counts - self._counted[name]).items()})
                self._counted[name] = Counter(tracker.counts)
        batch.counters = dict(counts)
        places = [one.place for one in deliveries if one.place]
        if source and places:
            batch.place[source] = places[-1]
        self.filtered(batch, filter_s)
        return batch

    def filtered(self, batch: Batch, filter_s: float = math.inf) -> Batch:
        """Filter turbines that wait for `filter_s` [s], the longest waiting first, one at least; the batch with what that gives."""
        end = time.monotonic() + filter_s
        courses: dict[str, Course] = {}
        while self.waiting:
            name = next(iter(self.waiting))
            del self.waiting[name]
            course = self._advanced(name)
            if course is not None:
                courses[name] = course
            if time.monotonic() >= end:
                break
        found = conditions({name: (self.turbines[name], course) for name, course in courses.items()})
        for name, course in courses.items():
            self._follow(name, course, found[name], batch)
        return batch

    def _advanced(self, name: str) -> Course | None:
        try:
            course = self.trackers[name].advance()
        except (
            ValueError
        ) as fault:  # nothing of the readings is lost: they are in the tracker, and in the batch
            self.faults[name] = str(fault)
            return None
        self.faults.pop(name, None)
        return course

    def _follow(self, name: str, course: Course, found: Condition, batch: Batch) -> None:
        """What follows from a course and its condition."""
        point = self.trackers[name].point
        if len(found.time_s):
            final = 0 if point is None else int(np.sum(found.time_s <= point.time + SAME_S))
            batch.estimates[name] = (found, final, float(course.seconds[0]))
        if point is None:
            return
        batch.points[name] = point
        self._watch(name, self.turbines[name].plan, course, point.time, batch)
        self._warn(name, found, batch)

    def _watch(self, name: str, plan: Plan, course: Course, final_s: float, batch: Batch) -> None:
        """Properties and departures, once an hour of final estimates, however many came at once."""
        slots = np.floor(course.seconds / PROPERTY_S)
        before = self._slots.get(name, -math.inf)
        begins = (slots > np.append(before, slots[:-1])) & (course.seconds <= final_s + SAME_S)
        for i in np.flatnonzero(begins):
            at, errors = float(course.seconds[i]), self.turbines[name].errors
            mean, covariance = course.trace.mean[i], course.trace.covariance[i]
            states = states_of(plan.model, mean, covariance, at, self.trackers[name].heard())
            if not states:
                return
            self._slots[name] = slots[i]
            batch.properties.append((name, at, properties(states, plan.values, errors)))
            self.departures[name] = departures(self.departures[name], at, states, errors)
            batch.memories[name, "departures"] = {k: asdict(d) for k, d in self.departures[name].items()}

    def _warn(self, name: str, found: Condition, batch: Batch) -> None:
        """Alarms by every estimate that is newer than the last one judged, and the properties."""
        after = self._warned.get(name, -math.inf)
        for i in np.flatnonzero(found.time_s > after):
            levels = condensation_level(found, int(i)) + departure_levels(
                self.departures[name], self.findings.get(name)
            )
            levels = resting_on(levels, self.turbines[name].verdicts)
            self._judge(name, float(found.time_s[i]), levels, WARNED, batch)
        self._warned[name] = max(after, float(found.time_s[-1]))

    def tick(self, now: float, sources: MappingOf[str, tuple[str, str]]) -> Batch:
        """Alarms by what did not come: turbines whose data are old at `now` [s], and sources that are lost."""
        batch = Batch()
        self._began = min(self._began, now)
        for name, tracker in self.trackers.items():
            ages = {signal: now - time for signal, time in tracker.heard().items()} or {"": now - self._began}
            self._judge(name, now, stale_levels(ages, self.turbines[name].stale_s), (STALE.kind,), batch)
        self._judge(SOURCE, now, source_levels(sources), (LOST.kind,), batch)
        return batch

    def asked(self) -> str | None:
        """A turbine of which something departs that lasts, and which was not inquired into since or for a day."""
        for name, found in self.departures.items():
            lasting = [one for one in found.values() if one.lasting]
            newest = max((one.since for one in lasting), default=-math.inf) + LASTING_S
            known = self.findings.get(name)
            state = self.trackers[name].newest_state
            if lasting and state and (known is None or known.time_s < max(newest, state.time - INQUIRE_S)):
                return name
        return None

    def open_alarms(self) -> list[Alarm]:
        """Alarms that have begun and not ended."""
        return [
            one.alarm for known in self.standings.values() for one in known.values() if one.alarm is not None
        ]

    def answered(self, name: str, finding: Finding) -> Batch:
        """What an inquiry found is remembered and said."""
        self.findings[name] = finding
        batch = Batch(memories={(name, "finding"): asdict(finding)})
        levels = departure_levels(self.departures[name], finding)
        levels = resting_on(levels, self.turbines[name].verdicts)
        self._judge(name, finding.time_s, levels, (CHANGED.kind, SUSPECT.kind), batch)
        return batch

    def due(self, every_s: float) -> str | None:
        """The turbine whose last forecast is oldest, where it is older than `every_s` [s] of its own time."""
        best, oldest = None, every_s
        for name, tracker in self.trackers.items():
            if tracker.newest_state is not None:
                age = tracker.newest_state.time - self.looked.get(name, -math.inf)
                if age >= oldest:
                    best, oldest = name, age
        return best

    def _judge(
        self, name: str, now: float, levels: list[Level], kinds: tuple[str, ...], batch: Batch
    ) -> None:
        """Alarms of these kinds by their levels."""
        before = self.standings[name]
        after, changed = judged(name, before, now, levels, kinds)
        if after != before:
            self.standings[name] = after
            batch.memories[name, "alarms"] = {key: asdict(one) for key, one in after.items()}
        batch.alarms += changed


def standing_of(data: MappingOf) -> Standing:
    """A standing from what the store has of it."""
    alarm = data["alarm"]
    return Standing(data["since"], None if alarm is None else Alarm(**alarm))


def conditions(courses: MappingOf[str, tuple[Turbine, Course]]) -> dict[str, Condition]:
    """The condition of each turbine at the instants of its course that the store keeps.

    Turbines of one model are looked at together: for the few instants of one alone numpy takes longer to begin than to end.
    """
    alike: dict[int, list[str]] = defaultdict(list)
    for name, (one, _) in courses.items():
        alike[id(one.plan.model)].append(name)
    found: dict[str, Condition] = {}
    for names in alike.values():
        several = [courses[name] for name in names]
        model = several[0][0].plan.model
        kept = [instants_kept(course) for _, course in several]
        counts = [len(places) for places in kept]
        parts = [inputs_of(model, course.run.timeline) for _, course in several]
        together = air_condition(
            model,
            {
                p.name: np.repeat([one.plan.values[p.name] for one, _ in several], counts)
                for p in model.parameters
            },
            _joined(course.seconds[k] for (_, course), k in zip(several, kept, strict=True)),
            {n: _joined(u[n][k] for u, k in zip(parts, kept, strict=True)) for n in model.inputs},
            _joined(course.trace.mean[k] for (_, course), k in zip(several, kept, strict=True)),
            _joined(course.trace.covariance[k] for (_, course), k in zip(several, kept, strict=True)),
            Surface(
                np.repeat([one.surface.follows for one, _ in several], counts),
                np.repeat([one.surface.offset_K for one, _ in several], counts),
            ),
        )
        ends = np.cumsum(counts)
        for name, count, end in zip(names, counts, ends.tolist(), strict=True):
            found[name] = only(together, slice(end - count, end))
    return found


def _joined(arrays: Iterable[np.ndarray]) -> np.ndarray:
    return np.concatenate(list(arrays))


def instants_kept(course: Course) -> np.ndarray:
    """Places of a course's instants that the store keeps: those of the cabinet's readings, or a few, and the last one."""
    kept = np.isfinite(course.run.timeline.y).any(axis=1)
    if not kept.any():
        slot = np.floor(course.seconds / THIN_S)
        kept = np.append(True, np.diff(slot) > 0)
    kept[-1] = True
    return np.flatnonzero(kept)


def digest(plan: Plan) -> str:
    """What a point belongs to: the model, its values, and how readings are given."""
    said = {
        "design": plan.design.to_json(),
        "values": dict(plan.values),
        "fastest": plan.fastest,
        "forms": {name: asdict(form) for name, form in sorted(plan.forms.items())},
    }
    return hashlib.sha256(json.dumps(said, sort_keys=True, default=str).encode()).hexdigest()
