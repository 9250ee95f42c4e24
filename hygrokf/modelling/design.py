"""The model for a record: a `Design` is a model with the constants that turn any record into its inputs.

A design is made from the identification period alone and then applied unchanged to every record: the
validation period, another turbine of the type, a forecast.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from hygrokf.data.actuators import Chosen, actuators
from hygrokf.data.ambient import bridge_h
from hygrokf.data.prepared import PreparedRecord, prepare
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SIGNALS, signal_named
from hygrokf.modelling.derived_inputs import BASE_INPUTS, FEATURES, without_settings
from hygrokf.modelling.library import LIBRARY, Library
from hygrokf.physics.holds import LINEAR, MEAN, PREVIOUS
from hygrokf.physics.mechanisms import Factory
from hygrokf.physics.mechanisms.hygric import LEAST_K_H
from hygrokf.physics.model import Mechanism, Model, compose, field_values
from hygrokf.physics.parameters import Prior
from hygrokf.physics.signal_names import CABINET_HUMIDITIES, CABINET_TEMPERATURE
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement, unique
from hygrokf.texts.terms import Name

INPUT_HOLDS: Mapping[str, str] = {
    **{signal.name: MEAN if signal.hold == PREVIOUS else LINEAR for signal in SIGNALS.values()},
    **{name: hold for name, (hold, _) in BASE_INPUTS.items()},
    **{name: hold for name, (_, hold) in FEATURES.items()},
}
"""Holds of inputs between their own times: every signal, the inputs of the base models, and the package's
features."""
POWER_BRIDGE_H = 1.0
"""[h] longest gap of the power bridged by the preceding value; in longer gaps the power is unknown."""
BOUND = 4.0
"""Standardised innovation at which the influence of a reading is bounded: a Gaussian one exceeds it once in
16,000 readings."""
FEWEST_READINGS = 50
"""Fewest readings of a signal that is used in an identification."""
JOINT = "joint"
CASCADE = "cascade"


_models: WeakValueDictionary[tuple[tuple[Factory, ...], str], Model] = WeakValueDictionary()
"""Existing models by the factories of their mechanisms and their other content as JSON."""


@dataclass(frozen=True)
class Design:
    """A model, and how its inputs are made from a record.

    `mechanisms`: pairs (name, settings) of the library.  `averaged`: outputs read as interval means, with the
    interval [h].  `power_scale_W`: power that counts as 1; `power_order`: highest exponent of the relative
    power p; `power_mean`: means of the features (operating, p, …) that replace an unknown power.  `humidity`:
    the observed humidity signal.  `ambient_noise`: (q, r) of the ambient signals that are smoothed before use
    (see `data.ambient`).  `features`: inputs made from the record's signals, with their settings.  `priors`:
    (mean, sd, logarithmic) of parameters, from other turbines (see `turbine_type`).  `actuator_means`: means
    [SI unit] of the logged actuators, which replace unknown values.  `scales`: signal → the numbers of its
    `gate.Scale`, by which a tracker judges its readings.  `library`: where mechanisms and features are looked
    up by name; designs are compared without it.
    """

    mechanisms: tuple[Chosen, ...]
    averaged: Mapping[str, float] = field(default_factory=dict)
    power_scale_W: float | None = None
    power_order: int = 0
    power_mean: tuple[float, ...] = ()
    humidity: Name | None = None
    ambient_noise: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    statements: tuple[Statement, ...] = ()
    holds: Mapping[str, Name] = field(default_factory=dict)
    features: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    priors: Mapping[str, tuple[float, float, bool]] = field(default_factory=dict)
    actuator_means: Mapping[str, float] = field(default_factory=dict)
    scales: Mapping[str, tuple[float, float, float, float]] = field(default_factory=dict)
    library: Library = field(default=LIBRARY, compare=False)

    @cached_property
    def model(self) -> Model:
        """The model; equal designs share it, because tracing and compiling takes time and memory."""
        library_features, factories = self.library.features, self.library.mechanisms
        features = {name: library_features[name][1] for name in self.features if name in library_features}
        holds = {**INPUT_HOLDS, **features, **self.holds}
        content = [
            [settings for _, settings in self.mechanisms],
            sorted(holds.items()),
            dict(self.averaged),
            sorted(self.priors.items()),
        ]
        key = (tuple(factories[name] for name, _ in self.mechanisms), json.dumps(content))
        model = _models.get(key)
        if model is None:
            mechanisms = [
                _with_priors(factories[name](**settings), self.priors) for name, settings in self.mechanisms
            ]
            model = replace(compose(mechanisms, holds, self.averaged), bound=BOUND)
            _models[key] = model
        return model

    __getstate__ = field_values

    def __repr__(self) -> str:
        """Its model, and the humidity that it reads."""
        return f"Design of a {self.model!r}\n  humidity: {self.humidity or 'none'}"

    def to_json(self) -> dict[str, Any]:
        """All fields as plain data, with the `origins` of a user's mechanisms and features."""
        data = field_values(self)
        del data["library"]
        origins = self.library.origins
        names = (*(name for name, _ in self.mechanisms), *self.features)
        user_origins = {name: dict(origins[name]) for name in names if name in origins}
        return data | ({"origins": user_origins} if user_origins else {})

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Design:
        """A design from the data of `to_json`, with the package's library; missing fields have defaults."""
        fields = {name: value for name, value in data.items() if name != "origins"}
        not_text = [name for name, _ in fields.get("mechanisms", ()) if not isinstance(name, str)]
        if not_text:
            raise ValueError(f"expected names of mechanisms, found {not_text}")
        mechanisms = tuple((name, dict(settings)) for name, settings in fields.pop("mechanisms", ()))
        fields["power_mean"] = tuple(fields.get("power_mean", ()))
        fields["statements"] = tuple(map(Statement.from_json, fields.get("statements", ())))
        for name in ("ambient_noise", "priors", "scales"):
            fields[name] = {key: tuple(numbers) for key, numbers in fields.get(name, {}).items()}
        return cls(mechanisms, **fields)


