"""One turbine's filter for live readings, which may be late, repeated and in any order.

Readings are stored by their own times.  The **point** is the newest final estimate, about `lateness_s` before
the newest reading, kept as a Gaussian; the filter runs again from the point on whenever readings come in.
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
from hygrokf.live.plan import BEFORE, Plan
from hygrokf.live.traces import SAME_S, changed_trace
from hygrokf.modelling.inputs import Run, longest_gap_h, model_inputs
from hygrokf.physics.signal_names import AMBIENT_HUMIDITIES

PROVISIONAL_S = 7 * DAY_S
"""[s] for which estimates without cabinet readings stay provisional, because silent sensors may still deliver
readings."""
Losses = Mapping[str, Sequence[tuple[float, float]]]
"""Signal → spans (begin, end) [s] without connection; the end is ∞ while it is lost."""
Column = Sequence[float] | np.ndarray
"""Times [s] or values [SI unit] of a signal's readings."""
Readings = tuple[np.ndarray, np.ndarray]
"""Times [s] (T,) and values [SI unit] (T,) of a signal's readings."""
KEPT_OUT = {DEPARTED: "departed", FROZEN: "frozen"}
"""Verdict of the gate that rejects a reading → name of the count of these readings."""
GAP_END_S = 30 * DAY_S
"""[s] after the newest reading at which a gap that is too long to be bridged is assumed to end."""


@dataclass(frozen=True)
class Reading:
    """One reading of a signal: time [s since 1970, UTC], which for a mean is the end of its interval, and
    value [SI unit].

    `mark`: the source's own number of this version of the value, which orders the versions of a stamp; NaN:
    they are ordered by arrival; `NEITHER`: no version counts.
    """

    signal: str
    time: float
    value: float
    mark: float = field(default=math.nan, compare=False)

    def as_stored(self, mark: float = math.nan) -> Reading:
        """Return the reading with a mark and its time in whole microseconds, as every store keeps it."""
        time = whole_microseconds(self.time)
        return self if time == self.time and math.isnan(mark) else replace(self, time=time, mark=mark)


NEITHER = math.inf
"""`Reading.mark` of a source that states no order: of two values with one time stamp neither is used."""
Versions = dict[tuple[str, float], list[Reading]]
"""Versions of values by signal and time [s], in the order of their arrival."""
REVISIONS = ("revised", "revised late", "contradicting")
"""Names in `Tracker.counts` of new values at stamps that already had another value."""


def used_value(versions: Sequence[Reading]) -> float:
    """Return the value that the filter uses of the versions of a stamp, given in the order of their arrival:
    that with the greatest mark, else the last one; NaN if none is used."""
    if any(version.mark == NEITHER for version in versions):
        return math.nan
    return reduce(lambda used, version: used if version.mark < used.mark else version, versions).value


@dataclass(frozen=True)
class Point:
    """A final estimate: the Gaussian of the states after all readings up to `time` [s]."""

    time: float
    state: Gaussian


@dataclass(frozen=True)
class TrackedCourse:
    """The new estimates of a tracker: the run, and the filter's moments (`trace`) at its instants.

    `after_s`: time [s] after which the estimates begin, −∞ for the first course; `read`: times [s] of each
    signal's accepted readings.  Alarms are to be judged at instants in (`judged_s`, `final_s`] [s], which no
    reading within the lateness can change any more.  `frozen`: signals that repeat a value.
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
        """The instants (T,) [s since 1970] in whole microseconds, wherever the run begins."""
        return np.round(self.run.timeline.seconds * 1e6) / 1e6

    def state(self, index: int) -> Gaussian:
        """Return the state after the instant with this index; the accumulator of a mean that begins there is
        not reset."""
        time_h = float(self.run.timeline.time[index])
        return Gaussian(self.trace.mean[index].copy(), self.trace.covariance[index].copy(), time_h)

    def heard(self, signal: str) -> np.ndarray:
        """Return the time (T,) [s] of a signal's newest reading up to each instant, −∞ before the first."""
        times = np.append(-math.inf, self.read.get(signal, ()))
        return times[np.searchsorted(times, self.seconds + SAME_S, side="right") - 1]


