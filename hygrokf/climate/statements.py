"""Statements on a climate: doubts about its weather, power, members, limits and extrapolation.

They are part of the result (`statements` of a region in climate.json).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.climate.bounds import LEVEL, Bounded, held
from hygrokf.climate.ensemble import WHOLE, YEAR_H, course
from hygrokf.climate.limits import Limit
from hygrokf.climate.years import Gathered
from hygrokf.data.ambient import middle
from hygrokf.data.record import Record
from hygrokf.identification.fit import Fit
from hygrokf.modelling.inputs import IDENTIFIED_ON
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K

FEWEST_MEMBERS = 39
"""Members whose extremes are 95 % bounds."""
DRIPPING_H = 24.0
"""[h/a] above saturation from which the model evidently lacks condensation or storage of moisture."""
LEAST_OPERATION = 0.3
"""Share of the time in operation below which power or wind are doubted."""
BEYOND_K = 2.0
BEYOND_SHARE = 0.1
"""How far beyond the ends a temperature [K], or a share of the range of another input, counts as outside."""
SAID_FROM = 0.01
"""Share of the time outside the identified range from which a statement says so."""


def interval_words(weather: Record) -> list[str]:
    """A statement where weather comes less often than every hour."""
    rare = [
        (middle(s.steps_s) / 3600.0, s.signal)
        for s in weather.series
        if s.signal.startswith("ambient_") and len(s.steps_s) and middle(s.steps_s) > 1.01 * 3600.0
    ]
    if not rare:
        return []
    step, name = max(rare)
    more = "; the course of a day is lost" if step >= 12.0 else ""
    return [
        f"{name} comes every {step:g} h and is interpolated linearly: extremes, rates, cycles and short "
        f"excursions are underestimated{more}"
    ]


def operating_words(gathered: Gathered, by_curve: bool) -> list[str]:
    """The share of time in operation, with a doubt where it is low."""
    spans = gathered.spans
    share = float(np.average([one.operating for one in spans], weights=[one.hours for one in spans]))
    said = f"the turbine operates {100.0 * share:.0f} % of the time"
    if share >= LEAST_OPERATION:
        return [said]
    return [f"{said}: check {'units and height of the wind' if by_curve else 'unit and sign of the power'}"]


def member_words(members: int, years: int) -> list[str]:
    """A statement where there are too few members for the stated bounds."""
    share = held(members * years)
    if share >= LEVEL:
        return []
    return [
        f"{members} members are too few: the bounds are the smallest and the largest member, which hold a "
        f"single year in {100.0 * share:.0f} % of cases, not in {100.0 * LEVEL:.0f} %; use "
        f"{FEWEST_MEMBERS} or more (--members)"
    ]


def limit_words(limits: Sequence[Limit], gathered: Gathered) -> list[str]:
    """Statements on limits that cannot be judged: the model lacks the quantity, or the hours never occur."""
    said = []
    for one in limits:
        if one.name not in gathered.limits:
            said.append(
                f'limit "{one.name}" is not judged: the model has no {one.quantity_words}, only a temperature'
            )
        elif not gathered.has(one.during):
            where = f"{'at' if one.during == 'standstill' else 'in'} {one.during}"
            verdict = "is not exceeded" if gathered.part else "passes"
            days = "these days" if gathered.part else "these years"
            said.append(f'limit "{one.name}" {verdict} only because {days} have no hours {where}')
    return said


def weather_words(gathered: Gathered, found: int) -> list[str]:
    """Statements on the years used, out of `found` years."""
    hours, count = sum(one.hours for one in gathered.spans), len(gathered.spans)
    length = sum(one.end_s - one.begin_s for one in gathered.spans) / 3600.0 + count
    said = []
    if count < found:
        said.append(
            f"{found - count} of {found} years are left out: less than {100.0 * WHOLE:.0f} % of their "
            "weather and power is known"
        )
    if gathered.part and count == 1:
        said.append(
            f"the bounds rest on {gathered.part} of weather and say nothing about the rest of the year or "
            "other years"
        )
    elif count == 1:
        said.append("the bounds rest on one year of weather and say nothing about how years differ")
    if length < 0.95 * YEAR_H * count:
        days = f"{length / 24.0:.0f} days" if length >= 48.0 else f"{length:.0f} hours"
        said.append(
            f"the weather covers {days}, not {'a year' if count == 1 else f'{count} years'}: hours per year "
            "are scaled up as if the rest were alike"
        )
    if gathered.part:
        said.append(
            f"on {gathered.part} no limit passes, because the rest of the year may exceed it: a limit that "
            "is kept here is undecided, one that is exceeded fails"
        )
    if hours < 0.98 * length:
        said.append(
            f"weather or power is unknown for {100.0 * (1.0 - hours / length):.1f} % of the time, which is "
            "left out"
        )
    return said


def saturation_words(found: Mapping[str, Bounded]) -> list[str]:
    """A doubt where the simulated air is supersaturated for long."""
    hours = found.get("saturation_h")
    if hours is None or hours.value < DRIPPING_H:
        return []
    return [
        f"the cabinet's air is above 100 % for {hours.value:.0f} h a year: the model lacks a process that "
        "limits the humidity (condensation, moisture storage), and the bounds do not include this error; "
        "hours of wetness and condensation are unreliable"
    ]


def extrapolation_words(fit: Fit, record: Record) -> list[str]:
    """Statements on the hours of weather and power outside the range on which a fit was identified; none for
    a fit without a stated range."""
    ranges = fit.results.identified_on
    if not ranges:
        return []
    made = course(fit, record)
    said = []
    for name, key in IDENTIFIED_ON.items():
        if key not in ranges or name not in fit.design.model.inputs:
            continue
        low, high = ranges[key]
        beyond = BEYOND_K if name == "ambient_temperature" else BEYOND_SHARE * (high - low)
        value = made.timeline.input(name)[made.scored]
        outside = (value < low - beyond) | (value > high + beyond)
        share = float(outside.mean()) if len(value) else 0.0
        if share > SAID_FROM:
            words, factor, offset, digits = _units(fit)[name]
            ends = (factor * one + offset for one in (low, high, float(np.min(value)), float(np.max(value))))
            a, b, least, most = (f"{one:.{digits}f}" for one in ends)
            said.append(
                f"{share * YEAR_H:.0f} h/a are outside the {a} … {b} {words} on which the model was "
                f"identified (here {least} … {most}): the model is extrapolated"
            )
    return said


def _units(fit: Fit) -> dict[str, tuple[str, float, float, int]]:
    """By input: unit with meaning, factor and offset from the model's unit, decimals."""
    return {
        "ambient_temperature": ("°C of ambient air", 1.0, -ZERO_CELSIUS_K, 1),
        "ambient_absolute_humidity": ("g/m³ of ambient air", 1.0, 0.0, 1),
        "power_1": ("kW of power", (fit.design.power_scale_W or 0.0) / 1e3, 0.0, 0),
    }
