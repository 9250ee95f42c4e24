"""All tracked turbines: each round turns deliveries into the batch that the store has to keep.

A round changes nothing but the trackers.  If the store refuses a batch, the fleet is reopened from the store,
and the source repeats the deliveries that were not acknowledged.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from hygrokf.data.structured import plain, structured
from hygrokf.data.timestamps import DAY_S, HOUR_S, MINUTE_S
from hygrokf.live.alarms import (
    CLOCKS,
    CONTRADICTS,
    ESTIMATES,
    INNOVATIONS,
    REACH,
    SHIFTS,
    SILENCE,
    Estimated,
    Level,
    Standing,
    contradiction_level,
    estimate_levels,
    innovations,
    judge,
    kinds_of,
    missing_levels,
    shift_levels,
    source_levels,
    stale_levels,
    with_doubts,
)
from hygrokf.live.assessment import STANDSTILL_S, Known, Outlook, assess
from hygrokf.live.batch import (
    Alarm,
    Assessment,
    Batch,
    Estimates,
    Event,
    Loss,
    Observation,
    content_of,
    text_of,
)
from hygrokf.live.clock_levels import Ahead, Backlogs, clock_levels
from hygrokf.live.condition import Condition
from hygrokf.live.fault_isolation import CauseFinding, ShiftStep, shift_step
from hygrokf.live.forecast import ForecastMade
from hygrokf.live.plan import Plan
from hygrokf.live.properties import (
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
from hygrokf.live.storage.schema import assessment, property_
from hygrokf.live.storage.statements import select_newest, select_rows
from hygrokf.live.storage.store import Store
from hygrokf.live.traces import StatedChange, settled
from hygrokf.live.tracker import NEITHER, REVISIONS, SAME_S, Point, TrackedCourse, Tracker
from hygrokf.live.turbine import STALE_S as STALE_S
from hygrokf.live.turbine import Kept as Kept
from hygrokf.live.turbine import Turbine as Turbine
from hygrokf.live.turbine import conditions as conditions
from hygrokf.live.turbine import digest as digest
from hygrokf.texts.statement import Statement

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


@dataclass(kw_only=True)
class TurbineState(Kept):
    """What a turbine carries from round to round.

    `newest`: time [s] of its newest estimate and the probability of condensation [1]; `outlook`: that of its
    forecast; `fault`: why its readings cannot be filtered; `slot`: of its newest properties; `turn`: number
    of the last fault isolation.
    """

    turbine: Turbine
    tracker: Tracker
    assessment: Assessment | None = None
    newest: tuple[float | None, float | None] = (None, None)
    outlook: Outlook | None = None
    forecast_made_s: float = -math.inf
    fault: str = ""
    slot: float = -math.inf
    turn: int = 0

    @classmethod
    def from_store(cls, name: str, turbine: Turbine, store: Store) -> TurbineState:
        """The state that the store holds."""
        point, memories = store.point(name), store.memories(name)
        since = -math.inf if point is None else point.time - turbine.plan.context_s
        kept = Kept.of(memories)
        kept.alarms = _without_pending(kept.alarms)
        tracker = Tracker(
            turbine.plan,
            point,
            store.readings(name, since),
            [change.time for change in kept.changes],
            store.revised(name, since),
            kept.judged,
            kept.frozen,
            store.losses(name),
        )
        made = cls(turbine=turbine, tracker=tracker, **vars(kept))
        made.assessment = next(
            iter(store.records(Assessment, select_rows(assessment, same="turbine"), turbine=name)), None
        )
        made.newest = store.newest_estimate(name) or made.newest
        if outlook := store.outlook(name):
            made.outlook = Outlook(*np.array(outlook, dtype=float).T)
        if "forecast" in memories:
            made.forecast_made_s = structured(ForecastMade, memories["forecast"]).made
        last = store.first(select_newest(property_, "time", "turbine"), turbine=name)
        made.slot = -math.inf if point is None or last is None else last[0] // PROPERTY_S
        return made

    def known(self, now: float, catching_up: bool) -> Known:
        """What is known of the turbine at `now` [s]; `catching_up`: whether a backlog is being delivered."""
        plan, tracker, awaited = self.turbine.plan, self.tracker, self.tracker.awaited()
        return Known(
            known_s=min(self.known_s, now),
            heard=tracker.heard(),
            awaited=[need for need in plan.needs if need.required and need.signals[0] in awaited],
            estimate_s=self.newest[0],
            condensation=self.newest[1],
            with_humidity="vapour" in plan.model.states,
            outlook=self.outlook,
            alarms=[one.alarm for one in self.alarms.values() if one.alarm is not None],
            standstill=tracker.stands_still(STANDSTILL_S),
            history_until_s=tracker.history_until(),
            fault=self.fault,
            catching_up=catching_up,
            stale_s=self.turbine.stale_s,
            silent_s=tracker.silent_since(),
        )


class Fleet:
    """The state of each turbine, and what belongs to several.

    Readings that are ahead of the clock are held back in the `store`.
    """

    def __init__(self, turbines: Mapping[str, Turbine], store: Store | None = None) -> None:
        self.tracked = {
            name: TurbineState(turbine=one, tracker=Tracker(one.plan)) for name, one in turbines.items()
        }
        self._common = Kept()
        self._turns = count(1)
        self._store = store
        self.ahead = Ahead(store)
        self.backlogs = Backlogs()
        # turbines with readings that are not yet filtered, longest waiting first
        self.waiting: dict[str, None] = {}
        self._orders: dict[str, Order] = defaultdict(dict)
        self._now = -math.inf
        self._began = math.inf

    @classmethod
    def from_store(cls, turbines: Mapping[str, Turbine], store: Store) -> Fleet:
        """The fleet in the state that the store holds."""
        store.add_turbines({name: digest(one.plan) for name, one in turbines.items()})
        fleet = cls(turbines, store)
        fleet.tracked = {name: TurbineState.from_store(name, one, store) for name, one in turbines.items()}
        fleet.waiting = dict.fromkeys(turbines)  # committed readings may not have been filtered yet
        fleet._common = Kept.of(store.memories(SOURCE))
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
        self._now = max((one.received for one in deliveries), default=self._now)
        touched: dict[str, list[Observation]] = defaultdict(list)
        for one in deliveries:
            try:
                found = mapping.read(one.content, one.received, one.topic, self._orders[source])
            except Refused as fault:
                batch.counters[SOURCE, fault.kind] += 1
                continue
            for turbine, stated, rejections in found:
                mark = NEITHER if mapping.revision == "neither" else one.mark
                readings = [reading.as_stored(mark) for reading in stated]
                batch.counters.update((turbine, rejection.kind) for rejection in rejections)
                observations = [Observation(turbine, reading, one.received) for reading in readings]
                if mapping.weather:
                    batch.weather += observations
                elif observations:
                    touched[turbine] += observations
        for name, observations in touched.items():
            self.ahead.note(name, observations)
            limit = self._now + AHEAD_S
            ahead = [one for one in observations if one.reading.time > limit]
            present = [one for one in observations if one.reading.time <= limit]
            self.backlogs.note(source, name, (one.reading for one in present), self._now)
            # the filter takes readings that were ahead before those that came after them
            due = self.ahead.release(name, self._now, batch)
            self.ahead.hold(name, ahead, batch)
            self._take(name, [*due, *present], batch)
        places = [one.place for one in deliveries if one.place]
        if source and places:
            batch.place[source] = places[-1]
        for one in deliveries:
            batch.memories.update({(source, name): data for name, data in one.memories.items()})
        self.filter_waiting(batch, filter_s)
        for name in touched.keys() & self.waiting.keys():  # the others were assessed when they were filtered
            self._assess(name, batch)
        return batch

    def _take(self, name: str, observations: Sequence[Observation], batch: Batch) -> None:
        if not observations:
            return
        state = self.tracked[name]
        tracker = state.tracker
        readings = [one.reading for one in observations]
        final = {(one.signal, one.time) for one in readings if tracker.is_late(one)}
        outcomes = tracker.take(readings, self._store.versions(name, final) if self._store else None)
        batch.observations += [
            replace(one, late="late" in outcome, revision=outcome in REVISIONS)
            for one, outcome in zip(observations, outcomes, strict=True)
        ]
        self._note_doubt(name, batch)
        self.waiting.setdefault(name)
        batch.counters.update({(name, kind): n for kind, n in tracker.counts.items() if n})
        tracker.counts.clear()

    def _note_doubt(self, name: str, batch: Batch) -> None:
        """Keep that alarms will be judged anew from the point on."""
        tracker = self.tracked[name].tracker
        if tracker.point is not None and tracker.judged_s == -math.inf:
            self._keep(name, batch, judged=-math.inf)

    def filter_waiting(self, batch: Batch, filter_s: float = math.inf) -> Batch:
        """Filter waiting turbines for `filter_s` [s], longest waiting first and at least one; returns the
        batch."""
        end = time.monotonic() + filter_s
        courses: dict[str, TrackedCourse] = {}
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
        states = {name: self.tracked[name] for name in courses}
        found = conditions({name: (states[name].turbine, one) for name, one in courses.items()}, states)
        for name, course in courses.items():
            self._add_results(name, course, found[name], batch)
        for name in done:
            self._assess(name, batch)
        return batch

    def _advance(self, name: str) -> TrackedCourse | None:
        state, course = self.tracked[name], None
        try:
            course, state.fault = state.tracker.advance(), ""
        except ValueError as fault:  # no reading is lost: all are in the tracker and in the batch
            state.fault = str(fault)
        return course

    def _add_results(self, name: str, course: TrackedCourse, found: Condition, batch: Batch) -> None:
        state = self.tracked[name]
        tracker, point = state.tracker, state.tracker.point
        final = 0 if point is None else int(np.sum(found.time_s <= point.time + SAME_S))
        # also where none is kept: the provisional ones of this stretch are not any more
        batch.estimates[name] = Estimates(found, final, float(course.seconds[0]))
        if len(found.time_s):
            chance = None if found.condensation is None else float(found.condensation[-1])
            state.newest = float(found.time_s[-1]), chance
            if found.excess_g_m3 is not None:
                tracker.excess = float(found.excess_g_m3[-1])
                if final:
                    self._keep(name, batch, excess=float(found.excess_g_m3[final - 1]))
        if point is None:
            return
        batch.points[name] = point
        if tracker.ahead is not None:
            self._keep(name, batch, judged=tracker.judged_s)
        if tracker.frozen != state.frozen:
            self._keep(name, batch, frozen=tracker.frozen)
        self._watch_properties(name, course, point.time, batch)
        for one in innovations(course, point.time):
            # between the two thresholds a level says nothing: that of the other signals
            others = [s for s in course.run.timeline.outputs if s != one.signal]
            silent = [Level(CONTRADICTS.kind, CONTRADICTS.off, subject=s) for s in others]
            self._judge(name, one.time_s, [*silent, contradiction_level(one)], INNOVATIONS, batch)
        due = (found.time_s > course.judged_s + SAME_S) & (found.time_s <= course.final_s + SAME_S)
        for i in np.flatnonzero(due):
            levels = estimate_levels(Estimated(found, int(i), course.frozen), state.turbine.verdicts)
            self._judge(name, float(found.time_s[i]), levels, ESTIMATES, batch)

    def _watch_properties(self, name: str, course: TrackedCourse, final_s: float, batch: Batch) -> None:
        """Update properties and parameter shifts once per hour of final estimates, however many hours came at
        once."""
        state = self.tracked[name]
        plan, errors = state.turbine.plan, state.turbine.errors
        slots = np.floor(course.seconds / PROPERTY_S)
        begins = (slots > np.append(state.slot, slots[:-1])) & (course.seconds <= final_s + SAME_S)
        heard = {signal: course.heard(signal) for signal in course.run.timeline.outputs}
        for i in np.flatnonzero(begins):
            at = float(course.seconds[i])
            mean, covariance = course.trace.mean[i], course.trace.covariance[i]
            newest = {signal: float(times[i]) for signal, times in heard.items()}
            states = states_of(plan.model, mean, covariance, at, newest)
            if not states:
                return
            state.slot = slots[i]
            batch.properties.append((name, at, properties(states, plan.values, errors)))
            references = self._references(name, at, states, Point(at, course.state(int(i))), batch)
            present = deviations(states, errors, references)
            known = state.deviations | present  # what cannot be observed now stays as it was
            shifts = parameter_shifts(state.parameter_shifts, at, present)
            self._keep(name, batch, deviations=known, parameter_shifts=shifts)
            isolated_s = -math.inf if state.finding is None else state.finding.time_s
            isolated_s = next((one.time for one in reversed(state.shift_steps) if one.due), isolated_s)
            state.shift_steps.append(shift_step(at, shifts, known, isolated_s))
            self._judge_shifts(name, batch)

    def _judge_shifts(self, name: str, batch: Batch) -> None:
        state = self.tracked[name]
        steps, finding = state.shift_steps, state.finding
        while steps and (not steps[0].due or (finding is not None and finding.time_s == steps[0].time)):
            step = steps.pop(0)
            levels = with_doubts(shift_levels(step, finding), state.turbine.verdicts)
            self._judge(name, step.time, levels, SHIFTS, batch)
        self._keep(name, batch, shift_steps=steps)

    def _references(
        self, name: str, at: float, states: Mapping[str, TrackedState], point: Point, batch: Batch
    ) -> Mapping[str, TrackedState] | None:
        """The states against which shifts are judged at a time [s]; None for the fit's values."""
        state = self.tracked[name]
        if not state.changes or at < state.changes[-1].time:
            return None
        before = state.references
        found = settled(before, state.changes[-1].time, at, states)
        if found != before:
            self._keep(name, batch, references=found)
        if found and not before:
            self._keep(name, batch, reference_point=point)
        return found

    def take_events(self, events: Iterable[Event]) -> Batch:
        """Take stated changes into account that are not known yet: what had shifted is expected, and its
        alarms end."""
        batch = Batch()
        for event in events:
            name = event.turbine
            state = self.tracked.get(name)
            if state is None or event.id in [one.event for one in state.changes]:
                continue
            tracker = state.tracker
            change = StatedChange(event.id, tracker.note_change(event.time), event.kind)
            changes = sorted([*state.changes, change], key=lambda one: one.time)
            self._keep(
                name, batch, changes=changes, parameter_shifts={}, references={}, deviations={}, finding=None,
                reference_point=None, shift_steps=[],
            )  # fmt: skip
            self._note_doubt(name, batch)
            if tracker.point is not None:
                self._judge(name, tracker.point.time, [], SHIFTS, batch)
            self.waiting[name] = None
            self._assess(name, batch)
        return batch

    def tick(
        self,
        now: float,
        sources: Mapping[str, Reach],
        left: Mapping[str, Statement] | None = None,
        quiet: Collection[str] = (),
    ) -> Batch:
        """Judge alarms about delivery at `now` [s], release readings that were ahead, assess every turbine.

        left: turbine -> that its sender has left. quiet: turbines whose silence is no news.
        """
        batch, left = Batch(), left or {}
        self._began, self._now = min(self._began, now), now
        for name in self.ahead.turbines:
            self._take(name, self.ahead.release(name, now, batch), batch)
        for name in self.tracked:
            if name in left or name not in quiet:
                self._judge_missing(name, now, left.get(name), batch)
        clocks = clock_levels(self.ahead.by_turbine())
        for name in (*self.tracked, SOURCE):
            self._judge(name, now, clocks.get(name, []), CLOCKS, batch)
        self._judge(SOURCE, now, source_levels(sources, now), REACH, batch)
        for name in self.tracked:
            self._assess(name, batch)
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
                    span = self.tracked[name].tracker.note_connection(signal, since, now)
                    if span is not None:
                        regained = span[1] if math.isfinite(span[1]) else None
                        batch.losses.append(Loss(name, signal, span[0], regained))
                        self._note_doubt(name, batch)
                        self.waiting.setdefault(name)
        if unreached:
            batch.memories[SOURCE, CONNECTED] = now
        return batch

    def _judge_missing(self, name: str, now: float, left: Statement | None, batch: Batch) -> None:
        """Judge alarms about signals that came and come no more, and signals that never came; not while a
        backlog may still bring them, unless their sender has `left`."""
        state = self.tracked[name]
        one, heard = state.turbine, state.tracker.heard()
        if state.known_s > now:  # new, or this machine's clock was ahead
            self._keep(name, batch, known_s=now)
        if self.backlogs.awaited(name, now) and not left:
            return
        ages = {signal: now - time for signal, time in heard.items()} or {"": now - self._began}
        missing = [need for need in one.plan.expected if heard and not set(need.signals) & set(heard)]
        levels = stale_levels(ages, one.stale_s, left)
        levels += missing_levels(missing, state.known_s, now, one.stale_s)
        self._judge(name, now, levels, SILENCE, batch)

    def isolation_due(self) -> tuple[str, ShiftStep] | None:
        """A turbine, the one that waits longest first, with the step at which the cause of its shifts is to
        be isolated next; None if no cause is due, and while sisters are waited for."""
        turns = sorted(self.tracked.items(), key=lambda item: item[1].turn)
        due = ((name, one.shift_steps[0]) for name, one in turns if one.shift_steps)
        return next(((name, step) for name, step in due if not self._awaits_sisters(name, step.time)), None)

    def sisters(self, name: str, time: float) -> dict[str, Plan]:
        """The plans of the other turbines whose readings up to a time [s] are final."""
        others = {other: state for other, state in self.tracked.items() if other != name}
        return {other: one.turbine.plan for other, one in others.items() if one.tracker.judged_s >= time}

    def _awaits_sisters(self, name: str, time: float) -> bool:
        """Whether the readings of sisters up to a time [s] will be final: for `SISTERS_S`, by the newest
        stamps, so that the order in which turbines are delivered does not matter."""
        now = self.tracked[name].tracker.newest
        trackers = {other: state.tracker for other, state in self.tracked.items() if other != name}
        behind = {other: tracker.newest for other, tracker in trackers.items() if tracker.judged_s < time}
        recent = any(newest > now - SISTERS_S for newest in behind.values())
        return any(other in self.waiting for other in behind) or (now < time + SISTERS_S and recent)

    def open_alarms(self) -> list[Alarm]:
        """The open alarms."""
        owners = (*self.tracked.values(), self._common)
        return [one.alarm for owner in owners for one in owner.alarms.values() if one.alarm is not None]

    def keep_forecast(self, name: str, made_s: float, batch: Batch) -> None:
        """Keep the forecast of a turbine in the batch, from its state at `made_s` [s], and assess the
        turbine."""
        state, made = self.tracked[name], batch.forecasts[name]
        state.forecast_made_s, state.outlook = made_s, None
        if made is not None and made.condition.condensation is not None:
            state.outlook = Outlook(made.condition.time_s, made.condition.condensation)
        self._assess(name, batch)

    def keep_finding(self, name: str, finding: CauseFinding) -> Batch:
        """Keep the finding of fault isolation, unless a change was stated meanwhile, and judge the alarms
        that it explains."""
        state, batch = self.tracked[name], Batch()
        state.turn = next(self._turns)  # the others come first now
        if state.shift_steps and state.shift_steps[0].time == finding.time_s:
            self._keep(name, batch, finding=finding)
            self._judge_shifts(name, batch)
            self._assess(name, batch)
        return batch

    def forecast_due(self, every_s: float) -> str | None:
        """The turbine whose forecast is oldest, if it is at least `every_s` [s] old in the turbine's own
        time."""
        best, oldest = None, every_s
        for name, state in self.tracked.items():
            newest = state.tracker.newest_state
            if newest is not None:
                age = newest.time - state.forecast_made_s
                if age >= oldest:
                    best, oldest = name, age
        return best

    def _judge(self, name: str, now: float, levels: list[Level], follows: str, batch: Batch) -> None:
        before = self.tracked.get(name, self._common).alarms
        after, changed = judge(name, before, now, levels, kinds_of(follows))
        if after != before:
            self._keep(name, batch, alarms=after)
        batch.alarms += changed

    def _assess(self, name: str, batch: Batch) -> None:
        """Assess a turbine; a change goes to the batch.  Before the first round or tick the time is not known
        yet, and the state that the store holds stands."""
        if not math.isfinite(self._now):
            return
        state, now = self.tracked[name], self._now
        word, statements = assess(state.known(now, self.backlogs.awaited(name, now)), now)
        content, before = content_of(statements), state.assessment
        if before is None or (before.state, before.content) != (word, content):
            since = before.since if before is not None and before.state == word else now
            state.assessment = Assessment(name, word, text_of(statements), since, content)
            others = [one for one in batch.assessments if one.turbine != name]
            batch.assessments = [*others, state.assessment]

    def _keep(self, name: str, batch: Batch, **kept: object) -> None:
        """Let a turbine, or what belongs to none, carry something from now on, and the store keep it."""
        owner = self.tracked.get(name, self._common)
        for key, value in kept.items():
            setattr(owner, key, value)
            batch.memories[name, key] = plain(value)


def _without_pending(standings: Mapping[str, Standing]) -> dict[str, Standing]:
    """Standings at a restart: what was silent before it must be silent again for as long before an alarm
    begins, because its readings may have been kept for the tracker."""
    silent = kinds_of(SILENCE, CLOCKS)
    return {key: one for key, one in standings.items() if one.alarm is not None or one.kind not in silent}
