"""A record for simulations: inputs over cells of equal length, and the readings to compare with.

Every input is averaged over each cell along the same path as in the filter (`modelling.inputs`), sampled at
the edges of `CELL_PARTS` parts of a cell.  Readings keep their own times.

Shapes: K cells, F = PARTS K + 1 edges of their parts, T readings of a quantity.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.input_paths import centred
from hygrokf.data.prepared import VAPOUR, PreparedRecord, prepare
from hygrokf.data.readings import SATURATED
from hygrokf.data.record import Record, Series
from hygrokf.data.shared_clocks import Shift, in_america
from hygrokf.data.timestamps import HOUR_S, summer_time
from hygrokf.engine.cell_loop import IDLE, CellInputs
from hygrokf.modelling.derived_inputs import SIGNAL_OF, feature
from hygrokf.modelling.design import Design, reading_step_h
from hygrokf.modelling.inputs import (
    ambient_inputs,
    bridged,
    common_span,
    courses,
    further_input,
    power_inputs,
)
from hygrokf.physics.holds import LINEAR
from hygrokf.physics.psychrometrics import absolute_humidity
from hygrokf.physics.signal_names import CABINET_HUMIDITIES, CABINET_TEMPERATURE

CELL_PARTS = 8
"""Number of parts of a cell, so that a change of the power in 10-minute means acts at most a minute early or
late."""
SHORTEST_CELL_S, LONGEST_CELL_S = 180.0, 1200.0
"""[s] shortest and longest cell."""
MOST_CELLS = 33_000
DRY = 0.005
"""[1] relative humidity below which, as above `SATURATED`, a reading is at the end of its sensor's range."""
UNKNOWN_K = 25.0
"""[K²] variance of the temperature's error at the start of a run and after a gap."""
UNKNOWN_SHARE = 0.3
"""Standard deviation of the vapour's error at the start of a run and after a gap, as a share of the mean."""


@dataclass(frozen=True)
class SceneReadings:
    """The readings of a quantity at T instants.

    time_s: (T,) [s] instants, or ends of the averaging intervals.
    value: (T,) [K] or [g/m³]; NaN where a reading is left out.
    saturated: (T,) factor from the sensor's output to `value`: saturation vapour [g/m³] for a relative
        humidity, else 1.
    begin, end: (T,) averaging interval, in cells from the start of the scene; equal for instants.
    identified: (T,) whether the reading belongs to the identification period.
    added: (T,) extra variance of the error, at the start and after gaps.
    """

    time_s: np.ndarray
    value: np.ndarray
    saturated: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    identified: np.ndarray
    added: np.ndarray

    @property
    def time_h(self) -> np.ndarray:
        """(T,) [h] since the first reading."""
        return (self.time_s - self.time_s[0]) / HOUR_S

    @property
    def day(self) -> np.ndarray:
        """(T,) days since the first reading."""
        return np.floor(self.time_h / 24.0).astype(int)

    def by_day(self, values: np.ndarray) -> np.ndarray:
        """Return the daily sums (days, …) of values (T, …)."""
        sums = np.zeros((self.day.max() + 1, *values.shape[1:]))
        np.add.at(sums, self.day, values)
        return sums

    def sampled(self, output: np.ndarray) -> np.ndarray:
        """Return the readings (T, lanes) that a sensor would give.

        output: (K, lanes) output of the sensor at the ends of the cells, for several runs side by side.
        """
        if np.array_equal(self.begin, self.end):
            return _between(output, self.end) * self.saturated[:, None]
        # the first cell counts with the output at its end; a shifted interval stays within the cells
        increments = [np.zeros_like(output[:1]), output[:1], 0.5 * (output[1:] + output[:-1])]
        total = np.cumsum(np.concatenate(increments), axis=0)
        width = self.end - self.begin
        begin = np.clip(self.begin, 0.0, len(output) - width) + 1.0
        mean = (_between(total, begin + width) - _between(total, begin)) / width[:, None]
        return mean * self.saturated[:, None]


def _between(values: np.ndarray, position_in_cells: np.ndarray) -> np.ndarray:
    """Interpolate values (K, lanes), given at the ends of cells, at positions (T,) counted in cells from the
    start."""
    position = np.clip(position_in_cells - 1.0, 0.0, len(values) - 1.0)
    cell = np.minimum(position.astype(int), len(values) - 2)
    fraction = (position - cell)[:, None]
    if not fraction.any():
        return values[cell]
    return values[cell] * (1.0 - fraction) + values[cell + 1] * fraction


