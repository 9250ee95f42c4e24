"""Scores of an identified model: errors by regime, simple baselines, the sensors' share, band coverage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

import numpy as np

from hygrokf.engine.schedule import STEP_TOLERANCE
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.estimation.conventions import CONFIDENCE
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
    """Readings inside a band.

    `coverage`: share [1] of the `n` readings inside the band; `scale`: factor by which the band would have to
    be widened to contain its nominal share of readings.  NaN without readings.
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
    """How well a model's free run and forecasts agree with the readings.

    `rmse`: errors of the free run by period and quantity, and those of simple rules in `baselines`;
    `sensor_share`: share of the squared error [1] that the sensors' accuracy explains; `bands`: coverage of
    the 95 % bands.
    """

    rmse: Scores = field(default_factory=dict)
    baselines: RuleScores = field(default_factory=dict)
    sensor_share: Shares = field(default_factory=dict)
    bands: Bands = field(default_factory=dict)

    def errors(self, period: str, quantity: str) -> Errors:
        """Errors of the free run in one period; NaN where nothing was scored."""
        return self.rmse.get(period, {}).get(quantity, Errors())

    def rule_errors(self, period: str, rule: str, quantity: str) -> Errors:
        """Errors of a rule that needs no model; NaN where it was not scored."""
        return self.baselines.get(period, {}).get(rule, {}).get(quantity, Errors())

    def band(self, lead: str, quantity: str) -> Coverage:
        """Coverage of the 95 % band of a lead ("1h", "free_run"); NaN where it was not checked."""
        return self.bands.get(lead, {}).get(quantity, Coverage())


def period_masks(run: Run) -> dict[str, np.ndarray]:
    """Instants (T,) of the identification and of the validation period of a run's record."""
    seconds, until_s = run.timeline.seconds, run.record.until_s
    early = np.ones(len(seconds), bool) if until_s is None else seconds <= until_s
    return {"identification": early, "validation": ~early}


def rmse(error: np.ndarray, operating: np.ndarray) -> Errors:
    """Root mean squared error in operation, at standstill and in total of errors (T,); NaN are left out."""
    is_finite = np.isfinite(error)
    parts = [error[in_regime & is_finite] for in_regime in (operating, ~operating, np.ones_like(operating))]
    on, off, all_ = (float(np.sqrt(np.mean(part**2))) if len(part) else math.nan for part in parts)
    return Errors(on, off, all_, Counts(*map(len, parts)))


def _by_period(run: Run, evaluate: Callable[[np.ndarray], T]) -> dict[str, T]:
    """A function of instants (T,), evaluated at the scored instants of each period."""
    return {period: evaluate(in_period & run.scored) for period, in_period in period_masks(run).items()}


def scores(run: Run, predicted: Prediction) -> Scores:
    """The paper's Table III for both quantities and both periods, without stretches of unknown inputs."""
    observed, missing = measured(run), np.full(len(run.scored), np.nan)
    errors = {q: observed[q] - (predicted.of(q) or (missing,))[0] for q in SCORED}
    return _by_period(run, lambda in_period: _errors(errors, in_period, run))


def _errors(errors: Mapping[str, np.ndarray], in_period: np.ndarray, run: Run) -> dict[str, Errors]:
    return {q: rmse(np.where(in_period, error, np.nan), run.operating) for q, error in errors.items()}


def readings_sd(run: Run) -> Shares:
    """Standard deviation of the scored readings by period and quantity [K, g/m³]; NaN without readings.

    A free run with a larger error is worse than the readings' own mean.
    """
    observed = measured(run)

    def spread(in_period: np.ndarray) -> dict[str, float]:
        parts = {q: observed[q][in_period & np.isfinite(observed[q])] for q in SCORED}
        return {q: float(np.std(part)) if len(part) else math.nan for q, part in parts.items()}

    return _by_period(run, spread)


def guesses(run: Run) -> dict[str, dict[str, np.ndarray]]:
    """Predictions (T,) of simple rules that need no model, by rule and quantity.

    `ambient`: c = c_amb; `ambient_pressure_balance`: c = c_amb T_amb/T_conv,a with the measured temperature;
    `no_dynamics`: T_amb plus a heat release fitted by least squares to the identification period, without any
    heat storage.
    """
    t = run.timeline
    observed = measured(run)
    masks = period_masks(run)
    rule_values: dict[str, dict[str, np.ndarray]] = {}
    if "ambient_absolute_humidity" in t.varying:
        ambient = t.input("ambient_absolute_humidity")
        rule_values["ambient"] = {"absolute_humidity_g_m3": ambient}
        ratio = t.input("ambient_temperature") / observed["temperature_K"]
        rule_values["ambient_pressure_balance"] = {"absolute_humidity_g_m3": ambient * ratio}
    static = _without_dynamics(run, observed["temperature_K"], masks["identification"])
    if static is not None:
        rule_values["no_dynamics"] = {"temperature_K": static}
    return rule_values


