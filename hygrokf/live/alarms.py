"""Alarms: when they begin and end, how severe they are, and what they say.

A rule watches a level.  An alarm begins once the level has been at or above `on` for `hold_s` and ends once
it has been below `off` for as long; between the two thresholds nothing changes.  Alarms about the process
follow from final estimates and their times alone, so that a replay raises the same alarms; alarms about
delivery (`DELIVERY`) follow from the wall clock.  An alarm's id consists of turbine, kind and beginning, so
that no alarm is raised twice after a crash.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.readings import SATURATED
from hygrokf.data.signals import from_si, signal_named
from hygrokf.data.timestamps import HOUR_S, MINUTE_S
from hygrokf.identification.verdict_terms import Inherited, rests_on
from hygrokf.live.batch import Alarm, stated_content, stated_text
from hygrokf.live.condition import Z95, Condition
from hygrokf.live.fault_isolation import PAIRED_SENSORS, PAIRS, CauseFinding, ShiftStep
from hygrokf.live.frozen import Frozen
from hygrokf.live.plan import Need
from hygrokf.live.properties import MOIST, TrackedState, relative_shift
from hygrokf.live.sources.stream import Reach
from hygrokf.live.traces import SAME_S
from hygrokf.live.tracker import TrackedCourse
from hygrokf.physics.signal_names import CABINET_RELATIVE_HUMIDITY
from hygrokf.texts.live_codes import AlarmCode, CauseCode
from hygrokf.texts.parts import PARTS
from hygrokf.texts.statement import Statement

ESTIMATES, SHIFTS, INNOVATION_KIND = "estimates", "shifts", "innovations"
SILENCE, CLOCKS, REACH_KIND = "silence", "clocks", "reach"
"""Origins of the levels of alarms (`AlarmRule.follows`)."""
DELIVERY = (SILENCE, CLOCKS, REACH_KIND)
"""Origins of the levels of alarms about delivery; no alarm about delivery begins in a replay."""
FROZEN_S = 6 * HOUR_S
"""[s] for which a signal must have repeated a value, beyond its longest repetition before."""
CONTRADICTION_SD = 8.0
"""Standard deviations √S of the prediction ŷ beyond which a reading y contradicts it: |y − ŷ| >
`CONTRADICTION_SD` √S.

On ordinary data of simulated cabinets the innovations have heavier tails than a normal distribution, so that
the bound is wider than a normal distribution would need: docs/validation/live_trials.md has the shares
of false and of correct flags.
"""
HUMIDITY_SENSOR = "humidity_sensor"
UNDECIDED_LEVEL = 0.75
"""Level, between `off` and `on`, at which no alarm begins or ends: of a change whose bounds contain zero."""
CHANGES = {
    ("thermal_time_constant", True): AlarmCode.HEAT_LOSS_LOWER,
    ("thermal_time_constant", False): AlarmCode.HEAT_LOSS_HIGHER,
    ("hygric_k", True): AlarmCode.AIR_EXCHANGE_LOWER,
    ("hygric_k", False): AlarmCode.AIR_EXCHANGE_HIGHER,
    (MOIST, False): AlarmCode.AIR_DRIER,
    ("heat_release_change", True): AlarmCode.HEAT_RELEASE_HIGHER,
    ("heat_release_change", False): AlarmCode.HEAT_RELEASE_LOWER,
}
"""(property, whether it increased) -> what its alarm says; for moister air see `SENSOR_OR_WATER`."""
SENSOR_ERRORS = {
    "temperature_reading_change": AlarmCode.TEMPERATURE_SENSOR_SUSPECT,
    "humidity_reading_change": AlarmCode.HUMIDITY_SENSOR_SUSPECT,
    "humidity_scale_change": AlarmCode.HUMIDITY_SCALE_SUSPECT,
    "ambient_temperature_change": AlarmCode.AMBIENT_TEMPERATURE_SUSPECT,
    "ambient_humidity_change": AlarmCode.AMBIENT_HUMIDITY_SUSPECT,
}
"""State of a sensor's error -> what its alarm says."""
CAUSE_CODES = {
    "thermal_time_constant": CauseCode.CHANGED_HEAT_LOSS,
    "hygric_k": CauseCode.CHANGED_AIR_EXCHANGE,
    "heat_release_change": CauseCode.CHANGED_HEAT_RELEASE,
    "temperature_sensor": CauseCode.TEMPERATURE_SENSOR,
    "humidity_sensor": CauseCode.HUMIDITY_SENSOR_OR_MOISTURE,
    "ambient_temperature": CauseCode.AMBIENT_TEMPERATURE_SENSOR,
    "ambient_humidity": CauseCode.AMBIENT_HUMIDITY_SENSOR,
}
"""Cause in `fault_isolation.STATES` -> its code."""
RESTS_ON = {
    "thermal_time_constant": PARTS[:1], "heat_release_change": PARTS[:1], "hygric_k": PARTS[1:],
    MOIST: PARTS[1:],
}  # fmt: skip
"""Property -> the numbers of the fit on which the level of its shift rests."""


