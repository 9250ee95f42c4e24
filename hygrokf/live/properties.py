"""The cabinet's present properties: time constants and heat release with bounds, and lasting shifts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.identification.fit import Fit
from hygrokf.live.condition import Z95
from hygrokf.physics.model import Model
from hygrokf.physics.signal_names import CABINET_HUMIDITIES


@dataclass(frozen=True)
class Watched:
    """A tracked property and the model's state x that represents it.

    `parameter`: parameter of the fit that e^x multiplies, None if the property is x; `least`: smallest shift
    of x that matters; `blind`: standard deviation of x from which the property is not observable; `shown_by`:
    signals that make the property observable.
    """

    name: str
    state: str
    parameter: str | None
    unit: str
    least: float
    blind: float
    shown_by: tuple[str, ...]


TEMPERATURES = ("cabinet_temperature",)
WATCHED = (
    Watched(
        "thermal_time_constant", "log_thermal_change", "thermal_time_constant", "h", math.log(1.15), 0.25,
        TEMPERATURES,
    ),
    Watched("hygric_k", "log_hygric_change", "hygric_k", "h", math.log(1.15), 0.25, CABINET_HUMIDITIES),
    Watched("heat_release_change", "release_change", None, "K", 1.0, 2.0, TEMPERATURES),
    Watched("humidity_offset", "humidity_reading_change", None, "1", 0.04, 0.1, CABINET_HUMIDITIES[:1]),
)  # fmt: skip
"""The tracked properties; the smallest shifts that matter are 15 %, 1 K and 4 % relative humidity."""
SURE_SD = 4.0
"""Number of standard deviations by which a property must differ from its reference to have shifted."""
UNOBSERVABLE_S = 3.0 * DAY_S
"""[s] without a reading in `shown_by` after which a property is not observable."""
LASTING_S = 2.0 * DAY_S
"""[s] after which a shift counts as lasting."""
MOIST = "humidity_offset"
MOIST_S = 6.0 * HOUR_S
"""[s] after which a rise of the humidity offset counts as lasting; shorter, because it may be water."""
BACK = 0.5
"""Share of its largest change [1] below which a shift has ended."""


class TrackedState(NamedTuple):
    """The state x of a watched property and its standard deviation."""

    x: float
    sd: float

    def to_json(self) -> list[float]:
        """Return [x, sd]."""
        return list(self)

    @classmethod
    def from_json(cls, data: Sequence[float]) -> TrackedState:
        """Return the state of [x, sd]."""
        return cls(*map(float, data))


@dataclass(frozen=True)
class Property:
    """The present `value` of a property with 95 % bounds, None if the property is not `observable`, and the
    fit's `reference` value."""

    name: str
    unit: str
    value: float | None
    lower: float | None
    upper: float | None
    reference: float
    observable: bool


@dataclass(frozen=True)
class ParameterShift:
    """A property's shift from its reference: its beginning `since` [s], whether it is `lasting`, and the
    largest change so far.

    `change`: logarithm of the ratio [1], or difference [K] or [1]; negative for a decrease.
    """

    name: str
    since: float
    lasting: bool
    change: float


def standard_errors(fit: Fit) -> dict[str, float]:
    """Return watched property → its standard error by the fit, in the unit of its state."""
    if fit.results.covariance is None:
        return {}
    names, covariance = fit.covariance
    sd = dict(zip(names, np.sqrt(np.maximum(np.diag(covariance), 0.0)), strict=True))
    return {
        watched.name: float(sd[watched.parameter] / fit.values[watched.parameter])
        for watched in WATCHED
        if watched.parameter in sd
    }


