"""What the methods share on one record: the base model, its held-out errors, and the drivers on a grid."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.data.ambient import ambient_absolute_humidity
from hygrokf.data.clocks import shifted
from hygrokf.data.record import Record, Series
from hygrokf.discovery.estimate import Calibration
from hygrokf.discovery.final_set import final_estimator, final_set, fit_of
from hygrokf.discovery.residuals import Residuals, residuals, root_mean_square
from hygrokf.discovery.starting_model import base_estimate
from hygrokf.modelling.derived_inputs import clear_sky

TEMPERATURE, HUMIDITY = "temperature_K", "absolute_humidity_g_m3"
OF_RESIDUALS = {TEMPERATURE: "temperature", HUMIDITY: "humidity"}
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
    """A record, its base model and what that took, and the residuals of its free run, at whose readings every
    method is judged."""

    record: Record
    base: Calibration
    residuals: Residuals
    cpu_s: float

    @property
    def until_s(self) -> float:
        assert self.record.until_s is not None
        return self.record.until_s

    @property
    def quantities(self) -> tuple[str, ...]:
        return (TEMPERATURE, HUMIDITY) if "vapour" in self.base.quantities else (TEMPERATURE,)

    @property
    def readings(self) -> Mapping[str, tuple[np.ndarray, np.ndarray]]:
        """Quantity → (times [s], readings)."""
        return {
            quantity: (self.residuals.time_s[there], self.residuals.measured[OF_RESIDUALS[quantity]][there])
            for quantity in self.quantities
            for there in [np.isfinite(self.residuals.error[OF_RESIDUALS[quantity]])]
        }

    def errors(self, quantity: str, held_out: bool) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and errors of the base model's free run, on held-out readings or those before."""
        error = self.residuals.error[OF_RESIDUALS[quantity]]
        there = np.isfinite(error) & (self.residuals.validation == held_out)
        return self.residuals.time_s[there], error[there]

    def held_out(self, one: Calibration | None = None) -> dict[str, float]:
        """Errors of the free run [K], [g/m³] on held-out readings, of the base or of another model."""
        of = self.residuals if one is None else free_run(self.record, one)
        return {
            quantity: root_mean_square(of.error[OF_RESIDUALS[quantity]][of.validation])
            for quantity in self.quantities
        }


def free_run(record: Record, one: Calibration) -> Residuals:
    """Residuals of an estimate with the parameters with which `discover` would end."""
    final = final_set(one, final_estimator(one))
    return residuals(fit_of(record, final), shifted(record, *final.estimate.simulator.scene.shifts))


def ground(record: Record) -> Ground:
    """Estimate the base model of a record and simulate it."""
    begin = time.process_time()
    base = base_estimate(record)
    spent = time.process_time() - begin
    return Ground(record, base, free_run(record, base), spent)


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
