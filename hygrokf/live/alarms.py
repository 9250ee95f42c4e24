"""Alarms: when they begin and end, how severe they are, and what they say.

A rule watches a level.  An alarm begins once the level has been at or above `on` for `hold_s` and ends once
it has been below `off` for as long; between the two thresholds nothing changes.  Alarms about the process
follow from final estimates and their times alone, so that a replay gives the same ones; alarms about delivery
(`DELIVERY_RULES`) follow from the wall clock.  An alarm's id consists of turbine, kind and beginning, so
that no alarm is raised twice after a crash.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.readings import SATURATED
from hygrokf.data.signals import SIGNALS, from_si, in_words, signal_named
from hygrokf.data.timestamps import HOUR_S, MINUTE_S
from hygrokf.identification.verdict_terms import Inherited, rests_on
from hygrokf.live.batch import Alarm
from hygrokf.live.condition import Z95, Condition
from hygrokf.live.fault_isolation import PAIRS, SENSORS, CauseFinding, ShiftStep
from hygrokf.live.frozen import Frozen
from hygrokf.live.plan import Need
from hygrokf.live.properties import MOIST, TrackedState, relative_shift
from hygrokf.live.sources.stream import Reach
from hygrokf.live.traces import HUMIDITY
from hygrokf.live.tracker import SAME_S, TrackedCourse
from hygrokf.modelling.design import PARTS
from hygrokf.texts.wording import fixed, signed, stamp_text


@dataclass(frozen=True)
class AlarmRule:
    """When to raise one kind of alarm.

    `on`, `off`: levels at which it begins and ends; `hold_s`: time [s] the level must persist; `severity`: at
    first; `severe`: level from which the severity is "alarm".
    """

    kind: str
    on: float
    off: float
    hold_s: float
    severity: str
    severe: float
    remedy: str


CONDENSATION = AlarmRule(
    "condensation", 0.5, 0.2, 20 * MINUTE_S, "warning", 0.95,
    "pre-heat before the converter is started, and look for water at the coldest surface",
)  # fmt: skip
CHANGED = AlarmRule("cabinet changed", 1.0, 0.5, 0.0, "warning", np.inf, "")
STALE = AlarmRule(
    "data stale", 1.0, 0.5, 5 * MINUTE_S, "warning", 12.0,
    "check the logger, its power supply and the data path; the estimate continues without these readings",
)  # fmt: skip
LOST = AlarmRule(
    "source lost", 1.0, 0.5, 0.0, "alarm", 1.0,
    "run `hygrokf doctor` to find out what cannot be reached and why",
)  # fmt: skip
SUSPECT = AlarmRule("sensor suspect", 1.0, 0.5, 0.0, "warning", np.inf, "")
SENSOR_OR_WATER = AlarmRule(
    "sensor or water", 1.0, 0.5, 0.0, "warning", np.inf,
    "look for water in the cabinet, and compare the humidity sensor with another one; if it is the sensor, "
    "state it on the turbine's page with the date",
)  # fmt: skip
CONTRADICTS = AlarmRule(
    "reading contradicts", 1.0, 0.5, 0.0, "warning", np.inf,
    "compare the sensor with another one, and ask what happened in the cabinet at that time",
)  # fmt: skip
MISSING = AlarmRule(
    "signal missing", 1.0, 0.5, 0.0, "warning", np.inf,
    "check the sensor, the logger and its name in the mapping of payloads",
)  # fmt: skip
CLOCK = AlarmRule(
    "clock wrong", 1.0, 0.5, 15 * MINUTE_S, "alarm", 1.0,
    "compare the clocks of this machine and of the sender, and synchronise both by NTP",
)  # fmt: skip
STUCK = AlarmRule(
    "sensor frozen", 1.0, 0.5, 0.0, "warning", np.inf,
    "look whether sensor, logger and data path are alive; what is estimated from it is doubtful",
)  # fmt: skip
FROZEN_S = 6 * HOUR_S
"""[s] for which a signal must have repeated one value, beyond what it ever did before."""
ESTIMATE_RULES = (CONDENSATION, STUCK)
"""Rules whose levels follow from each final estimate."""
SHIFT_RULES = (CHANGED, SUSPECT, SENSOR_OR_WATER)
"""Rules whose levels follow from the tracked properties and the cause of lasting shifts
(`fault_isolation.ShiftStep`)."""
DELIVERY_RULES = (STALE, MISSING, CLOCK, LOST)
"""Rules that follow from the arrival of readings, by the wall clock; none of them begins in a replay."""
RULES = {rule.kind: rule for rule in (*ESTIMATE_RULES, *SHIFT_RULES, CONTRADICTS, *DELIVERY_RULES)}
"""All rules by kind.

