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
from hygrokf.live.traces import SAME_S as SAME_S
from hygrokf.live.traces import changed_trace
from hygrokf.modelling.inputs import Run, longest_gap_h, model_inputs
from hygrokf.physics.signal_names import AMBIENT_HUMIDITIES

PROVISIONAL_S = 7 * DAY_S
"""[s] for which estimates from the inputs alone stay provisional, because silent cabinet sensors may still
deliver readings."""
Losses = Mapping[str, Sequence[tuple[float, float]]]
"""Signal → spans [s] in which its connection was lost; ∞ is the end of a loss that continues."""
Column = Sequence[float] | np.ndarray
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
        """The reading with its time rounded to microseconds, as every store gives it back, and a mark."""
        time = whole_microseconds(self.time)
        return self if time == self.time and math.isnan(mark) else replace(self, time=time, mark=mark)


NEITHER = math.inf
"""Mark of a source of which no version of a value is used once there are two."""
Versions = dict[tuple[str, float], list[Reading]]
"""Versions of values by signal and time [s], in the order of their arrival."""
REVISIONS = ("revised", "revised late", "contradicting")
"""Counts of new values at stamps that already had another value (`Tracker.counts`)."""


def used_value(versions: Sequence[Reading]) -> float:
    """The value that is used of the versions of a stamp, given in the order of their arrival: the version
    with the greatest mark, else the last one; NaN if none is used."""
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
    """Estimates after the point or, while the cabinet's sensors are silent, after `Tracker.ahead`: the run,
    and the filter's moments at its instants.

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
        """The instants (T,) [s since 1970], rounded to microseconds, so that they do not depend on where the
        run begins."""
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
    provisional for `PROVISIONAL_S`, because a late delivery replaces them; `ahead` is the last estimate that
    only a late delivery can change, and the filter continues from it.  Alarms do not wait: they are judged up
    to `judged_s` [s], and again from the point on if a late delivery changes their estimates.

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
        for reading in readings:
            self._insert(reading)
        self.judged_s = judged_s if point is None else max(point.time, judged_s)

    # -- readings --------------------------------------------------------------------------------------------
    def take(self, readings: Iterable[Reading], stored: Versions | None = None) -> list[str]:
        """Add readings in any order; values must be finite.  Returns the name of the count for each reading,
        "" for the first value of a stamp that is not late.

        stored: known versions of stamps whose estimates are final; new versions are added to them.
        """
        stored, outcomes = {} if stored is None else stored, []
        for reading in readings:
            if not math.isfinite(reading.value):
                raise ValueError(
                    f"{reading.signal}: expected a number, found {reading.value}; a missing reading is none"
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
        """Take a stated change at `time` [s] into account; returns the time [s] at which it takes effect,
        which is not before the newest final estimate."""
        if self.point is not None:
            time = max(time, self.point.time)
        self._doubt(time)
        self.changes = (*self.changes, time)
        return time

    def note_connection(self, signal: str, lost_s: float | None, now: float) -> tuple[float, float] | None:
        """Note at `now` [s] the time `lost_s` [s] since which the connection of a signal is lost: None if it
        is not lost, ∞ if this is not known yet.

        Returns the span of a loss that has begun (its end is ∞) or ended, else None.  The edges of the span
        are not before the newest final estimate or an earlier edge, and are whole seconds, as files keep
        them.
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
        self._doubt(edge)
        return span

    def _doubt(self, time: float) -> None:
        """Filter and judge anew from the point on if something new acts at a `time` [s] that was judged."""
        if time <= self.judged_s + SAME_S:
            self.ahead, self.judged_s = None, -math.inf

    def is_late(self, reading: Reading) -> bool:
        """Whether the estimate at a reading's time is already final."""
        return self.point is not None and reading.time <= self.point.time + SAME_S

    def _versions_at(self, signal: str, time: float) -> list[Reading]:
        """The kept versions of a stamp, in the order of their arrival."""
        times = self._times.get(signal, array("d"))
        place = bisect.bisect_left(times, time)
        if place == len(times) or times[place] != time:
            return []
        only_version = Reading(signal, time, self._values[signal][place], self._marks[signal][place])
        return list(self._versions.get((signal, time), [only_version]))

    def _insert(self, reading: Reading) -> str:
        """Insert a reading; returns the name of its count, "" for the first value of its stamp."""
        self._doubt(reading.time)
        kept = (self._times, self._values, self._marks)
        columns = times, values, _ = [by_signal.setdefault(reading.signal, array("d")) for by_signal in kept]
        # most readings come in order
        in_order = not times or reading.time > times[-1]
        place = len(times) if in_order else bisect.bisect_left(times, reading.time)
        if in_order or times[place] != reading.time:
            for column, number in zip(columns, (reading.time, reading.value, reading.mark), strict=True):
                column.insert(place, number)
            self.newest = max(self.newest, reading.time)
            return ""
        versions = self._versions_at(reading.signal, reading.time)
        if any(reading.value == version.value for version in versions):
            return "repeated"
        self._versions[reading.signal, reading.time] = versions = [*versions, reading]
        values[place] = used_value(versions)
        if not math.isnan(values[place]):
            return "revised"
        self.counts["contradicting"] += len(versions) == 2  # the first version is not used either
        return "contradicting"

    def readings(self) -> list[Reading]:
        """All stored readings, sorted by signal and time; NaN where no version of a value is used."""
        return [
            Reading(signal, time, value)
            for signal in sorted(self._times)
            for time, value in zip(self._times[signal], self._values[signal], strict=True)
        ]

    def heard(self) -> dict[str, float]:
        """Time [s] of the newest reading of each signal."""
        return {signal: times[-1] for signal, times in self._times.items() if times}

    def stands_still(self, for_s: float) -> bool:
        """Whether the turbine has fed no power in the last `for_s` [s] before its newest power reading; False
        if the readings of power do not cover this time."""
        times, values = self._times.get("active_power"), self._values.get("active_power")
        if not times or not values or times[0] > times[-1] - for_s:
            return False
        return not any(value > 0.0 for value in values[bisect.bisect_left(times, times[-1] - for_s) :])

    def history_until(self) -> float | None:
        """Time [s] up to which readings of ambient and cabinet are needed for the first estimate; None with
        an estimate, and while signals are missing."""
        if self.point is not None or self.awaited():
            return None
        first, last, longest = self._overlap()
        return first + longest if last - first <= longest else None

    def awaited(self) -> tuple[str, ...]:
        """Signals that the model needs but that are still missing; a missing ambient humidity is named by its
        first variant."""
        present = {signal for signal, values in self._values.items() if any(map(math.isfinite, values))}
        variants = (need.signals for need in self.plan.needs if need.required)
        return tuple(sorted(signals[0] for signals in variants if not present & set(signals)))

    # -- the filter ------------------------------------------------------------------------------------------
    def advance(self) -> TrackedCourse | None:
        """Filter the readings after the point and advance the point; returns the course after the old point.

        Returns None without new instants, while `awaited` names signals, and while `history_until` gives a
        time.
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
        if self.ahead is not None and not (
            is_provisional and silent_s is not None and silent_s <= self.ahead.time
        ):
            self.ahead = None
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
            self._forget()
        if newest_final is not None:
            self.ahead = newest_final if is_provisional else None
            self.judged_s = newest_final.time
        return course

    def _state_until(self, course: TrackedCourse, time: float) -> Point | None:
        last = int(np.searchsorted(course.seconds, time + SAME_S, side="right")) - 1
        return None if last < 0 else Point(float(course.seconds[last]), self._state_at(course, last))

    def silent_since(self) -> float | None:
        """Time [s] of the cabinet's newest accepted reading if estimates follow from the inputs alone; None
        else."""
        return silent_since({s: times for s, (times, _) in self._accepted.items()}, self.plan.lateness_s)

    def _frozen(self, judged: Mapping[str, JudgedReadings]) -> tuple[Frozen, ...]:
        after_s = -math.inf if self.point is None else self.point.time
        runs: list[Frozen] = []
        for signal, readings in judged.items():
            scale = self.plan.scale(signal)
            if scale is not None and signal.startswith(("ambient_", "cabinet_")):
                before = self.frozen.get(signal)
                runs += frozen_runs(
                    signal, readings.readings, scale.still_s, self.plan.context_s, after_s, before
                )
        return tuple(runs)

    def _overlap(self) -> tuple[float, float, float]:
        """First and last time [s] at which the readings of ambient and, if any, cabinet are known, and the
        longest averaging interval [s]."""
        known_times = {
            signal: [t for t, v in zip(times, self._values[signal], strict=True) if not math.isnan(v)]
            for signal, times in self._times.items()
        }
        ambient = [known_times[s] for s in ("ambient_temperature", *AMBIENT_HUMIDITIES) if known_times.get(s)]
        cabinet = [times for s, times in known_times.items() if s.startswith("cabinet_") and times] or ambient
        first = max(min(times[0] for times in cabinet), *(times[0] for times in ambient))
        last = min(max(times[-1] for times in cabinet), *(times[-1] for times in ambient))
        longest_interval_s = max((form.interval_s for form in self.plan.forms.values()), default=0.0)
        return first, last, longest_interval_s

    def _course(self, run: Run) -> TrackedCourse | None:
        timeline, start = run.timeline, self.ahead or self.point
        after = -math.inf if start is None else start.time + SAME_S
        first = int(np.searchsorted(timeline.seconds, after, side="right"))
        # the run goes on to the assumed end of a gap (`GAP_END_S`)
        end = int(np.searchsorted(timeline.seconds, self.newest + SAME_S, side="right"))
        if first >= end:
            return None
        new_run = run.window(first, end)
        read = {signal: times for signal, (times, _) in self._accepted.items()}
        return TrackedCourse(new_run, self._filter(new_run.timeline, start), after - SAME_S, read)

    def _state_at(self, course: TrackedCourse, place: int) -> Gaussian:
        """The state from which the filter continues after an instant; the accumulator of a mean that begins
        there is reset."""
        timeline = course.run.timeline
        if timeline.reset[place]:
            return self._filter(timeline.window(0, place + 1), self.ahead or self.point).last
        return course.state(place)

    def _filter(self, timeline: Timeline, start: Point | None) -> Trace:
        since, state = (-math.inf, None) if start is None else (start.time, start.state)
        later_changes = [time for time in self.changes if time + SAME_S >= since]
        return changed_trace(self.plan.likelihood(timeline), self.plan.values, state, later_changes)

    @property
    def _complete_s(self) -> float:
        """Time [s] up to which all readings that will be used have arrived."""
        return self.newest - self.plan.lateness_s

    def _final_s(self) -> float:
        """Time [s] up to which no future reading can change the estimates.

        Between two readings a driver depends on both of them, unless the first one is held.  A path through
        means, or a path corrected for a sensor's response, depends on further readings, too.  Whether a gap
        is bridged is known once the gap ends or is too long.
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
        """Whether a driver's last reading is so old that the gap after it will not be bridged."""
        times, _ = self._accepted[signal]
        place = int(times.searchsorted(self._complete_s, side="right"))
        if place < len(times) or not place or self.plan.looks_back(signal):
            return False
        age, bridge_s = self._complete_s - times[-1], HOUR_S * longest_gap_h(signal)
        if age <= bridge_s or len(times) < 2:
            return age > bridge_s
        usual_step_s = middle(np.sort(np.diff(times)))
        return age > max(bridge_s, 1.5 * usual_step_s - self.plan.form(signal).interval_s)

    def _record_with_ended_gaps(self) -> Record:
        """The accepted readings, with an additional one at the newest time + `GAP_END_S` for each stale
        driver, so that its gap is recognised as too long."""
        with_readings = {s for s, (times, _) in self._accepted.items() if len(times)}
        stale = {s for s in with_readings if not s.startswith("cabinet_") and self._stale(s)}
        if any(s.startswith("ambient_") for s in stale):
            stale |= {s for s in with_readings if s.startswith("ambient_")}
        ahead = self.newest + GAP_END_S
        readings = {
            s: (np.append(times, ahead), np.append(values, values[-1])) if s in stale else (times, values)
            for s, (times, values) in self._accepted.items()
        }
        return _record(self.plan, readings, self.lost)

    def _forget(self) -> None:
        """Drop readings that no later instant needs, but keep `BEFORE` older readings to delimit gaps."""
        assert self.point is not None
        oldest_s = self.point.time - self.plan.context_s
        for signal, times in self._times.items():
            place = bisect.bisect_left(times, oldest_s) - BEFORE
            if place > 0:
                for columns in (self._times, self._values, self._marks):
                    del columns[signal][:place]
        first_s = {signal: times[0] for signal, times in self._times.items() if times}
        self._versions = {
            (signal, time): versions
            for (signal, time), versions in self._versions.items()
            if time >= first_s[signal]
        }
        self.lost = {s: tuple((a, b) for a, b in spans if b >= oldest_s) for s, spans in self.lost.items()}


