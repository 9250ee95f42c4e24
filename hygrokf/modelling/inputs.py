"""From a record to the instants of a run: inputs by their holds, readings at their own times, gaps kept as
gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.prepared import VAPOUR, PreparedRecord, prepare
from hygrokf.data.record import Record, Series, expect_record
from hygrokf.engine.timeline import Timeline, timeline
from hygrokf.modelling.derived_inputs import feature
from hygrokf.modelling.design import POWER_BRIDGE_H, Design, power_features
from hygrokf.physics.holds import LINEAR, MEAN, PREVIOUS
from hygrokf.physics.mechanisms.hygric import exchange_factor
from hygrokf.physics.signal_names import CABINET_HUMIDITIES, CABINET_TEMPERATURE

IDENTIFIED_ON = {
    "ambient_temperature": "ambient_temperature_K",
    "ambient_absolute_humidity": "ambient_absolute_humidity_g_m3",
    "power_1": "power_share",
}
"""Inputs whose range in the identification period is stored with a fit, and their keys in `identified_on`."""


@dataclass(frozen=True)
class Run:
    """A record on the instants of a model: its timeline, with flags for them.

    `record` supplies the inputs and readings of the timeline.  `operating` (T,) is True where the turbine
    feeds power (a record without power counts as standstill).  `scored` (T,) is False where an input is
    unknown and, after `evaluation.simulation.settled`, until the gap hardly affects the free run any more.
    """

    record: PreparedRecord
    timeline: Timeline
    operating: np.ndarray
    scored: np.ndarray

    def window(self, first: int, last: int) -> Run:
        """Instants first … last−1, as `Timeline.window`."""
        part = self.timeline.window(first, last)
        return replace(
            self, timeline=part, operating=self.operating[first:last], scored=self.scored[first:last]
        )

    def unread(self) -> Run:
        """The run without any reading, for simulations and forecasts."""
        t = self.timeline
        return replace(self, timeline=t.with_readings(np.full_like(t.y, np.nan)))

    def __repr__(self) -> str:
        """The timeline, and how many of its instants are flagged."""
        return f"Run on a {self.timeline!r}\n  {self.operating.sum()} operating, {self.scored.sum()} scored"


def _changes(series: Series, first: float, last: float) -> np.ndarray:
    """Times [s] of the corners and jumps in the course of a series."""
    time = series.time
    if series.interval_s > 0:
        time = np.concatenate([time, time - series.interval_s])
    elif series.hold == PREVIOUS:
        times, _, longest_s = series.held
        ends = times + longest_s
        time = np.concatenate([time, times, ends[ends < np.append(times[1:], np.inf)]])
    return time[(time >= first) & (time <= last)]


def longest_gap_h(signal: str) -> float:
    """Longest gap [h] of an input that is bridged, unless its own usual step is longer."""
    return {"active_power": POWER_BRIDGE_H, "preheating": 24.0}.get(signal, AMBIENT_BRIDGE_H)


def model_inputs(design: Design, record: Record, *, beyond: bool = False) -> Run:
    """Put inputs and readings of a record on the instants of the filter.

    design: which inputs the model reads, and how (`fit.design`).
    record: the run covers the span that the cabinet's readings and the ambient's series have in common.
    beyond: whether the run continues after the cabinet's readings, to the end of the ambient's series.

    Interval means of the ambient are replaced by a path with the same means (`data.input_paths`); of
    overlapping interval means of the cabinet, the later ones are left out.

    Returns the run: `timeline` with times (T,) [h], inputs and readings; masks (T,) of operation and of the
    instants that are scored.
    Raises KeyError where the record lacks an input; ValueError where nothing is left, and where the record's
    averaging intervals differ from the design's (`read_as` makes a design that fits).
    """
    model, record = design.model, prepare(expect_record(record, "model_inputs"))
    outputs = [name for name in model.outputs if name in record]
    _check_intervals(design, record, outputs)
    inputs_of = set(model.inputs)
    ambient = courses(design, record)
    first, last = common_span(record, ambient, beyond)
    switched = [
        record[name]
        for name in ("active_power", "preheating")
        if name in record and (name != "active_power" or design.power_order or "operating" in inputs_of)
    ]
    others = [record[name] for name in sorted(inputs_of & set(record.signals) - {*ambient, "preheating"})]
    courses_read = [
        record.path(s.signal) if s.hold == PREVIOUS and model.holds[s.signal] == LINEAR else s for s in others
    ]
    times = [_changes(s, first, last) for s in (*ambient.values(), *switched, *courses_read)]
    times += [_changes(record[name], first, last) for name in outputs]
    time = np.sort(np.concatenate([(first, last), *times]))
    time = time[np.append(True, time[1:] > time[:-1])]
    values, unknown_ambient = ambient_inputs(ambient, time, inputs_of)
    if "preheating" in inputs_of:
        values["preheating"] = np.nan_to_num(bridged(record, "preheating", time))
    power, operating, unknown_power = power_inputs(design, record, time)
    values |= power
    for name in sorted(inputs_of & set(design.features)):
        values[name] = feature(record, name, design.features[name], time, design.library.features)
    for name in sorted(inputs_of - set(values)):  # further signals that an added mechanism reads
        values[name] = further_input(record, name, time, model.holds[name], design.actuator_means.get(name))
    readings, resets = _readings(design, record, outputs, time, unknown_ambient)
    ends = gap_ends(~unknown_ambient)
    run_timeline = timeline(model, (time - first) / 3600.0, values, readings, resets, first, ends)
    return Run(record, run_timeline, operating, ~unknown_ambient & ~unknown_power)


def gap_ends(is_known: np.ndarray) -> np.ndarray:
    """True at the instants (T,) with known inputs that follow an instant with unknown inputs; empty if there
    are none."""
    ends = is_known & np.append(False, ~is_known[:-1])
    return ends if ends.any() else ends[:0]


def courses(design: Design, record: PreparedRecord) -> dict[str, Series]:
    """The courses of the ambient, and of the cabinet's temperature where a model reads it, by input."""
    inputs_read = design.model.inputs
    names = ["ambient_temperature"]
    names += [VAPOUR] if VAPOUR in inputs_read and record.ambient_vapour is not None else []
    names += [CABINET_TEMPERATURE] if CABINET_TEMPERATURE in inputs_read else []
    return {name: record.course(name, design.ambient_noise.get(name)) for name in names}


