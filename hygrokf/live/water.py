"""Water in the cabinet, or a humidity sensor that errs: two hypotheses about the same readings.

By the *model*, a reading that exceeds the estimate is an error of the sensor, whose offset is a slow state.
By the *sensor*, the reading is right within the sensor's accuracy, and the vapour beyond the estimate is
water: its concentration is c + excess, where the excess is that of the newest reading.  Which of them holds,
the readings cannot tell; so the larger of the two probabilities of condensation counts, until a second sensor
or a person tells.  Shapes: T instants, n states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.live.changes import SAME_S, SENSOR_WRONG, Change
from hygrokf.live.condition import Condition, Quantity, Surface, air_condition
from hygrokf.physics.mechanisms.hygric import saturation_pressure
from hygrokf.physics.model import Model
from hygrokf.physics.psychrometrics import GAS_CONSTANT_VAPOUR

SHOWN = 0.005
"""Difference of the probabilities [1] from which the condition by the sensor is shown instead of that by the
model: half a percent."""


def vapour_read(readings: Mapping[str, np.ndarray], air_K: np.ndarray, ambient_K: np.ndarray) -> np.ndarray:
    """Equivalent vapour concentration (T,) [g/m³] that the readings of a cabinet show, NaN without one.

    readings: signal -> values (T,) [K], [1] or [g/m³]; air_K: (T,) the estimated temperature, where there is
    no reading.  It is that of equation (5): c* = e/(R_v T_amb).  Of two sensors the moister one counts.
    """
    nothing = np.full(len(air_K), np.nan)
    kelvin = readings.get("cabinet_temperature", nothing)
    kelvin = np.where(np.isfinite(kelvin), kelvin, air_K)
    relative = readings.get("cabinet_relative_humidity", nothing)
    absolute = readings.get("cabinet_absolute_humidity", nothing)
    pressure = relative * saturation_pressure(kelvin)
    return np.fmax(pressure / (1e-3 * GAS_CONSTANT_VAPOUR * ambient_K), absolute * kelvin / ambient_K)


def carried(excess: np.ndarray, before: float = np.nan) -> np.ndarray:
    """The excess (T,) [g/m³] of each instant's newest reading, from the excess at readings, NaN elsewhere;
    `before`: that of the newest reading before them."""
    all_of_them = np.append(before, excess)
    newest = np.maximum.accumulate(np.where(np.isfinite(all_of_them), np.arange(len(all_of_them)), 0))
    return all_of_them[newest][1:]


def believed(changes: Sequence[Change], seconds: np.ndarray) -> np.ndarray:
    """Whether the sensor may be right (T,) at times [s]: False from a statement that it is wrong to the next
    stated change."""
    place = np.searchsorted([one.time for one in changes], seconds + SAME_S, side="right")
    wrong = np.array([False, *(one.kind == SENSOR_WRONG for one in changes)])
    return ~wrong[place]


def accuracy_sd(model: Model, air_K: np.ndarray, ambient_K: np.ndarray) -> np.ndarray:
    """Standard deviation (T,) [g/m³] of the vapour concentration by a sensor of the stated accuracy."""
    sd = np.zeros(len(air_K))
    for one in model.mechanisms:
        scale = {
            "humidity_sensor": saturation_pressure(air_K) / (1e-3 * GAS_CONSTANT_VAPOUR * ambient_K),
            "absolute_humidity_sensor": air_K / ambient_K,
        }.get(one.name)
        if scale is not None:
            sd = np.maximum(sd, one.settings["accuracy"] / 1.96 * scale)
    return sd


def on_the_safe_side(
    by_model: Condition,
    model: Model,
    values: Mapping[str, float | np.ndarray],
    u: Mapping[str, np.ndarray],
    mean: np.ndarray,
    covariance: np.ndarray,
    surface: Surface,
    excess: np.ndarray,
) -> Condition:
    """The condition by the model or, at instants where condensation is likelier, by the sensor.

    The arguments are those of `air_condition` and its result.  By the sensor the vapour is higher by the
    excess (T,) [g/m³], NaN where none is known, and has the variance of the sensor's accuracy besides.  The
    probability is the larger one; the quantities are those by the sensor where this differs by `SHOWN`.
    """
    if by_model.condensation is None or by_model.temperature_K is None:
        return by_model
    place, known = model.states.index("vapour"), np.isfinite(excess)
    sd = accuracy_sd(model, by_model.temperature_K.value, u["ambient_temperature"])
    mean, covariance = mean.copy(), covariance.copy()
    mean[:, place] += np.where(known, excess, 0.0)
    covariance[:, place, place] += np.where(known, sd**2, 0.0)
    by_sensor = air_condition(model, values, by_model.time_s, u, mean, covariance, surface)
    assert by_sensor.condensation is not None, "both are of one model"
    larger = np.fmax(by_model.condensation, by_sensor.condensation)
    wetter = larger > by_model.condensation + SHOWN

    def chosen(name: str, one: Quantity) -> Quantity:
        other = getattr(by_sensor, name)
        return Quantity(np.where(wetter, other.value, one.value), np.where(wetter, other.sd, one.sd))

    return by_model.mapped(chosen, condensation=larger, excess_g_m3=excess)