A new kind of alarm that follows from estimates is a rule in `ESTIMATE_RULES` and a function in
`ESTIMATE_LEVELS`; docs/explanation/live.md has an example.
"""

BEYOND = 8.0
"""Standard deviations √S of the prediction ŷ beyond which a reading y contradicts it: |y − ŷ| > `BEYOND` √S.

On ordinary data of simulated cabinets the innovations have heavier tails than a normal distribution, so that
the bound is wider than a normal distribution would need: docs/validation/live_trials.md has the shares
of false and of right flags.
"""

CABINET_CHANGES = {
    ("thermal_time_constant", True): (
        "the cabinet loses its heat more slowly",
        "look for clogged filters, a stopped fan, or added insulation",
    ),
    ("thermal_time_constant", False): (
        "the cabinet loses its heat faster",
        "look for an open door or flap, missing insulation, or a fan that never stops",
    ),
    ("hygric_k", True): (
        "the cabinet exchanges less air with the ambient",
        "look for clogged vents and filters, or a renewed seal",
    ),
    ("hygric_k", False): (
        "the cabinet exchanges more air with the ambient",
        "check door, seals and cable glands",
    ),
    ("humidity_offset", False): (
        "the air is drier than air exchange and heat release explain",
        "compare the humidity sensor with another one, and check whether something dries the air",
    ),
    ("heat_release_change", True): (
        "more heat is released than the operation explains",
        "check cooling and fans, and whether a heater stays on",
    ),
    ("heat_release_change", False): (
        "less heat is released than the operation explains",
        "check the heater and its thermostat, and the temperature sensor against another one",
    ),
}
"""(property, whether it increased) -> (statement, what to check); for moister air see `SENSOR_OR_WATER`."""
HUMIDITY_SENSOR = "humidity_sensor"
UNSURE = 0.75
"""Level of a change whose bounds contain zero: no alarm begins, and none ends."""
SENSOR_ERRORS = {
    "temperature_reading_change": (
        "the temperature sensor reads {0} K too {1}{2}: the humidity readings do not follow it",
        "compare the temperature sensor with another one, and check where it is mounted",
    ),
    "humidity_reading_change": (
        "the humidity sensor reads {0} % too {1}{2}: air exchange and heat release do not explain its level",
        "compare the humidity sensor with another one; clean or renew it",
    ),
    "humidity_scale_change": (
        "the humidity sensor reads {0} % of its value too {1}{2}",
        "compare the humidity sensor with another one at low and at high humidity; clean or renew it",
    ),
    "ambient_temperature_change": (
        "the ambient's temperature sensor reads {0} K too {1}: neither its sisters nor the cabinet follow it",
        "compare the ambient's temperature sensor with another one, and check where it is mounted",
    ),
    "ambient_humidity_change": (
        "the ambient's humidity sensor reads {0} % too {1}: neither its sisters nor the cabinet follow it",
        "compare the ambient's humidity sensor with another one; clean or renew it",
    ),
}
"""State of a sensor's error -> (statement, what to check)."""
CAUSES = {
    "thermal_time_constant": "a changed heat loss", "hygric_k": "a changed exchange of air",
    "heat_release_change": "a changed heat release", "temperature_sensor": "the temperature sensor",
    "humidity_sensor": "the humidity sensor or a source of moisture",
    "ambient_temperature": "the ambient's temperature sensor",
    "ambient_humidity": "the ambient's humidity sensor",
}  # fmt: skip
"""Cause in `fault_isolation.STATES` -> words."""


