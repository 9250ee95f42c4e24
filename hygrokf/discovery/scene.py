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
"""Parts of a cell: a change of the power in 10-minute means then acts at most a minute early or late."""
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
    """Readings of a quantity: T instants.

    time_s: (T,) [s] instants, or ends of averaging intervals; value: (T,) [K] or [g/m³], NaN if left out;
    saturated: (T,) factor of the output: saturation vapour [g/m³] for a relative humidity, else 1; begin,
    end: (T,) positions [cells] of the averaging interval, equal for an instant; identified: (T,) whether the
    reading belongs to the identification period; added: (T,) added variance of the error at the start and
    after gaps.
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
        return (self.time_s - self.time_s[0]) / HOUR_S

    @property
    def day(self) -> np.ndarray:
        """(T,) days since the first reading."""
        return np.floor(self.time_h / 24.0).astype(int)

    def by_day(self, values: np.ndarray) -> np.ndarray:
        """Daily sums (days, …) of values (T, …)."""
        sums = np.zeros((self.day.max() + 1, *values.shape[1:]))
        np.add.at(sums, self.day, values)
        return sums

    def sampled(self, shown: np.ndarray) -> np.ndarray:
        """The readings (T, lanes) of a sensor with outputs (K, lanes) at the ends of the cells."""
        if np.array_equal(self.begin, self.end):
            return _between(shown, self.end) * self.saturated[:, None]
        # the first cell counts with the output at its end; a shifted interval stays within the cells
        parts = [np.zeros_like(shown[:1]), shown[:1], 0.5 * (shown[1:] + shown[:-1])]
        total = np.cumsum(np.concatenate(parts), axis=0)
        width = self.end - self.begin
        begin = np.clip(self.begin, 0.0, len(shown) - width) + 1.0
        mean = (_between(total, begin + width) - _between(total, begin)) / width[:, None]
        return mean * self.saturated[:, None]


def _between(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Values (K, lanes) at the ends of cells, interpolated at positions (T,) [cells] from the start of the
    first cell."""
    position = np.clip(place - 1.0, 0.0, len(values) - 1.0)
    cell = np.minimum(position.astype(int), len(values) - 2)
    share = (position - cell)[:, None]
    if not share.any():
        return values[cell]
    return values[cell] * (1.0 - share) + values[cell + 1] * share


@dataclass(frozen=True)
class Scene:
    """A record on its cells.

    first_s: [s] start of the first cell; cell_h: [h] length of a cell; count: K.  heat, vapour: the base
    designs, whose rules define the inputs; readings: by quantity; drive: (F,) [K] temperature that drives
    the vapour.
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
        """(F,) [s] edges of the parts of cells, to a millisecond: a mean counts up to its stamp."""
        edges = np.arange(self.count * CELL_PARTS + 1) * (HOUR_S * self.cell_h / CELL_PARTS)
        return np.round(self.first_s + edges, 3)

    def _base(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Inputs of the base designs at the edges of parts, and whether any of them is unknown there."""
        if "" not in self._cache:
            design = self.vapour or self.heat
            time, wanted = self.edges_s, {"exchange_factor"}
            ambient = courses(design, self.record)
            # a gap of the cabinet's temperature matters for the vapour only
            ambient.pop(CABINET_TEMPERATURE, None)
            inputs, unknown = ambient_inputs(ambient, time, wanted)
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
        """(F,) whether an input on which a signal depends is unknown."""
        unknown = self._base()[1]
        if signal == CABINET_TEMPERATURE:
            return unknown
        path = self.record.course(CABINET_TEMPERATURE)
        return unknown | np.isnan(at_times(path, self.edges_s, bridge_h(path, AMBIENT_BRIDGE_H)))

    def at_edges(self, name: str, design: Design) -> np.ndarray:
        """(F,) an input at the edges of parts; for a series of means, that over the part that ends there."""
        value = self._unmoved(name, design)
        own_shifts = [shift for shift in self.shifts if shift.source == self.source(name)]
        if not own_shifts:
            return value
        delay = sum(self._delay(shift, self.edges_s) for shift in own_shifts)
        return np.interp(self.edges_s - delay, self.edges_s, value)

    def _delay(self, shift: Shift, time_s: np.ndarray) -> np.ndarray:
        """The delay (n,) [s] of stamps at times (n,) [s] by a clock correction."""
        if not shift.summer:
            return np.full(len(time_s), shift.seconds)
        return shift.seconds * summer_time(time_s, in_america(self.record))

    def source(self, name: str) -> str:
        """The source whose clock stamps an input; empty for an input without a signal."""
        if name == VAPOUR and (vapour := self.record.ambient_vapour) is not None:
            return vapour.file
        signal = SIGNAL_OF.get(name, name)
        return self.record[signal].file if signal in self.record else ""

    def _unmoved(self, name: str, design: Design) -> np.ndarray:
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

    def with_inputs(self, given: Sequence[tuple[str, Design, np.ndarray]]) -> Scene:
        """The scene in which inputs of designs have other values (F,) at the edges of parts."""
        found, unknown = self._base()
        base = {**found, **{name: value for name, _, value in given if name in found}}
        values = {_key(name, design.features.get(name)): value for name, design, value in given}
        return replace(self, _cache={"": (base, unknown), **values})

    def cells(self, inputs: Sequence[str], designs: Sequence[Design]) -> CellInputs:
        """The inputs of a model over the cells."""
        means = np.empty((self.count, len(inputs)))
        edges = np.empty((self.count + 1, len(inputs)))
        for c, name in enumerate(inputs):
            owner = next((one for one in designs if name in one.model.inputs), designs[0])
            straight = name == CABINET_TEMPERATURE or owner.model.holds.get(name) == LINEAR
            means[:, c], edges[:, c] = self._over_cells(name, owner, straight)
        return CellInputs(self.cell_h, means, edges)

    def _over_cells(self, name: str, design: Design, straight: bool) -> tuple[np.ndarray, np.ndarray]:
        source = self.source(name)
        moved = [[one.seconds, one.summer] for one in self.shifts if one.source == source]
        drive = id(self.drive) if name == CABINET_TEMPERATURE else 0
        key = json.dumps([name, design.features.get(name), moved, drive, straight], default=float)
        if key not in self._cache:
            # the temperature is kept with its means, so that its identity stays its own
            made = over_cells(self.at_edges(name, design), straight)
            self._cache[key] = (*made, self.drive if drive else None)
        return self._cache[key][:2]

    def column(self, name: str, design: Design) -> np.ndarray:
        """(K,) means of an input over the cells."""
        return self._over_cells(name, design, design.model.holds.get(name) == LINEAR)[0]

    def moved(self, shift: Shift) -> Scene:
        """The scene with a source's stamps corrected; the readings stay the same ones."""
        made = replace(self, shifts=(*self.shifts, shift))
        if shift.source != self.record[CABINET_TEMPERATURE].file:
            return made
        readings = {}
        for q, one in self.readings.items():
            cells = self._delay(shift, one.time_s) / (HOUR_S * self.cell_h)
            readings[q] = replace(one, begin=one.begin + cells, end=one.end + cells)
        return replace(made, readings=readings)

    def place(self, time_s: np.ndarray) -> np.ndarray:
        """Times [s] in cells from the first one's beginning."""
        return (time_s - self.first_s) / (HOUR_S * self.cell_h)


