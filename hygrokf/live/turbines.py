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
    INNOVATION_KIND,
    REACH_KIND,
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
from hygrokf.live.assessment import STANDSTILL_S, Facts, Outlook, assess
from hygrokf.live.batch import (
    Alarm,
    Assessment,
    Batch,
    Estimates,
    Event,
    Loss,
    Observation,
    stated_content,
    stated_text,
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
from hygrokf.live.sources.payload_values import STAMP_AHEAD_S
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
"""[s] without a running tracker after which all connections count as lost."""
CONNECTED = "connected"
"""Name of the memory that holds the time at which a tracker last noted its connections."""
SOURCE = ""
"""Name under which counts, alarms and memories that belong to no turbine are kept."""


@dataclass(kw_only=True)
class TurbineState(Kept):
    """What a turbine carries from round to round.

    `newest`: time [s] of its newest estimate and the probability of condensation [1]; `outlook`: forecast of
    this probability; `fault`: why its readings cannot be filtered; `slot`: number of the hour of its newest
    properties; `turn`: number of the last fault isolation.
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
        state = cls(turbine=turbine, tracker=tracker, **vars(kept))
        state.assessment = next(
            iter(store.records(Assessment, select_rows(assessment, same="turbine"), turbine=name)), None
        )
        state.newest = store.newest_estimate(name) or state.newest
        if outlook := store.outlook(name):
            state.outlook = Outlook(*np.array(outlook, dtype=float).T)
        if "forecast" in memories:
            state.forecast_made_s = structured(ForecastMade, memories["forecast"]).made
        row = store.first(select_newest(property_, "time", "turbine"), turbine=name)
        state.slot = -math.inf if point is None or row is None else row[0] // PROPERTY_S
        return state

    def facts(self, now: float, catching_up: bool) -> Facts:
        """The facts about the turbine at `now` [s]; `catching_up`: whether a backlog is being delivered."""
        plan, tracker, awaited = self.turbine.plan, self.tracker, self.tracker.awaited()
        return Facts(
            known_s=min(self.known_s, now),
            heard=tracker.heard(),
            awaited=[need for need in plan.needs if need.required and need.signals[0] in awaited],
            estimate_s=self.newest[0],
            condensation=self.newest[1],
            with_humidity="vapour" in plan.model.states,
            outlook=self.outlook,
            alarms=[standing.alarm for standing in self.alarms.values() if standing.alarm is not None],
            standstill=tracker.stands_still(STANDSTILL_S),
            history_until_s=tracker.history_until(),
            fault=self.fault,
            catching_up=catching_up,
            stale_s=self.turbine.stale_s,
            silent_s=tracker.silent_since(),
        )


class Fleet:
    """The state of each turbine, and the alarms and memories that belong to no turbine.

    Readings that are ahead of the clock are held back in the `store`.
    """

    def __init__(self, turbines: Mapping[str, Turbine], store: Store | None = None) -> None:
        self.tracked = {
            name: TurbineState(turbine=turbine, tracker=Tracker(turbine.plan))
            for name, turbine in turbines.items()
        }
        self._shared = Kept()
        self._turn_numbers = count(1)
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
        store.add_turbines({name: digest(turbine.plan) for name, turbine in turbines.items()})
        fleet = cls(turbines, store)
        fleet.tracked = {
            name: TurbineState.from_store(name, turbine, store) for name, turbine in turbines.items()
        }
        fleet.waiting = dict.fromkeys(turbines)  # committed readings may not have been filtered yet
        fleet._shared = Kept.of(store.memories(SOURCE))
        return fleet

    def round(
        self,
        deliveries: Sequence[Delivery],
        mapping: PayloadMapping,
        source: str = "",
        filter_s: float = math.inf,
    ) -> Batch:
        """Read the deliveries of a source by its mapping, and filter the turbines whose readings they
        contain.

        The batch contains all deliveries; turbines that are not filtered within `filter_s` [s] wait for the
        next round.
        """
        batch = Batch()
        self._now = max((delivery.received for delivery in deliveries), default=self._now)
        by_turbine: dict[str, list[Observation]] = defaultdict(list)
        for delivery in deliveries:
            try:
                contents = mapping.read(
                    delivery.content, delivery.received, delivery.topic, self._orders[source]
                )
            except Refused as fault:
                batch.counters[SOURCE, fault.kind] += 1
                continue
            for turbine, stated, rejections in contents:
                mark = NEITHER if mapping.revision == "neither" else delivery.mark
                readings = [reading.as_stored(mark) for reading in stated]
                batch.counters.update((turbine, rejection.kind) for rejection in rejections)
                observations = [Observation(turbine, reading, delivery.received) for reading in readings]
                if mapping.weather:
                    batch.weather += observations
                elif observations:
                    by_turbine[turbine] += observations
        for name, observations in by_turbine.items():
            self.ahead.note(name, observations)
            limit = self._now + STAMP_AHEAD_S
            ahead = [observed for observed in observations if observed.reading.time > limit]
            present = [observed for observed in observations if observed.reading.time <= limit]
            self.backlogs.note(source, name, (observed.reading for observed in present), self._now)
            # the filter takes readings that were held back before those that came after them
            due = self.ahead.release(name, self._now, batch)
            self.ahead.hold(name, ahead, batch)
            self._take(name, [*due, *present], batch)
        places = [delivery.place for delivery in deliveries if delivery.place]
        if source and places:
            batch.place[source] = places[-1]
        for delivery in deliveries:
            batch.memories.update({(source, name): data for name, data in delivery.memories.items()})
        self.filter_waiting(batch, filter_s)
        # the other turbines were assessed when they were filtered
        for name in by_turbine.keys() & self.waiting.keys():
            self._assess(name, batch)
        return batch

    def _take(self, name: str, observations: Sequence[Observation], batch: Batch) -> None:
        if not observations:
            return
        state = self.tracked[name]
        tracker = state.tracker
        readings = [observed.reading for observed in observations]
        final = {(reading.signal, reading.time) for reading in readings if tracker.is_late(reading)}
        outcomes = tracker.take(readings, self._store.versions(name, final) if self._store else None)
        batch.observations += [
            replace(observed, late="late" in outcome, revision=outcome in REVISIONS)
            for observed, outcome in zip(observations, outcomes, strict=True)
        ]
        self._note_rejudgement(name, batch)
        self.waiting.setdefault(name)
        batch.counters.update({(name, kind): n for kind, n in tracker.counts.items() if n})
        tracker.counts.clear()

    def _note_rejudgement(self, name: str, batch: Batch) -> None:
        """Let the store remember that the turbine's alarms will be judged anew from the point on."""
        tracker = self.tracked[name].tracker
        if tracker.point is not None and tracker.judged_s == -math.inf:
            self._keep(name, batch, judged=-math.inf)

    def filter_waiting(self, batch: Batch, filter_s: float = math.inf) -> Batch:
        """Filter waiting turbines for `filter_s` [s], longest waiting first and at least one; returns the
        batch."""
        end = time.monotonic() + filter_s
        courses: dict[str, TrackedCourse] = {}
        filtered: list[str] = []
        while self.waiting:
            name = next(iter(self.waiting))
            del self.waiting[name]
            filtered.append(name)
            course = self._advance(name)
            if course is not None:
                courses[name] = course
            if time.monotonic() >= end:
                break
        states = {name: self.tracked[name] for name in courses}
        tracked = {name: (states[name].turbine, course) for name, course in courses.items()}
        by_name = conditions(tracked, states)
        for name, course in courses.items():
            self._add_results(name, course, by_name[name], batch)
        for name in filtered:
            self._assess(name, batch)
        return batch

    def _advance(self, name: str) -> TrackedCourse | None:
        state, course = self.tracked[name], None
        try:
            course, state.fault = state.tracker.advance(), ""
        except ValueError as fault:  # no reading is lost: all are in the tracker and in the batch
            state.fault = str(fault)
        return course

    def _add_results(self, name: str, course: TrackedCourse, condition: Condition, batch: Batch) -> None:
        state = self.tracked[name]
        tracker, point = state.tracker, state.tracker.point
        final_count = 0 if point is None else int(np.sum(condition.time_s <= point.time + SAME_S))
        # also without new estimates: the stored provisional estimates from the first instant on are void
        batch.estimates[name] = Estimates(condition, final_count, float(course.seconds[0]))
        if len(condition.time_s):
            probability = None if condition.condensation is None else float(condition.condensation[-1])
            state.newest = float(condition.time_s[-1]), probability
            if condition.excess_g_m3 is not None:
                tracker.excess = float(condition.excess_g_m3[-1])
                if final_count:
                    self._keep(name, batch, excess=float(condition.excess_g_m3[final_count - 1]))
        if point is None:
            return
        batch.points[name] = point
        if tracker.ahead is not None:
            self._keep(name, batch, judged=tracker.judged_s)
        if tracker.frozen != state.frozen:
            self._keep(name, batch, frozen=tracker.frozen)
        self._watch_properties(name, course, point.time, batch)
        for innovation in innovations(course, point.time):
            # for the other signals a level between the two thresholds, which changes no alarm
            others = [signal for signal in course.run.timeline.outputs if signal != innovation.signal]
            unchanged = [Level(CONTRADICTS.kind, CONTRADICTS.off, subject=signal) for signal in others]
            levels = [*unchanged, contradiction_level(innovation)]
            self._judge(name, innovation.time_s, levels, INNOVATION_KIND, batch)
        due = (condition.time_s > course.judged_s + SAME_S) & (condition.time_s <= course.final_s + SAME_S)
        for i in np.flatnonzero(due):
            levels = estimate_levels(Estimated(condition, int(i), course.frozen), state.turbine.verdicts)
            self._judge(name, float(condition.time_s[i]), levels, ESTIMATES, batch)

    def _watch_properties(self, name: str, course: TrackedCourse, final_s: float, batch: Batch) -> None:
        """Update properties and parameter shifts once per hour of final estimates, for each hour of the
        course."""
        state = self.tracked[name]
        plan, errors = state.turbine.plan, state.turbine.errors
        slots = np.floor(course.seconds / PROPERTY_S)
        begins_slot = (slots > np.append(state.slot, slots[:-1])) & (course.seconds <= final_s + SAME_S)
        heard = {signal: course.heard(signal) for signal in course.run.timeline.outputs}
        for i in np.flatnonzero(begins_slot):
            time_s = float(course.seconds[i])
            mean, covariance = course.trace.mean[i], course.trace.covariance[i]
            newest = {signal: float(times[i]) for signal, times in heard.items()}
            states = states_of(plan.model, mean, covariance, time_s, newest)
            if not states:
                return
            state.slot = slots[i]
            batch.properties.append((name, time_s, properties(states, plan.values, errors)))
            references = self._references(name, time_s, states, Point(time_s, course.state(int(i))), batch)
            present = deviations(states, errors, references)
            latest = state.deviations | present  # a deviation that cannot be observed keeps its last value
            shifts = parameter_shifts(state.parameter_shifts, time_s, present)
            self._keep(name, batch, deviations=latest, parameter_shifts=shifts)
            isolated_s = -math.inf if state.finding is None else state.finding.time_s
            isolated_s = next((step.time for step in reversed(state.shift_steps) if step.due), isolated_s)
            state.shift_steps.append(shift_step(time_s, shifts, latest, isolated_s))
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
        self, name: str, time_s: float, states: Mapping[str, TrackedState], point: Point, batch: Batch
    ) -> Mapping[str, TrackedState] | None:
        """The states against which shifts are judged at a time [s]; None for the fit's values."""
        state = self.tracked[name]
        if not state.changes or time_s < state.changes[-1].time:
            return None
        previous = state.references
        references = settled(previous, state.changes[-1].time, time_s, states)
        if references != previous:
            self._keep(name, batch, references=references)
        if references and not previous:
            self._keep(name, batch, reference_point=point)
        return references

    def take_events(self, events: Iterable[Event]) -> Batch:
        """Take new stated changes into account: the present shifts are expected, and alarms about shifts
        end."""
        batch = Batch()
        for event in events:
            name = event.turbine
            state = self.tracked.get(name)
            if state is None or event.id in [known.event for known in state.changes]:
                continue
            tracker = state.tracker
            change = StatedChange(event.id, tracker.note_change(event.time), event.kind)
            changes = sorted([*state.changes, change], key=lambda stated: stated.time)
            self._keep(
                name, batch, changes=changes, parameter_shifts={}, references={}, deviations={}, finding=None,
                reference_point=None, shift_steps=[],
            )  # fmt: skip
            self._note_rejudgement(name, batch)
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
        """Judge alarms about delivery at `now` [s], release readings that the clock has reached, assess every
        turbine.

        left: turbine -> statement that its sender has left.  quiet: turbines whose silence raises no alarm,
        because other alarms explain it or a record is played back.
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
        self._judge(SOURCE, now, source_levels(sources, now), REACH_KIND, batch)
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

        unreached: turbine -> signal that is held while connected -> time [s] since which its sources are
        lost.  left: turbines whose sender has left.  begins: whether the tracker begins; all connections were
        lost if none ran for longer than `DOWN_S`.
        """
        batch, noted_s = Batch(), self._store.memory(SOURCE, CONNECTED) if begins and self._store else None
        lost_while_down = [noted_s] if isinstance(noted_s, float) and now - noted_s > DOWN_S else []
        for name, signals in unreached.items():
            for signal, lost_s in signals.items():
                for since in (*lost_while_down, now if lost_s is None and name in left else lost_s):
                    span = self.tracked[name].tracker.note_connection(signal, since, now)
                    if span is not None:
                        regained = span[1] if math.isfinite(span[1]) else None
                        batch.losses.append(Loss(name, signal, span[0], regained))
                        self._note_rejudgement(name, batch)
                        self.waiting.setdefault(name)
        if unreached:
            batch.memories[SOURCE, CONNECTED] = now
        return batch

    def _judge_missing(self, name: str, now: float, left: Statement | None, batch: Batch) -> None:
        """Judge alarms about signals that became silent or never came; not while a backlog may still bring
        the signals, unless their sender has left (statement `left`)."""
        state = self.tracked[name]
        turbine, heard = state.turbine, state.tracker.heard()
        if state.known_s > now:  # new, or this machine's clock was ahead
            self._keep(name, batch, known_s=now)
        if self.backlogs.awaited(name, now) and not left:
            return
        ages = {signal: now - time for signal, time in heard.items()} or {"": now - self._began}
        missing = [need for need in turbine.plan.expected if heard and not set(need.signals) & set(heard)]
        levels = stale_levels(ages, turbine.stale_s, left)
        levels += missing_levels(missing, state.known_s, now, turbine.stale_s)
        self._judge(name, now, levels, SILENCE, batch)

    def isolation_due(self) -> tuple[str, ShiftStep] | None:
        """The turbine that has waited longest for fault isolation, and the step whose cause is to be
        isolated; None if none is due or all of these await readings of the other turbines (sisters)."""
        by_turn = sorted(self.tracked.items(), key=lambda item: item[1].turn)
        due = ((name, state.shift_steps[0]) for name, state in by_turn if state.shift_steps)
        return next(((name, step) for name, step in due if not self._awaits_sisters(name, step.time)), None)

    def sisters(self, name: str, time: float) -> dict[str, Plan]:
        """The plans of the other turbines whose readings up to a time [s] are final."""
        others = {other: state for other, state in self.tracked.items() if other != name}
        return {
            other: state.turbine.plan for other, state in others.items() if state.tracker.judged_s >= time
        }

    def _awaits_sisters(self, name: str, time: float) -> bool:
        """Whether to wait until the readings of sisters up to a time [s] are final.

        The turbine waits for at most `SISTERS_S`, measured by stamps, so that the order of deliveries does
        not matter.
        """
        newest_s = self.tracked[name].tracker.newest
        trackers = {other: state.tracker for other, state in self.tracked.items() if other != name}
        behind = {other: tracker.newest for other, tracker in trackers.items() if tracker.judged_s < time}
        any_recent = any(newest > newest_s - SISTERS_S for newest in behind.values())
        return any(other in self.waiting for other in behind) or (newest_s < time + SISTERS_S and any_recent)

    def open_alarms(self) -> list[Alarm]:
        """The open alarms."""
        owners = (*self.tracked.values(), self._shared)
        alarms = (standing.alarm for owner in owners for standing in owner.alarms.values())
        return [alarm for alarm in alarms if alarm is not None]

    def keep_forecast(self, name: str, made_s: float, batch: Batch) -> None:
        """Keep the forecast of a turbine in the batch, from its state at `made_s` [s], and assess the
        turbine."""
        state, forecast_ = self.tracked[name], batch.forecasts[name]
        state.forecast_made_s, state.outlook = made_s, None
        if forecast_ is not None and forecast_.condition.condensation is not None:
            state.outlook = Outlook(forecast_.condition.time_s, forecast_.condition.condensation)
        self._assess(name, batch)

    def keep_finding(self, name: str, finding: CauseFinding) -> Batch:
        """Keep the finding of fault isolation, unless a change was stated meanwhile, and judge the alarms
        that it explains."""
        state, batch = self.tracked[name], Batch()
        state.turn = next(self._turn_numbers)  # the other turbines come first from now on
        if state.shift_steps and state.shift_steps[0].time == finding.time_s:
            self._keep(name, batch, finding=finding)
            self._judge_shifts(name, batch)
            self._assess(name, batch)
        return batch

    def forecast_due(self, every_s: float) -> str | None:
        """The turbine whose forecast is oldest, if it is at least `every_s` [s] old in the turbine's own
        time."""
        oldest_name, greatest_age = None, every_s
        for name, state in self.tracked.items():
            newest = state.tracker.newest_state
            if newest is not None:
                age = newest.time - state.forecast_made_s
                if age >= greatest_age:
                    oldest_name, greatest_age = name, age
        return oldest_name

    def _judge(self, name: str, now: float, levels: list[Level], follows: str, batch: Batch) -> None:
        before = self.tracked.get(name, self._shared).alarms
        after, changed = judge(name, before, now, levels, kinds_of(follows))
        if after != before:
            self._keep(name, batch, alarms=after)
        batch.alarms += changed

    def _assess(self, name: str, batch: Batch) -> None:
        """Assess a turbine, and put a changed assessment into the batch.  Before the first round or tick the
        time is not known yet, and the stored assessment stays valid."""
        if not math.isfinite(self._now):
            return
        state, now = self.tracked[name], self._now
        state_word, statements = assess(state.facts(now, self.backlogs.awaited(name, now)), now)
        content, previous = stated_content(statements), state.assessment
        if previous is None or (previous.state, previous.content) != (state_word, content):
            since = previous.since if previous is not None and previous.state == state_word else now
            state.assessment = Assessment(name, state_word, stated_text(statements), since, content)
            others = [other for other in batch.assessments if other.turbine != name]
            batch.assessments = [*others, state.assessment]

    def _keep(self, name: str, batch: Batch, **attributes: object) -> None:
        """Set attributes of a turbine's state, or of the shared state for `SOURCE`, and store them."""
        owner = self.tracked.get(name, self._shared)
        for key, value in attributes.items():
            setattr(owner, key, value)
            batch.memories[name, key] = plain(value)


def _without_pending(standings: Mapping[str, Standing]) -> dict[str, Standing]:
    """The standings without those of silence and clocks that have no alarm yet.

    After a restart a signal must be silent for the full time before its alarm begins, because the source may
    have kept its readings for the tracker.
    """
    kinds = kinds_of(SILENCE, CLOCKS)
    return {key: s for key, s in standings.items() if s.alarm is not None or s.kind not in kinds}
