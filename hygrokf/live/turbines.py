"""All tracked turbines: each round turns deliveries into the batch that the store has to keep.

A round changes nothing but the trackers.  If the store refuses a batch, the fleet is reopened from the store,
and the source repeats the deliveries that were not acknowledged.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from hygrokf.data.structured import structured
from hygrokf.data.timestamps import HOUR_S
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.live.alarms import (
    CHANGED,
    ESTIMATE_RULES,
    LOST,
    STALE,
    SUSPECT,
    Estimated,
    Level,
    Rule,
    Standing,
    estimate_levels,
    judge,
    shift_levels,
    source_levels,
    stale_levels,
    with_doubts,
)
from hygrokf.live.batch import Alarm, Batch, Estimates, Event, Observation
from hygrokf.live.changes import Change, settled
from hygrokf.live.condition import Condition, Surface, air_condition, inputs_of, only
from hygrokf.live.fault_isolation import EVERY_S as ISOLATE_S
from hygrokf.live.fault_isolation import Finding
from hygrokf.live.forecast import LIMIT, ForecastMade
from hygrokf.live.plan import Plan
from hygrokf.live.properties import (
    LASTING_S,
    ParameterShift,
    TrackedState,
    parameter_shifts,
    properties,
    states_of,
)
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_formats import Refused
from hygrokf.live.sources.stream import Delivery, SourceState
from hygrokf.live.storage.store import Store, state_of, state_text
from hygrokf.live.tracker import SAME_S, Course, Point, Tracker

PROPERTY_S = HOUR_S
"""[s] between two stored rows of a property."""
THIN_S = 600.0
"""[s] between two stored estimates of a cabinet without sensors."""
STALE_S = 2.0 * HOUR_S
SOURCE = ""
"""Name under which counts, alarms and memories that belong to no turbine are kept."""


@dataclass(frozen=True)
class Turbine:
    """A turbine to be tracked: its plan and its coldest surface.

    `errors`: the fit's standard errors of the tracked properties; `limit` [1]: relative humidity for
    forecasts and restart advice; `stale_s` [s]: age above which its data are stale; `verdicts`: the fit's
    verdicts on its numbers; `heating_sd_K`: standard error of the effect of its heaters.
    """

    plan: Plan
    surface: Surface = field(default_factory=Surface)
    errors: Mapping[str, float] = field(default_factory=dict)
    limit: float = LIMIT
    stale_s: float = STALE_S
    verdicts: Mapping[str, Inherited] = field(default_factory=dict)
    heating_sd_K: float = 0.0


@dataclass(frozen=True)
class KeptState:
    """The states of a filter at `time` [s] as text (`state_text`), in a turbine's memory."""

    time: float
    state: str


