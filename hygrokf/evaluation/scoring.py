"""Scores of an identified model: errors by regime, simple baselines, the sensors' share, band coverage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

import numpy as np

from hygrokf.engine.schedule import STEP_TOLERANCE
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.evaluation.simulation import QUANTITIES, Prediction, forecasts, measured
from hygrokf.modelling.design import Design, accuracy_of
from hygrokf.modelling.inputs import Run
from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_slope_temperature
from hygrokf.texts.parts import SCORED

T = TypeVar("T")
SCORED_PERIODS = ("identification", "validation")
REGIMES = ("operation", "standstill", "total")


@dataclass(frozen=True)
class Counts:
    """Numbers of readings by regime."""

    operation: int = 0
    standstill: int = 0
    total: int = 0


@dataclass(frozen=True)
class Errors:
    """Root mean squared errors [the quantity's unit] by regime, NaN without readings; `n` counts the
    readings."""

    operation: float = math.nan
    standstill: float = math.nan
    total: float = math.nan
    n: Counts = Counts()


@dataclass(frozen=True)
class Coverage:
    """How many readings lie inside a band.

    `coverage`: share [1] of the `n` readings inside.  `scale`: factor by which the band would have to be
        widened to contain its nominal share.  NaN without readings.
    """

    coverage: float = math.nan
    n: int = 0
    scale: float = math.nan


Scores: TypeAlias = Mapping[str, Mapping[str, Errors]]
"""Errors by period and quantity."""
RuleScores: TypeAlias = Mapping[str, Mapping[str, Mapping[str, Errors]]]
"""Errors of simple rules by period, rule and quantity."""
Shares: TypeAlias = Mapping[str, Mapping[str, float]]
"""A number by period and quantity, NaN where it is unknown."""
Bands: TypeAlias = Mapping[str, Mapping[str, Coverage]]
"""Coverage by lead ("1h", "free_run") and quantity."""


@dataclass(frozen=True)
class Scored:
    """Scores of a model's free run and forecasts.

    `rmse`: errors of the free run by period and quantity; `baselines`: errors of rules that need no model.
    `sensor_share`: share of the squared error [1] that the sensors' accuracy explains.
    `bands`: coverage of the 95 % bands.
    """

    rmse: Scores = field(default_factory=dict)
    baselines: RuleScores = field(default_factory=dict)
    sensor_share: Shares = field(default_factory=dict)
    bands: Bands = field(default_factory=dict)

    def errors(self, period: str, quantity: str) -> Errors:
        """Return the errors of the free run in one period; NaN where nothing was scored."""
        return self.rmse.get(period, {}).get(quantity, Errors())

    def rule_errors(self, period: str, rule: str, quantity: str) -> Errors:
        """Return the errors of a rule that needs no model; NaN where it was not scored."""
        return self.baselines.get(period, {}).get(rule, {}).get(quantity, Errors())

    def band(self, lead: str, quantity: str) -> Coverage:
        """Return the coverage of the 95 % band of a lead ("1h", "free_run"); NaN where it was not checked."""
        return self.bands.get(lead, {}).get(quantity, Coverage())


def period_masks(run: Run) -> dict[str, np.ndarray]:
    """Return (T,) which instants belong to the identification and to the validation period of a run."""
    seconds, until_s = run.timeline.seconds, run.record.until_s
    early = np.ones(len(seconds), bool) if until_s is None else seconds <= until_s
    return {"identification": early, "validation": ~early}


def rmse(error: np.ndarray, operating: np.ndarray) -> Errors:
    """Return the root mean squared error in operation, at standstill and in total.

    error: (T,), NaN are left out.  operating: (T,) whether the turbine operates.
    """
    is_finite = np.isfinite(error)
    errors_by_regime = [
        error[in_regime & is_finite] for in_regime in (operating, ~operating, np.ones_like(operating))
    ]
    in_operation, at_standstill, overall = (
        float(np.sqrt(np.mean(errors_of_regime**2))) if len(errors_of_regime) else math.nan
        for errors_of_regime in errors_by_regime
    )
    return Errors(in_operation, at_standstill, overall, Counts(*map(len, errors_by_regime)))


def _by_period(run: Run, evaluate: Callable[[np.ndarray], T]) -> dict[str, T]:
    """Evaluate a function of a mask (T,) at the scored instants of each period."""
    return {period: evaluate(in_period & run.scored) for period, in_period in period_masks(run).items()}


def scores(run: Run, predicted: Prediction) -> Scores:
    """Return the free run's errors by period and quantity (the paper's Table III), without times of unknown
    inputs."""
    observed, missing = measured(run), np.full(len(run.scored), np.nan)
    errors = {q: observed[q] - (predicted.of(q) or (missing,))[0] for q in SCORED}
    return _by_period(run, lambda in_period: _errors(errors, in_period, run))


def _errors(errors: Mapping[str, np.ndarray], in_period: np.ndarray, run: Run) -> dict[str, Errors]:
    """Return the root mean squared errors of each quantity over the instants in a period."""
    return {q: rmse(np.where(in_period, error, np.nan), run.operating) for q, error in errors.items()}


def readings_sd(run: Run) -> Shares:
    """Return the standard deviation of the scored readings by period and quantity [K, g/m³]; NaN without any.

    A free run with a larger error is worse than the mean of the readings.
    """
    observed = measured(run)

    def spread(in_period: np.ndarray) -> dict[str, float]:
        readings_by_quantity = {q: observed[q][in_period & np.isfinite(observed[q])] for q in SCORED}
        return {
            q: float(np.std(readings_of_period)) if len(readings_of_period) else math.nan
            for q, readings_of_period in readings_by_quantity.items()
        }

    return _by_period(run, spread)


def guesses(run: Run) -> dict[str, dict[str, np.ndarray]]:
    """Return the predictions (T,) of simple rules that need no model, by rule and quantity.

    `ambient`: c = c_amb.  `ambient_pressure_balance`: c = c_amb T_amb/T_conv,a with the measured temperature.
    `no_dynamics`: T_amb plus a heat release fitted by least squares to the identification period, without
        heat storage.
    """
    timeline = run.timeline
    observed = measured(run)
    masks = period_masks(run)
    rule_values: dict[str, dict[str, np.ndarray]] = {}
    if "ambient_absolute_humidity" in timeline.varying:
        ambient = timeline.input("ambient_absolute_humidity")
        rule_values["ambient"] = {"absolute_humidity_g_m3": ambient}
        ratio = timeline.input("ambient_temperature") / observed["temperature_K"]
        rule_values["ambient_pressure_balance"] = {"absolute_humidity_g_m3": ambient * ratio}
    static = _without_dynamics(run, observed["temperature_K"], masks["identification"])
    if static is not None:
        rule_values["no_dynamics"] = {"temperature_K": static}
    return rule_values


def baselines(run: Run) -> RuleScores:
    """Return the errors of the rules in `guesses` by period, rule and quantity."""
    observed, rules = measured(run), guesses(run)
    errors = {
        name: {q: observed[q] - value for q, value in by_quantity.items()}
        for name, by_quantity in rules.items()
    }
    return _by_period(
        run, lambda in_period: {name: _errors(of_rule, in_period, run) for name, of_rule in errors.items()}
    )


def _without_dynamics(run: Run, temperature: np.ndarray, in_period: np.ndarray) -> np.ndarray | None:
    """Return the predictions (T,) of the rule `no_dynamics`; None if too few readings lie in the period
    (T,)."""
    timeline = run.timeline
    ambient = timeline.input("ambient_temperature")
    columns = [np.ones(len(timeline)), ambient - 283.15]
    for name in timeline.varying:
        if name in ("operating", "preheating") or name.startswith("power_"):
            columns.append(timeline.input(name))
        if name == "operating":
            columns.append(timeline.input(name) * (ambient - 283.15))
    features = np.column_stack(columns)
    usable = in_period & run.scored & np.isfinite(temperature)
    if usable.sum() < 5 * features.shape[1]:
        return None
    coefficients, *_ = np.linalg.lstsq(features[usable], (temperature - ambient)[usable], rcond=None)
    return ambient + features @ coefficients


def sensor_share(run: Run, errors: Scores) -> Shares:
    """Return the share [1] of the mean squared error that the sensors' stated accuracy explains.

    The accuracy is a 95 % bound.  For absolute humidity the errors of the humidity and of the temperature
    sensor add in quadrature (2 % relative humidity is 0.26 g/m³ at 15 °C).
    """
    observed, record = measured(run), run.record
    variance: dict[str, float] = {}
    temperature_sd = (
        accuracy_of(record["cabinet_temperature"]) / 1.96 if "cabinet_temperature" in record else 0.0
    )
    if temperature_sd:
        variance["temperature_K"] = temperature_sd**2
    if "cabinet_relative_humidity" in record and np.isfinite(observed["absolute_humidity_g_m3"]).any():
        humidity_sd = accuracy_of(record["cabinet_relative_humidity"]) / 1.96
        is_present = np.isfinite(observed["absolute_humidity_g_m3"])
        relative_humidity = observed["relative_humidity"][is_present]
        mean_K = float(np.nanmean(observed["temperature_K"]))
        saturation_vapour = np.full(len(relative_humidity), 1e3 * absolute_humidity(1.0, mean_K))
        np.divide(
            observed["absolute_humidity_g_m3"][is_present],
            relative_humidity,
            out=saturation_vapour,
            where=relative_humidity > 0,
        )
        humidity_by_temperature = 1e3 * absolute_humidity_slope_temperature(relative_humidity, mean_K)
        variance["absolute_humidity_g_m3"] = float(
            np.mean((saturation_vapour * humidity_sd) ** 2 + (humidity_by_temperature * temperature_sd) ** 2)
        )
    return {
        period: {
            q: min(1.0, variance_of_quantity / rmse_total**2)
            if (rmse_total := errors[period][q].total) > 0
            else math.nan
            for q, variance_of_quantity in variance.items()
        }
        for period in SCORED_PERIODS
    }


def coverage(reading: np.ndarray, value: np.ndarray, sd: np.ndarray, level: float = 0.95) -> Coverage:
    """Return the share of readings inside the band around `value`.

    Also returns the factor by which the band would have to be scaled to contain the share `level`.
    """
    distances = np.abs(reading - value) / sd
    distances = distances[np.isfinite(distances)]
    if len(distances) == 0:
        return Coverage()
    nominal_distance = normal_quantile(level)
    return Coverage(
        float(np.mean(distances <= nominal_distance)),
        len(distances),
        float(np.quantile(distances, level) / nominal_distance),
    )


def bands(
    design: Design,
    values: Mapping[str, float],
    run: Run,
    predicted: Prediction,
    tolerance: float = STEP_TOLERANCE,
) -> Bands:
    """Return the coverage of the 1 h, 6 h, 24 h and free-run bands, by lead and quantity.

    The validation period counts, or the whole record without one.
    """
    masks = period_masks(run)
    scored_period = masks["validation"] if masks["validation"].any() else masks["identification"]
    observed = measured(run)
    coverage_by_lead: dict[str, dict[str, Coverage]] = {}
    forecasts_by_lead = forecasts(
        design, values, run, int(np.flatnonzero(scored_period)[0]), tolerance=tolerance
    )
    for lead, by_quantity in forecasts_by_lead.items():
        coverage_by_lead[f"{lead:g}h"] = {
            q: coverage(*forecast_arrays) for q, forecast_arrays in by_quantity.items()
        }
    usable = scored_period & run.scored
    coverage_by_lead["free_run"] = {
        q: coverage(observed[q][usable], value_and_sd[0][usable], value_and_sd[1][usable])
        for q in QUANTITIES
        if (value_and_sd := predicted.of(q)) is not None
    }
    return coverage_by_lead