@dataclass(frozen=True)
class Level:
    """How close an alarm of a `kind` is: its `level`, which the rule of the kind compares with its
    thresholds, and the `statements` that the alarm would make.

    `subject` distinguishes alarms of one kind; `severity`, if any, replaces that of the rule.
    """

    kind: str
    level: float
    statements: tuple[Statement, ...] = ()
    subject: str = ""
    severity: str = ""

    @property
    def key(self) -> str:
        """Kind and subject, which identify the state of the alarm."""
        return f"{self.kind} {self.subject}".strip()


@dataclass(frozen=True)
class AlarmState:
    """The state of an alarm of a `kind`: the open `alarm`, None while it is not open, and the time `since`
    [s] from which the level has been past the threshold for its beginning or, if it is open, for its end."""

    kind: str
    since: float | None = None
    alarm: Alarm | None = None


def judge(
    turbine: str,
    previous: Mapping[str, AlarmState],
    now: float,
    levels: Iterable[Level],
    kinds: Collection[str],
) -> tuple[dict[str, AlarmState], list[Alarm]]:
    """Judge levels at `now` [s]; returns `Level.key` → state of the alarm, and the alarms that began, changed
    or ended.

    previous: the states before.  A missing level of these `kinds` counts as 0; states of other kinds stay as
    they are.  `now` may go back after a late delivery; a level before the beginning of an alarm does not end
    the alarm.
    """
    level_by_key = {level.key: level for level in levels}
    states = {key: state for key, state in previous.items() if state.kind not in kinds}
    judged_before = [key for key in previous if key not in states]
    alarms: list[Alarm] = []
    for key in dict.fromkeys((*judged_before, *level_by_key)):
        before = previous[key] if key in previous else AlarmState(level_by_key[key].kind)
        level = level_by_key.get(key, Level(before.kind, 0.0))
        state, alarm = _judge_level(turbine, before, now, level)
        if alarm is not None:
            alarms.append(alarm)
        if state != AlarmState(before.kind):
            states[key] = state
    return states, alarms


def _judge_level(
    turbine: str, before: AlarmState, now: float, level: Level
) -> tuple[AlarmState, Alarm | None]:
    """Judge one level at `now` [s]; returns the new state of its alarm, and the alarm if it began, changed or
    ended."""
    rule, alarm = ALARM_RULES[level.kind], before.alarm
    severity = "alarm" if level.level >= rule.severe else level.severity or rule.severity
    if alarm is None:
        is_past_threshold = level.level >= rule.on
    else:
        is_past_threshold = level.level < rule.off and now >= alarm.began
    since = None
    if is_past_threshold:
        since = now if before.since is None else min(now, before.since)
    if since is not None and now - since >= rule.hold_s:
        if alarm is not None:
            return AlarmState(level.kind), replace(alarm, ended=since)
        begun = _alarm(turbine, since, severity, level)
        return AlarmState(level.kind, None, begun), begun
    if alarm is not None and severity == "alarm" and alarm.severity != "alarm":
        worsened = _alarm(turbine, alarm.began, severity, level)
        return AlarmState(level.kind, since, worsened), worsened
    return AlarmState(level.kind, since, alarm), None


