"""Forecast of a cabinet's climate: the model run forward from its present state under possible weather and
operation.

Possible futures are a small set of **members**, each a course of every driver.  The state's Gaussian is
propagated under each member.  The forecast is the mixture of the members: probabilities are their means, and
bounds include their spread.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import HOUR_S
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.evaluation.self_switching import self_switched
from hygrokf.identification.fit import Fit
from hygrokf.live.condition import (
    Condition,
    Quantity,
    Surface,
    air_condition,
    at_instants,
    inputs_of,
    probability_above,
    probability_below,
    safer_condition,
)
from hygrokf.live.plan import Plan
from hygrokf.live.scenarios import OPERATION_SIGNALS, Scenarios
from hygrokf.live.traces import SAME_S
from hygrokf.live.tracker import Point
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.holds import LINEAR, MEAN
from hygrokf.physics.model import Model
from hygrokf.texts.live_codes import AdviceCode, StateCode
from hygrokf.texts.statement import Statement, Value

LIMIT = 0.8
"""Default limit of relative humidity [1]; a forecast gives the probability that it is exceeded."""


class NoForecast(Exception):
    """No forecast can be made; the message says why."""


@dataclass(frozen=True)
class Forecast:
    """The forecast condition at future instants (T,).

    `made_s`: time [s] of the state it starts from; `above` (T,): probability [1] that relative humidity
    exceeds `limit`; `basis`: what the scenarios are based on.
    """

    made_s: float
    condition: Condition
    above: np.ndarray
    limit: float
    basis: Statement


@dataclass(frozen=True)
class ForecastMade:
    """What the store keeps of a forecast beside its courses.

    `made`: time [s] of the state from which it starts; `basis`: what the scenarios are based on, or why there
    are none; `limit`: of relative humidity [1]; `advice`: for a restart, None while the turbine runs.
    """

    made: float
    basis: Statement
    limit: float
    advice: Statement | None = None


def forecast(
    plan: Plan,
    state: Point,
    scenarios: Scenarios,
    surface: Surface,
    limit: float = LIMIT,
    excess: float = np.nan,
) -> Forecast:
    """Forecast the condition from the newest state under scenarios.

    `limit` [1]: relative humidity whose exceedance is forecast; `excess` [g/m³]: vapour by which the newest
    reading exceeds the estimate (`live.condition`), assumed to remain constant. Raises NoForecast if the
    model uses the cabinet's own readings as inputs, because future readings do not exist.
    """
    members = conditions_by_member(plan, state, scenarios, surface, excess)
    condition = mixture(members)
    humidities = [member.relative_humidity for member in members if member.relative_humidity is not None]
    above = np.full(len(condition.time_s), np.nan)
    if humidities:
        above = np.mean([probability_above(humidity, limit) for humidity in humidities], axis=0)
    return Forecast(state.time, condition, above, limit, scenarios.basis)


def conditions_by_member(
    plan: Plan, state: Point, scenarios: Scenarios, surface: Surface, excess: float = np.nan
) -> list[Condition]:
    """Return the condition of each member of the scenarios at the state's time and at their later instants.

    The state's time must equal the scenarios' `now_s`.  `excess` as of `forecast`.  Raises NoForecast as
    `forecast` does.
    """
    conditions = []
    for t, mean, covariance in moments_by_member(plan, state, scenarios):
        excesses, u = np.full(len(t), excess), inputs_of(plan.model, t)
        by_model = air_condition(plan.model, plan.values, t.seconds, u, mean, covariance, surface)
        safe = safer_condition(by_model, plan.model, plan.values, u, mean, covariance, surface, excesses)
        conditions.append(at_instants(safe, np.isin(np.round(safe.time_s), np.round(scenarios.time_s))))
    return conditions


def moments_by_member(
    plan: Plan, state: Point, scenarios: Scenarios
) -> Iterator[tuple[Timeline, np.ndarray, np.ndarray]]:
    """Yield for each member of the scenarios the timeline from the state's time on, and the means (T, n) and
    covariances (T, n, n) of the model's states at its instants."""
    if abs(state.time - scenarios.now_s) > SAME_S:
        raise NoForecast(
            f"the scenarios must begin at the state's time; they begin {scenarios.now_s - state.time:+.0f} s "
            "from it"
        )
    for member in scenarios.members:
        series = (_series(plan, name, scenarios, values) for name, values in sorted(member.items()))
        record = Record(plan.name, tuple(series), plan.site, plan.rated_power_W)
        try:
            run = model_inputs(plan.design, record)
        except (ValueError, KeyError) as fault:
            raise NoForecast(f"the model needs inputs that are unknown in the future: {fault}") from fault
        timeline = run.timeline
        first = int(np.searchsorted(timeline.seconds, state.time + 1e-3, side="right"))
        future = run.window(first, len(timeline)).unread()
        future_timeline = self_switched(plan.design, plan.values, [future], [state.state])[0].timeline
        trace = plan.likelihood(future_timeline).trace(plan.values, start=state.state)
        mean = np.concatenate([state.state.mean[None], trace.mean])
        covariance = np.concatenate([state.state.covariance[None], trace.covariance])
        yield timeline.window(first - 1, len(timeline)), mean, covariance


