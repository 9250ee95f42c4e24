"""Whether a climate lies within what a model was identified on: temperature and humidity outside, and power."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hygrokf.climate.acceleration import FREEZING_K
from hygrokf.climate.ensemble import YEAR_H, course
from hygrokf.data.record import Record
from hygrokf.identification.fit import Fit
from hygrokf.modelling.inputs import IDENTIFIED_ON

BEYOND_K = 2.0
BEYOND_SHARE = 0.1
"""How far beyond the ends a temperature [K], or a share of the range of another input, counts as outside."""
SAID_FROM = 0.01
"""Share of the time from which it is said."""


def extrapolation_words(fit: Fit, record: Record) -> list[str]:
    """Hours of weather and power that lie outside of what a fit was identified on; nothing for a fit that keeps no range."""
    ranges = fit.results.get("identified_on")
    if not isinstance(ranges, Mapping) or not ranges:
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
                f"{share * YEAR_H:.0f} h/a are outside of the {a} … {b} {words} on which the model was identified "
                f"(here {least} … {most}): extrapolated"
            )
    return said


def _units(fit: Fit) -> dict[str, tuple[str, float, float, int]]:
    """How each input is told: unit and meaning, factor, offset, decimals."""
    return {
        "ambient_temperature": ("°C of ambient air", 1.0, -FREEZING_K, 1),
        "ambient_absolute_humidity": ("g/m³ of ambient air", 1.0, 0.0, 1),
        "power_1": ("kW of power", (fit.design.power_scale_W or 0.0) / 1e3, 0.0, 0),
    }