def _alarm(turbine: str, began: float, severity: str, level: Level) -> Alarm:
    """Return the alarm of a level, with an id of turbine, kind, subject and beginning [s]."""
    return Alarm(
        id=f"{turbine}:{level.key}:{began:.0f}",
        turbine=turbine,
        kind=level.kind,
        severity=severity,
        began=began,
        statement=stated_text(level.statements),
        remedy=level.statements[0].remedy if level.statements else "",
        subject=level.subject,
        content=stated_content(level.statements),
    )


# -- levels that follow from estimates -----------------------------------------------------------------------
@dataclass(frozen=True)
class Estimated:
    """A turbine's condition, of which the instant at index `index` is judged, and its frozen signals."""

    condition: Condition
    index: int
    frozen: Sequence[Frozen] = ()


def condensation_levels(estimated: Estimated) -> list[Level]:
    """Return the level of condensation: its probability, if the model gives one."""
    probabilities, margin = estimated.condition.condensation, estimated.condition.margin_K
    if probabilities is None or margin is None:
        return []
    probability = float(probabilities[estimated.index])
    if probability < CONDENSATION.off:
        return [Level(CONDENSATION.kind, probability)]
    index, columns = estimated.index, (margin.value, margin.lower, margin.upper)
    value, lower, upper = (float(column[index]) for column in columns)
    code = AlarmCode.WATER_CONDENSES
    statement = code(probability=probability, margin_K=value, lower_K=lower, upper_K=upper)
    return [Level(CONDENSATION.kind, probability, (statement,))]


def frozen_levels(estimated: Estimated) -> list[Level]:
    """Return a level for each signal that repeats a value: the duration as a multiple of `FROZEN_S`."""
    time, levels = float(estimated.condition.time_s[estimated.index]), []
    for run in estimated.frozen:
        if run.known_s <= time < run.end:
            (value,), unit = _in_display_unit(run.signal, run.value)
            statement = AlarmCode.SIGNAL_FROZEN(signal=run.signal, value=value, unit=unit, since=run.since)
            levels.append(Level(STUCK.kind, (time - run.since) / FROZEN_S, (statement,), run.signal))
    return levels


def _in_display_unit(signal: str, *values: float) -> tuple[list[float], str]:
    """Convert values [SI unit] of a signal to its display unit; returns them and " UNIT"."""
    row = signal_named(signal)
    unit = {"degC": " °C", "1": ""}.get(row.display, f" {row.display}")
    return [float(from_si(value, row.display, row)) for value in values], unit


def estimate_levels(estimated: Estimated, verdicts: Mapping[str, Inherited]) -> list[Level]:
    """Return all levels from a turbine's estimates, with the doubts about its fit (`verdicts`)."""
    functions = (rule.levels for rule in ALARM_RULES.values() if rule.levels is not None)
    return with_doubts((level for levels_of in functions for level in levels_of(estimated)), verdicts)


def with_doubts(levels: Iterable[Level], verdicts: Mapping[str, Inherited]) -> list[Level]:
    """Add to each level the doubt about a number of the fit on which it rests, if one of the fit's `verdicts`
    rejects this number."""
    completed = []
    for level in levels:
        doubts = rests_on(verdicts, RESTS_ON.get(level.subject, ALARM_RULES[level.kind].rests_on))
        if doubts and level.statements:
            level = replace(level, statements=(*level.statements, *doubts))
        completed.append(level)
    return completed


