"""The condition of a cabinet's air with its uncertainty, derived from the filter's Gaussian.

All quantities follow from the air's temperature T, its vapour pressure e = c* R_v T_amb (equation 5) and
their covariance, which is propagated to first order.  Shapes: T instants, n states.

A humidity reading above the estimate has two explanations.  By the *model* the sensor errs, and its offset is
a slow state.  By the *sensor* the reading is right within the sensor's accuracy, and there is more vapour in
the cabinet: the concentration is c + excess, with the excess of the newest reading.  The readings cannot
distinguish the two explanations; so the larger of the two probabilities of condensation counts, until a
second sensor or a person decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.engine.timeline import Timeline
from hygrokf.physics.linearisation import state_derivatives
from hygrokf.physics.mechanisms.hygric import saturation_pressure
from hygrokf.physics.model import Model
from hygrokf.physics.psychrometrics import (
    GAS_CONSTANT_VAPOUR,
    ICE_RANGE,
    ZERO_CELSIUS_K,
    absolute_humidity_from_vapour_pressure,
    dew_point,
    frost_point,
    saturation_pressure_ice_slope,
    saturation_pressure_water,
    saturation_pressure_water_slope,
)
from hygrokf.physics.psychrometrics import Surface as Surface

Z95 = 1.959964


@dataclass(frozen=True)
class Quantity:
    """Values (T,) with standard deviations (T,)."""

    value: np.ndarray
    sd: np.ndarray

    @property
    def lower(self) -> np.ndarray:
        return self.value - Z95 * self.sd

    @property
    def upper(self) -> np.ndarray:
        return self.value + Z95 * self.sd


@dataclass(frozen=True)
class Condition:
    """The air in a cabinet at instants `time_s` (T,) [s since 1970, UTC].

    `relative_humidity` [1] is over water, `frost_point_K` is NaN above freezing.  `margin_K` is the coldest
    surface's temperature above the dew point or, below freezing, above the frost point; `condensation` (T,)
    [1] is the probability that the margin is negative; `surface_humidity` [1] is the relative humidity of the
    air at that surface; `excess_g_m3` (T,) is the vapour by which the newest reading exceeds the estimate
    (`on_the_safe_side`), NaN without one.  Quantities that the model lacks are None.
    """

    time_s: np.ndarray
    temperature_K: Quantity | None
    relative_humidity: Quantity | None
    absolute_humidity_g_m3: Quantity | None
    dew_point_K: Quantity | None
    frost_point_K: Quantity | None
    margin_K: Quantity | None
    condensation: np.ndarray | None
    surface_humidity: Quantity | None
    excess_g_m3: np.ndarray | None = None

    def mapped(self, change: Callable[[str, Quantity], Quantity], **others: np.ndarray | None) -> Condition:
        """The condition with each quantity replaced by `change(name, quantity)`, and with other fields."""
        changed = {name: change(name, q) for name, q in vars(self).items() if isinstance(q, Quantity)}
        return replace(self, **changed, **others)  # type: ignore[arg-type]


@dataclass(frozen=True)
class DisplayedQuantity:
    """A quantity of `Condition` for the store and the page: displayed value = factor × value + offset [unit].

    `column`: name of the quantity in `Condition` and in the store's tables.
    """

    name: str
    column: str
    unit: str
    factor: float = 1.0
    offset: float = 0.0

    @property
    def sd_column(self) -> str:
        """The store's column of the quantity's standard deviation."""
        return f"{self.name}_sd"


DISPLAYED_QUANTITIES = (
    DisplayedQuantity("temperature", "temperature_K", "celsius", offset=-ZERO_CELSIUS_K),
    DisplayedQuantity("relative_humidity", "relative_humidity", "percent", factor=100.0),
    DisplayedQuantity("absolute_humidity", "absolute_humidity_g_m3", "g_m3"),
    DisplayedQuantity("dew_point", "dew_point_K", "celsius", offset=-ZERO_CELSIUS_K),
    DisplayedQuantity("frost_point", "frost_point_K", "celsius", offset=-ZERO_CELSIUS_K),
    DisplayedQuantity("margin", "margin_K", "kelvin"),
)


def inputs_of(model: Model, t: Timeline) -> dict[str, np.ndarray]:
    """A model's inputs (T,) at the instants of a timeline."""
    return {name: t.input(name) for name in model.inputs}


