"""From a record to the instants of a run: inputs by their holds, readings at their own times, gaps as gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.ambient import (
    AMBIENT_BRIDGE_H,
    ambient_absolute_humidity,
    at_times,
    bridge_h,
    centred,
    smoothed,
)
from hygrokf.design import (
    BRIDGE_H,
    HUMIDITIES,
    SETTLING_H,
    TEMPERATURE,
    Design,
    power_features,
)
from hygrokf.mechanisms.hygric import exchange_factor
from hygrokf.record import Record, Series
from hygrokf.timeline import Timeline, timeline


@dataclass(frozen=True)
class Run:
    """A timeline and what is known about its instants.

    `operating` (T,) True where the turbine feeds power (a record without power counts as standstill); `scored` (T,)
    False where an input is unknown or was until shortly before.
    """

    timeline: Timeline
    operating: np.ndarray
    scored: np.ndarray


def _changes(series: Series, first: float, last: float) -> np.ndarray:
    """Times at which a series' course has a corner or a jump [s]."""
    time = series.time
    if series.interval_s > 0:
        time = np.union1d(time, time - series.interval_s)
    return time[(time >= first) & (time <= last)]


def run(design: Design, record: Record) -> Run:
    """The instants of a record for a design.

    The run spans the cabinet's readings as far as ambient series exist.  Raises ValueError where nothing is left.
    """
    model = design.model
    outputs = [name for name in model.outputs if name in record]
    inputs_of = set(model.inputs)
    vapour = ambient_absolute_humidity(record) if "ambient_absolute_humidity" in inputs_of else None
    ambient = {"ambient_temperature": record["ambient_temperature"]}
    if vapour is not None:
        ambient["ambient_absolute_humidity"] = vapour
    ambient = {name: smoothed(series, design.ambient_noise.get(name)) for name, series in ambient.items()}
    if TEMPERATURE in inputs_of:
        ambient[TEMPERATURE] = record[TEMPERATURE]
    observed = [record[name] for name in (TEMPERATURE, *HUMIDITIES) if name in record]
    spans = observed or list(ambient.values())
    first = max(min(s.time[0] - s.interval_s for s in spans), *(s.time[0] for s in ambient.values()))
    last = min(max(s.time[-1] for s in spans), *(s.time[-1] for s in ambient.values()))
    if not first < last:
        raise ValueError(
            f"record {record.name}: the cabinet's readings and the ambient series have no time in common"
        )
    switched = [
        record[name]
        for name in ("active_power", "preheating")
        if name in record and (name != "active_power" or design.power_order or "operating" in inputs_of)
    ]
    times = [_changes(s, first, last) for s in (*ambient.values(), *switched)]
    times += [_changes(record[name], first, last) for name in outputs]
    time = np.unique(np.concatenate([np.array([first, last]), *times]))
    values, unknown_ambient = _ambient_inputs(ambient, time, inputs_of)
    if "preheating" in inputs_of:
        duty = at_times(record["preheating"], time, 24.0) if "preheating" in record else np.zeros(len(time))
        values["preheating"] = np.nan_to_num(duty)
    power, operating, unknown_power = _power_inputs(design, record, time)
    values |= power
    for name in inputs_of - set(values):  # further signals that an added mechanism reads
        values[name] = _further(record, name, time)
    near = _spread(time, unknown_ambient, SETTLING_H)
    readings, resets = {}, {}
    for name in outputs:
        series = record[name]
        at = np.full(len(time), np.nan)
        place = np.searchsorted(time, series.time)
        inside = (series.time >= first) & (series.time <= last)
        scale = 1e3 if name == "cabinet_absolute_humidity" else 1.0
        at[place[inside]] = series.value[inside] * scale
        at[near] = np.nan
        readings[name] = at
        if name in design.averaged:
            begin = np.zeros(len(time), bool)
            start = series.time[inside] - series.interval_s
            begin[np.searchsorted(time, start[start >= first])] = True
            resets[name] = begin
            readings[name][place[inside & (series.time - series.interval_s < first)]] = np.nan
    made = timeline(model, (time - first) / 3600.0, values, readings, resets, origin_s=first)
    scored = ~near & ~_spread(time, unknown_power, SETTLING_H)
    return Run(made, operating, scored)


def _ambient_inputs(
    ambient: dict[str, Series], time: np.ndarray, wanted: set[str]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    values, unknown = {}, np.zeros(len(time), bool)
    for name, series in ambient.items():
        value = at_times(series, time, AMBIENT_BRIDGE_H)
        missing = np.isnan(value)
        unknown |= missing
        there = ~missing
        if not there.any():
            raise ValueError(f"{name}: no reading within the span of the cabinet's readings")
        scale = 1e3 if name == "ambient_absolute_humidity" else 1.0
        values[name] = np.interp(time, time[there], value[there]) * scale
    if "exchange_factor" in wanted:
        values["exchange_factor"] = exchange_factor(values["ambient_temperature"])
    return values, unknown


def _power_inputs(
    design: Design, record: Record, time: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Power features, where the turbine operates, and where its power is unknown."""
    nothing = np.zeros(len(time), bool)
    if design.power_scale_W is None or "active_power" not in record:
        if design.power_mean:  # the model knows a power, this record does not
            values = dict(zip(_feature_names(design), design.power_mean, strict=True))
            return (
                {n: np.full(len(time), v) for n, v in values.items()} | {"power_unknown": np.ones(len(time))},
                nothing,
                ~nothing,
            )
        return {}, nothing, nothing
    relative = at_times(record["active_power"], time, BRIDGE_H) / design.power_scale_W
    unknown = np.isnan(relative)
    features = power_features(np.where(unknown, 0.0, relative), design.power_order)
    features[unknown] = np.array(design.power_mean) if design.power_mean else 0.0
    values = dict(zip(_feature_names(design), features.T, strict=True))
    wanted = set(design.model.inputs)
    values = {name: v for name, v in values.items() if name in wanted}
    if "power_unknown" in wanted:
        values["power_unknown"] = unknown.astype(float)
    return values, (relative > 0) & ~unknown, unknown


def _feature_names(design: Design) -> list[str]:
    return ["operating", *(f"power_{k}" for k in range(1, design.power_order + 1))]


def _further(record: Record, name: str, time: np.ndarray) -> np.ndarray:
    """Any other signal as an input; unknown values take the record's mean."""
    if name not in record:
        raise ValueError(
            f"the model reads {name!r}, which the record does not have: {', '.join(record.signals)}"
        )
    value = at_times(record[name], time, AMBIENT_BRIDGE_H)
    return np.where(np.isnan(value), np.nanmean(record[name].value), value)


def _spread(time: np.ndarray, flag: np.ndarray, hours: float) -> np.ndarray:
    """Instants at which the flag holds or held within the last `hours`."""
    last = np.where(flag, time, -np.inf)
    return time - np.maximum.accumulate(last) <= hours * 3600.0