@dataclass(frozen=True)
class Level:
    """A level that a rule judges, with its statement; remedy and severity replace the rule's own.

    `subject` distinguishes alarms of one kind.
    """

    kind: str
    level: float
    statement: str
    remedy: str = ""
    subject: str = ""
    severity: str = ""


@dataclass(frozen=True)
class Standing:
    """State of an alarm: the open `alarm`, if any, and `since` when [s] the level has been past the next
    threshold."""

    since: float | None = None
    alarm: Alarm | None = None


def judge(
    turbine: str, known: Mapping[str, Standing], now: float, levels: Iterable[Level], kinds: Collection[str]
) -> tuple[dict[str, Standing], list[Alarm]]:
    """The standings after judging the levels at `now` [s], and the alarms that began, changed or ended.

    A missing level of these `kinds` counts as 0; standings of other kinds stay as they are.  `now` may go
    back where a late delivery changed what was judged; what was before an alarm began does not end it.
    """
    given = {f"{level.kind} {level.subject}".strip(): level for level in levels}
    standings = {key: standing for key, standing in known.items() if _kind(key) not in kinds}
    alarms: list[Alarm] = []
    for key in dict.fromkeys((*(key for key in known if key not in standings), *given)):
        level = given.get(key, Level(_kind(key), 0.0, ""))
        standing, alarm = _judge_level(turbine, key, known.get(key, Standing()), now, level)
        if alarm is not None:
            alarms.append(alarm)
        if standing != Standing():
            standings[key] = standing
    return standings, alarms


def _judge_level(
    turbine: str, key: str, before: Standing, now: float, level: Level
) -> tuple[Standing, Alarm | None]:
    rule, alarm = RULES[level.kind], before.alarm
    severity = "alarm" if level.level >= rule.severe else level.severity or rule.severity
    past = level.level >= rule.on if alarm is None else level.level < rule.off and now >= alarm.began
    since = None if not past else now if before.since is None else min(now, before.since)
    if since is not None and now - since >= rule.hold_s:
        if alarm is not None:
            return Standing(), replace(alarm, ended=since)
        begun = Alarm(
            id=f"{turbine}:{key}:{since:.0f}",
            turbine=turbine,
            kind=level.kind,
            severity=severity,
            began=since,
            statement=level.statement,
            remedy=level.remedy or rule.remedy,
        )
        return Standing(None, begun), begun
    if alarm is not None and severity == "alarm" and alarm.severity != "alarm":
        worse = replace(alarm, severity="alarm", statement=level.statement)
        return Standing(since, worse), worse
    return Standing(since, alarm), None


def _kind(key: str) -> str:
    return max((kind for kind in RULES if key == kind or key.startswith(kind + " ")), key=len)


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
    chance, place = float(chances[now.place]), now.place
    if chance < CONDENSATION.off:
        return [Level(CONDENSATION.kind, chance, "")]
    value, lower, upper = (signed(one[place], 1) for one in (margin.value, margin.lower, margin.upper))
    statement = (
        f"water condenses on the coldest surface with a probability of {100 * chance:.0f} %: "
        f"its margin to the dew point is {value} K ({lower} … {upper})"
    )
    return [Level(CONDENSATION.kind, chance, statement)]


