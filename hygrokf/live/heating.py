"""The heaters that a model knows, which the restart advice switches on: their signals at full power and their
identified effect with its bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.estimation.confidence import normal_quantile
from hygrokf.identification.fit import Fit
from hygrokf.live.plan import Plan
from hygrokf.physics.model import Mechanism, Model

LEVEL = 0.95
"""Level of the bounds of the effect."""
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

    @property
    def is_heat(self) -> bool:
        return self.effect_K > 0.0


def heaters(model: Model) -> tuple[Heater, ...]:
    """The heaters among a model's inputs: a logged heater, the pre-heating flag, or both."""
    return tuple(heater for one in model.mechanisms if (heater := _heater(one)) is not None)


def _heater(one: Mechanism) -> Heater | None:
    if one.name == LOGGED:
        return Heater(one.settings["signal"], float(one.settings["full"]), LOGGED_HEAT)
    if PREHEATING in one.inputs and any(p.name == PREHEATING_HEAT for p in one.parameters):
        return Heater(PREHEATING, 1.0, PREHEATING_HEAT)
    return None


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