@dataclass(frozen=True)
class JudgedReadings:
    """The readings of a signal (time [s], value [SI unit]) and the gate's judgement of them."""

    readings: Readings
    judgement: Judgement

    @property
    def accepted(self) -> Readings:
        time, value = self.readings
        is_accepted = self.judgement.verdict == ACCEPTED
        return (time, value) if is_accepted.all() else (time[is_accepted], value[is_accepted])

    def rejected(self, after_s: float, until_s: float) -> dict[str, int]:
        """Numbers of readings in (after_s, until_s] [s] that the gate rejected, by verdict."""
        time, verdict = self.readings[0], self.judgement.verdict
        within = verdict[(time > after_s) & (time <= until_s)]
        return {name: n for code, name in KEPT_OUT.items() if (n := int(np.sum(within == code)))}


def judged_readings(
    plan: Plan, signal: str, times: Column, values: Column, known_until_s: float = math.inf
) -> JudgedReadings:
    """The readings of a signal of the plan's turbine that are not missing, judged by the gate."""
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
    """A record of the plan's turbine from times [s] and values [SI unit] by signal, judged by the gate."""
    judged = {signal: judged_readings(plan, signal, times[signal], values[signal]) for signal in times}
    return _record(plan, {signal: readings.accepted for signal, readings in judged.items()}, lost or {})


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
    """The course of the offline filter on a complete record, with the tracker's model and steps; missing
    readings are skipped.

    `changes`: times [s] of stated changes.
    """
    times = {series.signal: series.time for series in record.series}
    values = {series.signal: series.value for series in record.series}
    accepted = tracked_record(plan, times, values, {series.signal: series.lost for series in record.series})
    silent_s = silent_since({series.signal: series.time for series in accepted.series}, plan.lateness_s)
    run = model_inputs(plan.design, accepted, beyond=silent_s is not None)
    trace = changed_trace(plan.likelihood(run.timeline), plan.values, None, changes)
    return TrackedCourse(run, trace, read={series.signal: series.time for series in accepted.series})


def silent_since(times: Mapping[str, Column], lateness_s: float) -> float | None:
    """Time [s] of the cabinet's newest reading if the ambient is known for more than the lateness [s] after
    this reading; None else, and without any reading of the cabinet.

    times: signal → times [s] of its readings.
    """
    newest = {signal: float(stamps[-1]) for signal, stamps in times.items() if len(stamps)}
    cabinet_s = max((at for signal, at in newest.items() if signal.startswith("cabinet_")), default=math.inf)
    vapour_s = max((newest[signal] for signal in AMBIENT_HUMIDITIES if signal in newest), default=math.inf)
    inputs_s = min(newest.get("ambient_temperature", -math.inf), vapour_s)
    return cabinet_s if inputs_s - cabinet_s > lateness_s else None
