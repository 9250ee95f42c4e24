"""All tracked turbines: each round turns deliveries into the batch that the store has to keep.

A round changes nothing but the trackers.  If the store refuses a batch, the fleet is reopened from the store,
and the source repeats the deliveries that were not acknowledged.
"""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from hygrokf.data.structured import structured
from hygrokf.data.timestamps import DAY_S, HOUR_S, MINUTE_S
from hygrokf.live.alarms import (
    CLOCK,
    CONTRADICTS,
    ESTIMATE_RULES,
    LOST,
    MISSING,
    SHIFT_RULES,
    STALE,
    Estimated,
    Level,
    Rule,
    Standing,
    contradiction_level,
    estimate_levels,
    innovations,
    judge,
    missing_levels,
    shift_levels,
    source_levels,
    stale_levels,
    with_doubts,
)
from hygrokf.live.assessment import States
from hygrokf.live.batch import Alarm, Batch, Estimates, Event, Loss, Observation
from hygrokf.live.changes import Change, settled
from hygrokf.live.clocks import Backlogs, Clocks, HeldReadings, clock_levels
from hygrokf.live.condition import Condition
from hygrokf.live.fault_isolation import Finding, ShiftStep, shift_step
from hygrokf.live.forecast import ForecastMade
from hygrokf.live.frozen import Frozen
from hygrokf.live.plan import Plan
from hygrokf.live.properties import (
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
from hygrokf.live.sources.stream import Delivery, Reach
from hygrokf.live.storage.store import Store, state_of, state_text
from hygrokf.live.tracker import NEITHER, REVISIONS, SAME_S, Course, Point, Tracker
from hygrokf.live.turbine import STALE_S as STALE_S
from hygrokf.live.turbine import Evidence
from hygrokf.live.turbine import Turbine as Turbine
from hygrokf.live.turbine import conditions as conditions
from hygrokf.live.turbine import digest as digest

PROPERTY_S = HOUR_S
"""[s] between two stored rows of a property."""
SISTERS_S = DAY_S
"""[s] for which fault isolation waits for the readings of other turbines."""
DOWN_S = MINUTE_S
"""[s] after which a tracker that does not run has lost its connections."""
CONNECTED = "connected"
"""Name of the memory of the time at which a tracker last knew what is connected."""
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
        self._store = store
        self.held = HeldReadings(store)
        self.backlogs = Backlogs()
        self.clocks = Clocks(() if store is None else store.held_ahead())
        # turbines with readings that are not yet filtered, longest waiting first
        self.waiting: dict[str, None] = {}
        # at which lasting shifts have still to be judged, the first one as soon as its cause is isolated
        self.steps: dict[str, list[ShiftStep]] = defaultdict(list)
        self._slots: dict[str, float] = {}
        self._frozen: dict[str, dict[str, Frozen]] = defaultdict(dict)
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
            readings, versions = store.readings(name, since), store.revised(name, since)
            judged_s = -math.inf if known.get("judged") is None else structured(float, known["judged"])
            found = structured(dict[str, tuple[float, float, float]], known.get("frozen", {}))
            frozen = {signal: Frozen(signal, *parts) for signal, parts in found.items()}
            lost = store.losses(name)
            fleet.trackers[name] = Tracker(one.plan, point, readings, times, versions, judged_s, frozen, lost)
            fleet._frozen[name] = frozen
            fleet.waiting[name] = None  # committed readings may not have been filtered yet
            pairs = structured(dict[str, tuple[float, float]], known.get("references", {}))
            fleet.references[name] = {key: TrackedState(*pair) for key, pair in pairs.items()}
            if known.get("reference_point"):
                kept = structured(KeptState, known["reference_point"])
                fleet.reference_points[name] = Point(kept.time, state_of(kept.state))
            pairs = structured(dict[str, tuple[float, float]], known.get("deviations", {}))
            fleet.deviations[name] = {key: TrackedState(*pair) for key, pair in pairs.items()}
            fleet.shifts[name] = structured(dict[str, ParameterShift], known.get("parameter_shifts", {}))
            fleet.standings[name] = _without_pending(structured(dict[str, Standing], known.get("alarms", {})))
            if known.get("finding"):
                fleet.findings[name] = structured(Finding, known["finding"])
            if known.get("excess") is not None:
                fleet.excesses[name] = structured(float, known["excess"])
            if "forecast" in known:
                fleet.forecast_made_s[name] = structured(ForecastMade, known["forecast"]).made
            fleet.steps[name] = structured(list[ShiftStep], known.get("shift_steps") or [])
            (last,) = store.rows("SELECT MAX(time) FROM property WHERE turbine = ?", (name,))[0]
            fleet._slots[name] = -math.inf if point is None or last is None else last // PROPERTY_S
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
                mark = NEITHER if mapping.revision == "neither" else one.mark
                readings = [reading.as_stored(mark) for reading in stated]
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
        readings = [one.reading for one in observations]
        final = {(one.signal, one.time) for one in readings if tracker.is_late(one)}
        outcomes = tracker.take(readings, self._store.versions(name, final) if self._store else None)
        batch.observations += [
            replace(one, late="late" in outcome, revision=outcome in REVISIONS)
            for one, outcome in zip(observations, outcomes, strict=True)
        ]
        self._note_doubt(name, batch)
        self.waiting.setdefault(name)
        counts.update({(name, kind): n for kind, n in (tracker.counts - self._counted[name]).items()})
        self._counted[name] = Counter(tracker.counts)

    def _note_doubt(self, name: str, batch: Batch) -> None:
        """Keep that alarms will be judged anew from the point on."""
        if self.trackers[name].point is not None and self.trackers[name].judged_s == -math.inf:
            batch.memories[name, "judged"] = None

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
        tracker, point = self.trackers[name], self.trackers[name].point
        final = 0 if point is None else int(np.sum(found.time_s <= point.time + SAME_S))
        # also where none is kept: the provisional ones of this stretch are not any more
        batch.estimates[name] = Estimates(found, final, float(course.seconds[0]))
        if len(found.time_s):
            self.states.note_estimate(name, found)
            if found.excess_g_m3 is not None:
                tracker.excess = float(found.excess_g_m3[-1])
                if final:
                    excess = self.excesses[name] = float(found.excess_g_m3[final - 1])
                    batch.memories[name, "excess"] = excess if math.isfinite(excess) else None
        if point is None:
            return
        batch.points[name] = point
        if tracker.ahead is not None:
            batch.memories[name, "judged"] = tracker.judged_s
        if tracker.frozen != self._frozen[name]:
            self._frozen[name] = tracker.frozen
            batch.memories[name, "frozen"] = {
                signal: [one.since, one.value, one.known_s] for signal, one in tracker.frozen.items()
            }
        self._watch_properties(name, self.turbines[name].plan, course, point.time, batch)
        for one in innovations(course, point.time):
            # between the two thresholds a level says nothing: that of the other signals
            others = [s for s in course.run.timeline.outputs if s != one.signal]
            silent = [Level(CONTRADICTS.kind, CONTRADICTS.off, "", subject=s) for s in others]
            self._judge(name, one.time_s, [*silent, contradiction_level(one)], (CONTRADICTS,), batch)
        due = (found.time_s > course.judged_s + SAME_S) & (found.time_s <= course.final_s + SAME_S)
        for i in np.flatnonzero(due):
            levels = estimate_levels(Estimated(found, int(i), course.frozen), self.turbines[name].verdicts)
            self._judge(name, float(found.time_s[i]), levels, ESTIMATE_RULES, batch)

    def _watch_properties(self, name: str, plan: Plan, course: Course, final_s: float, batch: Batch) -> None:
        """Update properties and parameter shifts once per hour of final estimates, however many hours came at
        once."""
        slots = np.floor(course.seconds / PROPERTY_S)
        before = self._slots.get(name, -math.inf)
        begins = (slots > np.append(before, slots[:-1])) & (course.seconds <= final_s + SAME_S)
        heard = {signal: course.heard(signal) for signal in course.run.timeline.outputs}
        for i in np.flatnonzero(begins):
            at, errors = float(course.seconds[i]), self.turbines[name].errors
            mean, covariance = course.trace.mean[i], course.trace.covariance[i]
            newest = {signal: float(times[i]) for signal, times in heard.items()}
            states = states_of(plan.model, mean, covariance, at, newest)
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
            known = self.deviations[name]
            self.steps[name].append(shift_step(at, self.shifts[name], known, self._isolated_s(name)))
            self._judge_shifts(name, batch)

    def _isolated_s(self, name: str) -> float:
        """Time [s] at which the cause of a turbine's shifts was last due; −∞ if it never was."""
        due = [step.time for step in self.steps[name] if step.due]
        known = self.findings.get(name)
        return due[-1] if due else -math.inf if known is None else known.time_s

    def _judge_shifts(self, name: str, batch: Batch) -> None:
        """Judge alarms about shifts, step after step up to the next one whose cause is not isolated yet."""
        steps, finding = self.steps[name], self.findings.get(name)
        while steps and (not steps[0].due or (finding is not None and finding.time_s == steps[0].time)):
            step = steps.pop(0)
            levels = with_doubts(shift_levels(step, finding), self.turbines[name].verdicts)
            self._judge(name, step.time, levels, SHIFT_RULES, batch)
        batch.memories[name, "shift_steps"] = [asdict(step) for step in steps]

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
            self.steps[name].clear()
            batch.memories[name, "changes"] = [asdict(one) for one in self.changes[name]]
            for key in ("parameter_shifts", "references", "deviations"):
                batch.memories[name, key] = {}
            for key in ("finding", "reference_point", "shift_steps"):
                batch.memories[name, key] = None
            self._note_doubt(name, batch)
            if tracker.point is not None:
                self._judge(name, tracker.point.time, [], SHIFT_RULES, batch)
            self.waiting[name] = None
            self._assess(name, batch)
        return batch

    def tick(
        self,
        now: float,
        sources: Mapping[str, Reach],
        left: Mapping[str, str] | None = None,
        quiet: Collection[str] = (),
    ) -> Batch:
        """Judge alarms about delivery at `now` [s], release readings that were ahead, assess every turbine.

        left: turbine -> text about a sender that has left. quiet: turbines whose silence is no news.
        """
        batch, left = Batch(), left or {}
        counts: Counter[tuple[str, str]] = Counter()
        self._began, self._now = min(self._began, now), now
        for name in self.held.turbines:
            self._take(name, self.held.release(name, now, batch), batch, counts)
        for name in self.turbines:
            if name in left or name not in quiet:
                self._judge_missing(name, now, left.get(name, ""), batch)
        clocks = clock_levels(self.clocks.ahead())
        for name in (*self.turbines, SOURCE):
            self._judge(name, now, clocks.get(name, []), (CLOCK,), batch)
        self._judge(SOURCE, now, source_levels(sources, now), (LOST,), batch)
        for name in self.turbines:
            self._assess(name, batch)
        batch.counters = {key: count for key, count in counts.items() if count}
        return batch

    def note_connections(
        self,
        now: float,
        unreached: Mapping[str, Mapping[str, float | None]],
        left: Collection[str] = (),
        begins: bool = False,
    ) -> Batch:
        """Note at `now` [s] which connections are lost or regained.

        unreached: turbine -> signal that is held while connected -> time [s] since when its sources are lost.
        left: turbines whose sender has left.  begins: whether a tracker begins; all were lost while none ran
        for longer than `DOWN_S`.
        """
        batch, noted = Batch(), self._store.memory(SOURCE, CONNECTED) if begins and self._store else None
        down_s = [noted] if isinstance(noted, float) and now - noted > DOWN_S else []
        for name, signals in unreached.items():
            for signal, lost_s in signals.items():
                for since in (*down_s, now if lost_s is None and name in left else lost_s):
                    span = self.trackers[name].note_connection(signal, since, now)
                    if span is not None:
                        regained = span[1] if math.isfinite(span[1]) else None
                        batch.losses.append(Loss(name, signal, span[0], regained))
                        self._note_doubt(name, batch)
                        self.waiting.setdefault(name)
        if unreached:
            batch.memories[SOURCE, CONNECTED] = now
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

    def isolation_due(self) -> tuple[str, ShiftStep] | None:
        """A turbine, the one that waits longest first, with the step at which the cause of its shifts is to
        be isolated next; None if no cause is due, and while sisters are waited for."""
        due = ((name, steps[0]) for name, steps in self.steps.items() if steps)
        return next(((name, step) for name, step in due if not self._awaits_sisters(name, step.time)), None)

    def sisters(self, name: str, time: float) -> dict[str, Plan]:
        """The plans of the other turbines whose readings up to a time [s] are final."""
        return {
            other: self.turbines[other].plan
            for other, tracker in self.trackers.items()
            if other != name and tracker.judged_s >= time
        }

    def _awaits_sisters(self, name: str, time: float) -> bool:
        """Whether the readings of sisters up to a time [s] will be final: for `SISTERS_S`, by the newest
        stamps, so that the order in which turbines are delivered does not matter."""
        now = self.trackers[name].newest
        behind = [one for one, tracker in self.trackers.items() if one != name and tracker.judged_s < time]
        recent = [one for one in behind if self.trackers[one].newest > now - SISTERS_S]
        return any(one in self.waiting for one in behind) or (now < time + SISTERS_S and bool(recent))

    def open_alarms(self) -> list[Alarm]:
        """The open alarms."""
        return [
            one.alarm for known in self.standings.values() for one in known.values() if one.alarm is not None
        ]

    def keep_forecast(self, name: str, made_s: float, batch: Batch) -> None:
        """Keep the forecast of a turbine in the batch, from its state at `made_s` [s], and assess the
        turbine."""
        self.forecast_made_s[name], made = made_s, batch.forecasts[name]
        self.states.note_forecast(name, None if made is None else made.condition)
        self._assess(name, batch)

    def keep_finding(self, name: str, finding: Finding) -> Batch:
        """Keep the finding of fault isolation, unless a change was stated meanwhile, and judge the alarms
        that it explains."""
        steps, batch = self.steps.pop(name, []), Batch()
        self.steps[name] = steps  # the others come first now
        if steps and steps[0].time == finding.time_s:
            self.findings[name] = finding
            batch.memories[name, "finding"] = asdict(finding)
            self._judge_shifts(name, batch)
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