class Fleet:
    """The trackers by turbine, and the data that each turbine carries from round to round."""

    def __init__(self, turbines: Mapping[str, Turbine]) -> None:
        self.turbines = dict(turbines)
        self.trackers = {name: Tracker(one.plan) for name, one in turbines.items()}
        self.shifts: dict[str, dict[str, ParameterShift]] = defaultdict(dict)
        self.standings: dict[str, dict[str, Standing]] = defaultdict(dict)
        self.faults: dict[str, str] = {}
        self.forecast_made_s: dict[str, float] = {}
        self.findings: dict[str, Finding] = {}
        self.changes: dict[str, list[Change]] = defaultdict(list)
        # what shifts are judged against after a stated change: states of properties, and the whole state
        self.references: dict[str, dict[str, TrackedState]] = {}
        self.reference_points: dict[str, Point] = {}
        # turbines with readings that are not yet filtered, longest waiting first
        self.waiting: dict[str, None] = {}
        self._slots: dict[str, float] = {}
        self._warned: dict[str, float] = {}
        self._began = math.inf
        self._counted: dict[str, Counter[str]] = defaultdict(Counter)

    @classmethod
    def from_store(cls, turbines: Mapping[str, Turbine], store: Store) -> Fleet:
        """The fleet in the state that the store holds."""
        store.add_turbines({name: digest(one.plan) for name, one in turbines.items()})
        fleet = cls(turbines)
        for name, one in turbines.items():
            point = store.point(name)
            since = -math.inf if point is None else point.time - one.plan.context_s
            known = store.memories(name)
            fleet.changes[name] = structured(list[Change], known.get("changes", []))
            times = [change.time for change in fleet.changes[name]]
            fleet.trackers[name] = Tracker(one.plan, point, store.readings(name, since), times)
            fleet.waiting[name] = None  # committed readings may not have been filtered yet
            pairs = structured(dict[str, tuple[float, float]], known.get("references", {}))
            fleet.references[name] = {key: TrackedState(*pair) for key, pair in pairs.items()}
            if known.get("reference_point"):
                kept = structured(KeptState, known["reference_point"])
                fleet.reference_points[name] = Point(kept.time, state_of(kept.state))
            shifts = known.get("parameter_shifts", known.get("departures", {}))  # older stores
            fleet.shifts[name] = structured(dict[str, ParameterShift], shifts)
            fleet.standings[name] = structured(dict[str, Standing], known.get("alarms", {}))
            if known.get("finding"):
                fleet.findings[name] = structured(Finding, known["finding"])
            if "forecast" in known:
                fleet.forecast_made_s[name] = structured(ForecastMade, known["forecast"]).made
        fleet.standings[SOURCE] = structured(dict[str, Standing], store.memory(SOURCE, "alarms") or {})
        return fleet

    def round(
        self,
        deliveries: Sequence[Delivery],
        mapping: PayloadMapping,
        source: str = "",
        filter_s: float = math.inf,
    ) -> Batch:
        """Read the deliveries of one source by its mapping, and filter the turbines that they belong to.

        The batch contains all deliveries; turbines that are not filtered within `filter_s` [s] wait for the
        next round.
        """
        batch = Batch()
        counts: Counter[tuple[str, str]] = Counter()
        touched: dict[str, list[Observation]] = defaultdict(list)
        for one in deliveries:
            try:
                found = mapping.read(one.content, one.received, one.topic)
            except Refused as fault:
                counts[SOURCE, fault.kind] += 1
                continue
            for turbine, stated, rejections in found:
                readings = [reading.at_whole_microsecond() for reading in stated]
                counts.update((turbine, rejection.kind) for rejection in rejections)
                if mapping.weather:
                    batch.weather += [Observation(turbine, r, one.received) for r in readings]
                elif readings:
                    is_late = self.trackers[turbine].is_late
                    touched[turbine] += [Observation(turbine, r, one.received, is_late(r)) for r in readings]
        for name, observations in touched.items():
            tracker = self.trackers[name]
            tracker.take(one.reading for one in observations)
            batch.observations += observations
            self.waiting.setdefault(name)
            counts.update({(name, kind): n for kind, n in (tracker.counts - self._counted[name]).items()})
            self._counted[name] = Counter(tracker.counts)
        batch.counters = dict(counts)
        places = [one.place for one in deliveries if one.place]
        if source and places:
            batch.place[source] = places[-1]
        for one in deliveries:
            batch.memories.update({(source, name): data for name, data in one.memories.items()})
        self.filter_waiting(batch, filter_s)
        return batch

    def filter_waiting(self, batch: Batch, filter_s: float = math.inf) -> Batch:
        """Filter waiting turbines for `filter_s` [s], longest waiting first and at least one; returns the
        batch."""
        end = time.monotonic() + filter_s
        courses: dict[str, Course] = {}
        while self.waiting:
            name = next(iter(self.waiting))
            del self.waiting[name]
            course = self._advance(name)
            if course is not None:
                courses[name] = course
            if time.monotonic() >= end:
                break
        found = conditions({name: (self.turbines[name], course) for name, course in courses.items()})
        for name, course in courses.items():
            self._add_results(name, course, found[name], batch)
        return batch

    def _advance(self, name: str) -> Course | None:
        try:
            course = self.trackers[name].advance()
        except ValueError as fault:  # no reading is lost: all are in the tracker and in the batch
            self.faults[name] = str(fault)
            return None
        self.faults.pop(name, None)
        return course

    def _add_results(self, name: str, course: Course, found: Condition, batch: Batch) -> None:
        """Put estimates, properties and alarms that follow from a course into the batch."""
        point = self.trackers[name].point
        if len(found.time_s):
            final = 0 if point is None else int(np.sum(found.time_s <= point.time + SAME_S))
            batch.estimates[name] = Estimates(found, final, float(course.seconds[0]))
        if point is None:
            return
        batch.points[name] = point
        self._watch_properties(name, self.turbines[name].plan, course, point.time, batch)
        self._judge_estimates(name, found, batch)

    def _watch_properties(self, name: str, plan: Plan, course: Course, final_s: float, batch: Batch) -> None:
        """Update properties and parameter shifts once per hour of final estimates, however many hours came at
        once."""
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
            references = self._references(name, at, states, Point(at, course.state(int(i))), batch)
            self.shifts[name] = parameter_shifts(self.shifts[name], at, states, errors, references)
            batch.memories[name, "parameter_shifts"] = {k: asdict(d) for k, d in self.shifts[name].items()}

    def _references(
        self, name: str, at: float, states: Mapping[str, TrackedState], point: Point, batch: Batch
    ) -> Mapping[str, TrackedState] | None:
        """The states against which shifts are judged at a time [s]; None for the fit's values."""
        if not self.changes[name] or at < self.changes[name][-1].time:
            return None
        before = self.references.get(name, {})
        found = settled(before, self.changes[name][-1].time, at, states)
        if found != before:
            self.references[name] = found
            batch.memories[name, "references"] = {key: list(one) for key, one in found.items()}
        if found and not before:
            self.reference_points[name] = point
            kept = KeptState(at, state_text(point.state))
            batch.memories[name, "reference_point"] = asdict(kept)
        return found

    def take_events(self, events: Iterable[Event]) -> Batch:
        """Take stated changes into account that are not known yet: what had shifted is expected, and its
        alarms end."""
        batch = Batch()
        for event in events:
            name = event.turbine
            if name not in self.trackers or event.id in [one.event for one in self.changes[name]]:
                continue
            tracker = self.trackers[name]
            self.changes[name].append(Change(event.id, tracker.note_change(event.time)))
            self.changes[name].sort(key=lambda one: one.time)
            self.shifts[name], self.references[name] = {}, {}
            self.findings.pop(name, None)
            self.reference_points.pop(name, None)
            batch.memories[name, "changes"] = [asdict(one) for one in self.changes[name]]
            for key, nothing in (("parameter_shifts", {}), ("references", {}), ("finding", None)):
                batch.memories[name, key] = nothing
            batch.memories[name, "reference_point"] = None
            newest = tracker.newest_state
            if newest is not None:
                self._judge(name, newest.time, [], (CHANGED, SUSPECT), batch)
            self.waiting[name] = None
        return batch

    def _judge_estimates(self, name: str, found: Condition, batch: Batch) -> None:
        """Judge alarms at every estimate newer than the last one judged."""
        after = self._warned.get(name, -math.inf)
        for i in np.flatnonzero(found.time_s > after):
            now = Estimated(found, int(i), self.shifts[name], self.findings.get(name))
            levels = estimate_levels(now, self.turbines[name].verdicts)
            self._judge(name, float(found.time_s[i]), levels, ESTIMATE_RULES, batch)
        self._warned[name] = max(after, float(found.time_s[-1]))

    def tick(
        self, now: float, sources: Mapping[str, SourceState], left: Mapping[str, str] | None = None
    ) -> Batch:
        """Judge alarms about missing data: turbines with stale data at `now` [s], and lost sources.

        left: turbine -> text about a sender that has left.
        """
        batch, left = Batch(), left or {}
        self._began = min(self._began, now)
        for name, tracker in self.trackers.items():
            ages = {signal: now - time for signal, time in tracker.heard().items()} or {"": now - self._began}
            levels = stale_levels(ages, self.turbines[name].stale_s, left.get(name, ""))
            self._judge(name, now, levels, (STALE,), batch)
        self._judge(SOURCE, now, source_levels(sources), (LOST,), batch)
        return batch

    def isolation_due(self) -> str | None:
        """A turbine with a lasting shift whose cause was not isolated since it became lasting, or not for a
        day."""
        for name, found in self.shifts.items():
            lasting = [one for one in found.values() if one.lasting]
            newest = max((one.since for one in lasting), default=-math.inf) + LASTING_S
            known = self.findings.get(name)
            state = self.trackers[name].newest_state
            if lasting and state and (known is None or known.time_s < max(newest, state.time - ISOLATE_S)):
                return name
        return None

    def open_alarms(self) -> list[Alarm]:
        """The open alarms."""
        return [
            one.alarm for known in self.standings.values() for one in known.values() if one.alarm is not None
        ]

    def keep_finding(self, name: str, finding: Finding) -> Batch:
        """Keep the finding of fault isolation and judge the alarms that it explains."""
        self.findings[name] = finding
        batch = Batch(memories={(name, "finding"): asdict(finding)})
        levels = with_doubts(shift_levels(self.shifts[name], finding), self.turbines[name].verdicts)
        self._judge(name, finding.time_s, levels, (CHANGED, SUSPECT), batch)
        return batch

    def forecast_due(self, every_s: float) -> str | None:
        """The turbine whose forecast is oldest, if it is at least `every_s` [s] old in the turbine's own
        time."""
        best, oldest = None, every_s
        for name, tracker in self.trackers.items():
            if tracker.newest_state is not None:
                age = tracker.newest_state.time - self.forecast_made_s.get(name, -math.inf)
                if age >= oldest:
                    best, oldest = name, age
        return best

    def _judge(
        self, name: str, now: float, levels: list[Level], rules: tuple[Rule, ...], batch: Batch
    ) -> None:
        """Judge the alarms of some rules by their levels."""
        before = self.standings[name]
        after, changed = judge(name, before, now, levels, [rule.kind for rule in rules])
        if after != before:
            self.standings[name] = after
            batch.memories[name, "alarms"] = {key: asdict(one) for key, one in after.items()}
        batch.alarms += changed


