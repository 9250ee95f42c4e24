"""Whether a climate stays within the range on which a model was identified: ambient temperature, ambient
humidity, and power."""

from __future__ import annotations

import numpy as np

from hygrokf.climate.ensemble import YEAR_H, course
from hygrokf.data.record import Record
from hygrokf.identification.fit import Fit
from hygrokf.modelling.inputs import IDENTIFIED_ON
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K

BEYOND_K = 2.0
BEYOND_SHARE = 0.1
"""How far beyond the ends a temperature [K], or a share of the range of another input, counts as outside."""
SAID_FROM = 0.01
"""Share of the time from which it is said."""


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
    """How each input is told: unit and meaning, factor, offset, decimals."""
    return {
        "ambient_temperature": ("°C of ambient air", 1.0, -ZERO_CELSIUS_K, 1),
        "ambient_absolute_humidity": ("g/m³ of ambient air", 1.0, 0.0, 1),
        "power_1": ("kW of power", (fit.design.power_scale_W or 0.0) / 1e3, 0.0, 0),
    }