def _series(plan: Plan, signal: str, scenarios: Scenarios, values: np.ndarray) -> Series:
    """Return a signal of a member with its values (H,) as a series; a signal that is not interpolated
    linearly is constant over each step of the scenarios."""
    is_stepwise = signal in OPERATION_SIGNALS or (
        plan.form(signal).hold != LINEAR and not signal.startswith("ambient_")
    )
    step_s = float(scenarios.time_s[1] - scenarios.time_s[0])
    hold = (MEAN, step_s) if is_stepwise else (LINEAR, 0.0)
    return Series(signal, scenarios.time_s, values, *hold)


def mixture(conditions: Sequence[Condition]) -> Condition:
    """Return the mixture of equally likely conditions at the same instants, with its moments."""

    def mixed(name: str, _: Quantity) -> Quantity:
        """Return mean and standard deviation of one quantity over all conditions."""
        values = np.array([getattr(condition, name).value for condition in conditions])
        spreads = np.array([getattr(condition, name).sd for condition in conditions])
        return Quantity(values.mean(axis=0), np.sqrt(values.var(axis=0) + np.mean(spreads**2, axis=0)))

    probabilities = [condition.condensation for condition in conditions if condition.condensation is not None]
    condensation = np.mean(probabilities, axis=0) if probabilities else None
    return conditions[0].mapped(mixed, condensation=condensation)


# -- advice for a restart ------------------------------------------------------------------------------------
DRY_ENOUGH = 0.95
"""Probability [1] with which the air must be dry enough for a restart."""
LONGEST_HEATING_H = 24.0
"""Longest pre-heating that is considered [h]."""
STAYS_H = 1.0
"""[h] for which the air must stay dry: the peak of the vapour driven out of materials must have passed."""
PREHEATING, PREHEATING_HEAT = "preheating", "preheating_heat"
LOGGED_HEATER, LOGGED_HEATER_HEAT = "logged_heater", "logged_heater_heat"


@dataclass(frozen=True)
class Heater:
    """A heater of a model: its `signal`, the value `full` [SI unit] of the signal at full power, and the
    parameter of its effect, the heat release [K] at full power."""

    signal: str
    full: float
    parameter: str


@dataclass(frozen=True)
class Heating:
    """All heaters of a model at full power: heat release `effect_K` [K] with its standard error `sd_K`, 0 if
    unknown."""

    heaters: tuple[Heater, ...]
    effect_K: float
    sd_K: float = 0.0

    @property
    def signals(self) -> dict[str, float]:
        """Signal of each heater → its value at full power [SI unit]."""
        return {heater.signal: heater.full for heater in self.heaters}

    @property
    def bounds_K(self) -> tuple[float, float]:
        """Bounds of the effect [K] at the confidence level `CONFIDENCE`; the lower one is not negative."""
        half_width_K = normal_quantile(CONFIDENCE) * self.sd_K
        return max(self.effect_K - half_width_K, 0.0), self.effect_K + half_width_K

    def values_at(self, effect_K: float, values: Mapping[str, float]) -> dict[str, float]:
        """Return parameter values with another effect [K]; the heaters keep their proportions."""
        ratio = effect_K / self.effect_K
        return {**values, **{heater.parameter: ratio * values[heater.parameter] for heater in self.heaters}}


def heaters(model: Model) -> tuple[Heater, ...]:
    """Return the heaters among a model's inputs: a logged heater, the pre-heating flag, or both."""
    model_heaters = []
    for mechanism in model.mechanisms:
        if mechanism.name == LOGGED_HEATER:
            settings = mechanism.settings
            model_heaters.append(Heater(settings["signal"], float(settings["full"]), LOGGED_HEATER_HEAT))
        elif PREHEATING in mechanism.inputs and PREHEATING_HEAT in [
            parameter.name for parameter in mechanism.parameters
        ]:
            model_heaters.append(Heater(PREHEATING, 1.0, PREHEATING_HEAT))
    return tuple(model_heaters)


def heating(plan: Plan, sd_K: float = 0.0) -> Heating | None:
    """Return all heaters of a plan at full power, None without one; `sd_K`: standard error of their
    effect."""
    all_heaters = heaters(plan.model)
    effect_K = sum(plan.values[heater.parameter] for heater in all_heaters)
    return Heating(all_heaters, effect_K, sd_K) if all_heaters else None


def heating_sd(fit: Fit) -> float:
    """Return a fit's standard error [K] of the effect of all its heaters together; 0 without a covariance."""
    if fit.results.covariance is None:
        return 0.0
    names, covariance = fit.covariance
    heat_releases = {heater.parameter for heater in heaters(fit.design.model)}
    is_heat_release = np.array([name in heat_releases for name in names])
    return math.sqrt(max(float(is_heat_release @ covariance @ is_heat_release), 0.0))


@dataclass(frozen=True)
class Advice:
    """How long to pre-heat before a restart.

    `hours` [h] of pre-heating until the air is dry enough, None if `LONGEST_HEATING_H` is not enough or the
    time is unknown; `probability` [1] of dry air after `hours` or, without them, its maximum within
    `LONGEST_HEATING_H`.
    """

    statement: Statement
    hours: float | None = None
    probability: float | None = None


