"""One turbine's filter for live readings, which may be late, repeated and in any order.

Readings are stored by their own times.  Up to the **point**, about `lateness_s` before the newest reading,
the estimate is final and kept as a Gaussian; from there on the filter runs again whenever readings come in.
Final estimates equal those of the offline filter on the same readings (`offline_course`) bit for bit, because
both take the same steps: instants and inputs come from `modelling.inputs.model_inputs`, and the inputs at an
instant depend only on the readings around it.
"""

from __future__ import annotations

import bisect
import math
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np

from hygrokf.data.ambient import middle
from hygrokf.data.gate import ACCEPTED, DEPARTED, FROZEN, Judgement, judge
from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S, HOUR_S, whole_microseconds
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Gaussian, Trace
from hygrokf.live.frozen import Frozen, frozen_runs
from hygrokf.live.plan import AMBIENT_HUMIDITIES, BEFORE, Plan
from hygrokf.live.traces import SAME_S as SAME_S
from hygrokf.live.traces import changed_trace
from hygrokf.modelling.inputs import Run, longest_gap_h, model_inputs

WAITS_S = 7 * DAY_S
"""[s] for which estimates from the inputs alone wait for a late delivery of silent cabinet sensors."""
Losses = Mapping[str, Sequence[tuple[float, float]]]
"""Spans [s] in which the connection of a signal was lost, ∞ as the end of one that still is."""
Column = Sequence[float] | np.ndarray
Readings = tuple[np.ndarray, np.ndarray]
"""Times [s] (T,) and values [SI unit] (T,) of a signal's readings."""
KEPT_OUT = {DEPARTED: "departed", FROZEN: "frozen"}
"""Verdicts of the gate, and the counts of the readings that it keeps out."""
AHEAD_S = 30 * DAY_S
"""[s] after the newest reading at which a gap that is too long to be bridged is assumed to end."""


@dataclass(frozen=True)
class Reading:
    """One reading of a signal: time [s since 1970, UTC], which for a mean is the end of its interval, and
    value [SI unit].

    `mark`: the source's own number of this version of the value, by which those of one stamp are ordered;
    NaN: by arrival; `NEITHER`: none of them counts.
    """

    signal: str
    time: float
    value: float
    mark: float = field(default=math.nan, compare=False)

    def as_stored(self, mark: float = math.nan) -> Reading:
        """The reading with its time rounded to microseconds, as every store gives it back, and a mark."""
        time = whole_microseconds(self.time)
        return self if time == self.time and math.isnan(mark) else replace(self, time=time, mark=mark)


NEITHER = math.inf
"""Mark of a source whose versions of a value are all unused once there are two."""
Versions = dict[tuple[str, float], list[Reading]]
"""Versions of values by signal and time [s], in the order of their arrival."""
REVISIONS = ("revised", "revised late", "contradicting")
"""Counts of values that their stamp has not had before, while it had others (`Tracker.counts`)."""


def used_value(versions: Sequence[Reading]) -> float:
    """The value that counts of the versions of one stamp, in the order of their arrival: the one with the
    greatest mark, else the last one; NaN if none counts."""
    if any(one.mark == NEITHER for one in versions):
        return math.nan
    return reduce(lambda used, one: used if one.mark < used.mark else one, versions).value


@dataclass(frozen=True)
class Point:
    """A final estimate: the Gaussian of the states after all readings up to `time` [s]."""

    time: float
    state: Gaussian


@dataclass(frozen=True)
class TrackedCourse:
    """Estimates after the point, or after those that go on from it in silence: the run, and the filter's
    moments at its instants.

    `after_s`: time [s] after which they begin, −∞ at the first ones; `read`: times [s] of each
    signal's accepted readings.  Alarms are to be judged at instants in (`judged_s`, `final_s`] [s],
    those that no reading within the lateness can change any more.  `frozen`: signals that repeat a value.
    """

    run: Run
    trace: Trace
    after_s: float = -math.inf
    read: Mapping[str, np.ndarray] = field(default_factory=dict)
    judged_s: float = -math.inf
    final_s: float = -math.inf
    frozen: tuple[Frozen, ...] = ()

    @property
    def seconds(self) -> np.ndarray:
        """The instants (T,) [s since 1970], in whole microseconds whatever the run begins with."""
        return np.round(self.run.timeline.seconds * 1e6) / 1e6

    def state(self, place: int) -> Gaussian:
        """The state after an instant; the accumulator of a mean that begins there is not reset."""
        time_h = float(self.run.timeline.time[place])
        return Gaussian(self.trace.mean[place].copy(), self.trace.covariance[place].copy(), time_h)

    def heard(self, signal: str) -> np.ndarray:
        """Time (T,) [s] of the newest reading of a cabinet signal up to each instant, −∞ before the first."""
        times = np.append(-math.inf, self.read.get(signal, ()))
        return times[np.searchsorted(times, self.seconds + SAME_S, side="right") - 1]


