"""All tracked turbines: each round turns deliveries into the batch that the store has to keep.

A round changes nothing but the trackers.  If the store refuses a batch, the fleet is reopened from the store,
and the source repeats the deliveries that were not acknowledged.
"""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from hygrokf.data.structured import structured
from hygrokf.data.timestamps import HOUR_S
from hygrokf.live.alarms import (
    CHANGE_RULES,
    CLOCK,
    CONTRADICTS,
    ESTIMATE_RULES,
    LOST,
    MISSING,
    STALE,
    Estimated,
    Level,
    Rule,
    Standing,
    change_levels,
    estimate_levels,
    judge,
    missing_levels,
    source_levels,
    stale_levels,
    with_doubts,
)
from hygrokf.live.backlog import Backlogs
from hygrokf.live.batch import Alarm, Batch, Estimates, Event, Observation
from hygrokf.live.changes import Change, settled
from hygrokf.live.clocks import Clocks, HeldReadings, clock_levels
from hygrokf.live.condition import Condition
from hygrokf.live.contradiction import contradiction_level, innovations
from hygrokf.live.fault_isolation import EVERY_S as ISOLATE_S
from hygrokf.live.fault_isolation import Finding
from hygrokf.live.forecast import Forecast, ForecastMade
from hygrokf.live.plan import Plan
from hygrokf.live.properties import (
    LASTING_S,
    ParameterShift,
    TrackedState,
    deviations,
    parameter_shifts,
    properties,
    states_of,
)
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_formats import Order, Refused
from hygrokf.live.sources.payload_values import AHEAD_S
from hygrokf.live.sources.stream import Delivery, SourceState
from hygrokf.live.states import States
from hygrokf.live.storage.store import Store, state_of, state_text
from hygrokf.live.tracker import SAME_S, Course, Point, Tracker
from hygrokf.live.turbine import STALE_S as STALE_S
from hygrokf.live.turbine import Evidence
from hygrokf.live.turbine import Turbine as Turbine
from hygrokf.live.turbine import conditions as conditions
from hygrokf.live.turbine import digest as digest

PROPERTY_S = HOUR_S
"""[s] between two stored rows of a property."""
SOURCE = ""
"""Name under which counts, alarms and memories that belong to no turbine are kept."""


@dataclass(frozen=True)
class KeptState:
    """The states of a filter at `time` [s] as text (`state_text`), in a turbine's memory."""

    time: float
    state: str