class Tracker:
    """The state of one turbine's filter.

    A restart begins from the stored `point` and `readings()`.  `newest_state` is the estimate at the newest
    instant, which may still change, and `running` tells whether the turbine operates at this instant;
    `excess` [g/m³] is the vapour by which the newest humidity reading exceeds this estimate (`condition`);
    `newest` is the time [s] of the newest reading, −∞ without any; `frozen` are the signals that repeat a
    value at the point.  `counts` counts distinct readings: "late" (the first value of its stamp, received
    after the estimate at that time was final), "revised" (another value of a stamp before its estimate was
    final; `used_value` selects one), "revised late" (another value after that: not used), "contradicting" (no
    value of the stamp is used), "repeated" (a value that its stamp has had before) and, once the estimate is
    final, "departed" and "frozen" (rejected by `data.gate`).

    While all sensors of the cabinet are silent, estimates follow from the inputs alone.  These estimates are
    provisional for `PROVISIONAL_S`, because a late delivery replaces them; `provisional_point` is the last
    estimate that only a late delivery can change, and the filter continues from it.  Alarms do not wait: they
    are judged up to `judged_s` [s], and again from the point on if a late delivery changes their estimates.

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
        self.provisional_point: Point | None = None
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
        for reading in readings:
            self._insert(reading)
        self.judged_s = judged_s if point is None else max(point.time, judged_s)

    # -- readings --------------------------------------------------------------------------------------------
    def take(self, readings: Iterable[Reading], stored: Versions | None = None) -> list[str]:
        """Add readings in any order; returns for each reading its name in `counts`, "" for a first value in
        time.

        readings: with finite values.  stored: versions in the store of stamps whose estimates are final; new
        versions are added to them.
        """
        stored, outcomes = {} if stored is None else stored, []
        for reading in readings:
            if not math.isfinite(reading.value):
                raise ValueError(
                    f"{reading.signal}: expected a finite number, found {reading.value}; omit missing ones"
                )
            if not self.is_late(reading):
                outcomes.append(self._insert(reading))
                continue
            versions = stored.setdefault(
                (reading.signal, reading.time), self._versions_at(reading.signal, reading.time)
            )
            if any(reading.value == version.value for version in versions):
                outcomes.append("repeated")
            else:
                outcomes.append("revised late" if versions else "late")
                versions.append(reading)
        self.counts.update(filter(None, outcomes))
        return outcomes

    def note_change(self, time: float) -> float:
        """Take a change that a person stated for `time` [s] into account; returns the time [s] at which it
        takes effect, which is not before the newest final estimate."""
        if self.point is not None:
            time = max(time, self.point.time)
        self._judge_again_from(time)
        self.changes = (*self.changes, time)
        return time

    def note_connection(self, signal: str, lost_s: float | None, now: float) -> tuple[float, float] | None:
        """Note at `now` [s] whether the connection of a signal is lost; returns the span (begin, end) [s] of
        a loss that has begun (its end is ∞) or ended, else None.

        lost_s: time [s] since which it is lost, None if it is not, ∞ if this is not decided yet.  The edges
        of the span are whole seconds, as in files, and not before the newest final estimate or an earlier
        edge.
        """
        spans = self.lost.get(signal, ())
        is_open = bool(spans) and spans[-1][1] == math.inf
        if is_open == (lost_s is not None) or lost_s == math.inf:
            return None
        edge = max(now if lost_s is None else lost_s, -math.inf if self.point is None else self.point.time)
        previous_edge = spans[-1][0 if is_open else 1] if spans else -math.inf
        edge = float(math.ceil(max(edge, previous_edge + 1.0)))
        span = (spans[-1][0], edge) if is_open else (edge, math.inf)
        self.lost[signal] = (*(spans[:-1] if is_open else spans), span)
        self._judge_again_from(edge)
        return span

    def _judge_again_from(self, time: float) -> None:
        """Filter and judge again from the point on if `time` [s] was judged before."""
        if time <= self.judged_s + SAME_S:
            self.provisional_point, self.judged_s = None, -math.inf

    def is_late(self, reading: Reading) -> bool:
        """Return whether the estimate at a reading's time is already final."""
        return self.point is not None and reading.time <= self.point.time + SAME_S

    def _versions_at(self, signal: str, time: float) -> list[Reading]:
        """Return the versions of the value at a stamp [s], in the order of their arrival."""
        times = self._times.get(signal, array("d"))
        index = bisect.bisect_left(times, time)
        if index == len(times) or times[index] != time:
            return []
        only_version = Reading(signal, time, self._values[signal][index], self._marks[signal][index])
        return list(self._versions.get((signal, time), [only_version]))

    def _insert(self, reading: Reading) -> str:
        """Insert a reading; returns its name in `counts`, "" for the first value of its stamp."""
        self._judge_again_from(reading.time)
        times, values, marks = (
            by_signal.setdefault(reading.signal, array("d"))
            for by_signal in (self._times, self._values, self._marks)
        )
        # most readings come in order
        in_order = not times or reading.time > times[-1]
        index = len(times) if in_order else bisect.bisect_left(times, reading.time)
        if in_order or times[index] != reading.time:
            times.insert(index, reading.time)
            values.insert(index, reading.value)
            marks.insert(index, reading.mark)
            self.newest = max(self.newest, reading.time)
            return ""
        versions = self._versions_at(reading.signal, reading.time)
        if any(reading.value == version.value for version in versions):
            return "repeated"
        self._versions[reading.signal, reading.time] = versions = [*versions, reading]
        values[index] = used_value(versions)
        if not math.isnan(values[index]):
            return "revised"
        self.counts["contradicting"] += len(versions) == 2  # the first version is not used either
        return "contradicting"

    def readings(self) -> list[Reading]:
        """Return all readings in memory by signal and time; NaN where no version of a value is used."""
        return [
            Reading(signal, time, value)
            for signal in sorted(self._times)
            for time, value in zip(self._times[signal], self._values[signal], strict=True)
        ]

    def heard(self) -> dict[str, float]:
        """Return signal → time [s] of its newest reading."""
        return {signal: times[-1] for signal, times in self._times.items() if times}

    def stands_still(self, for_s: float) -> bool:
        """Return whether the turbine has fed no power for `for_s` [s] before its newest power reading; False
        if the readings of power do not cover this time."""
        times, values = self._times.get("active_power"), self._values.get("active_power")
        if not times or not values or times[0] > times[-1] - for_s:
            return False
        return not any(value > 0.0 for value in values[bisect.bisect_left(times, times[-1] - for_s) :])

    def history_until(self) -> float | None:
        """Return the time [s] up to which readings of ambient and cabinet are needed for the first estimate;
        None once there are enough, and while required signals are missing."""
        if self.point is not None or self.awaited():
            return None
        first_s, last_s, longest_interval_s = self._common_span()
        has_history = last_s - first_s > longest_interval_s
        return None if has_history else first_s + longest_interval_s

    def awaited(self) -> tuple[str, ...]:
        """Return the signals that the model requires but that never came; ambient humidity is named by its
        first variant."""
        present = {signal for signal, values in self._values.items() if any(map(math.isfinite, values))}
        variants = (need.signals for need in self.plan.needs if need.required)
        return tuple(sorted(signals[0] for signals in variants if not present & set(signals)))

    # -- the filter ------------------------------------------------------------------------------------------
    def advance(self) -> TrackedCourse | None:
        """Filter the new readings and advance the point; returns the new estimates.

        Returns None without new instants, and while required signals (`awaited`) or the history for the first
        estimate (`history_until`) are missing.
        """
        if self.awaited() or self.history_until() is not None:
            return None
        judged = {
            signal: judged_readings(self.plan, signal, times, self._values[signal], self._complete_s)
            for signal, times in self._times.items()
        }
        self._accepted = {signal: readings.accepted for signal, readings in judged.items()}
        run = model_inputs(
            self.plan.design, self._record_with_ended_gaps(), beyond=self.silent_since() is not None
        )
        silent_s = silent_since(self._times, self.plan.lateness_s)
        is_provisional = silent_s is not None and self.newest - silent_s <= PROVISIONAL_S
        # a course that moves the point begins at it, so that all estimates that it passes become final
        if self.provisional_point is not None and not (
            is_provisional and silent_s is not None and silent_s <= self.provisional_point.time
        ):
            self.provisional_point = None
        course = self._course(run)
        if course is None:
            return None
        seconds = course.seconds
        # a mean that ends after the run may have an interval that begins within it
        settled_s = min((readings.judgement.settled_s for readings in judged.values()), default=math.inf)
        final_s = min(self._final_s(), settled_s, float(seconds[-1]) - self.plan.longest_mean_s)
        frozen = self._frozen(judged)
        course = replace(course, judged_s=self.judged_s, final_s=final_s, frozen=frozen)
        self.newest_state = Point(float(seconds[-1]), self._state_at(course, len(seconds) - 1))
        self.running = bool(course.run.operating[-1])
        newest_final = self._state_until(course, final_s)
        point = (
            self._state_until(course, min(final_s, silent_s)) if is_provisional and silent_s else newest_final
        )
        if point is not None:
            point_before_s = -math.inf if self.point is None else self.point.time
            self.point = point
            for readings in judged.values():
                self.counts.update(readings.rejected(point_before_s + SAME_S, point.time + SAME_S))
            self.frozen = {spell.signal: spell for spell in frozen if spell.known_s <= point.time < spell.end}
            self._drop_old_readings()
        if newest_final is not None:
            self.provisional_point = newest_final if is_provisional else None
            self.judged_s = newest_final.time
        return course

    def _state_until(self, course: TrackedCourse, time: float) -> Point | None:
        """Return the last estimate of a course up to `time` [s]; None if the course begins later."""
        last = int(np.searchsorted(course.seconds, time + SAME_S, side="right")) - 1
        return None if last < 0 else Point(float(course.seconds[last]), self._state_at(course, last))

    def silent_since(self) -> float | None:
        """Return the time [s] of the cabinet's newest accepted reading if its sensors are silent, so that
        estimates follow from the inputs alone; otherwise None."""
        accepted_times = {signal: times for signal, (times, _) in self._accepted.items()}
        return silent_since(accepted_times, self.plan.lateness_s)

    def _frozen(self, judged: Mapping[str, JudgedReadings]) -> tuple[Frozen, ...]:
        """Return the ambient and cabinet signals that have repeated a value for too long since the point."""
        after_s = -math.inf if self.point is None else self.point.time
        runs: list[Frozen] = []
        for signal, readings in judged.items():
            scale = self.plan.scale(signal)
            if scale is not None and signal.startswith(("ambient_", "cabinet_")):
                known, context_s = self.frozen.get(signal), self.plan.context_s
                runs += frozen_runs(signal, readings.readings, scale.still_s, context_s, after_s, known)
        return tuple(runs)

    def _common_span(self) -> tuple[float, float, float]:
        """Return the first and last time [s] that readings of ambient and cabinet cover, and the longest
        averaging interval [s]."""
        known_times: dict[str, np.ndarray] = {}
        for signal, stamps in self._times.items():
            times = np.array(stamps)[np.isfinite(self._values[signal])]
            if len(times):
                known_times[signal] = times
        ambient = [known_times[s] for s in ("ambient_temperature", *AMBIENT_HUMIDITIES) if s in known_times]
        cabinet = [times for signal, times in known_times.items() if signal.startswith("cabinet_")]
        first_s = max(min(times[0] for times in cabinet or ambient), *(times[0] for times in ambient))
        last_s = min(max(times[-1] for times in cabinet or ambient), *(times[-1] for times in ambient))
        longest_interval_s = max((form.interval_s for form in self.plan.forms.values()), default=0.0)
        return float(first_s), float(last_s), longest_interval_s

    def _course(self, run: Run) -> TrackedCourse | None:
        """Filter the instants of a run after the estimate to continue from; None without new instants."""
        timeline, start = run.timeline, self.provisional_point or self.point
        after_s = -math.inf if start is None else start.time + SAME_S
        first = int(np.searchsorted(timeline.seconds, after_s, side="right"))
        # the run goes on to the assumed end of a gap (`GAP_END_S`)
        end = int(np.searchsorted(timeline.seconds, self.newest + SAME_S, side="right"))
        if first >= end:
            return None
        new_run = run.window(first, end)
        read = {signal: times for signal, (times, _) in self._accepted.items()}
        return TrackedCourse(new_run, self._filter(new_run.timeline, start), after_s - SAME_S, read)

    def _state_at(self, course: TrackedCourse, index: int) -> Gaussian:
        """Return the state from which the filter continues after the instant with this index; the accumulator
        of a mean that begins there is reset."""
        timeline = course.run.timeline
        if timeline.reset[index]:
            return self._filter(timeline.window(0, index + 1), self.provisional_point or self.point).last
        return course.state(index)

    def _filter(self, timeline: Timeline, start: Point | None) -> Trace:
        """Run the filter over a timeline from an estimate or, with None, from the prior."""
        since, state = (-math.inf, None) if start is None else (start.time, start.state)
        later_changes = [time for time in self.changes if time + SAME_S >= since]
        return changed_trace(self.plan.likelihood(timeline), self.plan.values, state, later_changes)

    @property
    def _complete_s(self) -> float:
        """Time [s] up to which all readings that will be used have arrived."""
        return self.newest - self.plan.lateness_s

    def _final_s(self) -> float:
        """Return the time [s] up to which no future reading can change the estimates.

        Between two readings an input depends on both of them, unless the first one is held.  An input from
        means, or corrected for a sensor's response, depends on further readings, too.  Whether a gap is
        bridged is known once the gap ends or is too long.
        """
        final_s = self._complete_s
        for signal, (times, _) in self._accepted.items():
            count = int(times.searchsorted(self._complete_s, side="right"))
            acts_at_its_time = signal.startswith("cabinet_") or self.plan.looks_back(signal)
            if count and not acts_at_its_time and not self._stale(signal):
                newest_unaffected = count - 1 - self.plan.readings_ahead(signal)
                final_s = (
                    min(final_s, times[newest_unaffected] - self.plan.form(signal).interval_s)
                    if newest_unaffected >= 0
                    else -math.inf
                )
        # a cabinet reading acts at its own time, but a mean acts from the beginning of its interval
        return min(final_s, self._complete_s - self.plan.longest_mean_s)

    def _stale(self, signal: str) -> bool:
        """Return whether an input's last reading is so old that the gap after it will not be bridged."""
        times, _ = self._accepted[signal]
        index = int(times.searchsorted(self._complete_s, side="right"))
        if index < len(times) or not index or self.plan.looks_back(signal):
            return False
        age, bridge_s = self._complete_s - times[-1], HOUR_S * longest_gap_h(signal)
        if age <= bridge_s or len(times) < 2:
            return age > bridge_s
        usual_step_s = middle(np.sort(np.diff(times)))
        return age > max(bridge_s, 1.5 * usual_step_s - self.plan.form(signal).interval_s)

    def _record_with_ended_gaps(self) -> Record:
        """Return the accepted readings, with an additional one `GAP_END_S` after the newest for each stale
        input, so that its gap is recognised as too long."""
        with_readings = {signal for signal, (times, _) in self._accepted.items() if len(times)}
        stale = {
            signal for signal in with_readings if not signal.startswith("cabinet_") and self._stale(signal)
        }
        if any(signal.startswith("ambient_") for signal in stale):
            stale |= {signal for signal in with_readings if signal.startswith("ambient_")}
        readings = dict(self._accepted)
        for signal in stale:
            times, values = self._accepted[signal]
            readings[signal] = np.append(times, self.newest + GAP_END_S), np.append(values, values[-1])
        return _record(self.plan, readings, self.lost)

    def _drop_old_readings(self) -> None:
        """Drop readings that no later instant needs, but keep `BEFORE` older readings to delimit gaps."""
        assert self.point is not None
        oldest_s = self.point.time - self.plan.context_s
        for signal, times in self._times.items():
            index = bisect.bisect_left(times, oldest_s) - BEFORE
            if index > 0:
                for columns in (self._times, self._values, self._marks):
                    del columns[signal][:index]
        first_s = {signal: times[0] for signal, times in self._times.items() if times}
        self._versions = {
            (signal, time): versions
            for (signal, time), versions in self._versions.items()
            if time >= first_s[signal]
        }
        self.lost = {
            signal: tuple(span for span in spans if span[1] >= oldest_s)
            for signal, spans in self.lost.items()
        }