# -- levels of lasting shifts --------------------------------------------------------------------------------
def shift_levels(step: ShiftStep, finding: CauseFinding | None) -> list[Level]:
    """Return the levels that follow from the tracked properties and from the `finding` of fault isolation.

    Without a finding there is no level of a shift; a finding without a cause gives one level for each lasting
    shift.  No alarm begins while the bounds of its size contain zero.  Moister air has a level unless fault
    isolation names another sensor; before the finding its alarm neither begins nor ends.
    """
    lasting = {shift.name: shift for shift in step.lasting}
    relevant = finding if lasting else None  # a finding explains lasting shifts alone
    deviations = step.deviations
    humidity_deviation = deviations.get(MOIST)
    causes = () if relevant is None else (relevant.cause, *relevant.alike)
    levels = []
    if humidity_deviation is not None and (
        HUMIDITY_SENSOR in causes or not causes or causes[0] not in PAIRED_SENSORS
    ):
        may_be_ambient = bool(set(PAIRS) & set(causes))
        code = AlarmCode.EITHER_SENSOR_OR_WATER if may_be_ambient else AlarmCode.HUMIDITY_SENSOR_OR_WATER
        level = relative_shift(MOIST, humidity_deviation)
        level = level if relevant is not None and MOIST in lasting else min(level, UNDECIDED_LEVEL)
        levels.append(
            Level(SENSOR_OR_WATER.kind, level, (code(**_size_with_bounds(MOIST, humidity_deviation)),))
        )
    if relevant is None:
        return levels
    if relevant.cause in PAIRED_SENSORS:
        return [*levels, *_sensor_levels(relevant)]
    shifts = {relevant.cause: lasting[relevant.cause]} if relevant.cause in lasting else lasting
    return levels + [
        _shift_level(name, deviations.get(name, TrackedState(shift.change, 0.0)), relevant)
        for name, shift in shifts.items()
        if (name, shift.change > 0.0) in CHANGES
    ]


def _sensor_levels(finding: CauseFinding) -> list[Level]:
    """Return the level of a sensor that fault isolation names; none for a humidity sensor that reads too
    high, which may be right (`SENSOR_OR_WATER`)."""
    if finding.cause == HUMIDITY_SENSOR and finding.value > 0.0:
        return []
    factor = 1.0 if "temperature" in finding.state else 100.0  # [K] or [%]
    low, size, high = (factor * (abs(finding.value) + sign * Z95 * finding.sd) for sign in (-1.0, 0.0, 1.0))
    side, other_side = ("high", "low") if finding.value > 0.0 else ("low", "high")
    is_in_pair = any(PAIRS.get(cause) == finding.cause for cause in finding.alike)
    statement = SENSOR_ERRORS[finding.state](
        size=size,
        lower=low,
        upper=high,
        side=side,
        either=AlarmCode.OR_AMBIENT(side=other_side) if is_in_pair else "",
        others=_other_causes(finding),
    )
    return [Level(SUSPECT.kind, 1.0 if low > 0.0 else UNDECIDED_LEVEL, (statement,), finding.cause)]


def _shift_level(name: str, deviation: TrackedState, finding: CauseFinding) -> Level:
    """Return the level of a property whose shift fault isolation has explained."""
    level = 1.0 if abs(deviation.x) > Z95 * deviation.sd else UNDECIDED_LEVEL
    statement = CHANGES[name, deviation.x > 0.0](
        **_size_with_bounds(name, deviation), others=_other_causes(finding)
    )
    return Level(CABINET_CHANGED.kind, level, (statement,), name)


def _size_with_bounds(name: str, deviation: TrackedState) -> dict[str, float]:
    """Return the size of a deviation with its 95 % bounds, in the unit that its alarm shows: [K] or [%]."""
    x, sd = deviation
    change_and_bounds = np.array([x, x - Z95 * sd, x + Z95 * sd])
    if name != "heat_release_change":
        change_and_bounds = 100.0 * (change_and_bounds if name == MOIST else np.expm1(change_and_bounds))
    return dict(zip(("change", "lower", "upper"), change_and_bounds.tolist(), strict=True))


