"""What the methods share on one record: the identified base model, its held-out errors, and the drivers on a
grid."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.data.ambient import ambient_absolute_humidity
from hygrokf.data.record import Record, Series
from hygrokf.discovery.baseline import Baseline, baseline
from hygrokf.discovery.held_out import Model, model_of
from hygrokf.discovery.submodel import HYGRIC
from hygrokf.evaluation.simulation import measured
from hygrokf.modelling.derived_inputs import clear_sky
from hygrokf.modelling.design import merged
from hygrokf.modelling.inputs import prepare_run

TEMPERATURE, HUMIDITY = "temperature_K", "absolute_humidity_g_m3"
STARTS = 4
"""Starts of the base model's estimate, as `discover` has them."""
DRIVERS = {
    "ambient_temperature": "Ta",
    "active_power": "P",
    "preheating": "preheating",
    "heater_duty": "heater",
    "fan_duty": "fan",
    "global_horizontal_irradiance": "sun",
    "wind_speed": "wind",
    "rain": "rain",
}
"""Signals that drive a cabinet, and what terms call them."""


@dataclass(frozen=True)
class Ground:
    """A record, its base model (`base`; `baseline`) and what that took, its simulations (`model`), and the
    readings by which every method is judged: quantity → (times [s], readings), those that the base model's
    free run is scored at.
    """

    record: Record
    base: Baseline
    model: Model
    cpu_s: float
    readings: Mapping[str, tuple[np.ndarray, np.ndarray]]

    @property
    def until_s(self) -> float:
        return self.model.identified.until_s

    @property
    def quantities(self) -> tuple[str, ...]:
        return (TEMPERATURE, HUMIDITY) if HYGRIC in self.base.submodels else (TEMPERATURE,)

    def held_out(self, simulated: Model | None = None) -> dict[str, float | None]:
        """Errors of the free run [K], [g/m³] on the validation period, of the base or of another model, as
        estimated."""
        of = (simulated or self.model).identified
        return {quantity: of.rmse(quantity, "validation") for quantity in self.quantities}

    def moved(self) -> dict[str, float | None]:
        """The same of the base moved toward its least free-run error on the identification period."""
        return {quantity: self.model.moved.rmse(quantity, "validation") for quantity in self.quantities}


def ground(record: Record) -> Ground:
    """Identify the base model of a record and simulate it."""
    begin = time.process_time()
    base = baseline(record, starts=STARTS)
    spent = time.process_time() - begin
    made = prepare_run(merged([submodel.base for submodel in base.submodels.values()]), record)
    seconds = made.timeline.origin_s + 3600.0 * made.timeline.time
    readings = {}
    for quantity, values in measured(made).items():
        there = np.isfinite(values) & made.scored
        readings[quantity] = (seconds[there], values[there])
    return Ground(record, base, model_of(base, record), spent, readings)


def drivers(record: Record, grid: np.ndarray) -> dict[str, np.ndarray]:
    """What drives the cabinet, by the names of `DRIVERS`, `va` [g/m³] and the hour's sine and cosine, at
    `grid` (T,) [s].

    Means stand in the middle of their interval; gaps are bridged by straight lines.  The sun is measured, or
    that of a clear sky where the site is known.
    """
    found = {short: on(record[name], grid) for name, short in DRIVERS.items() if name in record}
    if "cabinet_relative_humidity" in record:
        found["va"] = 1e3 * on(ambient_absolute_humidity(record), grid)
    if "sun" not in found and record.site is not None:
        found["sun"] = clear_sky(grid, record.site)
    day = 2.0 * np.pi * (grid % 86400.0) / 86400.0
    return found | {"sin": np.sin(day), "cos": np.cos(day)}


def on(series: Series, grid: np.ndarray) -> np.ndarray:
    """Values (T,) of a series at `grid` (T,) [s], straight lines between its readings."""
    known, value = series.known
    return np.interp(grid, known - 0.5 * series.interval_s, value)