@dataclass(frozen=True)
class JudgedReadings:
    """The readings of a signal (time [s], value [SI unit]) and the gate's judgement of them."""

    readings: Readings
    judgement: Judgement

    @property
    def accepted(self) -> Readings:
        """The accepted readings: times [s] (T,) and values [SI unit] (T,)."""
        time, value = self.readings
        is_accepted = self.judgement.verdict == ACCEPTED
        return (time, value) if is_accepted.all() else (time[is_accepted], value[is_accepted])

    def rejected(self, after_s: float, until_s: float) -> dict[str, int]:
        """Return name of a verdict → number of readings in (after_s, until_s] [s] that the gate rejected."""
        time, verdict = self.readings[0], self.judgement.verdict
        verdicts = verdict[(time > after_s) & (time <= until_s)]
        counts = {name: int(np.sum(verdicts == code)) for code, name in KEPT_OUT.items()}
        return {name: count for name, count in counts.items() if count}


def judged_readings(
    plan: Plan, signal: str, times: Column, values: Column, known_until_s: float = math.inf
) -> JudgedReadings:
    """Judge the readings of a signal by the gate, without NaN; all up to the time `known_until_s` [s] have
    arrived."""
    time, value = np.array(times, dtype=float), np.array(values, dtype=float)
    is_finite = np.isfinite(value)
    if not is_finite.all():
        time, value = time[is_finite], value[is_finite]
    scale = plan.scale(signal)
    if scale is None:
        return JudgedReadings((time, value), Judgement(np.zeros(len(time), dtype=np.int8), known_until_s))
    return JudgedReadings((time, value), judge(signal, time, value, scale, known_until_s))