def _other_causes(finding: CauseFinding) -> Statement | str:
    """Return the statement of the causes that explain the readings as well as the finding's cause, without
    the other sensor of its pair; "" without such causes."""
    causes = [CAUSE_CODES[cause]() for cause in finding.alike if PAIRS.get(cause) != finding.cause]
    return AlarmCode.OR_OTHERS(causes=tuple(causes)) if causes else ""


# -- levels of readings that contradict the estimate ---------------------------------------------------------
@dataclass(frozen=True)
class Innovation:
    """A `reading` of a signal at a time [s] beside its prediction: `expected` value and `sd` [SI unit].

    Before the filter uses a reading y it predicts ŷ with the variance S, which contains the uncertainty of
    the state, the model and the sensor.
    """

    signal: str
    time_s: float
    reading: float
    expected: float
    sd: float

    @property
    def deviations(self) -> float:
        """The innovation in standard deviations of its prediction; a humidity reading at the sensor's ceiling
        is a lower bound of the humidity."""
        reading = self.reading
        if self.signal == CABINET_RELATIVE_HUMIDITY and reading >= SATURATED:
            reading = max(SATURATED, self.expected)
        return (reading - self.expected) / self.sd


def innovations(course: TrackedCourse, final_s: float = math.inf) -> list[Innovation]:
    """Return the innovations of a course up to the time `final_s` [s], sorted by time and signal."""
    timeline, trace = course.run.timeline, course.trace
    is_final = course.seconds <= final_s + SAME_S
    arrays = timeline.y, trace.prediction, np.sqrt(trace.variance)
    by_signal = [
        Innovation(signal, float(course.seconds[i]), *(float(values[i, column]) for values in arrays))
        for column, signal in enumerate(timeline.outputs)
        for i in np.flatnonzero(is_final & np.isfinite(timeline.y[:, column]))
    ]
    return sorted(by_signal, key=lambda innovation: (innovation.time_s, innovation.signal))


def contradiction_level(innovation: Innovation) -> Level:
    """Return how much a reading contradicts the estimate: 1 at `CONTRADICTION_SD` standard deviations."""
    level = abs(innovation.deviations) / CONTRADICTION_SD
    if level < CONTRADICTS.off:
        return Level(CONTRADICTS.kind, level, subject=innovation.signal)
    mean, sd = innovation.expected, innovation.sd
    values = (innovation.reading, mean, mean - 2.0 * sd, mean + 2.0 * sd)
    (reading, expected, lower, upper), unit = _in_display_unit(innovation.signal, *values)
    statement = AlarmCode.READING_CONTRADICTS(
        signal=innovation.signal, reading=reading, expected=expected, lower=lower, upper=upper, unit=unit
    )
    return Level(CONTRADICTS.kind, level, (statement,), innovation.signal)


# -- levels of missing data ----------------------------------------------------------------------------------
def stale_levels(
    ages_s: Mapping[str, float], limit_s: float, departure: Statement | None = None
) -> list[Level]:
    """Return the level of stale data: the age of a turbine's oldest signal as a multiple of the limit [s].

    ages_s: signal → time [s] since its last reading.  departure: statement that the sender is offline, so
    that its signals are stale at once.
    """
    silent = {signal: age for signal, age in ages_s.items() if age > limit_s}
    age_s = max(silent.values(), default=0.0)
    if departure is not None:
        return [Level(STALE.kind, max(1.0, age_s / limit_s), (departure,))]
    if not silent:
        return []
    if len(silent) == len(ages_s):
        statement = AlarmCode.NOTHING_ARRIVES(age_h=age_s / HOUR_S)
    else:
        statement = AlarmCode.SIGNALS_SILENT(signals=tuple(sorted(silent)), age_h=age_s / HOUR_S)
    return [Level(STALE.kind, age_s / limit_s, (statement,))]


