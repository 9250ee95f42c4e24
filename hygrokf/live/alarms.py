"""Alarms: when they begin and end, how severe they are, and what they say.

A rule watches a level.  An alarm begins once the level has been at or above `on` for `hold_s` and ends once
it has been below `off` for as long; between the two thresholds nothing changes.  Time is that of the
readings, so that a replay gives the same alarms.  An alarm's id consists of turbine, kind and beginning, so
that no alarm is raised twice after a crash.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.timestamps import HOUR_S, MINUTE_S
from hygrokf.identification.verdict_terms import Inherited, rests_on
from hygrokf.live.condition import Condition
from hygrokf.live.fault_isolation import SENSORS, Finding
from hygrokf.live.properties import ParameterShift
from hygrokf.live.storage.store import Alarm
from hygrokf.modelling.design import PARTS

if TYPE_CHECKING:
    from hygrokf.live.sources.streams import SourceState


@dataclass(frozen=True)
class Rule:
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


CONDENSATION = Rule(
    "condensation", 0.5, 0.2, 20 * MINUTE_S, "warning", 0.95,
    "pre-heat before the converter is started, and look for water at the coldest surface",
)  # fmt: skip
CHANGED = Rule("cabinet changed", 1.0, 0.5, 0.0, "warning", np.inf, "")
STALE = Rule(
    "data stale", 1.0, 0.5, 5 * MINUTE_S, "warning", 12.0,
    "check the logger, its power supply and the data path; the estimate continues without these readings",
)  # fmt: skip
LOST = Rule(
    "source lost",
    1.0,
    0.5,
    MINUTE_S,
    "alarm",
    1.0,
    "run `hygrokf doctor` to find out what cannot be reached and why",
)
SUSPECT = Rule("sensor suspect", 1.0, 0.5, 0.0, "warning", np.inf, "")
RULES = {rule.kind: rule for rule in (CONDENSATION, CHANGED, SUSPECT, STALE, LOST)}

LIKELY = {
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
    ("humidity_offset", True): (
        "the air is moister than air exchange and heat release explain",
        "look for water in the cabinet, and compare the humidity sensor with another one",
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
"""(property, whether it increased) -> (statement, what to check)."""
SENSOR = {
    "temperature_reading_change": (
        "the temperature sensor reads {0:.1f} K too {1}: the humidity readings do not follow it",
        "compare the temperature sensor with another one, and check where it is mounted",
    ),
    "humidity_reading_change": (
        "the humidity sensor reads {0:.0f} % too {1}: air exchange and heat release do not explain its level",
        "compare the humidity sensor with another one; clean or renew it",
    ),
    "humidity_scale_change": (
        "the humidity sensor reads {0:.0f} % of its value too {1}",
        "compare the humidity sensor with another one at low and at high humidity; clean or renew it",
    ),
}
"""State of a sensor's error -> (statement, what to check)."""
WORDS = {
    "thermal_time_constant": "a changed heat loss", "hygric_k": "a changed exchange of air",
    "heat_release_change": "a changed heat release", "temperature_sensor": "the temperature sensor",
    "humidity_sensor": "the humidity sensor or a source of moisture",
}  # fmt: skip


@dataclass(frozen=True)
class Level:
    """A level that a rule judges, with its statement and a remedy that replaces the rule's own.

    `subject` distinguishes alarms of one kind.
    """

    kind: str
    level: float
    statement: str
    remedy: str = ""
    subject: str = ""


@dataclass(frozen=True)
class Standing:
    """State of an alarm: the open `alarm`, if any, and `since` when [s] the level has been past the next
    threshold."""

    since: float | None = None
    alarm: Alarm | None = None


def judged(
    turbine: str,
    known: Mapping[str, Standing],
    now: float,
    levels: list[Level],
    kinds: Collection[str] = tuple(RULES),
) -> tuple[dict[str, Standing], list[Alarm]]:
    """The standings after judging the levels at `now` [s], and the alarms that began, changed or ended.

    A missing level of these `kinds` counts as 0; standings of other kinds stay as they are.
    """
    told = {f"{one.kind} {one.subject}".strip(): one for one in levels}
    standings = {key: one for key, one in known.items() if _kind(key) not in kinds}
    changed: list[Alarm] = []
    for key in dict.fromkeys((*(key for key in known if key not in standings), *told)):
        before = known.get(key, Standing())
        level = told.get(key, Level(_kind(key), 0.0, ""))
        after, alarm = _judged(turbine, key, before, now, level)
        if alarm is not None:
            changed.append(alarm)
        if after != Standing():
            standings[key] = after
    return standings, changed