class Fleet:
    """The trackers by turbine, and the data that each turbine carries from round to round.

    Readings that are ahead of the clock are held back in the `store`.
    """

    def __init__(self, turbines: Mapping[str, Turbine], store: Store | None = None) -> None:
        self.turbines = dict(turbines)
        self.trackers = {name: Tracker(one.plan) for name, one in turbines.items()}
        self.shifts: dict[str, dict[str, ParameterShift]] = defaultdict(dict)
        self.deviations: dict[str, dict[str, TrackedState]] = defaultdict(dict)
        self.standings: dict[str, dict[str, Standing]] = defaultdict(dict)
        self.faults: dict[str, str] = {}
        self.forecast_made_s: dict[str, float] = {}
        self.findings: dict[str, Finding] = {}
        # vapour [g/m³] by which the newest humidity reading exceeds the final estimate
        self.excesses: dict[str, float] = {}
        self.changes: dict[str, list[Change]] = defaultdict(list)
        # what shifts are judged against after a stated change: states of properties, and the whole state
        self.references: dict[str, dict[str, TrackedState]] = {}
        self.reference_points: dict[str, Point] = {}
        self.states = States(turbines)
        self.held = HeldReadings(store)
        self.backlogs = Backlogs()
        self.clocks = Clocks(() if store is None else store.held_ahead())
        # turbines with readings that are not yet filtered, longest waiting first
        self.waiting: dict[str, None] = {}
        self._slots: dict[str, float] = {}
        self._warned: dict[str, float] = {}
        self._judged: dict[str, dict[str, float]] = defaultdict(dict)
        self._contradictions: dict[str, dict[str, Level]] = defaultdict(dict)
        self._orders: dict[str, Order] = defaultdict(dict)
        self._now = -math.inf
        self._began = math.inf
        self._counted: dict[str, Counter[str]] = defaultdict(Counter)

    @classmethod
    def from_store(cls, turbines: Mapping[str, Turbine], store: Store) -> Fleet:
        """The fleet in the state that the store holds."""
        store.add_turbines({name: digest(one.plan) for name, one in turbines.items()})
        fleet = cls(turbines, store)
        fleet.states = States.from_store(turbines, store)
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
            pairs = structured(dict[str, tuple[float, float]], known.get("deviations", {}))
            fleet.deviations[name] = {key: TrackedState(*pair) for key, pair in pairs.items()}
            shifts = known.get("parameter_shifts", known.get("departures", {}))  # older stores
            fleet.shifts[name] = structured(dict[str, ParameterShift], shifts)
            fleet.standings[name] = _without_pending(structured(dict[str, Standing], known.get("alarms", {})))
            if known.get("finding"):
                fleet.findings[name] = structured(Finding, known["finding"])
            if known.get("excess") is not None:
                fleet.excesses[name] = structured(float, known["excess"])
            if "forecast" in known:
                fleet.forecast_made_s[name] = structured(ForecastMade, known["forecast"]).made
            newest = fleet.states.estimate_s(name)  # the readings up to it have been judged
            fleet._judged[name] = {} if newest is None else dict.fromkeys(one.plan.model.outputs, newest)
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
        self._now = max((one.received for one in deliveries), default=self._now)
        touched: dict[str, list[Observation]] = defaultdict(list)
        for one in deliveries:
            try:
                found = mapping.read(one.content, one.received, one.topic, self._orders[source])
            except Refused as fault:
                counts[SOURCE, fault.kind] += 1
                continue
            for turbine, stated, rejections in found:
                readings = [reading.at_whole_microsecond() for reading in stated]
                counts.update((turbine, rejection.kind) for rejection in rejections)
                observations = [Observation(turbine, reading, one.received) for reading in readings]
                if mapping.weather:
                    batch.weather += observations
                elif observations:
                    touched[turbine] += observations
        for name, observations in touched.items():
            self.clocks.note(name, observations)
            limit = self._now + AHEAD_S
            ahead = [one for one in observations if one.reading.time > limit]
            present = [one for one in observations if one.reading.time <= limit]
            self.backlogs.note(source, name, (one.reading for one in present), self._now)
            # the filter takes readings that were ahead before those that came after them
            due = self.held.release(name, self._now, batch)
            self.held.hold(name, ahead, batch, counts)
            self._take(name, [*due, *present], batch, counts)
        batch.counters = {key: count for key, count in counts.items() if count}
        places = [one.place for one in deliveries if one.place]
        if source and places:
            batch.place[source] = places[-1]
        for one in deliveries:
            batch.memories.update({(source, name): data for name, data in one.memories.items()})
        self.filter_waiting(batch, filter_s)
        for name in touched.keys() & self.waiting.keys():  # the others were assessed when they were filtered
            self._assess(name, batch)
        return batch

    def _take(
        self, name: str, observations: Sequence[Observation], batch: Batch, counts: Counter[tuple[str, str]]
    ) -> None:
        """Let a turbine's tracker take readings, and count those that it does not use."""
        if not observations:
            return
        tracker = self.trackers[name]
        batch.observations += [replace(one, late=tracker.is_late(one.reading)) for one in observations]
        tracker.take(one.reading for one in observations)
        self.waiting.setdefault(name)
        counts.update({(name, kind): n for kind, n in (tracker.counts - self._counted[name]).items()})
        self._counted[name] = Counter(tracker.counts)

    def filter_waiting(self, batch: Batch, filter_s: float = math.inf) -> Batch:
        """Filter waiting turbines for `filter_s` [s], longest waiting first and at least one; returns the
        batch."""
        end = time.monotonic() + filter_s
        courses: dict[str, Course] = {}
        done: list[str] = []
        while self.waiting:
            name = next(iter(self.waiting))
            del self.waiting[name]
            done.append(name)
            course = self._advance(name)
            if course is not None:
                courses[name] = course
            if time.monotonic() >= end:
                break
        known = {name: Evidence(self.excesses.get(name, math.nan), self.changes[name]) for name in courses}
        found = conditions({name: (self.turbines[name], course) for name, course in courses.items()}, known)
        for name, course in courses.items():
            self._add_results(name, course, found[name], batch)
        for name in done:
            self._assess(name, batch)
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
            self.states.note_estimate(name, found)
            if found.excess_g_m3 is not None:
                self.trackers[name].excess = float(found.excess_g_m3[-1])
                if final:
                    excess = self.excesses[name] = float(found.excess_g_m3[final - 1])
                    batch.memories[name, "excess"] = excess if math.isfinite(excess) else None
        if point is None:
            return
        batch.points[name] = point
        self._watch_properties(name, self.turbines[name].plan, course, point.time, batch)
        self._judge_readings(name, course, point.time, batch)
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
            present = deviations(states, errors, references)
            self.deviations[name] |= present  # what cannot be observed now stays as it was
            self.shifts[name] = parameter_shifts(self.shifts[name], at, present)
            batch.memories[name, "deviations"] = {k: list(d) for k, d in self.deviations[name].items()}
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
            self.changes[name].append(Change(event.id, tracker.note_change(event.time), event.kind))
            self.changes[name].sort(key=lambda one: one.time)
            self.shifts[name], self.references[name], self.deviations[name] = {}, {}, {}
            self.findings.pop(name, None)
            self.reference_points.pop(name, None)
            batch.memories[name, "changes"] = [asdict(one) for one in self.changes[name]]
            for key in ("parameter_shifts", "references", "deviations"):
                batch.memories[name, key] = {}
            for key in ("finding", "reference_point"):
                batch.memories[name, key] = None
            newest = tracker.newest_state
            if newest is not None:
                self._judge(name, newest.time, [], CHANGE_RULES, batch)
            self.waiting[name] = None
            self._assess(name, batch)
        return batch

    def _judge_estimates(self, name: str, found: Condition, batch: Batch) -> None:
        """Judge alarms at every estimate newer than the last one judged."""
        after = self._warned.get(name, -math.inf)
        for i in np.flatnonzero(found.time_s > after):
            known = self.shifts[name], self.findings.get(name), self.deviations[name]
            now = Estimated(found, int(i), *known, self.trackers[name].frozen)
            levels = estimate_levels(now, self.turbines[name].verdicts)
            self._judge(name, float(found.time_s[i]), levels, ESTIMATE_RULES, batch)
        self._warned[name] = max(after, float(found.time_s[-1]))

    def _judge_readings(self, name: str, course: Course, final_s: float, batch: Batch) -> None:
        """Judge alarms about readings that contradict the estimate, at every reading that is newer than the
        last one judged of its signal."""
        after = self._judged[name]
        levels = self._contradictions[name]
        for one in innovations(course, after, final_s):
            after[one.signal] = one.time_s
            levels[one.signal] = contradiction_level(one)
            self._judge(name, one.time_s, list(levels.values()), (CONTRADICTS,), batch)

    def tick(
        self, now: float, sources: Mapping[str, SourceState], left: Mapping[str, str] | None = None
    ) -> Batch:
        """Judge alarms about missing data and wrong clocks at `now` [s], and about lost sources; release
        readings that were ahead, and assess every turbine.

        left: turbine -> text about a sender that has left.
        """
        batch, left = Batch(), left or {}
        counts: Counter[tuple[str, str]] = Counter()
        self._began, self._now = min(self._began, now), now
        for name in self.held.turbines:
            self._take(name, self.held.release(name, now, batch), batch, counts)
        for name in self.turbines:
            self._judge_missing(name, now, left.get(name, ""), batch)
        clocks = clock_levels(self.clocks.ahead())
        for name in (*self.turbines, SOURCE):
            self._judge(name, now, clocks.get(name, []), (CLOCK,), batch)
        self._judge(SOURCE, now, source_levels(sources), (LOST,), batch)
        for name in self.turbines:
            self._assess(name, batch)
        batch.counters = {key: count for key, count in counts.items() if count}
        return batch

    def _judge_missing(self, name: str, now: float, left: str, batch: Batch) -> None:
        """Judge alarms about signals that came and come no more, and signals that never came; not while a
        backlog may still bring them, unless their sender has `left`."""
        one, heard = self.turbines[name], self.trackers[name].heard()
        since = self.states.known_since(name, now, batch)
        if self.backlogs.awaited(name, now) and not left:
            return
        ages = {signal: now - time for signal, time in heard.items()} or {"": now - self._began}
        missing = [need for need in one.plan.expected if heard and not set(need.signals) & set(heard)]
        levels = stale_levels(ages, one.stale_s, left)
        levels += missing_levels(missing, since, now, one.stale_s)
        self._judge(name, now, levels, (STALE, MISSING), batch)

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

    def keep_forecast(self, name: str, made_s: float, made: Forecast | None, batch: Batch) -> None:
        """Keep the forecast of a turbine from its state at `made_s` [s], and assess the turbine."""
        self.forecast_made_s[name] = made_s
        self.states.note_forecast(name, None if made is None else made.condition)
        self._assess(name, batch)

    def keep_finding(self, name: str, finding: Finding) -> Batch:
        """Keep the finding of fault isolation and judge the alarms that it explains."""
        self.findings[name] = finding
        batch = Batch(memories={(name, "finding"): asdict(finding)})
        levels = change_levels(self.shifts[name], finding, self.deviations[name])
        doubted = with_doubts(levels, self.turbines[name].verdicts)
        self._judge(name, finding.time_s, doubted, CHANGE_RULES, batch)
        self._assess(name, batch)
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

    def _assess(self, name: str, batch: Batch) -> None:
        """Assess a turbine; a change goes to the batch.  Before the first round or tick the time is not known
        yet, and the state that the store holds stands."""
        if not math.isfinite(self._now):
            return
        open_alarms = [one.alarm for one in self.standings[name].values() if one.alarm is not None]
        catching_up = self.backlogs.awaited(name, self._now)
        fault = self.faults.get(name, "")
        self.states.assess(name, self.trackers[name], self._now, open_alarms, fault, catching_up, batch)


def _without_pending(standings: Mapping[str, Standing]) -> dict[str, Standing]:
    """Standings at a restart: what was silent before it must be silent again for as long before an alarm
    begins, because its readings may have been kept for the tracker."""
    silent = (STALE.kind, MISSING.kind, CLOCK.kind)
    return {key: one for key, one in standings.items() if one.alarm is not None or not key.startswith(silent)}