def _key(name: str, settings: Any) -> str:
    return json.dumps([name, settings], default=float)


def over_cells(value: np.ndarray, straight: bool) -> tuple[np.ndarray, np.ndarray]:
    """Means (K,) over the cells and values (K+1,) at their edges, of values (F,) at the edges of parts."""
    parts = 0.5 * (value[1:] + value[:-1]) if straight else value[1:]
    means = parts.reshape(-1, CELL_PARTS).mean(axis=1)
    return means, value[::CELL_PARTS] if straight else np.append(means[:1], means)


def scene_of(record: Record, heat: Design, vapour: Design | None) -> Scene:
    """The record on cells of half its readings' step, 180 s to 20 min."""
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
    """The scene whose vapour runs on another temperature (F,) [K] at the edges of parts."""
    made = replace(scene, drive=temperature)
    humidity = scene.vapour.humidity if scene.vapour else None
    if humidity is None:
        return made
    return replace(made, readings={**scene.readings, "vapour": _vapour(made, scene.record[humidity])})


def _filled(value: np.ndarray) -> np.ndarray:
    there = np.isfinite(value)
    return np.interp(np.arange(len(value)), np.flatnonzero(there), value[there])


def _vapour(scene: Scene, series: Series) -> SceneReadings:
    """Readings of the humidity as vapour [g/m³] at the temperature on which the vapour runs."""
    if series.signal == "cabinet_absolute_humidity":
        return _readings(scene, series, 1e3 * series.value, np.ones(1))
    middle = series.time - 0.5 * series.interval_s
    saturated = 1e3 * absolute_humidity(1.0, _over_intervals(scene.edges_s, scene.drive, series))
    ends = (series.value >= SATURATED) | (series.value <= DRY)
    read = at_times(
        centred(scene.record[CABINET_TEMPERATURE]), middle, bridge_h(scene.record[CABINET_TEMPERATURE], 1.0)
    )
    value = np.where(ends, np.nan, 1e3 * absolute_humidity(series.value, read))
    return _readings(scene, series, value, saturated)


def _over_intervals(time: np.ndarray, value: np.ndarray, series: Series) -> np.ndarray:
    """Means (T,) of a course (F,) at times (F,) [s] over a series' intervals, or its values at instants."""
    if not series.interval_s:
        return np.interp(series.time, time, value)
    total = np.append(0.0, np.cumsum(0.5 * (value[1:] + value[:-1]) * np.diff(time)))
    ends = np.interp(series.time, time, total), np.interp(series.time - series.interval_s, time, total)
    return (ends[0] - ends[1]) / series.interval_s


def _readings(scene: Scene, series: Series, value: np.ndarray, saturated: np.ndarray) -> SceneReadings:
    """Readings within the cells whose inputs are known."""
    end = scene.place(series.time)
    begin = scene.place(series.time - series.interval_s)
    inside = (begin >= -1e-9) & (end <= scene.count + 1e-9)
    gone = np.append(0, np.cumsum(scene.unknown(series.signal)))
    at = [np.clip((CELL_PARTS * one).astype(int), 0, len(gone) - 2) for one in (begin, end)]
    known = gone[at[1] + 1] == gone[at[0]]
    value = np.where(known, value, np.nan)
    until = math.inf if scene.record.until_s is None else scene.record.until_s
    spread = np.broadcast_to(saturated, len(value))[inside]
    value, time = value[inside], series.time[inside]
    # where inputs were unknown since the reading before, the error begins anew
    there, anew = np.isfinite(value), np.zeros(len(value), bool)
    since = gone[at[1][inside] + 1][there]
    anew[there] = np.append(True, since[1:] > since[:-1])[: len(since)]
    scale = (
        UNKNOWN_K if series.signal == CABINET_TEMPERATURE else (UNKNOWN_SHARE * float(np.nanmean(value))) ** 2
    )
    return SceneReadings(
        time, value, spread, begin[inside], end[inside], time <= until, np.where(anew, scale, 0.0)
    )
