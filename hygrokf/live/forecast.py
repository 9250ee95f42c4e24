"""Forecast of a cabinet's climate: the model run forward from its present state under possible weather and
operation.

Possible futures are a small set of **members**, each a course of every driver.  The state's Gaussian is
propagated under each member.  The forecast is the mixture: probabilities are means over the members, and
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
from hygrokf.evaluation.self_switching import self_switched
from hygrokf.identification.fit import Fit
from hygrokf.live.condition import (
    Condition,
    Quantity,
    Surface,
    air_condition,
    inputs_of,
    on_the_safe_side,
    only,
    probability_above,
    probability_below,
)
from hygrokf.live.plan import Plan
from hygrokf.live.scenarios import OPERATION, Scenarios
from hygrokf.live.tracker import SAME_S, Point
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.holds import LINEAR, MEAN
from hygrokf.physics.model import Model
from hygrokf.texts.live_codes import AdviceCode, StateCode
from hygrokf.texts.statement import Statement, Value

LIMIT = 0.8
"""Default limit of relative humidity [1]; a forecast gives the probability of exceeding it."""


class NoForecast(Exception):
    """No forecast can be made; the message says why."""


@dataclass(frozen=True)
class Forecast:
    """The condition at future instants (T,).

    `made_s`: time [s] of the state it starts from; `above` (T,): probability [1] that relative humidity
    exceeds `limit`; `basis`: that of the scenarios.
    """

    made_s: float
    condition: Condition
    above: np.ndarray
    limit: float
    basis: Statement


@dataclass(frozen=True)
class ForecastMade:
    """What the store keeps of a forecast beside its courses: time [s] of the state it starts from, what the
    scenarios are based on or why there are none, the limit of relative humidity [1], and the advice for a
    restart at standstill."""

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
    """The forecast from the newest state under scenarios.

    `excess` [g/m³]: vapour by which the newest reading exceeds the estimate (`live.condition`); it stays.
    Raises NoForecast if the model uses the cabinet's own readings as inputs, because future readings do not
    exist.
    """
    found = conditions_by_member(plan, state, scenarios, surface, excess)
    mixed = mixture(found)
    humidities = [one.relative_humidity for one in found if one.relative_humidity is not None]
    above = np.full(len(mixed.time_s), np.nan)
    if humidities:
        above = np.mean([probability_above(humidity, limit) for humidity in humidities], axis=0)
    return Forecast(state.time, mixed, above, limit, scenarios.basis)


def conditions_by_member(
    plan: Plan, state: Point, scenarios: Scenarios, surface: Surface, excess: float = np.nan
) -> list[Condition]:
    """The condition at the state's time and at the scenarios' instants after it, one for each member, on the
    safe side of model and sensor.

    The state's time must be the scenarios' `now_s`.  Raises NoForecast as `forecast` does.
    """
    found = []
    for t, mean, covariance in moments_by_member(plan, state, scenarios):
        known, u = np.full(len(t), excess), inputs_of(plan.model, t)
        by_model = air_condition(plan.model, plan.values, t.seconds, u, mean, covariance, surface)
        whole = on_the_safe_side(by_model, plan.model, plan.values, u, mean, covariance, surface, known)
        found.append(only(whole, np.isin(np.round(whole.time_s), np.round(scenarios.time_s))))
    return found


def moments_by_member(
    plan: Plan, state: Point, scenarios: Scenarios
) -> Iterator[tuple[Timeline, np.ndarray, np.ndarray]]:
    """For each member: the timeline from the state's time on, and the state's means (T, n) and covariances
    (T, n, n) there."""
    if abs(state.time - scenarios.now_s) > SAME_S:
        raise NoForecast(
            f"the scenarios must begin at the state's time; they begin {scenarios.now_s - state.time:+.0f} s "
            "from it"
        )
    for member in scenarios.members:
        series = (_series(plan, name, scenarios, values) for name, values in sorted(member.items()))
        record = Record(plan.name, tuple(series), plan.site, plan.rated_power_W)
        try:
            whole = model_inputs(plan.design, record)
        except (ValueError, KeyError) as fault:
            raise NoForecast(f"the model needs inputs that are unknown in the future: {fault}") from fault
        made = whole.timeline
        first = int(np.searchsorted(made.seconds, state.time + 1e-3, side="right"))
        later = whole.window(first, len(made)).unread()
        part = self_switched(plan.design, plan.values, [later], [state.state])[0].timeline
        trace = plan.likelihood(part).trace(plan.values, start=state.state)
        mean = np.concatenate([state.state.mean[None], trace.mean])
        covariance = np.concatenate([state.state.covariance[None], trace.covariance])
        yield made.window(first - 1, len(made)), mean, covariance


def _series(plan: Plan, signal: str, scenarios: Scenarios, values: np.ndarray) -> Series:
    """A driver of a member; a signal that is not joined by lines is constant over each step of the
    scenarios."""
    stepped = signal in OPERATION or (plan.form(signal).hold != LINEAR and not signal.startswith("ambient_"))
    step_s = float(scenarios.time_s[1] - scenarios.time_s[0])
    hold = (MEAN, step_s) if stepped else (LINEAR, 0.0)
    return Series(signal, scenarios.time_s, values, *hold)


def mixture(found: Sequence[Condition]) -> Condition:
    """The mixture of equally likely conditions at the same instants: means and standard deviations."""

    def mixed(name: str, _: Quantity) -> Quantity:
        values = np.array([getattr(one, name).value for one in found])
        spreads = np.array([getattr(one, name).sd for one in found])
        return Quantity(values.mean(axis=0), np.sqrt(values.var(axis=0) + np.mean(spreads**2, axis=0)))

    chances = [one.condensation for one in found if one.condensation is not None]
    return found[0].mapped(mixed, condensation=np.mean(chances, axis=0) if chances else None)


# -- advice for a restart ------------------------------------------------------------------------------------
ENOUGH = 0.95
"""Probability [1] with which the air must be dry enough for a restart."""
LONGEST_H = 24.0
"""Longest pre-heating that is considered [h]."""
STAYS_H = 1.0
"""[h] the air must stay dry: the peak of vapour that the heat drives out of materials must have passed."""


LEVEL = 0.95
"""Level of the bounds of the heaters' effect (`Heating.bounds_K`)."""
PREHEATING, PREHEATING_HEAT = "preheating", "preheating_heat"
LOGGED, LOGGED_HEAT = "logged_heater", "logged_heater_heat"


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
        """Signal of each heater, and its value at full power [SI unit]."""
        return {one.signal: one.full for one in self.heaters}

    @property
    def bounds_K(self) -> tuple[float, float]:
        """Bounds of the effect [K]; a heater does not cool."""
        reach = normal_quantile(LEVEL) * self.sd_K
        return max(self.effect_K - reach, 0.0), self.effect_K + reach

    def values_at(self, effect_K: float, values: Mapping[str, float]) -> dict[str, float]:
        """Parameter values with another effect, to which the heaters contribute in the same proportions."""
        share = effect_K / self.effect_K
        return {**values, **{one.parameter: share * values[one.parameter] for one in self.heaters}}