def _with_priors(mechanism: Mechanism, priors: Mapping[str, tuple[float, float, bool]]) -> Mechanism:
    """The mechanism with priors for its parameters."""
    if not any(p.name in priors for p in mechanism.parameters):
        return mechanism
    parameters = tuple(
        replace(p, prior=Prior(*priors[p.name])) if p.name in priors else p for p in mechanism.parameters
    )
    return replace(mechanism, parameters=parameters)


RESOLVED = 0.02
"""Time constants shorter than this share of the readings' step cannot be distinguished from 0."""


def reading_step_h(series: Series) -> float:
    """Median time between readings [h]."""
    time = series.time[~series.missing]
    return float(np.median(np.diff(time))) / 3600.0 if len(time) > 1 else 1.0


def accuracy_of(series: Series) -> float:
    """Stated accuracy, else the signal table's default, else 0 [SI unit]."""
    if series.accuracy is not None:
        return series.accuracy
    return signal_named(series.signal).default_accuracy or 0.0


def observed_humidity(record: PreparedRecord) -> str | None:
    """The cabinet humidity in the likelihood, preferably the relative one; None without a usable one."""
    vapour = record.ambient_vapour
    if vapour is None or np.isfinite(vapour.value).sum() < FEWEST_READINGS:
        return None
    for name in CABINET_HUMIDITIES:
        if name in record and np.isfinite(record[name].value).sum() >= FEWEST_READINGS:
            return name
    return None


def power_scale(record: Record) -> float | None:
    """Power that counts as 1 [W]: the rated power, else the record's 99.9 % quantile; None without power."""
    if "active_power" not in record:
        return None
    value = record["active_power"].value
    value = value[np.isfinite(value)]
    if len(value) < 10:
        return None
    top = float(np.quantile(value, 0.999))
    return record.rated_power_W or (top if top > 0 else None)