def _judged(
    turbine: str, key: str, before: Standing, now: float, level: Level
) -> tuple[Standing, Alarm | None]:
    rule = RULES[level.kind]
    open_ = before.alarm
    past = level.level < rule.off if open_ is not None else level.level >= rule.on
    if not past:
        after = Standing(None, open_)
    else:
        since = now if before.since is None else before.since
        if now - since < rule.hold_s:
            after = Standing(since, open_)
        elif open_ is not None:
            return Standing(), replace(open_, ended=since)
        else:
            severity = "alarm" if level.level >= rule.severe else rule.severity
            made = Alarm(
                id=f"{turbine}:{key}:{since:.0f}",
                turbine=turbine,
                kind=level.kind,
                severity=severity,
                began=since,
                statement=level.statement,
                remedy=level.remedy or rule.remedy,
            )
            return Standing(None, made), made
    if open_ is not None and level.level >= rule.severe and open_.severity != "alarm":
        worse = replace(open_, severity="alarm", statement=level.statement)
        return replace(after, alarm=worse), worse
    return after, None


def _kind(key: str) -> str:
    return next(kind for kind in RULES if key == kind or key.startswith(kind + " "))


def condensation_level(found: Condition, place: int = -1) -> list[Level]:
    """The condensation level at one instant: probability that the coldest surface is below the dew point."""
    margin = found.margin_K
    if found.condensation is None or margin is None or not len(found.time_s):
        return []
    chance = float(found.condensation[place])
    if chance < CONDENSATION.off:
        return [Level(CONDENSATION.kind, chance, "")]
    words = (
        f"water condenses on the coldest surface with a probability of {100 * chance:.0f} %: "
        f"its margin to the dew point is {margin.value[place]:+.1f} K "
        f"({margin.lower[place]:+.1f} … {margin.upper[place]:+.1f})"
    )
    return [Level(CONDENSATION.kind, chance, words)]


RESTS_ON = {
    "thermal_time_constant": PARTS[:1], "heat_release_change": PARTS[:1], "hygric_k": PARTS[1:],
    "humidity_offset": PARTS[1:],
}  # fmt: skip
"""Property -> the numbers of the fit on which its shift rests; all other levels rest on both numbers."""


def resting_on(levels: list[Level], verdicts: Mapping[str, Inherited]) -> list[Level]:
    """The levels, with a note in each statement that rests on a rejected number of the fit; `verdicts` are
    the fit's."""
    made = []
    for one in levels:
        doubt = rests_on(verdicts, RESTS_ON.get(one.subject, PARTS))
        made.append(replace(one, statement=f"{one.statement}; {doubt}") if one.statement and doubt else one)
    return made


def stale_levels(ages_s: Mapping[str, float], limit_s: float) -> list[Level]:
    """The staleness of a turbine's data: age [s] of its oldest signal as a multiple of the limit [s]."""
    silent = {signal: age for signal, age in ages_s.items() if age > limit_s}
    if not silent:
        return []
    oldest = max(silent.values())
    which = "no signal" if len(silent) == len(ages_s) else ", ".join(sorted(silent)).replace("_", " ")
    verb = "has arrived" if len(silent) == len(ages_s) else "has not arrived"
    return [Level(STALE.kind, oldest / limit_s, f"{which} {verb} for {oldest / HOUR_S:.1f} h")]


def source_levels(states: Mapping[str, SourceState]) -> list[Level]:
    """One level for each lost source."""
    return [
        Level(LOST.kind, 1.0, f"{url} cannot be reached: {words}", subject=url)
        for url, (state, words) in states.items()
        if state == "lost"
    ]


def shift_levels(found: Mapping[str, ParameterShift], finding: Finding | None = None) -> list[Level]:
    """Levels for lasting parameter shifts, attributed to the cabinet or to a sensor by fault isolation.

    There is no level before fault isolation has a finding; a finding without a cause gives one level for each
    property.
    """
    lasting = {name: one for name, one in found.items() if one.lasting}
    if not lasting or finding is None:
        return []
    if finding.cause in SENSORS:
        said, remedy = SENSOR[finding.state]
        size = abs(finding.value) * (1.0 if finding.state.startswith("temperature") else 100.0)
        words = said.format(size, "high" if finding.value > 0.0 else "low") + _others(finding)
        return [Level(SUSPECT.kind, 1.0, words, remedy, finding.cause)]
    named = {finding.cause: lasting[finding.cause]} if finding.cause in lasting else lasting
    return [_changed(name, one, finding) for name, one in named.items() if (name, one.change > 0.0) in LIKELY]


def _changed(name: str, one: ParameterShift, finding: Finding) -> Level:
    said, remedy = LIKELY[name, one.change > 0.0]
    if name == "heat_release_change":
        size = f"{one.change:+.1f} K"
    elif name == "humidity_offset":
        size = f"{100.0 * one.change:+.0f} % relative humidity"
    else:
        size = f"{100.0 * np.expm1(one.change):+.0f} %"
    words = f"{said}: {name.replace('_', ' ')} {size}{_others(finding)}"
    return Level(CHANGED.kind, 1.0, words, remedy, name)


def _others(finding: Finding) -> str:
    return f" (or {', '.join(WORDS[cause] for cause in finding.alike)})" if finding.alike else ""
