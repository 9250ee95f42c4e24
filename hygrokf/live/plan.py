"""The plan for tracking one turbine: its model with slowly varying properties, and when an estimate is
final."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from hygrokf.data.actuators import ACTUATORS
from hygrokf.data.ambient import AMBIENT_BRIDGE_H
from hygrokf.data.gate import REACH_S, REACH_STEPS, Scale
from hygrokf.data.input_paths import readings_ahead
from hygrokf.data.record import USUAL_STEPS, Site
from hygrokf.data.signals import SIGNALS
from hygrokf.data.timestamps import HOUR_S
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.identification.fit import Fit
from hygrokf.modelling.design import INPUT_HOLDS, Design, extended
from hygrokf.physics.holds import LINEAR, MEAN, PREVIOUS
from hygrokf.physics.model import Model
from hygrokf.physics.signal_names import AMBIENT_HUMIDITIES

FEATURES_H = 48.0
"""[h] before an instant on which derived inputs (features) may depend."""
BEFORE = USUAL_STEPS + 1
"""Number of readings kept from before the context; they give a signal's usual step, to recognise long
gaps."""
LATENESS_S = 1800.0
"""[s] by which a reading may be older than the newest reading and still be used."""
TRACKED_PROPERTIES = {
    "wandering_time_constant": ("converter_temperature", 0.02),
    "wandering_exchange": ("vapour", 0.02),
    "wandering_release": ("converter_temperature", 0.1),
    "wandering_temperature_reading": ("cabinet_temperature", 1e-4),
    "wandering_humidity_reading": ("cabinet_relative_humidity", 0.005),
    "wandering_humidity_scale": ("cabinet_relative_humidity", 1e-6),
}
"""Tracked properties: mechanism -> (state or output that it requires, drift rate per day^0.5).

Over hours an offset of the thermometer looks like a change of the heat release, and an offset of the humidity
sensor like a scale error.  One property of each pair is held almost constant; fault isolation varies it.
"""


@dataclass(frozen=True)
class SignalReporting:
    """How a source reports a signal: `hold` between readings, averaging `interval_s` [s], `resolution` and
    `accuracy` [SI unit], `response_time_s` [s] of the sensor, None if unknown, and `longest_hold_s` [s], all
    as in a `Series`."""

    hold: str = LINEAR
    interval_s: float = 0.0
    resolution: float = 0.0
    accuracy: float | None = None
    response_time_s: float | None = None
    longest_hold_s: float | None = None


@dataclass(frozen=True)
class Need:
    """A quantity that the model reads, and the `signals` each of which determines it.

    `required`: whether there is no estimate without the quantity.
    """

    signals: tuple[str, ...]
    required: bool = False

    @property
    def quantity(self) -> str:
        """The name of the quantity."""
        return "ambient_humidity" if self.signals == AMBIENT_HUMIDITIES else self.signals[0]


@dataclass(frozen=True)
class Plan:
    """The constant data that a tracker of one turbine needs.

    `design`, `values`: the model and its parameters; `lateness_s`: how much older than the newest reading a
    reading may be [s]; `forms`: signal → how its source reports it; `site`, `rated_power_W`: of the
    turbine.
    """

    name: str
    design: Design
    values: Mapping[str, float]
    lateness_s: float = LATENESS_S
    forms: Mapping[str, SignalReporting] = field(default_factory=dict)
    site: Site | None = None
    rated_power_W: float | None = None

    @property
    def model(self) -> Model:
        """The model of the cabinet."""
        return self.design.model

    def likelihood(self, t: Timeline) -> Likelihood:
        """Return the likelihood of the plan's model on a timeline."""
        return Likelihood(self.model, t)

    def form(self, signal: str) -> SignalReporting:
        """Return how a source reports a signal; by default as instantaneous readings."""
        return self.forms.get(signal) or SignalReporting(SIGNALS[signal].hold_of_instants)

    def looks_back(self, signal: str) -> bool:
        """Return whether an input at a time depends only on readings up to that time."""
        return self.form(signal).hold == PREVIOUS and INPUT_HOLDS[signal] == MEAN

    @cached_property
    def held_while_connected(self) -> tuple[str, ...]:
        """Signals whose values are held until the next reading, as long as their source is connected."""
        return tuple(
            signal
            for signal, form in self.forms.items()
            if form.hold == PREVIOUS and form.longest_hold_s == math.inf
        )

    def scale(self, signal: str) -> Scale | None:
        """Return the scale by which the gate judges readings of a signal; None if the fit has none."""
        return Scale(*self.design.scales[signal]) if signal in self.design.scales else None

    def readings_ahead(self, signal: str) -> int:
        """Return the number of readings after the next one on which an input depends; 0 for a step signal."""
        form = self.form(signal)
        if INPUT_HOLDS[signal] == MEAN:
            return 0
        return readings_ahead(form.interval_s, form.response_time_s or 0.0)

    @property
    def context_s(self) -> float:
        """Time [s] before a final estimate for which readings are kept: inputs look back over gaps, features
        over a day, and the gate over the time for which a signal may stay still."""
        hours = FEATURES_H if self.design.features else AMBIENT_BRIDGE_H + 2.0
        still_s = max((scale[1] for scale in self.design.scales.values()), default=0.0)
        return HOUR_S * hours + REACH_STEPS * still_s + 2.0 * REACH_S

    @cached_property
    def longest_mean_s(self) -> float:
        """Longest averaging interval of the cabinet's readings [s]."""
        intervals = (form.interval_s for signal, form in self.forms.items() if signal.startswith("cabinet_"))
        return max(intervals, default=0.0)

    @cached_property
    def extra_signals(self) -> tuple[str, ...]:
        """Signals that only an added mechanism reads, such as wind speed or a heater's power."""
        basic = {"ambient_temperature", "ambient_absolute_humidity", "cabinet_temperature", "preheating"}
        return tuple(sorted((set(self.model.inputs) & set(SIGNALS)) - basic))

    @cached_property
    def needs(self) -> tuple[Need, ...]:
        """The quantities that the model reads: the required ones first, then those that help."""
        inputs, outputs = set(self.model.inputs), self.model.outputs
        required: list[tuple[str, ...]] = [("ambient_temperature",)]
        required += [(signal,) for signal in self.extra_signals]
        if "ambient_absolute_humidity" in inputs:
            required.append(AMBIENT_HUMIDITIES)
        if "cabinet_temperature" in inputs:
            required.append(("cabinet_temperature",))
        optional = [(name,) for name in outputs if name in SIGNALS]
        if self.design.power_order or "operating" in inputs:
            optional.append(("active_power",))
        if "preheating" in inputs:
            optional.append(("preheating",))
        return (
            *(Need(signals, True) for signals in dict.fromkeys(required)),
            *(Need(signals) for signals in dict.fromkeys(optional) if signals not in required),
        )

    @property
    def expected(self) -> tuple[Need, ...]:
        """The quantities whose absence is an alarm: required by the model, or configured for a source."""
        return tuple(need for need in self.needs if need.required or set(need.signals) & set(self.forms))