def design(
    record: Record,
    *,
    kind: str = JOINT,
    power_order: int = 2,
    heat_start: Mapping[str, float] | None = None,
    coloured: bool = True,
    library: Library = LIBRARY,
) -> Design:
    """The base model for a record, which mechanisms of the `library` may extend.

    `kind`: "joint" (thermal and hygric state in one filter), "thermal" (temperature alone), or "cascade" (the
    hygric model on the measured temperature).  `coloured=False` omits the coloured disturbances.
    """
    record = prepare(record)
    statements: list[Statement] = []
    mechanisms: list[Chosen] = []
    averaged: dict[str, float] = {}
    observed = observed_humidity(record)
    humidity = observed if kind != "thermal" else None
    scale = power_scale(record) if kind != CASCADE else None
    mean: tuple[float, ...] = ()
    reference = float(np.nanmean(record["ambient_temperature"].value))
    used_actuators = [actuator for actuator in actuators(record) if actuator.used]
    if kind != CASCADE:
        mechanisms.append(("thermal_network", {}))
        release, mean, remarks = _release_settings(record, scale, power_order, reference, heat_start or {})
        mechanisms.append(("heat_release", release))
        statements += remarks
        mechanisms += [
            (name, dict(settings)) for name, settings in (a.thermal for a in used_actuators if a.thermal)
        ]
        temperature = record[CABINET_TEMPERATURE]
        if coloured:
            mechanisms.append(("heat_disturbance", _correlation_bounds(temperature, record)))
        mechanisms.append(("thermal_diffusion", {}))
        mechanisms.append(("temperature_sensor", _sensor(temperature)))
        if temperature.interval_s > 0:
            averaged[CABINET_TEMPERATURE] = temperature.interval_s / 3600.0
        power_order = release["order"] if release["operation"] else 0
    else:
        mechanisms.append(("measured_air", {"accuracy": accuracy_of(record[CABINET_TEMPERATURE])}))
        power_order = 0
    if humidity is not None:
        series = record[humidity]
        shortest = RESOLVED * reading_step_h(series)
        mechanisms.append(("hygric_exchange", {"shortest_h": shortest} if shortest > LEAST_K_H else {}))
        mechanisms += [
            (name, dict(settings)) for name, settings in (a.hygric for a in used_actuators if a.hygric)
        ]
        if coloured:
            mechanisms.append(("vapour_disturbance", _correlation_bounds(series, record)))
        mechanisms.append(("hygric_diffusion", {}))
        relative = humidity == "cabinet_relative_humidity"
        settings = _sensor(series, 1.0 if relative else 1e3)
        mechanisms.append(("humidity_sensor" if relative else "absolute_humidity_sensor", settings))
        if series.interval_s > 0:
            averaged[humidity] = series.interval_s / 3600.0
    elif observed is None:
        statements.append(FitCode.NO_HUMIDITY())
    return Design(
        mechanisms=tuple(mechanisms),
        averaged=averaged,
        power_scale_W=scale,
        power_order=power_order,
        power_mean=mean,
        humidity=humidity,
        ambient_noise=record.noise,
        statements=tuple(statements),
        actuator_means={a.signal: float(np.nanmean(record[a.signal].value)) for a in used_actuators},
        scales=record.scales,
        library=library,
    )


def _sensor(series: Series, scale: float = 1.0) -> dict[str, float]:
    """Settings of a sensor's mechanism; `scale` converts SI to the output's unit."""
    settings = {"accuracy": scale * accuracy_of(series), "resolution": scale * float(series.resolution)}
    if series.response_time_s:
        settings["response_h"] = series.response_time_s / 3600.0
    return settings


def _correlation_bounds(series: Series, record: Record) -> dict[str, float]:
    """Bounds of a disturbance's correlation time that the step of the readings and the length of the record
    can resolve."""
    step = reading_step_h(series)
    length = (record.end_s - record.start_s) / 3600.0
    shortest = max(step, 0.1)
    return {"shortest_h": shortest, "longest_h": max(min(length / 10.0, 200.0), 4.0 * shortest)}