class Tracker:
    """The state of one turbine's filter.

    A restart begins from the `point` and the `readings()` of before.  `newest_state` is the estimate at the
    newest instant, which may still change, and `running` whether the turbine operates then; `excess`
    [g/m³] is the vapour by which the newest humidity reading exceeds it (`condition`); `newest` is the time
    [s] of the newest reading, −∞ without any; `frozen` are the signals that repeat a value at the point.
    `counts` counts distinct readings: "late" (the first value of its stamp, received after the estimate at
    that time was final), "revised" (another value of a stamp before that, of which `used_value` counts),
    "revised late" (after it: not used), "contradicting" (values of which none counts), and, once final,
    "departed" and "frozen" (kept out by `data.gate`); and "repeated", values that their stamp has had before.

    While all sensors of the cabinet are silent, estimates go on from the inputs alone.  They are provisional
    for `WAITS_S`, because a late delivery fills them in; `ahead` is the last of them that only such a
    delivery can change, and from which the filter goes on.  Alarms do not wait: they are judged up to
    `judged_s` [s], and again from the point on where a late delivery changes what they followed from.

    plan: what the tracker needs of a fit (`live.plan.plan`).
    point: the final estimate to begin from, or None.
    readings: stored readings after it, in SI units.
    changes: [s] times of stated changes of the cabinet.
    versions: of stamps that had several values.
    judged_s: [s] time up to which alarms have been judged before.
    frozen: signals that repeated a value at the point.
    lost: spans in which a connection was lost.
    """

    def __init__(
        self,
        plan: Plan,
        point: Point | None = None,
        readings: Iterable[Reading] = (),
        changes: Iterable[float] = (),
        versions: Versions | None = None,
        judged_s: float = -math.inf,
        frozen: Mapping[str, Frozen] | None = None,
        lost: Losses | None = None,
    ) -> None:
        self.plan = plan
        self.changes = tuple(changes)
        self.point = point
        self.ahead: Point | None = None
        self.judged_s = -math.inf
        self.newest_state = point
        self.running = False
        self.excess = math.nan
        self.newest = -math.inf
        self.counts: Counter[str] = Counter()
        self._times: dict[str, array[float]] = {}
        self._values: dict[str, array[float]] = {}
        self._marks: dict[str, array[float]] = {}
        self._versions = dict(versions or {})
        self._accepted: dict[str, Readings] = {}
        self.frozen = dict(frozen or {})
        self.lost = {signal: tuple(spans) for signal, spans in (lost or {}).items()}
        for one in readings:
            self._insert(one)
        self.judged_s = judged_s if point is None else max(point.time, judged_s)

    # -- readings --------------------------------------------------------------------------------------------
    def take(self, readings: Iterable[Reading], stored: Versions | None = None) -> list[str]:
        """Add readings in any order; values must be finite.  Returns for each the count that it belongs to,
        "" for a first value in time.

        stored: versions that are known of stamps whose estimates are final; what comes is added to them.
        """
        stored, outcomes = {} if stored is None else stored, []
        for one in readings:
            if not math.isfinite(one.value):
                raise ValueError(
                    f"{one.signal}: expected a number, found {one.value}; a missing reading is none"
                )
            if not self.is_late(one):
                outcomes.append(self._insert(one))
                continue
            known = stored.setdefault((one.signal, one.time), self._versions_at(one.signal, one.time))
            if any(one.value == before.value for before in known):
                outcomes.append("repeated")
            else:
                outcomes.append("revised late" if known else "late")
                known.append(one)
        self.counts.update(filter(None, outcomes))
        return outcomes

    def note_change(self, time: float) -> float:
        """Take a stated change at `time` [s] into account; returns the time from which it is, which is not
        before the newest final estimate."""
        if self.point is not None:
            time = max(time, self.point.time)
        self._doubt(time)
        self.changes = (*self.changes, time)
        return time

    def note_connection(self, signal: str, lost_s: float | None, now: float) -> tuple[float, float] | None:
        """Note at `now` [s] that the connection of a signal is lost since `lost_s` [s], or is not (None);
        ∞ if that is not known yet.

        Returns the span of a loss that has begun (its end is ∞) or ended.  No edge of it is before the newest
        final estimate or an earlier edge; they are whole seconds, as files keep them.
        """
        before = self.lost.get(signal, ())
        open_span = bool(before) and before[-1][1] == math.inf
        if open_span == (lost_s is not None) or lost_s == math.inf:
            return None
        edge = max(now if lost_s is None else lost_s, -math.inf if self.point is None else self.point.time)
        earlier = before[-1][0 if open_span else 1] if before else -math.inf
        edge = float(math.ceil(max(edge, earlier + 1.0)))
        span = (before[-1][0], edge) if open_span else (edge, math.inf)
        self.lost[signal] = (*(before[:-1] if open_span else before), span)
        self._doubt(edge)
        return span

    def _doubt(self, time: float) -> None:
        """Filter and judge anew from the point on if something new acts at a `time` [s] that is judged."""
        if time <= self.judged_s + SAME_S:
            self.ahead, self.judged_s = None, -math.inf

    def is_late(self, one: Reading) -> bool:
        """Whether the estimate at a reading's time is already final."""
        return self.point is not None and one.time <= self.point.time + SAME_S

    def _versions_at(self, signal: str, time: float) -> list[Reading]:
        """The versions of a stamp that are kept, in the order of their arrival."""
        times = self._times.get(signal, array("d"))
        place = bisect.bisect_left(times, time)
        if place == len(times) or times[place] != time:
            return []
        alone = Reading(signal, time, self._values[signal][place], self._marks[signal][place])
        return list(self._versions.get((signal, time), [alone]))

    def _insert(self, one: Reading) -> str:
        """Insert a reading; returns the count that it belongs to, "" for the first value of its stamp."""
        self._doubt(one.time)
        kept = (self._times, self._values, self._marks)
        columns = times, values, _ = [by_signal.setdefault(one.signal, array("d")) for by_signal in kept]
        # most readings come in order
        in_order = not times or one.time > times[-1]
        place = len(times) if in_order else bisect.bisect_left(times, one.time)
        if in_order or times[place] != one.time:
            for column, number in zip(columns, (one.time, one.value, one.mark), strict=True):
                column.insert(place, number)
            self.newest = max(self.newest, one.time)
            return ""
        known = self._versions_at(one.signal, one.time)
        if any(one.value == before.value for before in known):
            return "repeated"
        self._versions[one.signal, one.time] = known = [*known, one]
        values[place] = used_value(known)
        if not math.isnan(values[place]):
            return "revised"
        self.counts["contradicting"] += len(known) == 2  # the first one is not used either
        return "contradicting"

    def readings(self) -> list[Reading]:
        """All stored readings, sorted by signal and time; NaN where no version of a value counts."""
        return [
            Reading(signal, time, value)
            for signal in sorted(self._times)
            for time, value in zip(self._times[signal], self._values[signal], strict=True)
        ]

    def heard(self) -> dict[str, float]:
        """Time [s] of the newest reading of each signal."""
        return {signal: times[-1] for signal, times in self._times.items() if times}

    def stands_still(self, for_s: float) -> bool:
        """Whether the turbine has fed no power for a time [s] up to its newest power reading; False without
        readings of power over that time."""
        times, values = self._times.get("active_power"), self._values.get("active_power")
        if not times or not values or times[0] > times[-1] - for_s:
            return False
        return not any(value > 0.0 for value in values[bisect.bisect_left(times, times[-1] - for_s) :])

    def history_until(self) -> float | None:
        """Time [s] until which readings of ambient and cabinet have to come before the first estimate; None
        with an estimate, and while signals are missing."""
        if self.point is not None or self.awaited():
            return None
        first, last, longest = self._overlap()
        return first + longest if last - first <= longest else None

    def awaited(self) -> tuple[str, ...]:
        """Signals that the model needs but that are still missing; a missing ambient humidity is named by its
        first variant."""
        there = {signal for signal, values in self._values.items() if any(map(math.isfinite, values))}
        missing = (one.signals for one in self.plan.needs if one.required)
        return tuple(sorted(signals[0] for signals in missing if not there & set(signals)))

    # -- the filter ------------------------------------------------------------------------------------------
    def advance(self) -> TrackedCourse | None:
        """Filter the readings after the point and advance the point; returns the course after the old point.

        Returns None without new instants, while `awaited` names signals, and until the ambient is known over
        some period.
        """
        if self.awaited() or self.history_until() is not None:
            return None
        judged = {
            signal: judged_readings(self.plan, signal, times, self._values[signal], self._limit)
            for signal, times in self._times.items()
        }
        self._accepted = {signal: one.accepted for signal, one in judged.items()}
        made = model_inputs(
            self.plan.design, self._record_with_ended_gaps(), beyond=self.silent_since() is not None
        )
        silent_s = silent_since(self._times, self.plan.lateness_s)
        waits = silent_s is not None and self.newest - silent_s <= WAITS_S
        # a course that moves the point begins at it, so that all estimates that it passes become final
        if self.ahead is not None and not (waits and silent_s is not None and silent_s <= self.ahead.time):
            self.ahead = None
        course = self._course(made)
        if course is None:
            return None
        seconds = course.seconds
        # a mean that ends after the run may have an interval that begins within it
        settled = min((one.judgement.settled_s for one in judged.values()), default=math.inf)
        final_s = min(self._final(), settled, float(seconds[-1]) - self.plan.longest_mean_s)
        frozen = self._frozen(judged)
        course = replace(course, judged_s=self.judged_s, final_s=final_s, frozen=frozen)
        self.newest_state = Point(float(seconds[-1]), self._state_at(course, len(seconds) - 1))
        self.running = bool(course.run.operating[-1])
        reached = self._reached(course, final_s)
        point = self._reached(course, min(final_s, silent_s)) if waits and silent_s else reached
        if point is not None:
            before = -math.inf if self.point is None else self.point.time
            self.point = point
            for one in judged.values():
                self.counts.update(one.kept_out(before + SAME_S, point.time + SAME_S))
            self.frozen = {one.signal: one for one in frozen if one.known_s <= point.time < one.end}
            self._forget()
        if reached is not None:
            self.ahead = reached if waits else None
            self.judged_s = reached.time
        return course

    def _reached(self, course: TrackedCourse, time: float) -> Point | None:
        last = int(np.searchsorted(course.seconds, time + SAME_S, side="right")) - 1
        return None if last < 0 else Point(float(course.seconds[last]), self._state_at(course, last))

    def silent_since(self) -> float | None:
        """Time [s] of the cabinet's newest usable reading if estimates go on without it; None else."""
        return silent_since({s: times for s, (times, _) in self._accepted.items()}, self.plan.lateness_s)

    def _frozen(self, judged: Mapping[str, JudgedReadings]) -> tuple[Frozen, ...]:
        after_s = -math.inf if self.point is None else self.point.time
        found: list[Frozen] = []
        for signal, one in judged.items():
            scale = self.plan.scale(signal)
            if scale is not None and signal.startswith(("ambient_", "cabinet_")):
                known = self.frozen.get(signal)
                found += frozen_runs(signal, one.readings, scale.still_s, self.plan.context_s, after_s, known)
        return tuple(found)

    def _overlap(self) -> tuple[float, float, float]:
        """First and last time [s] of which ambient and, if any, cabinet are known, and the longest averaging
        interval [s]."""
        known = {
            signal: [t for t, v in zip(times, self._values[signal], strict=True) if not math.isnan(v)]
            for signal, times in self._times.items()
        }
        ambient = [known[s] for s in ("ambient_temperature", *AMBIENT_HUMIDITIES) if known.get(s)]
        cabinet = [times for s, times in known.items() if s.startswith("cabinet_") and times] or ambient
        first = max(min(times[0] for times in cabinet), *(times[0] for times in ambient))
        last = min(max(times[-1] for times in cabinet), *(times[-1] for times in ambient))
        longest = max((form.interval_s for form in self.plan.forms.values()), default=0.0)
        return first, last, longest

    def _course(self, made: Run) -> TrackedCourse | None:
        t, start = made.timeline, self.ahead or self.point
        after = -math.inf if start is None else start.time + SAME_S
        first = int(np.searchsorted(t.seconds, after, side="right"))
        # a gap of the ambient that has not ended yet reaches far ahead
        end = int(np.searchsorted(t.seconds, self.newest + SAME_S, side="right"))
        if first >= end:
            return None
        part = made.window(first, end)
        read = {signal: times for signal, (times, _) in self._accepted.items()}
        return TrackedCourse(part, self._filter(part.timeline, start), after - SAME_S, read)

    def _state_at(self, course: TrackedCourse, place: int) -> Gaussian:
        """The state from which the filter continues after an instant; the accumulator of a mean that begins
        there is reset."""
        t = course.run.timeline
        if t.reset[place]:
            return self._filter(t.window(0, place + 1), self.ahead or self.point).last
        return course.state(place)

    def _filter(self, t: Timeline, start: Point | None) -> Trace:
        since, state = (-math.inf, None) if start is None else (start.time, start.state)
        coming = [time for time in self.changes if time + SAME_S >= since]
        return changed_trace(self.plan.likelihood(t), self.plan.values, state, coming)

    @property
    def _limit(self) -> float:
        """Time [s] up to which all readings that will be used have arrived."""
        return self.newest - self.plan.lateness_s

    def _final(self) -> float:
        """Time [s] up to which no future reading can change the estimates.

        Between two readings a driver depends on both, unless it holds from its stamp on.  A path through
        means, or one corrected for a sensor's response, depends on further readings, too.  Whether a gap is
        bridged is known once it ends or is too long.
        """
        final = self._limit
        for signal, (times, _) in self._accepted.items():
            place = int(times.searchsorted(self._limit, side="right"))
            steps = signal.startswith("cabinet_") or self.plan.looks_back(signal)
            if place and not steps and not self._stale(signal):
                last = place - 1 - self.plan.readings_ahead(signal)
                final = (
                    min(final, times[last] - self.plan.form(signal).interval_s) if last >= 0 else -math.inf
                )
        # a cabinet reading acts at its own time, but a mean acts from the beginning of its interval
        return min(final, self._limit - self.plan.longest_mean_s)

    def _stale(self, signal: str) -> bool:
        """Whether a driver's last reading is so old that the gap after it will not be bridged."""
        times, _ = self._accepted[signal]
        place = int(times.searchsorted(self._limit, side="right"))
        if place < len(times) or not place or self.plan.looks_back(signal):
            return False
        age, bridge_s = self._limit - times[-1], HOUR_S * longest_gap_h(signal)
        if age <= bridge_s or len(times) < 2:
            return age > bridge_s
        usual = middle(np.sort(np.diff(times)))
        return age > max(bridge_s, 1.5 * usual - self.plan.form(signal).interval_s)

    def _record_with_ended_gaps(self) -> Record:
        """The readings, with one far ahead for each stale driver, so that its gap is recognised as too
        long."""
        known = {signal for signal, (times, _) in self._accepted.items() if len(times)}
        stale = {s for s in known if not s.startswith("cabinet_") and self._stale(s)}
        if any(s.startswith("ambient_") for s in stale):
            stale |= {s for s in known if s.startswith("ambient_")}
        ahead = self.newest + AHEAD_S
        readings = {
            s: (np.append(times, ahead), np.append(values, values[-1])) if s in stale else (times, values)
            for s, (times, values) in self._accepted.items()
        }
        return _record(self.plan, readings, self.lost)

    def _forget(self) -> None:
        """Drop readings that no later instant needs, but keep `BEFORE` older ones to delimit gaps."""
        assert self.point is not None
        oldest = self.point.time - self.plan.context_s
        for signal, times in self._times.items():
            place = bisect.bisect_left(times, oldest) - BEFORE
            if place > 0:
                for columns in (self._times, self._values, self._marks):
                    del columns[signal][:place]
        kept = {signal: times[0] for signal, times in self._times.items() if times}
        self._versions = {at: known for at, known in self._versions.items() if at[1] >= kept[at[0]]}
        self.lost = {s: tuple(one for one in spans if one[1] >= oldest) for s, spans in self.lost.items()}


