"""How one turbine is tracked: its model with slowly varying properties, and when an estimate is final."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hygrokf.data.ambient import AMBIENT_BRIDGE_H
from hygrokf.data.input_paths import readings_ahead
from hygrokf.data.record import Site
from hygrokf.data.signals import SIGNALS
from hygrokf.engine.timeline import Timeline, timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.identification.fit import Fit
from hygrokf.modelling.design import HOLDS, SETTLING_H, Design, extended
from hygrokf.physics.holds import ZERO_ORDER
from hygrokf.physics.mechanisms.hygric import exchange_factor
from hygrokf.physics.model import Model
from hygrokf.physics.psychrometrics import absolute_humidity

FEATURES_H = 48.0
BEFORE = 12
"""Readings of each signal that are kept from before the context: they tell its usual step, and so which gap is a long one."""
LATENESS_S = 1800.0
"""[s] readings may come this much later than the newest one and still count."""
WANDERING = {
    "wandering_time_constant": ("converter_temperature", 0.02),
    "wandering_exchange": ("vapour", 0.02),
    "wandering_release": ("converter_temperature", 0.1),
    "wandering_temperature_reading": ("cabinet_temperature", 1e-4),
    "wandering_humidity_reading": ("cabinet_relative_humidity", 0.005),
    "wandering_humidity_scale": ("cabinet_relative_humidity", 1e-6),
}
"""What is tracked: mechanism -> (state or output that it needs, rate for a day).

An offset of the thermometer and a change of the heat release look alike from hour to hour, and so do offset and scale of the
humidity sensor: one of each stands still until an inquiry asks for it.
"""
TEMPERATURES_K = (238.15, 253.15, 268.15, 283.15, 298.15, 313.15, 323.15)
HUMIDITIES = (0.05, 0.5, 1.0)
"""Climate that sub-steps are made for: from −35 to 50 °C, dry to saturated."""
MARGIN = 1.5
"""Factor on the fastest rate of that climate, for what a cabinet may add to it."""


@dataclass(frozen=True)
class Form:
    """How a source gives a signal: `hold`, averaging `interval_s` [s], `resolution` and `accuracy` in SI units,
    `response_time_s` [s] of the sensor where it is stated."""

    hold: str = "linear"
    interval_s: float = 0.0
    resolution: float = 0.0
    accuracy: float | None = None
    response_time_s: float | None = None


@dataclass(frozen=True)
class Plan:
    """What a tracker of one turbine needs, none of which changes while it runs.

    `design`, `values` the model; `fastest` [1/h] the rate that sub-steps are made for; `lateness_s` how late a reading may
    come after the newest one; `forms` signal → how its source gives it; `site`, `rated_power_W` of the turbine.
    """

    name: str
    design: Design
    values: Mapping[str, float]
    fastest: float
    lateness_s: float = LATENESS_S
    forms: Mapping[str, Form] = field(default_factory=dict)
    site: Site | None = None
    rated_power_W: float | None = None

    @property
    def model(self) -> Model:
        return self.design.model

    def likelihood(self, t: Timeline) -> Likelihood:
        """The likelihood on a timeline, with the plan's sub-steps."""
        return Likelihood(self.model, t, fastest=self.fastest)

    def form(self, signal: str) -> Form:
        """How a signal is given; instants where nothing is stated."""
        return self.forms.get(signal, Form())

    def readings_ahead(self, signal: str) -> int:
        """How many later readings the path of an input depends on, beside the next one; what holds over steps has none."""
        form = self.form(signal)
        if HOLDS[signal] == ZERO_ORDER:
            return 0
        return readings_ahead(form.interval_s, form.response_time_s or 0.0)

    @property
    def context_s(self) -> float:
        """How far before a final estimate readings are kept [s]: inputs look back over gaps and what settles after them.

        Features may look back over a day.
        """
        return 3600.0 * (FEATURES_H if self.design.features else AMBIENT_BRIDGE_H + SETTLING_H + 2.0)

    @cached_property
    def longest_mean_s(self) -> float:
        """Longest interval [s] over which readings of the cabinet are averaged."""
        intervals = (form.interval_s for signal, form in self.forms.items() if signal.startswith("cabinet_"))
        return max(intervals, default=0.0)

    @cached_property
    def further(self) -> tuple[str, ...]:
        """Signals of the signal table that an added mechanism reads as they are."""
        own = {"ambient_temperature", "ambient_absolute_humidity", "cabinet_temperature", "preheating"}
        return tuple(sorted((set(self.model.inputs) & set(SIGNALS)) - own))


def plan(
    fit: Fit,
    *,
    name: str | None = None,
    forms: Mapping[str, Form] | None = None,
    lateness_s: float = LATENESS_S,
    wandering: Mapping[str, float] | None = None,
    site: Site | None = None,
    rated_power_W: float | None = None,
) -> Plan:
    """The plan for a turbine with an identified model.

    `wandering`: rate for a day of each property that is tracked (by default all that the model has, at the rates of
    `WANDERING`).  The ambient's readings are used as they come: smoothing them needs those that come later.
    """
    model = fit.design.model
    rates = {m: rate for m, (_, rate) in WANDERING.items()} if wandering is None else dict(wandering)
    unknown = sorted(set(rates) - set(WANDERING))
    if unknown:
        raise ValueError(f"wandering: expected names of {sorted(WANDERING)}, found {unknown}")
    additions = [
        (m, {"rate": rate}) for m, rate in rates.items() if WANDERING[m][0] in (*model.states, *model.outputs)
    ]
    design = replace(extended(fit.design, additions), ambient_noise={})
    values = {p.name: fit.values.get(p.name, p.start) for p in design.model.parameters}
    return Plan(
        name=name or fit.name,
        design=design,
        values=values,
        fastest=fastest_rate(design.model, values),
        lateness_s=lateness_s,
        forms=dict(forms or {}),
        site=site,
        rated_power_W=rated_power_W,
    )


def fastest_rate(model: Model, values: Mapping[str, float]) -> float:
    """Bound [1/h] on the model's rates in any climate that a cabinet may stand in: no step depends on the record then."""
    kelvin, humidity, switched = (
        grid.ravel() for grid in np.meshgrid(TEMPERATURES_K, HUMIDITIES, (0.0, 1.0), indexing="ij")
    )
    known = {
        "ambient_temperature": kelvin,
        "cabinet_temperature": kelvin + 20.0 * switched,
        "ambient_absolute_humidity": 1e3 * absolute_humidity(humidity, kelvin),
        "exchange_factor": exchange_factor(kelvin),
    }
    inputs = {name: known.get(name, switched) for name in model.inputs}
    grid = timeline(model, np.arange(len(kelvin), dtype=float), inputs, {})
    return MARGIN * Likelihood(model, grid).rate(values, inputs)