@dataclass(frozen=True)
class Scene:
    """A record divided into cells of equal length, ready for simulation.

    first_s: [s] start of the first cell.  cell_h: [h] length of a cell.  count: number of cells K.
    heat, vapour: base designs, which define how inputs are made.
    readings: by quantity ("temperature", "vapour").
    drive: (F,) [K] the temperature on which the vapour model runs.
    shifts: corrections of clocks.
    """

    record: PreparedRecord
    first_s: float
    cell_h: float
    count: int
    heat: Design
    vapour: Design | None
    readings: Mapping[str, SceneReadings] = field(default_factory=dict)
    drive: np.ndarray = field(default_factory=lambda: np.empty(0))
    shifts: tuple[Shift, ...] = ()
    _cache: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def edges_s(self) -> np.ndarray:
        """(F,) [s] edges of the parts of all cells, rounded to a millisecond so that a mean ends exactly at
        its stamp."""
        edges = np.arange(self.count * CELL_PARTS + 1) * (HOUR_S * self.cell_h / CELL_PARTS)
        return np.round(self.first_s + edges, 3)

    def _base(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the inputs of the base designs (F,) by name, and (F,) whether any of them is unknown."""
        if "" not in self._cache:
            design = self.vapour or self.heat
            time, derived = self.edges_s, {"exchange_factor"}
            ambient = courses(design, self.record)
            # a gap of the cabinet's temperature matters for the vapour only
            ambient.pop(CABINET_TEMPERATURE, None)
            inputs, unknown = ambient_inputs(ambient, time, derived)
            power, operating, unknown_power = power_inputs(self.heat, self.record, time)
            inputs |= power
            if "preheating" in self.record:
                inputs["preheating"] = np.nan_to_num(bridged(self.record, "preheating", time))
            if "operating" not in inputs:
                inputs["operating"] = operating.astype(float)
            inputs[IDLE] = 1.0 - inputs["operating"]
            self._cache[""] = inputs, unknown | unknown_power
        return self._cache[""]

    def unknown(self, signal: str) -> np.ndarray:
        """Return (F,) whether an input that a signal depends on is unknown."""
        unknown = self._base()[1]
        if signal == CABINET_TEMPERATURE:
            return unknown
        path = self.record.course(CABINET_TEMPERATURE)
        return unknown | np.isnan(at_times(path, self.edges_s, bridge_h(path, AMBIENT_BRIDGE_H)))

    def at_edges(self, name: str, design: Design) -> np.ndarray:
        """Return an input (F,) at the edges of the parts, with clock corrections applied."""
        value = self._unmoved(name, design)
        own_shifts = [shift for shift in self.shifts if shift.source == self.source(name)]
        if not own_shifts:
            return value
        delay = sum(self._delay(shift, self.edges_s) for shift in own_shifts)
        return np.interp(self.edges_s - delay, self.edges_s, value)

    def _delay(self, shift: Shift, time_s: np.ndarray) -> np.ndarray:
        """Return by how many seconds (n,) a clock correction delays stamps at times (n,) [s]."""
        if not shift.summer:
            return np.full(len(time_s), shift.seconds)
        return shift.seconds * summer_time(time_s, in_america(self.record))

    def source(self, name: str) -> str:
        """Return the source (file) whose clock stamps an input; "" for an input that no signal provides."""
        if name == VAPOUR and (vapour := self.record.ambient_vapour) is not None:
            return vapour.file
        signal = SIGNAL_OF.get(name, name)
        return self.record[signal].file if signal in self.record else ""

    def _unmoved(self, name: str, design: Design) -> np.ndarray:
        """Return an input (F,) at the edges of the parts, without clock corrections."""
        if name == CABINET_TEMPERATURE:
            return self.drive
        if name in self._base()[0]:
            return self._base()[0][name]
        settings, key = design.features.get(name), _key(name, design.features.get(name))
        if key in self._cache:
            return np.asarray(self._cache[key])
        if settings is not None:
            # of hundreds of settings only the means over cells are kept
            value = feature(self.record, name, settings, self.edges_s, design.library.features)
            return np.asarray(value, dtype=float)
        mean = design.actuator_means.get(name)
        value = further_input(self.record, name, self.edges_s, design.model.holds[name], mean)
        self._cache[key] = np.asarray(value, dtype=float)
        return self._cache[key]

    def with_inputs(self, replacements: Sequence[tuple[str, Design, np.ndarray]]) -> Scene:
        """Return the scene with some inputs replaced.

        replacements: (name of the input, its design, values (F,) at the edges of the parts).
        """
        base_inputs, unknown = self._base()
        new_base_inputs = {
            **base_inputs,
            **{name: value for name, _, value in replacements if name in base_inputs},
        }
        values = {_key(name, design.features.get(name)): value for name, design, value in replacements}
        return replace(self, _cache={"": (new_base_inputs, unknown), **values})

    def cells(self, inputs: Sequence[str], designs: Sequence[Design]) -> CellInputs:
        """Return the named inputs of a model as means over the cells and values at their edges."""
        means = np.empty((self.count, len(inputs)))
        edges = np.empty((self.count + 1, len(inputs)))
        for c, name in enumerate(inputs):
            owner = next((design for design in designs if name in design.model.inputs), designs[0])
            straight = name == CABINET_TEMPERATURE or owner.model.holds.get(name) == LINEAR
            means[:, c], edges[:, c] = self._over_cells(name, owner, straight)
        return CellInputs(self.cell_h, means, edges)

    def _over_cells(self, name: str, design: Design, straight: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the means (K,) of an input over the cells and its values (K+1,) at their edges.

        straight: whether the input runs in straight lines between the edges; otherwise it is constant within
            a part.
        """
        source = self.source(name)
        shifts_of_source = [[shift.seconds, shift.summer] for shift in self.shifts if shift.source == source]
        drive_id = id(self.drive) if name == CABINET_TEMPERATURE else 0
        key = json.dumps(
            [name, design.features.get(name), shifts_of_source, drive_id, straight], default=float
        )
        if key not in self._cache:
            # the temperature is kept with its means, so that its identity stays its own
            means_and_edges = over_cells(self.at_edges(name, design), straight)
            self._cache[key] = (*means_and_edges, self.drive if drive_id else None)
        return self._cache[key][:2]

    def column(self, name: str, design: Design) -> np.ndarray:
        """Return the means (K,) of an input over the cells."""
        return self._over_cells(name, design, design.model.holds.get(name) == LINEAR)[0]

    def moved(self, shift: Shift) -> Scene:
        """Return the scene with the stamps of one source corrected; it keeps the same readings."""
        scene = replace(self, shifts=(*self.shifts, shift))
        if shift.source != self.record[CABINET_TEMPERATURE].file:
            return scene
        readings = {}
        for q, old in self.readings.items():
            delay_cells = self._delay(shift, old.time_s) / (HOUR_S * self.cell_h)
            readings[q] = replace(old, begin=old.begin + delay_cells, end=old.end + delay_cells)
        return replace(scene, readings=readings)

    def place(self, time_s: np.ndarray) -> np.ndarray:
        """Convert times [s] to cells since the start of the first cell."""
        return (time_s - self.first_s) / (HOUR_S * self.cell_h)


def _key(name: str, settings: Any) -> str:
    """Return a hashable key for a name and its settings."""
    return json.dumps([name, settings], default=float)


def over_cells(value: np.ndarray, straight: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return means (K,) over the cells and values (K+1,) at their edges.

    value: (F,) at the edges of the parts.  straight: whether it is linear within a part, else constant.
    """
    parts = 0.5 * (value[1:] + value[:-1]) if straight else value[1:]
    means = parts.reshape(-1, CELL_PARTS).mean(axis=1)
    return means, value[::CELL_PARTS] if straight else np.append(means[:1], means)


def scene_of(record: Record, heat: Design, vapour: Design | None) -> Scene:
    """Divide a record into cells of half the shortest reading step, between 180 s and 20 min.

    heat, vapour: base designs; vapour is None for a record without humidity.
    """
    design, record = vapour or heat, prepare(record)
    first, last = common_span(record, courses(design, record), False)
    step_s = HOUR_S * min(
        reading_step_h(record[n]) for n in (CABINET_TEMPERATURE, *CABINET_HUMIDITIES) if n in record
    )
    cell_s = min(max(0.5 * step_s, SHORTEST_CELL_S, (last - first) / MOST_CELLS), LONGEST_CELL_S)
    # readings at the edges of cells need no interpolation
    read = record[CABINET_TEMPERATURE].time
    first += float((read[np.searchsorted(read, first)] - first) % cell_s)
    count = max(math.ceil((last - first) / cell_s - 1e-9), 2)
    scene = Scene(record, first, cell_s / HOUR_S, count, heat, vapour)
    warm_series = record[CABINET_TEMPERATURE]
    warm = at_times(record.course(CABINET_TEMPERATURE), scene.edges_s, math.inf)
    scene = replace(scene, drive=_filled(warm))
    readings = {"temperature": _readings(scene, warm_series, warm_series.value, np.ones(1))}
    if vapour is not None and vapour.humidity is not None:
        readings["vapour"] = _vapour(scene, record[vapour.humidity])
    return replace(scene, readings=readings)


def driven(scene: Scene, temperature: np.ndarray) -> Scene:
    """Return the scene with another temperature (F,) [K] for its vapour model; the humidity readings are
    converted again."""
    driven_scene = replace(scene, drive=temperature)
    humidity = scene.vapour.humidity if scene.vapour else None
    if humidity is None:
        return driven_scene
    return replace(
        driven_scene, readings={**scene.readings, "vapour": _vapour(driven_scene, scene.record[humidity])}
    )


def _filled(value: np.ndarray) -> np.ndarray:
    """Return the values (n,) with NaN replaced by linear interpolation."""
    is_known = np.isfinite(value)
    return np.interp(np.arange(len(value)), np.flatnonzero(is_known), value[is_known])


def _vapour(scene: Scene, series: Series) -> SceneReadings:
    """Return humidity readings as vapour [g/m³] at the temperature that drives the vapour model."""
    if series.signal == "cabinet_absolute_humidity":
        return _readings(scene, series, 1e3 * series.value, np.ones(1))
    middle = series.time - 0.5 * series.interval_s
    saturated = 1e3 * absolute_humidity(1.0, _over_intervals(scene.edges_s, scene.drive, series))
    at_sensor_limit = (series.value >= SATURATED) | (series.value <= DRY)
    cabinet_K = at_times(
        centred(scene.record[CABINET_TEMPERATURE]), middle, bridge_h(scene.record[CABINET_TEMPERATURE], 1.0)
    )
    value = np.where(at_sensor_limit, np.nan, 1e3 * absolute_humidity(series.value, cabinet_K))
    return _readings(scene, series, value, saturated)


def _over_intervals(time: np.ndarray, value: np.ndarray, series: Series) -> np.ndarray:
    """Return the means (T,) of a function over a series' averaging intervals, or its values at instants.

    time, value: (F,) [s] and the function's values.
    """
    if not series.interval_s:
        return np.interp(series.time, time, value)
    integral = np.append(0.0, np.cumsum(0.5 * (value[1:] + value[:-1]) * np.diff(time)))
    integral_at = (
        np.interp(series.time, time, integral),
        np.interp(series.time - series.interval_s, time, integral),
    )
    return (integral_at[0] - integral_at[1]) / series.interval_s


def _readings(scene: Scene, series: Series, value: np.ndarray, saturated: np.ndarray) -> SceneReadings:
    """Return the readings of a series inside the cells; NaN where an input is unknown during the reading.

    value: (T,) in the quantity's unit.  saturated: factor from the sensor's output to it, (T,) or (1,).
    """
    end = scene.place(series.time)
    begin = scene.place(series.time - series.interval_s)
    inside_cells = (begin >= -1e-9) & (end <= scene.count + 1e-9)
    unknown_count = np.append(0, np.cumsum(scene.unknown(series.signal)))
    part_index = [
        np.clip((CELL_PARTS * position).astype(int), 0, len(unknown_count) - 2) for position in (begin, end)
    ]
    inputs_known = unknown_count[part_index[1] + 1] == unknown_count[part_index[0]]
    value = np.where(inputs_known, value, np.nan)
    until = math.inf if scene.record.until_s is None else scene.record.until_s
    output_factor = np.broadcast_to(saturated, len(value))[inside_cells]
    value, time = value[inside_cells], series.time[inside_cells]
    # where inputs were unknown since the reading before, the error begins anew
    is_read, begins_anew = np.isfinite(value), np.zeros(len(value), bool)
    unknown_before_reading = unknown_count[part_index[1][inside_cells] + 1][is_read]
    begins_anew[is_read] = np.append(True, unknown_before_reading[1:] > unknown_before_reading[:-1])[
        : len(unknown_before_reading)
    ]
    unknown_variance = (
        UNKNOWN_K if series.signal == CABINET_TEMPERATURE else (UNKNOWN_SHARE * float(np.nanmean(value))) ** 2
    )
    return SceneReadings(
        time,
        value,
        output_factor,
        begin[inside_cells],
        end[inside_cells],
        time <= until,
        np.where(begins_anew, unknown_variance, 0.0),
    )
