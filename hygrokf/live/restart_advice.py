"""Advice for a restart: how long to pre-heat, by the heaters that a model knows, until the air at the coldest
surface is dry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.timestamps import HOUR_S
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.identification.fit import Fit
from hygrokf.live.condition import Surface, probability_below
from hygrokf.live.forecast import LIMIT, conditions_by_member
from hygrokf.live.plan import Plan
from hygrokf.live.scenarios import Scenarios
from hygrokf.live.tracker import Point
from hygrokf.physics.model import Model

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
    unknown; `probability` [1] of dry air after that time, or the highest one within `LONGEST_H`; `stays` [1]:
    the lowest one in the hour after that time, in which the converter starts.  `heaters`: signals that are
    switched on, and `effect_K` their heat release with its 95 % bounds; `hours_bounds` [h]: of `hours`, at
    the upper and at the lower bound of the effect, None where `LONGEST_H` is not enough.
    """

    made_s: float
    hours: float | None
    probability: float | None
    limit: float
    statement: str
    stays: float | None = None
    heaters: tuple[str, ...] = ()
    effect_K: tuple[float, float, float] | None = None
    hours_bounds: tuple[float | None, float | None] | None = None


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
    standard error `heating_sd_K` of the heaters' effect.  `excess` as in `live.forecast.forecast`.
    """
    found = heating(plan, heating_sd_K)
    if found is None:
        statement = (
            "the record that identified the model has no pre-heating and no logged heater: its heating power "
            "is unknown"
        )
        return Advice(state.time, None, None, limit, statement)
    if not found.effect_K > 0.0:
        statement = f"the identified effect of {_named(found)} is no heat ({found.effect_K:+.1f} K)"
        return Advice(state.time, None, None, limit, statement)
    heated = scenarios.with_preheating(LONGEST_H + STAYS_H, found.signals)
    effects = sorted({found.effect_K, *found.bounds_K})
    chances = []
    for effect_K in effects:
        own = replace(plan, values=found.values_at(effect_K, plan.values))
        conditions = conditions_by_member(own, state, heated, surface, excess)
        humidities = [one.surface_humidity for one in conditions if one.surface_humidity is not None]
        if not humidities:
            return Advice(state.time, None, None, limit, "the model has no humidity")
        chances.append(np.mean([probability_below(humidity, limit) for humidity in humidities], axis=0))
    hours = (conditions[0].time_s - state.time) / HOUR_S
    if len(effects) == 1:
        advice = advice_from(state.time, hours, chances[0], limit)
        return replace(advice, heaters=tuple(found.signals), effect_K=(found.effect_K,) * 3)
    # three points at the bounds and between, with the mean and the variance of the effect
    outer = 0.5 / normal_quantile(LEVEL) ** 2
    mixed = outer * (chances[0] + chances[2]) + (1.0 - 2.0 * outer) * chances[1]
    advice = advice_from(state.time, hours, mixed, limit)
    weak, _, strong = (_hours_until_dry(hours, chance) for chance in chances)
    return _with_bounds(advice, found, (strong, weak))


def _with_bounds(advice: Advice, found: Heating, hours_bounds: tuple[float | None, float | None]) -> Advice:
    """The advice, with the bounds of the heaters' effect and what they mean for the time."""
    lower, upper = found.bounds_K
    effect = f"{_named(found)}: {found.effect_K:.1f} K, within {lower:.1f} to {upper:.1f} K"
    statement = f"{advice.statement} (identified effect of {effect}"
    strong, weak = hours_bounds
    if strong is not None and advice.hours != 0.0:
        longest = f"more than {LONGEST_H:.0f}" if weak is None else f"{weak:.1f}"
        statement += f", for which {strong:.1f} to {longest} h are needed"
    return replace(
        advice,
        statement=f"{statement})",
        heaters=tuple(found.signals),
        effect_K=(lower, found.effect_K, upper),
        hours_bounds=hours_bounds,
    )


def _named(found: Heating) -> str:
    return " with ".join(signal.replace("_", " ") for signal in found.signals)


def _hours_until_dry(hours: np.ndarray, chance: np.ndarray) -> float | None:
    """The first of `hours` (T,) [h] after which the air is and stays dry with a probability of `ENOUGH`; None
    where `LONGEST_H` is not enough."""
    for place in range(len(hours)):
        if hours[place] > LONGEST_H:
            break
        later = _until_start(hours, place)
        if np.all(chance[later] >= ENOUGH):
            return float(hours[place])
    return None


def _until_start(hours: np.ndarray, place: int) -> np.ndarray:
    """True (T,) in the hour after an instant in which the converter starts."""
    return (hours >= hours[place]) & (hours <= hours[place] + STAYS_H)


def advice_from(made_s: float, hours: np.ndarray, chance: np.ndarray, limit: float) -> Advice:
    """The advice from the probability `chance` (T,) of dry air after `hours` (T,) [h] of pre-heating."""
    at = _hours_until_dry(hours, chance)
    if at is not None:
        place = int(np.searchsorted(hours, at))
        likely, stays = float(chance[place]), float(chance[_until_start(hours, place)].min())
        what = (
            f"below {100 * limit:.0f} % at the coldest surface with a probability of {percent(likely)}, "
            f"and of at least {percent(stays)} until a start within {STAYS_H:.0f} h"
        )
        begin = f"pre-heat for {at:.1f} h: relative humidity is then"
        if at == 0.0:
            begin = "no pre-heating is needed: relative humidity is"
        return Advice(made_s, at, likely, limit, f"{begin} {what}", stays)
    best = int(np.argmax(np.where(hours <= LONGEST_H, chance, -1.0)))
    return Advice(
        made_s, None, float(chance[best]), limit,
        f"not even {LONGEST_H:.0f} h of pre-heating bring relative humidity at the coldest surface below "
        f"{100 * limit:.0f} % for {STAYS_H:.0f} h with a probability of {percent(ENOUGH)}: at best it is "
        f"{percent(chance[best])}, after {hours[best]:.1f} h",
    )  # fmt: skip


def percent(probability: float) -> str:
    """A probability as text that never claims certainty."""
    if probability > 0.99:
        return "over 99 %"
    return f"{100 * probability:.0f} %" if probability >= 0.01 else "under 1 %"