@dataclass(frozen=True)
class JudgedReadings:
    """The readings of a signal (time [s], value [SI unit]) and the gate's judgement of them."""

    readings: Readings
    judgement: Judgement

    @property
    def accepted(self) -> Readings:
        time, value = self.readings
        there = self.judgement.verdict == ACCEPTED
        return (time, value) if there.all() else (time[there], value[there])

    def kept_out(self, after_s: float, until_s: float) -> dict[str, int]:
        """Numbers of readings that were kept out within a time (after_s, until_s] [s], by the verdict."""
        time, verdict = self.readings[0], self.judgement.verdict
        within = verdict[(time > after_s) & (time <= until_s)]
        return {name: n for code, name in KEPT_OUT.items() if (n := int(np.sum(within == code)))}


def judged_readings(
    plan: Plan, signal: str, times: Column, values: Column, known_until_s: float = math.inf
) -> JudgedReadings:
    """The readings of a signal of the plan's turbine that are not missing, judged by the gate."""
    time, value = np.array(times, dtype=float), np.array(values, dtype=float)
    there = np.isfinite(value)
    if not there.all():
        time, value = time[there], value[there]
    scale = plan.scale(signal)
    if scale is None:
        return JudgedReadings((time, value), Judgement(np.zeros(len(time), dtype=np.int8), known_until_s))
    return JudgedReadings((time, value), judge(signal, time, value, scale, known_until_s))