def _release_settings(
    record: Record,
    scale: float | None,
    order: int,
    reference: float,
    start: Mapping[str, float],
) -> tuple[dict[str, Any], tuple[float, ...], list[Statement]]:
    """Settings of the heat release, the means of its features, and statements about it."""
    statements: list[Statement] = []
    settings: dict[str, Any] = {"reference_K": reference, "start": dict(start), "standstill_ambient": True}
    if "preheating" in record and np.nanmax(record["preheating"].value, initial=0.0) > 0:
        settings["preheating"] = True
    idle = {"operation": False, "standstill": True, "order": 0}
    if scale is None:
        statements.append(FitCode.NO_POWER())
        return settings | idle, (), statements
    series = record["active_power"]
    value = series.value[~series.missing] / scale
    running = value > 0
    operation, standstill = bool(running.mean() > 0.01), bool((~running).mean() > 0.01)
    if not standstill:
        statements.append(FitCode.HARDLY_ANY_STANDSTILL())
    if not operation:
        statements.append(FitCode.HARDLY_ANY_OPERATION())
        return settings | idle, (), statements
    distinct = float(np.ptp(np.quantile(value[running], [0.02, 0.98])))
    if distinct < 0.05 and order > 0:
        order = 0
        statements.append(FitCode.POWER_CONSTANT())
    features = power_features(value, order)
    settings |= {"order": order, "ambient": True, "operation": True, "standstill": standstill}
    if _longest_gap_h(series, record) > bridge_h(series, POWER_BRIDGE_H):
        varying = features if standstill else np.column_stack([np.zeros(len(value)), features[:, 1:]])
        settings["gap_covariance"] = np.cov(varying.T, bias=True).reshape(order + 1, order + 1).tolist()
        settings["gap_time_h"] = _correlation_time_h(series)
    return settings, tuple(features.mean(axis=0)), statements


def power_features(relative_power: np.ndarray, order: int) -> np.ndarray:
    """Features (T, order+1) of the relative power [1]: operating, and operating · p^k."""
    running = (relative_power > 0).astype(float)
    return np.column_stack([running, *(running * relative_power**k for k in range(1, order + 1))])


def _longest_gap_h(power: Series, record: Record) -> float:
    """Longest time without known power within the span of the cabinet's readings [h]."""
    spans = [record[n] for n in (CABINET_TEMPERATURE, *CABINET_HUMIDITIES) if n in record]
    first, last = min(s.time[0] for s in spans), max(s.time[-1] for s in spans)
    read_s = power.time[~power.missing]
    begin, end = np.append(-np.inf, read_s), np.append(read_s - power.interval_s, np.inf)
    return float(np.max(np.minimum(end, last) - np.maximum(begin, first))) / 3600.0


def _correlation_time_h(series: Series) -> float:
    """Lag at which the autocorrelation falls below 1/e [h]."""
    value = series.value - np.nanmean(series.value)
    step = float(np.median(np.diff(series.time))) / 3600.0
    value = np.where(np.isfinite(value), value, 0.0)
    variance = float(value @ value)
    if variance <= 0:
        return 24.0
    for lag in range(1, min(len(value) // 2, int(240 / step))):
        if float(value[lag:] @ value[:-lag]) < variance / math.e:
            return max(lag * step, 0.5)
    return 240.0


def extended(
    base: Design,
    additions: Sequence[Chosen],
    holds: Mapping[str, str] | None = None,
    features: Mapping[str, Mapping[str, Any]] | None = None,
) -> Design:
    """The design with further mechanisms of its library and the features that they read.

    `features`: features that have settings; features without settings follow from the mechanisms.
    """
    feature_settings = {**base.features, **(features or {})}
    library = base.library
    added = [library.mechanisms[mechanism](**settings) for mechanism, settings in additions]
    inputs = [name for mechanism in added for name in mechanism.inputs if name not in feature_settings]
    return replace(
        base,
        mechanisms=(*base.mechanisms, *additions),
        holds={**base.holds, **(holds or {})},
        features={**feature_settings, **without_settings(inputs, library.features)},
    )


def read_as(base: Design, record: Record) -> Design:
    """The design with the averaging intervals of a record, which are properties of the loggers.

    Outputs that the record lacks are predicted for instants.
    """
    averaged = {
        name: record[name].interval_s / 3600.0
        for name in base.model.outputs
        if name in record and record[name].interval_s > 0
    }
    return base if averaged == base.averaged else replace(base, averaged=averaged)


def merged(parts: Sequence[Design]) -> Design:
    """The joint design of a cascade: the thermal part supplies the air temperature of the hygric part."""
    joint = parts[0]
    for part in parts[1:]:
        joint = replace(
            joint,
            mechanisms=(*joint.mechanisms, *(m for m in part.mechanisms if m[0] != "measured_air")),
            averaged={**joint.averaged, **part.averaged},
            humidity=joint.humidity or part.humidity,
            statements=unique((*joint.statements, *part.statements)),
            holds={**joint.holds, **part.holds},
            features={**joint.features, **part.features},
            priors={**joint.priors, **part.priors},
            actuator_means={**joint.actuator_means, **part.actuator_means},
            scales={**part.scales, **joint.scales},
        )
    return joint