def heaters(model: Model) -> tuple[Heater, ...]:
    """The heaters among a model's inputs: a logged heater, the pre-heating flag, or both."""
    found = []
    for one in model.mechanisms:
        if one.name == LOGGED:
            found.append(Heater(one.settings["signal"], float(one.settings["full"]), LOGGED_HEAT))
        elif PREHEATING in one.inputs and any(p.name == PREHEATING_HEAT for p in one.parameters):
            found.append(Heater(PREHEATING, 1.0, PREHEATING_HEAT))
    return tuple(found)


def heating(plan: Plan, sd_K: float = 0.0) -> Heating | None:
    """All heaters of a plan at full power, with the standard error of their effect; None without a heater."""
    found = heaters(plan.model)
    return Heating(found, sum(plan.values[one.parameter] for one in found), sd_K) if found else None


def heating_sd(fit: Fit) -> float:
    """A fit's standard error [K] of the effect of all its heaters together; 0 without a covariance."""
    if fit.results.covariance is None:
        return 0.0
    names, covariance = fit.covariance
    known = {one.parameter for one in heaters(fit.design.model)}
    chosen = np.array([name in known for name in names])
    return math.sqrt(max(float(chosen @ covariance @ chosen), 0.0))


@dataclass(frozen=True)
class Advice:
    """How long to pre-heat before a restart.

    `hours` [h] of pre-heating until the air is dry enough, None if `LONGEST_H` is not enough or the time is
    unknown; `probability` [1] of dry air after that time, or the highest one within `LONGEST_H`.
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
    """How long to pre-heat from now on, at standstill and with all heaters of the model at full power.

    The advice is the shortest time after which the relative humidity at the coldest surface is below `limit`
    with a probability of at least `ENOUGH`, and stays so for `STAYS_H`.  The probability includes the
    standard error `heating_sd_K` of the heaters' effect.  `excess` as in `forecast`.
    """
    found = heating(plan, heating_sd_K)
    if found is None:
        return Advice(AdviceCode.HEATING_UNKNOWN())
    effect: dict[str, Value] = {"heaters": tuple(found.signals), "effect_K": found.effect_K}
    if not found.effect_K > 0.0:
        return Advice(AdviceCode.HEATING_COOLS(**effect))
    heated = scenarios.with_preheating(LONGEST_H + STAYS_H, found.signals)
    effects = sorted({found.effect_K, *found.bounds_K})
    chances = []
    for effect_K in effects:
        own = replace(plan, values=found.values_at(effect_K, plan.values))
        conditions = conditions_by_member(own, state, heated, surface, excess)
        humidities = [one.surface_humidity for one in conditions if one.surface_humidity is not None]
        if not humidities:
            return Advice(StateCode.MODEL_WITHOUT_HUMIDITY())
        chances.append(np.mean([probability_below(humidity, limit) for humidity in humidities], axis=0))
    hours = (conditions[0].time_s - state.time) / HOUR_S
    if len(effects) == 1:
        return advice_from(hours, chances[0], limit)
    # three points at the bounds and between, with the mean and the variance of the effect
    outer = 0.5 / normal_quantile(LEVEL) ** 2
    advice = advice_from(hours, outer * (chances[0] + chances[2]) + (1.0 - 2.0 * outer) * chances[1], limit)
    weak, _, strong = (_hours_until_dry(hours, chance) for chance in chances)
    lower, upper = found.bounds_K
    needed: Statement | str = ""
    if strong is not None and advice.hours != 0.0:
        code = AdviceCode.NEEDED_HOURS_OPEN if weak is None else AdviceCode.NEEDED_HOURS
        needed = code(shortest_h=strong, longest_h=LONGEST_H if weak is None else weak)
    told = AdviceCode.WITH_EFFECT(**effect, lower_K=lower, upper_K=upper, needed=needed)
    values = {**advice.statement.values, "effect": told}
    return replace(advice, statement=replace(advice.statement, values=values))


def _hours_until_dry(hours: np.ndarray, chance: np.ndarray) -> float | None:
    """The first of `hours` (T,) [h] after which the air is and stays dry with a probability of `ENOUGH`; None
    where `LONGEST_H` is not enough."""
    possible = hours[hours <= LONGEST_H].tolist()
    return next((at for at in possible if np.all(chance[_until_start(hours, at)] >= ENOUGH)), None)


def _until_start(hours: np.ndarray, at: float) -> np.ndarray:
    return (hours >= at) & (hours <= at + STAYS_H)


def advice_from(hours: np.ndarray, chance: np.ndarray, limit: float) -> Advice:
    """The advice from the probability `chance` (T,) of dry air after `hours` (T,) [h] of pre-heating."""
    at = _hours_until_dry(hours, chance)
    if at is not None:
        likely, least = float(chance[hours == at][0]), float(chance[_until_start(hours, at)].min())
        code = AdviceCode.NO_PREHEATING if at == 0.0 else AdviceCode.PREHEAT
        own = {"limit": limit, "probability": likely, "least": least, "stays_h": STAYS_H, "hours": at}
        return Advice(code(**own, effect=""), at, likely)
    best = int(np.argmax(np.where(hours <= LONGEST_H, chance, -1.0)))
    statement = AdviceCode.PREHEATING_TOO_WEAK(
        limit=limit,
        longest_h=LONGEST_H,
        stays_h=STAYS_H,
        enough=ENOUGH,
        probability=float(chance[best]),
        hours=float(hours[best]),
        effect="",
    )
    return Advice(statement, probability=float(chance[best]))
