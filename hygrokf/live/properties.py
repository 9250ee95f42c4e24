"""The cabinet's properties as they are now: time constants and heat release with bounds, and lasting departures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.identification.fit import Fit
from hygrokf.live.condition import Z95
from hygrokf.physics.model import Model

DAY_S = 86400.0


@dataclass(frozen=True)
class Watched:
    """A property that is tracked: its state, the fit's parameter that it multiplies by e^x (none: x is added to 0), its
    unit, the least departure that matters, the standard deviation of x from which it is not observable, and the readings
    that show it.
    """

    name: str
    state: str
    parameter: str | None
    unit: str
    least: float
    blind: float
    shown_by: tuple[str, ...]


TEMPERATURES = ("cabinet_temperature",)
HUMIDITIES = ("cabinet_relative_humidity", "cabinet_absolute_humidity")
WATCHED = (
    Watched(
        "thermal_time_constant",
        "log_thermal_change",
        "thermal_time_constant",
        "h",
        math.log(1.15),
        0.25,
        TEMPERATURES,
    ),
    Watched("hygric_k", "log_hygric_change", "hygric_k", "h", math.log(1.15), 0.25, HUMIDITIES),
    Watched("heat_release_change", "release_change", None, "K", 1.0, 2.0, TEMPERATURES),
    Watched("humidity_offset", "humidity_reading_change", None, "1", 0.04, 0.1, HUMIDITIES[:1]),
)
"""What a tracker watches; the least departures are 15 %, 1 K and 4 % relative humidity."""
SURE = 4.0
"""Standard deviations by which a property must differ from the fit's."""
SILENT_S = 3.0 * DAY_S
"""[s] without a reading that shows it after which a property is not observable."""
LASTING_S = 2.0 * DAY_S
"""[s] for how long it must do so."""
BACK = 0.5
"""Share of a departure below which a property is back."""


@dataclass(frozen=True)
class Property:
    """A property now: `value`, bounds of 95 %, the fit's `reference` value; all None where it is `observable` no more."""

    name: str
    unit: str
    value: float | None
    lower: float | None
    upper: float | None
    reference: float
    observable: bool


@dataclass(frozen=True)
class Departure:
    """A property that has departed from the fit's value: since when [s], whether that lasts, and the largest change yet.

    `change` [1] logarithm of the ratio, or [K]; negative where it fell.
    """

    name: str
    since: float
    lasting: bool
    change: float


def standard_errors(fit: Fit) -> dict[str, float]:
    """What the fit itself does not know of each watched property, in units of its state."""
    if "covariance" not in fit.results:
        return {}
    names, covariance = fit.covariance
    sd = dict(zip(names, np.sqrt(np.maximum(np.diag(covariance), 0.0)), strict=True))
    return {
        one.name: float(sd[one.parameter] / fit.values[one.parameter])
        for one in WATCHED
        if one.parameter in sd
    }


def states_of(
    model: Model, mean: np.ndarray, covariance: np.ndarray, time: float, heard: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """(x, standard deviation) of each watched property that the model has, from mean (n,) and covariance (n, n).

    `heard` signal → time [s] of its newest reading; the deviation is infinite where nothing shows the property at `time`.
    """
    found = {}
    for one in WATCHED:
        if one.state in model.states:
            i = model.states.index(one.state)
            newest = max((heard.get(signal, -math.inf) for signal in one.shown_by), default=-math.inf)
            sd = math.sqrt(max(float(covariance[i, i]), 0.0)) if time - newest < SILENT_S else math.inf
            found[one.name] = (float(mean[i]), sd)
    return found


def properties(
    states: Mapping[str, tuple[float, float]], values: Mapping[str, float], errors: Mapping[str, float]
) -> list[Property]:
    """The properties now; bounds hold the filter's uncertainty and, of time constants, the fit's own."""
    found = []
    for one in WATCHED:
        if one.name not in states:
            continue
        x, sd = states[one.name]
        reference = 0.0 if one.parameter is None else values[one.parameter]
        if sd >= one.blind:
            found.append(Property(one.name, one.unit, None, None, None, reference, False))
            continue
        spread = Z95 * math.hypot(sd, errors.get(one.name, 0.0))
        low, middle, high = (
            at if one.parameter is None else reference * math.exp(at) for at in (x - spread, x, x + spread)
        )
        found.append(Property(one.name, one.unit, middle, low, high, reference, True))
    return found


def departures(
    known: Mapping[str, Departure],
    time: float,
    states: Mapping[str, tuple[float, float]],
    errors: Mapping[str, float],
) -> dict[str, Departure]:
    """Departures at `time` [s], from those known before.

    One begins where a property differs from the fit's value by more than the least that matters and by `SURE` standard
    deviations, lasts after `LASTING_S`, and ends where the property is back within half of it, or cannot be observed.
    """
    found = {}
    for one in WATCHED:
        if one.name not in states:
            continue
        x, sd = states[one.name]
        before = known.get(one.name)
        spread = math.hypot(sd, errors.get(one.name, 0.0))
        if sd >= one.blind:
            continue
        if before is None or before.change * x < 0.0:
            if abs(x) > max(one.least, SURE * spread):
                found[one.name] = Departure(one.name, time, False, x)
            continue
        if abs(x) < BACK * abs(before.change):
            continue
        if not before.lasting and abs(x) <= max(one.least, SURE * spread):
            continue
        change = x if abs(x) > abs(before.change) else before.change
        found[one.name] = replace(
            before, lasting=before.lasting or time - before.since >= LASTING_S, change=change
        )
    return found