def baselines(run: Run) -> RuleScores:
    """Errors of the rules in `guesses`."""
    observed, rules = measured(run), guesses(run)
    errors = {
        name: {q: observed[q] - value for q, value in by_quantity.items()}
        for name, by_quantity in rules.items()
    }
    return _by_period(
        run, lambda in_period: {name: _errors(of_rule, in_period, run) for name, of_rule in errors.items()}
    )


def _without_dynamics(run: Run, temperature: np.ndarray, in_period: np.ndarray) -> np.ndarray | None:
    """The rule `no_dynamics` (T,), fitted to the instants in a period (T,); None if they are too few."""
    t = run.timeline
    ambient = t.input("ambient_temperature")
    columns = [np.ones(len(t)), ambient - 283.15]
    for name in t.varying:
        if name in ("operating", "preheating") or name.startswith("power_"):
            columns.append(t.input(name))
        if name == "operating":
            columns.append(t.input(name) * (ambient - 283.15))
    features = np.column_stack(columns)
    usable = in_period & run.scored & np.isfinite(temperature)
    if usable.sum() < 5 * features.shape[1]:
        return None
    coefficients, *_ = np.linalg.lstsq(features[usable], (temperature - ambient)[usable], rcond=None)
    return ambient + features @ coefficients


def sensor_share(run: Run, errors: Scores) -> Shares:
    """Share of the total mean squared error explained by the sensors' stated accuracy (accuracy = 95 %
    bound).

    For absolute humidity the errors of the humidity and of the temperature sensor add in quadrature
    (2 % relative humidity is 0.26 g/m³ at 15 °C).
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
        relative = observed["relative_humidity"][is_present]
        mean_K = float(np.nanmean(observed["temperature_K"]))
        saturated = np.full(len(relative), 1e3 * absolute_humidity(1.0, mean_K))
        np.divide(observed["absolute_humidity_g_m3"][is_present], relative, out=saturated, where=relative > 0)
        slope = 1e3 * absolute_humidity_slope_temperature(relative, mean_K)
        variance["absolute_humidity_g_m3"] = float(
            np.mean((saturated * humidity_sd) ** 2 + (slope * temperature_sd) ** 2)
        )
    return {
        period: {
            q: min(1.0, v / total**2) if (total := errors[period][q].total) > 0 else math.nan
            for q, v in variance.items()
        }
        for period in SCORED_PERIODS
    }


def coverage(reading: np.ndarray, value: np.ndarray, sd: np.ndarray, level: float = CONFIDENCE) -> Coverage:
    """Share of readings inside the band, and the factor by which the band would have to be scaled to contain
    `level`."""
    z = np.abs(reading - value) / sd
    z = z[np.isfinite(z)]
    if len(z) == 0:
        return Coverage()
    reach = normal_quantile(level)
    return Coverage(float(np.mean(z <= reach)), len(z), float(np.quantile(z, level) / reach))


def bands(
    design: Design,
    values: Mapping[str, float],
    run: Run,
    predicted: Prediction,
    tolerance: float = STEP_TOLERANCE,
) -> Bands:
    """Coverage of the 1 h, 6 h, 24 h and free-run bands on the validation period (the whole record without
    one)."""
    masks = period_masks(run)
    scored_period = masks["validation"] if masks["validation"].any() else masks["identification"]
    observed = measured(run)
    result: dict[str, dict[str, Coverage]] = {}
    forecast_rows = forecasts(design, values, run, int(np.flatnonzero(scored_period)[0]), tolerance=tolerance)
    for lead, by_quantity in forecast_rows.items():
        result[f"{lead:g}h"] = {q: coverage(*rows) for q, rows in by_quantity.items()}
    usable = scored_period & run.scored
    result["free_run"] = {
        q: coverage(observed[q][usable], pair[0][usable], pair[1][usable])
        for q in QUANTITIES
        if (pair := predicted.of(q)) is not None
    }
    return result