def restart(
    plan: Plan,
    state: Point,
    scenarios: Scenarios,
    surface: Surface,
    limit: float = LIMIT,
    heating_sd_K: float = 0.0,
    excess: float = np.nan,
) -> Advice:
    """Return how long to pre-heat from now on, at standstill and with all heaters of the model at full power.

    The advice is the shortest time after which the relative humidity at the coldest surface is below `limit`
    with a probability of at least `DRY_ENOUGH`, and stays so for `STAYS_H`.  The probability includes the
    standard error `heating_sd_K` of the heaters' effect.  `excess` as in `forecast`.
    """
    all_heaters = heating(plan, heating_sd_K)
    if all_heaters is None:
        return Advice(AdviceCode.HEATING_UNKNOWN())
    effect: dict[str, Value] = {"heaters": tuple(all_heaters.signals), "effect_K": all_heaters.effect_K}
    if not all_heaters.effect_K > 0.0:
        return Advice(AdviceCode.HEATING_COOLS(**effect))
    heated = scenarios.with_preheating(LONGEST_HEATING_H + STAYS_H, all_heaters.signals)
    effects = sorted({all_heaters.effect_K, *all_heaters.bounds_K})
    dry_by_effect = []
    for effect_K in effects:
        changed_plan = replace(plan, values=all_heaters.values_at(effect_K, plan.values))
        conditions = conditions_by_member(changed_plan, state, heated, surface, excess)
        humidities = [
            condition.surface_humidity for condition in conditions if condition.surface_humidity is not None
        ]
        if not humidities:
            return Advice(StateCode.MODEL_WITHOUT_HUMIDITY())
        dry_by_effect.append(np.mean([probability_below(humidity, limit) for humidity in humidities], axis=0))
    hours = (conditions[0].time_s - state.time) / HOUR_S
    if len(effects) == 1:
        return advice_from(hours, dry_by_effect[0], limit)
    # quadrature at the bounds and the estimate, with the weights that give the variance of the effect
    outer = 0.5 / normal_quantile(CONFIDENCE) ** 2
    weak, estimated, strong = dry_by_effect
    advice = advice_from(hours, outer * (weak + strong) + (1.0 - 2.0 * outer) * estimated, limit)
    longest_h, shortest_h = _hours_until_dry(hours, weak), _hours_until_dry(hours, strong)
    lower, upper = all_heaters.bounds_K
    needed_hours: Statement | str = ""
    if shortest_h is not None and advice.hours != 0.0:
        code = AdviceCode.NEEDED_HOURS_OPEN if longest_h is None else AdviceCode.NEEDED_HOURS
        needed_hours = code(
            shortest_h=shortest_h, longest_h=LONGEST_HEATING_H if longest_h is None else longest_h
        )
    effect_statement = AdviceCode.WITH_EFFECT(**effect, lower_K=lower, upper_K=upper, needed=needed_hours)
    values = {**advice.statement.values, "effect": effect_statement}
    return replace(advice, statement=replace(advice.statement, values=values))


def _hours_until_dry(hours: np.ndarray, probability: np.ndarray) -> float | None:
    """Return the first of `hours` (T,) [h] from which the air stays dry for `STAYS_H` with a probability of
    at least `DRY_ENOUGH`; None if it does not within `LONGEST_HEATING_H`.

    probability: of dry air (T,) [1].
    """
    for start_h in hours[hours <= LONGEST_HEATING_H].tolist():
        if np.all(probability[_while_restarting(hours, start_h)] >= DRY_ENOUGH):
            return float(start_h)
    return None


def _while_restarting(hours: np.ndarray, start_h: float) -> np.ndarray:
    """Return which of `hours` (T,) [h] lie within `STAYS_H` from `start_h` [h] on."""
    return (hours >= start_h) & (hours <= start_h + STAYS_H)


def advice_from(hours: np.ndarray, probability: np.ndarray, limit: float) -> Advice:
    """Return the advice from the probability (T,) [1] of dry air after `hours` (T,) [h] of pre-heating."""
    start_h = _hours_until_dry(hours, probability)
    if start_h is not None:
        at_start = float(probability[hours == start_h][0])
        least = float(probability[_while_restarting(hours, start_h)].min())
        code = AdviceCode.NO_PREHEATING if start_h == 0.0 else AdviceCode.PREHEAT
        statement = code(
            limit=limit, probability=at_start, least=least, stays_h=STAYS_H, hours=start_h, effect=""
        )
        return Advice(statement, start_h, at_start)
    best = int(np.argmax(np.where(hours <= LONGEST_HEATING_H, probability, -1.0)))
    statement = AdviceCode.PREHEATING_TOO_WEAK(
        limit=limit,
        longest_h=LONGEST_HEATING_H,
        stays_h=STAYS_H,
        enough=DRY_ENOUGH,
        probability=float(probability[best]),
        hours=float(hours[best]),
        effect="",
    )
    return Advice(statement, probability=float(probability[best]))