def states_of(
    model: Model, mean: np.ndarray, covariance: np.ndarray, time: float, heard: Mapping[str, float]
) -> dict[str, TrackedState]:
    """Return watched property → its state, from the mean (n,) and covariance (n, n) of the model's states.

    heard: signal → time [s] of its newest reading.  The standard deviation is infinite if no recent reading
    shows the property at `time` [s].
    """
    states = {}
    for watched in WATCHED:
        if watched.state in model.states:
            i = model.states.index(watched.state)
            heard_s = max((heard.get(signal, -math.inf) for signal in watched.shown_by), default=-math.inf)
            sd = math.sqrt(max(float(covariance[i, i]), 0.0)) if time - heard_s < UNOBSERVABLE_S else math.inf
            states[watched.name] = TrackedState(float(mean[i]), sd)
    return states


def observable(states: Mapping[str, TrackedState]) -> dict[str, TrackedState]:
    """Return the observable ones of the tracked properties."""
    blind = {watched.name: watched.blind for watched in WATCHED}
    return {name: state for name, state in states.items() if state.sd < blind[name]}


def properties(
    states: Mapping[str, TrackedState], values: Mapping[str, float], errors: Mapping[str, float]
) -> list[Property]:
    """Return the present properties; their bounds include the uncertainty of the filter and of the fit.

    values: parameter of the fit → value.  errors: property → standard error by the fit.
    """
    present = []
    for watched in WATCHED:
        if watched.name not in states:
            continue
        x, sd = states[watched.name]
        reference = 0.0 if watched.parameter is None else values[watched.parameter]
        if sd >= watched.blind:
            present.append(Property(watched.name, watched.unit, None, None, None, reference, False))
            continue
        spread = Z95 * math.hypot(sd, errors.get(watched.name, 0.0))
        low, middle, high = (
            state if watched.parameter is None else reference * math.exp(state)
            for state in (x - spread, x, x + spread)
        )
        present.append(Property(watched.name, watched.unit, middle, low, high, reference, True))
    return present


def deviations(
    states: Mapping[str, TrackedState],
    errors: Mapping[str, float],
    references: Mapping[str, TrackedState] | None = None,
) -> dict[str, TrackedState]:
    """Return observable property → its deviation from its reference, with the standard deviation of the
    difference.

    errors: property → standard error by the fit.  references: the states against which shifts are judged
    after a stated change, None for the fit's values; a property without a reference is not judged.
    """
    if references is None:
        references = {name: TrackedState(0.0, errors.get(name, 0.0)) for name in states}
    return {
        name: TrackedState(x - references[name].x, math.hypot(sd, references[name].sd))
        for name, (x, sd) in observable(states).items()
        if name in references
    }


def relative_shift(name: str, deviation: TrackedState) -> float:
    """Return a deviation of a property as a multiple of the smallest deviation that counts as a shift."""
    (least,) = (watched.least for watched in WATCHED if watched.name == name)
    return deviation.x / max(least, SURE_SD * deviation.sd)


def lasting_s(shift: ParameterShift) -> float:
    """Return the time [s] after which a shift counts as lasting."""
    return MOIST_S if shift.name == MOIST and shift.change > 0.0 else LASTING_S


def parameter_shifts(
    previous: Mapping[str, ParameterShift], time: float, present: Mapping[str, TrackedState]
) -> dict[str, ParameterShift]:
    """Return property → its shift at `time` [s], from the `previous` shifts and the present deviations.

    A shift begins when a property differs from its reference by more than the smallest change that matters
    and by `SURE_SD` standard deviations.  It is lasting after `lasting_s`.  It ends when less than the share
    `BACK` of its largest change remains, or when the property cannot be observed.
    """
    shifts = {}
    for name, deviation in present.items():
        x, is_large = deviation.x, abs(relative_shift(name, deviation)) > 1.0
        before = previous.get(name)
        if before is None or before.change * x < 0.0:
            if is_large:
                shifts[name] = ParameterShift(name, time, False, x)
            continue
        if abs(x) < BACK * abs(before.change) or not (before.lasting or is_large):
            continue
        change = x if abs(x) > abs(before.change) else before.change
        lasting = before.lasting or time - before.since >= lasting_s(before)
        shifts[name] = replace(before, lasting=lasting, change=change)
    return shifts