def record_of(
    plan: Plan, times: Mapping[str, Column], values: Mapping[str, Column], lost: Losses | None = None
) -> Record:
    """A record of the plan's turbine from times [s] and values [SI unit] by signal, judged by the gate."""
    judged = {signal: judged_readings(plan, signal, times[signal], values[signal]) for signal in times}
    return _record(plan, {signal: one.accepted for signal, one in judged.items()}, lost or {})


def _record(plan: Plan, readings: Mapping[str, Readings], lost: Losses) -> Record:
    series = [
        Series(
            signal=signal,
            time=time,
            value=value,
            lost=tuple(lost.get(signal, ())),
            **vars(plan.form(signal)),
        )
        for signal, (time, value) in sorted(readings.items())
        if len(time)
    ]
    return Record(plan.name, tuple(series), plan.site, plan.rated_power_W)


def offline_course(plan: Plan, record: Record, changes: Iterable[float] = ()) -> TrackedCourse:
    """The offline filter on a whole record, with the tracker's model and steps; missing readings are
    skipped.

    `changes`: times [s] of stated changes.
    """
    times = {s.signal: s.time for s in record.series}
    values = {s.signal: s.value for s in record.series}
    accepted = record_of(plan, times, values, {s.signal: s.lost for s in record.series})
    silent_s = silent_since({s.signal: s.time for s in accepted.series}, plan.lateness_s)
    made = model_inputs(plan.design, accepted, beyond=silent_s is not None)
    trace = changed_trace(plan.likelihood(made.timeline), plan.values, None, changes)
    return TrackedCourse(made, trace, read={s.signal: s.time for s in accepted.series})


def silent_since(times: Mapping[str, Column], lateness_s: float) -> float | None:
    """Time [s] of the cabinet's newest reading if the ambient is known for more than the lateness [s] after
    it; None else, and without any reading of the cabinet.  `times` [s] are those of each signal's readings.
    """
    newest = {signal: float(some[-1]) for signal, some in times.items() if len(some)}
    cabinet = max((at for signal, at in newest.items() if signal.startswith("cabinet_")), default=math.inf)
    vapour = max((newest[signal] for signal in AMBIENT_HUMIDITIES if signal in newest), default=math.inf)
    inputs = min(newest.get("ambient_temperature", -math.inf), vapour)
    return cabinet if inputs - cabinet > lateness_s else None