def air_condition(
    model: Model,
    values: Mapping[str, float | np.ndarray],
    seconds: np.ndarray,
    u: Mapping[str, np.ndarray],
    mean: np.ndarray,
    covariance: np.ndarray,
    surface: Surface,
) -> Condition:
    """The condition at instants (T,) [s], from inputs `u` (T,) and the state's means (T, n) and covariances
    (T, n, n).

    Parameter values and the surface may differ between instants (T,), so that many cabinets of one model are
    evaluated at once.
    """
    without_quantities = Condition(seconds, *[None] * 8)
    air, air_row = _air(model, values, u, mean)
    if air is None:
        return without_quantities
    air_var = np.einsum("ti,tij,tj->t", air_row, covariance, air_row)
    temperature = Quantity(air, np.sqrt(np.maximum(air_var, 0.0)))
    if "vapour" not in model.states:
        return Condition(seconds, temperature, *[None] * 7)
    vapour_index = model.states.index("vapour")
    ambient = u["ambient_temperature"]
    scale = 1e-3 * GAS_CONSTANT_VAPOUR * ambient
    # the filter's vapour state is linear and may become negative in almost dry air
    vapour_pressure = np.maximum(mean[:, vapour_index], 1e-3) * scale
    vapour_var = scale**2 * np.maximum(covariance[:, vapour_index, vapour_index], 0.0)
    cross_var = scale * np.einsum("ti,ti->t", air_row, covariance[:, :, vapour_index])

    def derived(value: np.ndarray, by_air: np.ndarray | float, by_vapour: np.ndarray | float) -> Quantity:
        variance = by_air**2 * air_var + by_vapour**2 * vapour_var + 2.0 * by_air * by_vapour * cross_var
        return Quantity(value, np.sqrt(np.maximum(variance, 0.0)))

    saturated = saturation_pressure_water(air)
    humidity = vapour_pressure / saturated
    relative = derived(
        humidity, -humidity * saturation_pressure_water_slope(air) / saturated, 1.0 / saturated
    )
    density = 1e3 * absolute_humidity_from_vapour_pressure(vapour_pressure, air)
    absolute = derived(density, -density / air, density / vapour_pressure)
    dew = dew_point(vapour_pressure)
    by_dew = 1.0 / saturation_pressure_water_slope(dew)
    frost = np.where(dew < ZERO_CELSIUS_K, frost_point(vapour_pressure), np.nan)
    by_frost = 1.0 / saturation_pressure_ice_slope(np.clip(frost, ICE_RANGE[0], ZERO_CELSIUS_K))
    surface_K = surface.temperature(ambient, air)
    # on a surface below freezing vapour deposits as frost, slightly above the dew point
    frosty = (surface_K < ZERO_CELSIUS_K) & np.isfinite(frost)
    margin = derived(
        surface_K - np.where(frosty, frost, dew), surface.follows, -np.where(frosty, by_frost, by_dew)
    )
    at_surface = saturation_pressure_water(surface_K)
    humidity_there = vapour_pressure / at_surface
    by_cold = -humidity_there * saturation_pressure_water_slope(surface_K) / at_surface
    return Condition(
        time_s=seconds,
        temperature_K=temperature,
        relative_humidity=relative,
        absolute_humidity_g_m3=absolute,
        dew_point_K=derived(dew, 0.0, by_dew),
        frost_point_K=derived(frost, 0.0, by_frost),
        margin_K=margin,
        condensation=probability_below(margin, 0.0),
        surface_humidity=derived(humidity_there, surface.follows * by_cold, 1.0 / at_surface),
    )


def only(condition: Condition, selected: np.ndarray | slice) -> Condition:
    """The condition at a selection of its instants."""
    probability, excess = (
        values if values is None else values[selected]
        for values in (condition.condensation, condition.excess_g_m3)
    )
    return condition.mapped(
        lambda name, quantity: Quantity(quantity.value[selected], quantity.sd[selected]),
        time_s=condition.time_s[selected], condensation=probability, excess_g_m3=excess,
    )  # fmt: skip