def tracked_record(
    plan: Plan, times: Mapping[str, Column], values: Mapping[str, Column], lost: Losses | None = None
) -> Record:
    """Return a record of the plan's turbine with the accepted ones of the readings: signal → `times` [s],
    `values` [SI unit]; `lost`: signal → spans [s] without connection."""
    judged = {signal: judged_readings(plan, signal, times[signal], values[signal]) for signal in times}
    return _record(plan, {signal: readings.accepted for signal, readings in judged.items()}, lost or {})


def _record(plan: Plan, readings: Mapping[str, Readings], lost: Losses) -> Record:
    """Return a record of the plan's turbine with these readings; signals without readings are left out."""
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
    """Filter a complete record offline, with the tracker's model and steps and with stated changes at the
    times `changes` [s]; missing readings are skipped."""
    times = {series.signal: series.time for series in record.series}
    values = {series.signal: series.value for series in record.series}
    accepted = tracked_record(plan, times, values, {series.signal: series.lost for series in record.series})
    silent_s = silent_since({series.signal: series.time for series in accepted.series}, plan.lateness_s)
    run = model_inputs(plan.design, accepted, beyond=silent_s is not None)
    trace = changed_trace(plan.likelihood(run.timeline), plan.values, None, changes)
    return TrackedCourse(run, trace, read={series.signal: series.time for series in accepted.series})


def silent_since(times: Mapping[str, Column], lateness_s: float) -> float | None:
    """Return the time [s] of the cabinet's newest reading if its sensors are silent, that is if the ambient
    is known for more than the lateness [s] after it; otherwise None.  times: signal → times [s] of its
    readings."""
    newest = {signal: float(stamps[-1]) for signal, stamps in times.items() if len(stamps)}
    cabinet_s = max((at for signal, at in newest.items() if signal.startswith("cabinet_")), default=math.inf)
    vapour_s = max((newest[signal] for signal in AMBIENT_HUMIDITIES if signal in newest), default=math.inf)
    inputs_s = min(newest.get("ambient_temperature", -math.inf), vapour_s)
    return cabinet_s if inputs_s - cabinet_s > lateness_s else None