def frozen_levels(now: Estimated) -> list[Level]:
    """One level for each signal that repeats a value: for how long, as a multiple of `FROZEN_S`."""
    time = float(now.condition.time_s[now.place])
    return [
        Level(
            STUCK.kind,
            (time - one.since) / FROZEN_S,
            f"{one.signal.replace('_', ' ')} has read {in_words(one.value, signal_named(one.signal))} since "
            f"{stamp_text(one.since)} without any change",
            subject=one.signal,
        )
        for one in now.frozen
        if one.known_s <= time < one.end
    ]


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
        which = "it or the ambient's" if set(PAIRS) & set(alike) else "it"
        statement = (
            f"the humidity sensor reads {_size(MOIST, moist)[0]} more than air exchange and heat release "
            f"explain: {which} errs, or there is water in the cabinet"
        )
        level = relative_shift(MOIST, moist)
        level = level if known is not None and MOIST in lasting else min(level, UNSURE)
        levels.append(Level(SENSOR_OR_WATER.kind, level, statement))
    if known is None:
        return levels
    if known.cause in SENSORS:
        return [*levels, *_sensor_levels(known)]
    named = {known.cause: lasting[known.cause]} if known.cause in lasting else lasting
    return levels + [
        _shift_level(name, deviations.get(name, TrackedState(shift.change, 0.0)), known)
        for name, shift in named.items()
        if (name, shift.change > 0.0) in CABINET_CHANGES
    ]


def _sensor_levels(finding: CauseFinding) -> list[Level]:
    """The level of a sensor that fault isolation names; a humidity sensor that reads too high may be right,
    and is part of `SENSOR_OR_WATER`."""
    if finding.cause == HUMIDITY_SENSOR and finding.value > 0.0:
        return []
    words, remedy = SENSOR_ERRORS[finding.state]
    factor = 1.0 if "temperature" in finding.state else 100.0
    low, size, high = (factor * (abs(finding.value) + part * Z95 * finding.sd) for part in (-1.0, 0.0, 1.0))
    digits = 1 if factor == 1.0 else 0
    bounds = f"{fixed(size, digits)} ({fixed(low, digits)} … {fixed(high, digits)})"
    sign, other = ("high", "low") if finding.value > 0.0 else ("low", "high")
    pair = any(PAIRS.get(one) == finding.cause for one in finding.alike)
    either = f", or the ambient's too {other}" if pair else ""
    statement = words.format(bounds, sign, either) + _alternatives(finding)
    return [Level(SUSPECT.kind, 1.0 if low > 0.0 else UNSURE, statement, remedy, finding.cause)]


def _shift_level(name: str, deviation: TrackedState, finding: CauseFinding) -> Level:
    statement, remedy = CABINET_CHANGES[name, deviation.x > 0.0]
    size, sure = _size(name, deviation)
    words = f"{statement}: {name.replace('_', ' ')} {size}{_alternatives(finding)}"
    return Level(CHANGED.kind, sure, words, remedy, name)


def _size(name: str, deviation: TrackedState) -> tuple[str, float]:
    """The size of a deviation with its bounds in words, and the level: `UNSURE` while these contain zero."""
    x, sd = deviation
    ends = np.array([x, x - Z95 * sd, x + Z95 * sd])
    if name == "heat_release_change":
        values, digits, unit = ends, 1, "K"
    elif name == MOIST:
        values, digits, unit = 100.0 * ends, 0, "% relative humidity"
    else:
        values, digits, unit = 100.0 * np.expm1(ends), 0, "%"
    size, low, high = (signed(one, digits) for one in values.tolist())
    return f"{size} ({low} … {high}) {unit}", 1.0 if abs(x) > Z95 * sd else UNSURE


def _alternatives(finding: CauseFinding) -> str:
    others = [CAUSES[cause] for cause in finding.alike if PAIRS.get(cause) != finding.cause]
    return f" (or {', '.join(others)})" if others else ""


RESTS_ON = {
    "thermal_time_constant": PARTS[:1], "heat_release_change": PARTS[:1], "hygric_k": PARTS[1:],
    "humidity_offset": PARTS[1:], "sensor or water": PARTS[1:], "sensor frozen": (),
}  # fmt: skip
"""Property, or kind of alarm -> the numbers of the fit on which its level rests; all others rest on both."""


