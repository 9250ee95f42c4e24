"""Alarms: when they begin and end, how severe they are, and what they say.

A rule watches a level.  An alarm begins once the level has been at or above `on` for `hold_s` and ends once
it has been below `off` for as long; between the two thresholds nothing changes.  Alarms about the process
follow from final estimates and their times alone, so that a replay gives the same ones; alarms about delivery
(`DELIVERY`) follow from the wall clock.  An alarm's id consists of turbine, kind and beginning, so
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
from hygrokf.live.batch import Alarm, content_of, text_of
from hygrokf.live.condition import Z95, Condition
from hygrokf.live.fault_isolation import PAIRS, SENSORS, CauseFinding, ShiftStep
from hygrokf.live.frozen import Frozen
from hygrokf.live.plan import Need
from hygrokf.live.properties import MOIST, TrackedState, relative_shift
from hygrokf.live.sources.stream import Reach
from hygrokf.live.traces import HUMIDITY
from hygrokf.live.tracker import SAME_S, TrackedCourse
from hygrokf.modelling.design import PARTS
from hygrokf.texts.live_codes import AlarmCode, CauseCode
from hygrokf.texts.statement import Statement

ESTIMATES, SHIFTS, INNOVATIONS = "estimates", "shifts", "innovations"
SILENCE, CLOCKS, REACH = "silence", "clocks", "reach"
DELIVERY = (SILENCE, CLOCKS, REACH)
"""What levels follow from where alarms are about delivery; none of them begins in a replay."""
FROZEN_S = 6 * HOUR_S
"""[s] for which a signal must have repeated one value, beyond what it ever did before."""
BEYOND = 8.0
"""Standard deviations √S of the prediction ŷ beyond which a reading y contradicts it: |y − ŷ| > `BEYOND` √S.

On ordinary data of simulated cabinets the innovations have heavier tails than a normal distribution, so that
the bound is wider than a normal distribution would need: docs/validation/live_trials.md has the shares
of false and of right flags.
"""
HUMIDITY_SENSOR = "humidity_sensor"
UNSURE = 0.75
"""Level of a change whose bounds contain zero: no alarm begins, and none ends."""
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
CAUSES = {
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
    """A level that the rule of a kind judges, and what an alarm of it says; `severity` replaces the rule's.

    `subject` distinguishes alarms of one kind.
    """

    kind: str
    level: float
    statements: tuple[Statement, ...] = ()
    subject: str = ""
    severity: str = ""

    @property
    def key(self) -> str:
        return f"{self.kind} {self.subject}".strip()


@dataclass(frozen=True)
class Standing:
    """State of an alarm of a kind: the open `alarm`, if any, and `since` when [s] the level has been past the
    next threshold."""

    kind: str
    since: float | None = None
    alarm: Alarm | None = None


def judge(
    turbine: str, known: Mapping[str, Standing], now: float, levels: Iterable[Level], kinds: Collection[str]
) -> tuple[dict[str, Standing], list[Alarm]]:
    """The standings after judging the levels at `now` [s], and the alarms that began, changed or ended.

    A missing level of these `kinds` counts as 0; standings of other kinds stay as they are.  `now` may go
    back where a late delivery changed what was judged; what was before an alarm began does not end it.
    """
    given = {level.key: level for level in levels}
    standings = {key: standing for key, standing in known.items() if standing.kind not in kinds}
    alarms: list[Alarm] = []
    for key in dict.fromkeys((*(key for key in known if key not in standings), *given)):
        before = known[key] if key in known else Standing(given[key].kind)
        standing, alarm = _judge_level(turbine, before, now, given.get(key, Level(before.kind, 0.0)))
        if alarm is not None:
            alarms.append(alarm)
        if standing != Standing(before.kind):
            standings[key] = standing
    return standings, alarms


def _judge_level(turbine: str, before: Standing, now: float, level: Level) -> tuple[Standing, Alarm | None]:
    rule, alarm = RULES[level.kind], before.alarm
    severity = "alarm" if level.level >= rule.severe else level.severity or rule.severity
    past = level.level >= rule.on if alarm is None else level.level < rule.off and now >= alarm.began
    since = None if not past else now if before.since is None else min(now, before.since)
    if since is not None and now - since >= rule.hold_s:
        if alarm is not None:
            return Standing(level.kind), replace(alarm, ended=since)
        begun = _alarm(turbine, since, severity, level)
        return Standing(level.kind, None, begun), begun
    if alarm is not None and severity == "alarm" and alarm.severity != "alarm":
        worse = _alarm(turbine, alarm.began, severity, level)
        return Standing(level.kind, since, worse), worse
    return Standing(level.kind, since, alarm), None


def _alarm(turbine: str, began: float, severity: str, level: Level) -> Alarm:
    return Alarm(
        id=f"{turbine}:{level.key}:{began:.0f}",
        turbine=turbine,
        kind=level.kind,
        severity=severity,
        began=began,
        statement=text_of(level.statements),
        remedy=level.statements[0].remedy if level.statements else "",
        subject=level.subject,
        content=content_of(level.statements),
    )


# -- levels that follow from estimates -----------------------------------------------------------------------
@dataclass(frozen=True)
class Estimated:
    """A turbine's estimates: the condition, of which instant `place` is judged, and its frozen signals."""

    condition: Condition
    place: int
    frozen: Sequence[Frozen] = ()