def missing_levels(missing: Iterable[Need], since: float, now: float, limit_s: float) -> list[Level]:
    """Return the levels of signals that never came: the time from `since`, when the tracker first knew the
    turbine, to `now` [s] as a multiple of the limit [s]; a notice if the model does not require the
    signal."""
    level, levels = (now - since) / limit_s, []
    for need in missing:
        code = AlarmCode.REQUIRED_NEVER_CAME if need.required else AlarmCode.SIGNAL_NEVER_CAME
        statement, severity = code(quantity=need.quantity, since=since), "" if need.required else "notice"
        levels.append(Level(SIGNAL_MISSING.kind, level, (statement,), need.signals[0], severity))
    return levels


def source_levels(reaches: Mapping[str, Reach], now: float) -> list[Level]:
    """Return a level for each source (URL) that is not reached: the duration until `now` [s] as a multiple of
    the source's limit."""
    levels = []
    for url, reach in reaches.items():
        if reach.since is not None:
            statement = AlarmCode.SOURCE_NOT_REACHED(source=url, since=reach.since, reason=reach.reason)
            levels.append(Level(SOURCE_LOST.kind, reach.share(now), (statement,), url))
    return levels


# -- the table of alarms -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class AlarmRule:
    """When alarms of a kind begin and end, from levels that follow from `follows`.

    `on`, `off`: levels at which an alarm begins and ends; `hold_s`: time [s] the level must persist;
    `severity`: severity at the beginning; `severe`: level from which the severity is "alarm"; `rests_on`:
    numbers of the fit on which the levels rest; `levels`: function that gives the levels where they follow
    from `ESTIMATES`.  `AlarmCode` has the statement and the remedy of each alarm.
    """

    kind: str
    follows: str
    on: float = 1.0
    off: float = 0.5
    hold_s: float = 0.0
    severity: str = "warning"
    severe: float = math.inf
    rests_on: tuple[str, ...] = PARTS
    levels: Callable[[Estimated], list[Level]] | None = None


ALARM_RULES = {
    rule.kind: rule
    for rule in (
        AlarmRule(
            "condensation", ESTIMATES, 0.5, 0.2, 20 * MINUTE_S, severe=0.95, levels=condensation_levels
        ),
        AlarmRule("sensor frozen", ESTIMATES, rests_on=(), levels=frozen_levels),
        AlarmRule("cabinet changed", SHIFTS),
        AlarmRule("sensor suspect", SHIFTS),
        AlarmRule("sensor or water", SHIFTS, rests_on=PARTS[1:]),
        AlarmRule("reading contradicts", INNOVATION_KIND),
        AlarmRule("data stale", SILENCE, hold_s=5 * MINUTE_S, severe=12.0),
        AlarmRule("signal missing", SILENCE),
        AlarmRule("clock wrong", CLOCKS, hold_s=15 * MINUTE_S, severity="alarm", severe=1.0),
        AlarmRule("source lost", REACH_KIND, severity="alarm", severe=1.0),
    )
}
"""The table of alarms, by kind.  A new kind that follows from estimates is a row here, its levels, and what
it says in `AlarmCode`; docs/explanation/live.md has an example."""
CONDENSATION = ALARM_RULES["condensation"]
STUCK = ALARM_RULES["sensor frozen"]
CABINET_CHANGED = ALARM_RULES["cabinet changed"]
SUSPECT = ALARM_RULES["sensor suspect"]
SENSOR_OR_WATER = ALARM_RULES["sensor or water"]
CONTRADICTS = ALARM_RULES["reading contradicts"]
STALE = ALARM_RULES["data stale"]
SIGNAL_MISSING = ALARM_RULES["signal missing"]
CLOCK = ALARM_RULES["clock wrong"]
SOURCE_LOST = ALARM_RULES["source lost"]


def kinds_of(*follows: str) -> tuple[str, ...]:
    """Return the kinds of alarms whose levels follow from one of `follows`, such as `ESTIMATES`."""
    return tuple(rule.kind for rule in ALARM_RULES.values() if rule.follows in follows)