def common_span(record: Record, ambient: dict[str, Series], beyond: bool) -> tuple[float, float]:
    """First and last instant [s] at which both cabinet readings and ambient series exist; with `beyond`, the
    last instant is the end of the ambient series."""
    observed = [record[name] for name in (CABINET_TEMPERATURE, *CABINET_HUMIDITIES) if name in record]
    spans = observed or list(ambient.values())
    known_times = [s.known[0] for s in ambient.values()]
    if not all(len(time) for time in known_times):
        empty = ", ".join(
            "the ambient humidity" if name == "ambient_absolute_humidity" else name
            for name, time in zip(ambient, known_times, strict=True)
            if not len(time)
        )
        raise ValueError(f"no reading of {empty} can be used, and every model needs it; check the source")
    first = max(min(s.time[0] - s.interval_s for s in spans), *(time[0] for time in known_times))
    ends = [time[-1] for time in known_times]
    last = min(ends if beyond else [max(s.time[-1] for s in spans), *ends])
    if not first < last:
        series = "the cabinet's readings and the ambient series" if observed else "the ambient series"
        raise ValueError(
            f"{series} have no stretch of time in common (a single reading does not count): "
            "check the spans with `hygrokf check`"
        )
    return first, last


def _readings(
    design: Design, record: Record, outputs: list[str], time: np.ndarray, unknown: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Readings (T,) of every output, NaN where there is none or an input is unknown; True (T,) where running
    means restart."""
    first, last = time[0], time[-1]
    readings, resets = {}, {}
    for name in outputs:
        series = record[name]
        values = np.full(len(time), np.nan)
        row = np.searchsorted(time, series.time)
        in_run = (series.time >= first) & (series.time <= last)
        scale = 1e3 if name == "cabinet_absolute_humidity" else 1.0
        values[row[in_run]] = series.value[in_run] * scale
        values[unknown] = np.nan
        readings[name] = values
        if name in design.averaged:
            start = _interval_starts(series, first)
            # a mean over an interval with unknown inputs cannot be predicted
            count = np.append(0, np.cumsum(unknown))
            interval_start = np.searchsorted(time, np.nan_to_num(start, nan=first))
            start[in_run] = np.where((count[row] > count[interval_start])[in_run], np.nan, start[in_run])
            readings[name][row[in_run & np.isnan(start)]] = np.nan
            resets_here = np.zeros(len(time), bool)
            resets_here[np.searchsorted(time, start[in_run & np.isfinite(start)])] = True
            resets[name] = resets_here
    return readings, resets


def _check_intervals(design: Design, record: Record, outputs: list[str]) -> None:
    """Raise ValueError where readings are means over other intervals than those of the design."""
    faults = []
    for name in outputs:
        stated_h, interval_h = design.averaged.get(name, 0.0), record[name].interval_s / 3600.0
        if abs(stated_h - interval_h) > 1e-9:
            faults.append(
                f"{name}: the design reads means over {3600.0 * stated_h:g} s, "
                f"the record has {3600.0 * interval_h:g} s"
            )
    if faults:
        raise ValueError("; ".join(faults) + " (0 s: instants); use `read_as(design, record)`")


def _interval_starts(series: Series, first: float) -> np.ndarray:
    """Start times of the intervals of averaged readings [s]; NaN for readings that cannot be predicted.

    A reading cannot be predicted if it is missing, if its interval begins before the run, or if its interval
    begins before the previous one ends, since a running mean covers one interval at a time.
    """
    start = np.where(
        series.missing | (series.time - series.interval_s < first), np.nan, series.time - series.interval_s
    )
    previous_end = -np.inf
    for i in np.flatnonzero(np.isfinite(start)):
        if start[i] < previous_end - 1e-3:  # a millisecond is rounding, not an overlap
            start[i] = np.nan
            continue
        start[i] = max(start[i], previous_end)
        previous_end = series.time[i]
    return start


def ambient_inputs(
    ambient: dict[str, Series], time: np.ndarray, inputs_read: set[str]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Values (T,) of the ambient inputs at the instants `time` (T,) [s], and where one of them is unknown.

    inputs_read: by the model; `exchange_factor` is computed if it is among them.  Humidity is in g/m³.

    Raises ValueError for an input without a reading in this time.
    """
    values: dict[str, np.ndarray] = {}
    unknown = np.zeros(len(time), bool)
    middle = 0.5 * (time[:-1] + time[1:])
    for name, series in ambient.items():
        longest = bridge_h(series, AMBIENT_BRIDGE_H)
        sampled = at_times(series, np.concatenate([time, middle]), longest)
        value, between = sampled[: len(time)], sampled[len(time) :]
        missing = np.isnan(value)
        unknown |= missing
        # where all loggers failed, no instant lies inside the gap: the step across it is unknown
        unknown[1:] |= np.isnan(between)
        is_known = ~missing
        if not is_known.any():
            raise ValueError(
                f"{name}: no reading within the span of the cabinet's readings; check both with `hygrokf "
                "check`"
            )
        scale = 1e3 if name == "ambient_absolute_humidity" else 1.0
        if missing.any():
            # in a gap that is not bridged the last value holds: later readings must not change earlier
            # estimates
            row = np.searchsorted(np.flatnonzero(is_known), np.arange(len(time)), side="right") - 1
            value = value[is_known][np.maximum(row, 0)]
        values[name] = value * scale
    if "exchange_factor" in inputs_read:
        values["exchange_factor"] = exchange_factor(values["ambient_temperature"])
    return values, unknown


def power_inputs(
    design: Design, record: Record, time: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Power features, True where the turbine operates, and True where its power is unknown."""
    all_false = np.zeros(len(time), bool)
    if design.power_scale_W is None or "active_power" not in record:
        if design.power_mean:  # the model uses a power that the record lacks
            means = zip(_feature_names(design), design.power_mean, strict=True)
            return (
                {n: np.full(len(time), v) for n, v in means} | {"power_unknown": np.ones(len(time))},
                all_false,
                ~all_false,
            )
        return {}, all_false, all_false
    relative = bridged(record, "active_power", time) / design.power_scale_W
    unknown = np.isnan(relative)
    features = power_features(np.where(unknown, 0.0, relative), design.power_order)
    features[unknown] = np.array(design.power_mean) if design.power_mean else 0.0
    values = dict(zip(_feature_names(design), features.T, strict=True))
    inputs_read = set(design.model.inputs)
    values = {name: v for name, v in values.items() if name in inputs_read}
    if "power_unknown" in inputs_read:
        values["power_unknown"] = unknown.astype(float)
    return values, (relative > 0) & ~unknown, unknown


def _feature_names(design: Design) -> list[str]:
    return ["operating", *(f"power_{k}" for k in range(1, design.power_order + 1))]


def bridged(record: Record, name: str, time: np.ndarray) -> np.ndarray:
    """Values of a signal over the steps, short gaps bridged; NaN in longer gaps, 0 without the signal."""
    if name not in record:
        return np.zeros(len(time))
    return _over_steps(record[name], time, bridge_h(record[name], longest_gap_h(name)))


def _over_steps(series: Series, time: np.ndarray, longest_h: float) -> np.ndarray:
    """Values of a series over the step that ends at each instant; NaN outside the series and in longer gaps.

    The mean of a straight line over a step is its value in the middle of the step.  A value that holds from
    its stamp on is also read there, since it changes at instants only.
    """
    if series.hold != MEAN:
        time = 0.5 * (time + np.concatenate([time[:1], time[:-1]]))
    return at_times(series, time, longest_h)


def further_input(
    record: PreparedRecord, name: str, time: np.ndarray, hold: str, mean: float | None = None
) -> np.ndarray:
    """Any other signal as an input; a `mean` replaces unknown values, by default that of the readings."""
    if name not in record:
        needed = name
        if name == "ambient_absolute_humidity":
            needed = "an ambient humidity (relative, absolute or dew point)"
        raise ValueError(
            f"the model reads {needed}, which the record does not have (it has {', '.join(record.signals)}): "
            "add the signal, or use a model without it"
        )
    series = record[name]
    longest = bridge_h(series, AMBIENT_BRIDGE_H)
    linear = hold == LINEAR
    value = at_times(record.course(name), time, longest) if linear else _over_steps(series, time, longest)
    if hold == PREVIOUS:  # over the step that begins at each instant
        value = np.append(value[1:], value[-1:])
    return np.where(np.isnan(value), np.nanmean(series.value) if mean is None else mean, value)