def conditions(courses: Mapping[str, tuple[Turbine, Course]]) -> dict[str, Condition]:
    """The condition of each turbine at the instants of its course that the store keeps.

    Turbines of one model are evaluated together, because numpy's overhead exceeds the work for the few
    instants of one.
    """
    by_model: dict[int, list[str]] = defaultdict(list)
    for name, (turbine, _) in courses.items():
        by_model[id(turbine.plan.model)].append(name)
    found: dict[str, Condition] = {}
    for names in by_model.values():
        turbines, runs = zip(*(courses[name] for name in names), strict=True)
        model = turbines[0].plan.model
        kept = [instants_kept(course) for course in runs]
        counts = [len(places) for places in kept]
        inputs = [inputs_of(model, course.run.timeline) for course in runs]
        together = air_condition(
            model,
            {
                p.name: np.repeat([one.plan.values[p.name] for one in turbines], counts)
                for p in model.parameters
            },
            _joined((course.seconds for course in runs), kept),
            {name: _joined((u[name] for u in inputs), kept) for name in model.inputs},
            _joined((course.trace.mean for course in runs), kept),
            _joined((course.trace.covariance for course in runs), kept),
            Surface(
                np.repeat([one.surface.follows for one in turbines], counts),
                np.repeat([one.surface.offset_K for one in turbines], counts),
            ),
        )
        ends = np.cumsum(counts)
        for name, count, end in zip(names, counts, ends.tolist(), strict=True):
            found[name] = only(together, slice(end - count, end))
    return found


def _joined(arrays: Iterable[np.ndarray], kept: Sequence[np.ndarray]) -> np.ndarray:
    """The kept instants of several arrays, one after the other."""
    return np.concatenate([array[places] for array, places in zip(arrays, kept, strict=True)])


def instants_kept(course: Course) -> np.ndarray:
    """Indices of the instants that the store keeps: those with cabinet readings, else one per `THIN_S`;
    always the last one."""
    kept = np.isfinite(course.run.timeline.y).any(axis=1)
    if not kept.any():
        slot = np.floor(course.seconds / THIN_S)
        kept = np.append(True, np.diff(slot) > 0)
    kept[-1] = True
    return np.flatnonzero(kept)


def digest(plan: Plan) -> str:
    """Digest of what a point depends on: the model, its parameter values and the forms of the readings."""
    said = {
        "design": plan.design.to_json(),
        "values": dict(plan.values),
        "fastest": plan.fastest,
        "forms": {name: asdict(form) for name, form in sorted(plan.forms.items())},
    }
    return hashlib.sha256(json.dumps(said, sort_keys=True, default=str).encode()).hexdigest()