def condensation_levels(now: Estimated) -> list[Level]:
    """The probability of condensation: that the coldest surface is below the dew point."""
    chances, margin = now.condition.condensation, now.condition.margin_K
    if chances is None or margin is None:
        return []
    chance = float(chances[now.place])
    if chance < CONDENSATION.off:
        return [Level(CONDENSATION.kind, chance)]
    value, lower, upper = (float(one[now.place]) for one in (margin.value, margin.lower, margin.upper))
    statement = AlarmCode.WATER_CONDENSES(probability=chance, margin_K=value, lower_K=lower, upper_K=upper)
    return [Level(CONDENSATION.kind, chance, (statement,))]


def frozen_levels(now: Estimated) -> list[Level]:
    """One level for each signal that repeats a value: for how long, as a multiple of `FROZEN_S`."""
    time, levels = float(now.condition.time_s[now.place]), []
    for one in now.frozen:
        if one.known_s <= time < one.end:
            (value,), unit = _shown(one.signal, one.value)
            statement = AlarmCode.SIGNAL_FROZEN(signal=one.signal, value=value, unit=unit, since=one.since)
            levels.append(Level(STUCK.kind, (time - one.since) / FROZEN_S, (statement,), one.signal))
    return levels


def _shown(signal: str, *values: float) -> tuple[list[float], str]:
    """Values [SI unit] of a signal in the unit that messages show, and this unit after its blank."""
    row = signal_named(signal)
    unit = {"degC": " °C", "1": ""}.get(row.display, f" {row.display}")
    return [float(from_si(value, row.display, row)) for value in values], unit


def estimate_levels(now: Estimated, verdicts: Mapping[str, Inherited]) -> list[Level]:
    """All levels that follow from a turbine's estimates, with the doubts about its fit (`verdicts`)."""
    rules = (rule.levels for rule in RULES.values() if rule.levels is not None)
    return with_doubts((level for levels in rules for level in levels(now)), verdicts)


def with_doubts(levels: Iterable[Level], verdicts: Mapping[str, Inherited]) -> list[Level]:
    """The levels, with a doubt about each that rests on a number of the fit that its verdict rejects;
    `verdicts` are the fit's."""
    doubted = []
    for level in levels:
        doubts = rests_on(verdicts, RESTS_ON.get(level.subject, RULES[level.kind].rests_on))
        if doubts and level.statements:
            level = replace(level, statements=(*level.statements, *doubts))
        doubted.append(level)
    return doubted


# -- levels of lasting shifts --------------------------------------------------------------------------------
def shift_levels(step: ShiftStep, finding: CauseFinding | None) -> list[Level]:
    """Levels that follow from the tracked properties and, for those of lasting shifts, from fault isolation.

    There is no level of a shift before fault isolation has a finding; a finding without a cause gives one
    level for each property.  No alarm begins while the bounds of its size contain zero.  Moister air is told
    unless another sensor explains the readings better; before that is known, no alarm of it begins or ends.
    """
    lasting = {shift.name: shift for shift in step.lasting}
    known = finding if lasting else None
    deviations = step.deviations
    moist = deviations.get(MOIST)
    alike = () if known is None else (known.cause, *known.alike)
    levels = []
    if moist is not None and (HUMIDITY_SENSOR in alike or not alike or alike[0] not in SENSORS):
        either = set(PAIRS) & set(alike)
        code = AlarmCode.EITHER_SENSOR_OR_WATER if either else AlarmCode.HUMIDITY_SENSOR_OR_WATER
        level = relative_shift(MOIST, moist)
        level = level if known is not None and MOIST in lasting else min(level, UNSURE)
        levels.append(Level(SENSOR_OR_WATER.kind, level, (code(**_size(MOIST, moist)),)))
    if known is None:
        return levels
    if known.cause in SENSORS:
        return [*levels, *_sensor_levels(known)]
    named = {known.cause: lasting[known.cause]} if known.cause in lasting else lasting
    return levels + [
        _shift_level(name, deviations.get(name, TrackedState(shift.change, 0.0)), known)
        for name, shift in named.items()
        if (name, shift.change > 0.0) in CHANGES
    ]