def probability_below(quantity: Quantity, limit: float) -> np.ndarray:
    """Probability (T,) that a quantity is below a limit."""
    from scipy.special import ndtr

    with np.errstate(divide="ignore", invalid="ignore"):
        z = (limit - quantity.value) / quantity.sd
    return np.where(quantity.sd > 0.0, ndtr(z), (quantity.value < limit).astype(float))


def probability_above(quantity: Quantity, limit: float) -> np.ndarray:
    """Probability (T,) that a quantity is above a limit."""
    return 1.0 - probability_below(quantity, limit)


def _air(
    model: Model, values: Mapping[str, float | np.ndarray], u: Mapping[str, np.ndarray], mean: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """Temperature (T,) of the cabinet air [K], None without it, and its exact gradient (T, n) with respect to
    the states."""
    name, columns = "cabinet_air_temperature", list(mean.T)
    temperature = model.quantities(columns, u, values).get(name)
    if temperature is None:
        return None, np.zeros(mean.shape)
    derivatives = np.broadcast_to(state_derivatives(model, name, values, columns, u), mean.shape)
    return np.broadcast_to(np.asarray(temperature), len(mean)), derivatives


# -- water in the cabinet, or a humidity sensor that errs ----------------------------------------------------
SHOWN_DIFFERENCE = 0.005
"""Difference of the probabilities [1] from which the condition by the sensor is shown instead of that by the
model: half a percent."""


def vapour_read(readings: Mapping[str, np.ndarray], air_K: np.ndarray, ambient_K: np.ndarray) -> np.ndarray:
    """Equivalent vapour concentration (T,) [g/m³] c* = e/(R_v T_amb) (equation 5) by the readings of a
    cabinet, NaN without a reading.

    readings: signal -> values (T,) [K], [1] or [g/m³]; air_K: (T,) the estimated temperature, used where
    there is no reading of it.  Of two sensors the moister one counts.
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
    `before`: the excess of the newest earlier reading."""
    padded = np.append(before, excess)
    newest = np.maximum.accumulate(np.where(np.isfinite(padded), np.arange(len(padded)), 0))
    return padded[newest][1:]


def accuracy_sd(model: Model, air_K: np.ndarray, ambient_K: np.ndarray) -> np.ndarray:
    """Standard deviation (T,) [g/m³] of the vapour concentration that follows from the sensor's accuracy."""
    sd = np.zeros(len(air_K))
    for mechanism in model.mechanisms:
        scale = {
            "humidity_sensor": saturation_pressure(air_K) / (1e-3 * GAS_CONSTANT_VAPOUR * ambient_K),
            "absolute_humidity_sensor": air_K / ambient_K,
        }.get(mechanism.name)
        if scale is not None:
            sd = np.maximum(sd, mechanism.settings["accuracy"] / 1.96 * scale)
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

    The arguments are the arguments and the result of `air_condition`.  By the sensor the vapour is higher by
    the excess (T,) [g/m³], NaN where it is unknown, and the variance of the sensor's accuracy is added.  The
    probability is the larger of the two; the quantities are those by the sensor where the probability by the
    sensor is larger by more than `SHOWN_DIFFERENCE`.
    """
    if by_model.condensation is None or by_model.temperature_K is None:
        return by_model
    vapour_index, is_known = model.states.index("vapour"), np.isfinite(excess)
    sd = accuracy_sd(model, by_model.temperature_K.value, u["ambient_temperature"])
    mean, covariance = mean.copy(), covariance.copy()
    mean[:, vapour_index] += np.where(is_known, excess, 0.0)
    covariance[:, vapour_index, vapour_index] += np.where(is_known, sd**2, 0.0)
    by_sensor = air_condition(model, values, by_model.time_s, u, mean, covariance, surface)
    assert by_sensor.condensation is not None, "by_model has it, and both have the same model"
    larger = np.fmax(by_model.condensation, by_sensor.condensation)
    wetter = larger > by_model.condensation + SHOWN_DIFFERENCE

    def chosen(name: str, quantity: Quantity) -> Quantity:
        other = getattr(by_sensor, name)
        sd = np.where(wetter, other.sd, quantity.sd)
        return Quantity(np.where(wetter, other.value, quantity.value), sd)

    return by_model.mapped(chosen, condensation=larger, excess_g_m3=excess)