def plan(
    fit: Fit,
    *,
    name: str | None = None,
    forms: Mapping[str, SignalReporting] | None = None,
    lateness_s: float = LATENESS_S,
    wandering: Mapping[str, float] | None = None,
    site: Site | None = None,
    rated_power_W: float | None = None,
) -> Plan:
    """Return the plan for tracking a turbine with an identified model.

    wandering: tracked property → drift rate [per day^0.5], by default all properties of the model at the
    rates of `TRACKED_PROPERTIES`.  The ambient's readings are used without smoothing, because smoothing would
    need later readings.
    """
    model = fit.design.model
    rates = (
        {mechanism: rate for mechanism, (_, rate) in TRACKED_PROPERTIES.items()}
        if wandering is None
        else dict(wandering)
    )
    unknown = sorted(set(rates) - set(TRACKED_PROPERTIES))
    if unknown:
        raise ValueError(f"wandering: expected names of {sorted(TRACKED_PROPERTIES)}, found {unknown}")
    additions = [
        (mechanism, {"rate": rate})
        for mechanism, rate in rates.items()
        if TRACKED_PROPERTIES[mechanism][0] in (*model.states, *model.outputs)
    ]
    # a fit of an earlier version lacks these means: an unknown actuator is off, whatever the earlier readings
    means = {name: 0.0 for name in ACTUATORS if name in model.inputs} | dict(fit.design.actuator_means)
    design = replace(extended(fit.design, additions), ambient_noise={}, actuator_means=means)
    values = {
        parameter.name: fit.values.get(parameter.name, parameter.start)
        for parameter in design.model.parameters
    }
    return Plan(
        name=name or fit.name,
        design=design,
        values=values,
        lateness_s=lateness_s,
        forms=dict(forms or {}),
        site=site,
        rated_power_W=rated_power_W,
    )