def _sensor_levels(finding: CauseFinding) -> list[Level]:
    """The level of a sensor that fault isolation names; a humidity sensor that reads too high may be right,
    and is part of `SENSOR_OR_WATER`."""
    if finding.cause == HUMIDITY_SENSOR and finding.value > 0.0:
        return []
    factor = 1.0 if "temperature" in finding.state else 100.0
    low, size, high = (factor * (abs(finding.value) + part * Z95 * finding.sd) for part in (-1.0, 0.0, 1.0))
    side, other = ("high", "low") if finding.value > 0.0 else ("low", "high")
    pair = any(PAIRS.get(one) == finding.cause for one in finding.alike)
    statement = SENSOR_ERRORS[finding.state](
        size=size,
        lower=low,
        upper=high,
        side=side,
        either=AlarmCode.OR_AMBIENT(side=other) if pair else "",
        others=_others(finding),
    )
    return [Level(SUSPECT.kind, 1.0 if low > 0.0 else UNSURE, (statement,), finding.cause)]


def _shift_level(name: str, deviation: TrackedState, finding: CauseFinding) -> Level:
    level = 1.0 if abs(deviation.x) > Z95 * deviation.sd else UNSURE
    statement = CHANGES[name, deviation.x > 0.0](**_size(name, deviation), others=_others(finding))
    return Level(CHANGED.kind, level, (statement,), name)


def _size(name: str, deviation: TrackedState) -> dict[str, float]:
    """The size of a deviation with its bounds, in the unit that its alarm shows: [K] or [%]."""
    x, sd = deviation
    ends = np.array([x, x - Z95 * sd, x + Z95 * sd])
    if name != "heat_release_change":
        ends = 100.0 * (ends if name == MOIST else np.expm1(ends))
    return dict(zip(("change", "lower", "upper"), ends.tolist(), strict=True))


def _others(finding: CauseFinding) -> Statement | str:
    """Causes that cannot be distinguished from that of the finding, but for the other sensor of a pair."""
    causes = [CAUSES[cause]() for cause in finding.alike if PAIRS.get(cause) != finding.cause]
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
        """The innovation in standard deviations of its prediction; at its ceiling a humidity sensor reads at
        least its reading."""
        reading = self.reading
        if self.signal == HUMIDITY and reading >= SATURATED:
            reading = max(SATURATED, self.expected)
        return (reading - self.expected) / self.sd


def innovations(course: TrackedCourse, final_s: float = math.inf) -> list[Innovation]:
    """The innovations of a course by time, as far as its estimates are final (up to `final_s` [s])."""
    timeline, trace = course.run.timeline, course.trace
    known = course.seconds <= final_s + SAME_S
    columns = timeline.y, trace.prediction, np.sqrt(trace.variance)
    found = [
        Innovation(signal, float(course.seconds[i]), *(float(one[i, column]) for one in columns))
        for column, signal in enumerate(timeline.outputs)
        for i in np.flatnonzero(known & np.isfinite(timeline.y[:, column]))
    ]
    return sorted(found, key=lambda one: (one.time_s, one.signal))


def contradiction_level(one: Innovation) -> Level:
    """The level of a contradiction: 1 at `BEYOND` standard deviations of the prediction."""
    level = abs(one.deviations) / BEYOND
    if level < CONTRADICTS.off:
        return Level(CONTRADICTS.kind, level, subject=one.signal)
    ends = (one.expected, one.expected - 2.0 * one.sd, one.expected + 2.0 * one.sd)
    (reading, expected, lower, upper), unit = _shown(one.signal, one.reading, *ends)
    statement = AlarmCode.READING_CONTRADICTS(
        signal=one.signal, reading=reading, expected=expected, lower=lower, upper=upper, unit=unit
    )
    return Level(CONTRADICTS.kind, level, (statement,), one.signal)