def with_doubts(levels: Iterable[Level], verdicts: Mapping[str, Inherited]) -> list[Level]:
    """The levels, with a note in each statement that rests on a number of the fit that its verdict rejects;
    `verdicts` are the fit's."""
    doubts = [
        (level, rests_on(verdicts, RESTS_ON.get(level.subject, RESTS_ON.get(level.kind, PARTS))))
        for level in levels
    ]
    return [
        replace(level, statement="; ".join([level.statement, *map(str, doubt)]))
        if level.statement and doubt
        else level
        for level, doubt in doubts
    ]


ESTIMATE_LEVELS: tuple[Callable[[Estimated], list[Level]], ...] = (condensation_levels, frozen_levels)
"""Functions that give the levels of the rules in `ESTIMATE_RULES`."""


def estimate_levels(now: Estimated, verdicts: Mapping[str, Inherited]) -> list[Level]:
    """All levels that follow from a turbine's estimates, with the doubts about its fit (`verdicts`)."""
    return with_doubts((level for levels in ESTIMATE_LEVELS for level in levels(now)), verdicts)


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
        return Level(CONTRADICTS.kind, level, "", subject=one.signal)
    row = SIGNALS[one.signal]
    reading, expected, lower, upper = (
        float(from_si(value, row.display, row))
        for value in (one.reading, one.expected, one.expected - 2.0 * one.sd, one.expected + 2.0 * one.sd)
    )
    unit = {"degC": "°C"}.get(row.display, row.display)
    statement = (
        f"{one.signal.replace('_', ' ')} reads {fixed(reading, 1)} {unit}, where the estimate expects "
        f"{fixed(expected, 1)} ({fixed(lower, 1)} … {fixed(upper, 1)})"
    )
    return Level(CONTRADICTS.kind, level, statement, subject=one.signal)


# -- levels of missing data ----------------------------------------------------------------------------------
def stale_levels(ages_s: Mapping[str, float], limit_s: float, left: str = "") -> list[Level]:
    """The level of stale data: age [s] of a turbine's oldest signal as a multiple of the limit [s].

    left: text about a sender that has left, so that its signals are stale at once.
    """
    silent = {signal: age for signal, age in ages_s.items() if age > limit_s}
    if left:
        return [Level(STALE.kind, max(1.0, *(age / limit_s for age in (0.0, *silent.values()))), left)]
    if not silent:
        return []
    oldest = max(silent.values())
    which = "no signal" if len(silent) == len(ages_s) else ", ".join(sorted(silent)).replace("_", " ")
    verb = "has arrived" if len(silent) == len(ages_s) else "has not arrived"
    return [Level(STALE.kind, oldest / limit_s, f"{which} {verb} for {oldest / HOUR_S:.1f} h")]


def missing_levels(missing: Iterable[Need], since: float, now: float, limit_s: float) -> list[Level]:
    """The levels of what never came `since` the tracker knows the turbine: the time until `now` [s] as a
    multiple of the limit [s]; a notice where there is an estimate without it."""
    return [
        Level(
            MISSING.kind,
            (now - since) / limit_s,
            f"{one.words} never came since {stamp_text(since)}"
            + (": without it there is no estimate" if one.required else ""),
            subject=one.signals[0],
            severity="" if one.required else "notice",
        )
        for one in missing
    ]


def source_levels(reaches: Mapping[str, Reach], now: float) -> list[Level]:
    """One level for each source that is not reached: for how long at `now` [s], as a multiple of its
    limit."""
    return [
        Level(
            LOST.kind,
            one.share(now),
            f"{url} has not been reached since {stamp_text(one.since)}: {one.words}",
            subject=url,
        )
        for url, one in reaches.items()
        if one.since is not None
    ]