# -- levels of missing data ----------------------------------------------------------------------------------
def stale_levels(ages_s: Mapping[str, float], limit_s: float, left: Statement | None = None) -> list[Level]:
    """The level of stale data: age [s] of a turbine's oldest signal as a multiple of the limit [s].

    left: about a sender that has left, so that its signals are stale at once.
    """
    silent = {signal: age for signal, age in ages_s.items() if age > limit_s}
    age_s = max(silent.values(), default=0.0)
    if left is not None:
        return [Level(STALE.kind, max(1.0, age_s / limit_s), (left,))]
    if not silent:
        return []
    if len(silent) == len(ages_s):
        statement = AlarmCode.NOTHING_ARRIVES(age_h=age_s / HOUR_S)
    else:
        statement = AlarmCode.SIGNALS_SILENT(signals=tuple(sorted(silent)), age_h=age_s / HOUR_S)
    return [Level(STALE.kind, age_s / limit_s, (statement,))]


def missing_levels(missing: Iterable[Need], since: float, now: float, limit_s: float) -> list[Level]:
    """The levels of what never came `since` the tracker knows the turbine: the time until `now` [s] as a
    multiple of the limit [s]; a notice where there is an estimate without it."""
    level, levels = (now - since) / limit_s, []
    for one in missing:
        code = AlarmCode.REQUIRED_NEVER_CAME if one.required else AlarmCode.SIGNAL_NEVER_CAME
        statement, severity = code(quantity=one.quantity, since=since), "" if one.required else "notice"
        levels.append(Level(MISSING.kind, level, (statement,), one.signals[0], severity))
    return levels


def source_levels(reaches: Mapping[str, Reach], now: float) -> list[Level]:
    """One level for each source that is not reached: for how long at `now` [s], as a multiple of its
    limit."""
    lost = {url: (one, one.since) for url, one in reaches.items() if one.since is not None}
    return [
        Level(
            LOST.kind,
            one.share(now),
            (AlarmCode.SOURCE_NOT_REACHED(source=url, since=since, reason=one.words),),
            url,
        )
        for url, (one, since) in lost.items()
    ]


# -- the table of alarms -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class AlarmRule:
    """When alarms of a kind begin and end, from levels that follow from `follows`.

    `on`, `off`: levels at which it begins and ends; `hold_s`: time [s] the level must persist; `severity`: at
    first; `severe`: level from which the severity is "alarm"; `rests_on`: numbers of the fit on which it
    rests; `levels`: its levels where they follow from `ESTIMATES`.  What to do stands beside what an alarm
    says, in `AlarmCode`.
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


RULES = {
    rule.kind: rule
    for rule in (
        AlarmRule(
            "condensation", ESTIMATES, 0.5, 0.2, 20 * MINUTE_S, severe=0.95, levels=condensation_levels
        ),
        AlarmRule("sensor frozen", ESTIMATES, rests_on=(), levels=frozen_levels),
        AlarmRule("cabinet changed", SHIFTS),
        AlarmRule("sensor suspect", SHIFTS),
        AlarmRule("sensor or water", SHIFTS, rests_on=PARTS[1:]),
        AlarmRule("reading contradicts", INNOVATIONS),
        AlarmRule("data stale", SILENCE, hold_s=5 * MINUTE_S, severe=12.0),
        AlarmRule("signal missing", SILENCE),
        AlarmRule("clock wrong", CLOCKS, hold_s=15 * MINUTE_S, severity="alarm", severe=1.0),
        AlarmRule("source lost", REACH, severity="alarm", severe=1.0),
    )
}
"""The table of alarms, by kind.  A new kind that follows from estimates is a row here, its levels, and what
it says in `AlarmCode`; docs/explanation/live.md has an example."""
CONDENSATION = RULES["condensation"]
STUCK = RULES["sensor frozen"]
CHANGED = RULES["cabinet changed"]
SUSPECT = RULES["sensor suspect"]
SENSOR_OR_WATER = RULES["sensor or water"]
CONTRADICTS = RULES["reading contradicts"]
STALE = RULES["data stale"]
MISSING = RULES["signal missing"]
CLOCK = RULES["clock wrong"]
LOST = RULES["source lost"]


def kinds_of(*follows: str) -> tuple[str, ...]:
    """Kinds of alarms whose levels follow from these."""
    return tuple(rule.kind for rule in RULES.values() if rule.follows in follows)
