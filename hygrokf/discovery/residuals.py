"""Errors of the free run, and all drivers on which the errors may depend.

Shapes: T instants of a fit's series, n bins.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.prepared import VAPOUR, prepare
from hygrokf.data.record import Record
from hygrokf.data.signals import SIGNALS
from hygrokf.data.signals import UNITS as CASE_UNITS
from hygrokf.identification.fit import Fit
from hygrokf.modelling.design import accuracy_of
from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_slope_temperature

Quantity = Literal["temperature", "humidity"]
TEMPERATURE: Quantity = "temperature"
HUMIDITY: Quantity = "humidity"
RESIDUAL_QUANTITIES = (TEMPERATURE, HUMIDITY)
RESIDUAL_UNITS: Mapping[str, str] = {TEMPERATURE: "K", HUMIDITY: "g/m³"}
SERIES_STEMS: Mapping[str, str] = {TEMPERATURE: "temperature", HUMIDITY: "absolute_humidity"}
"""Quantity -> beginning of its names in a fit's series."""
TIME_CONSTANT: Mapping[str, str] = {TEMPERATURE: "thermal_time_constant", HUMIDITY: "hygric_k"}
"""Quantity -> parameter that is the time constant [h] of its low pass."""
RESPONSES = ("cabinet_", "converter_")
"""Beginnings of the names of signals that respond to the cabinet instead of driving it."""
SAME_AIR = ("ambient_dew_point_temperature", "ambient_absolute_humidity", "ambient_temperature")
"""Ambient signals that are not taken from the record, since a fit's series already hold temperature and
vapour."""
LEAST_KNOWN = 0.5
"""[1] smallest share of the instants at which a driver must be known."""
NORMAL_95 = 1.96
"""[1] standard deviations that contain 95 % of a normal distribution around its mean."""
PAUSE_H = 3.0
"""[h] shortest pause that ends an episode."""
LONGEST_DURATION_H = 48.0
"""[h] longest episode for which a duration is stated."""


@dataclass(frozen=True)
class Residuals:
    """Reading minus prediction at the instants of a fit, and the drivers on which the error may depend.

    time_h: [h] (T,) since `origin_s` [s] (Unix epoch).
    error: quantity -> (T,) [K], [g/m³] reading − free run; NaN without a reading, or if not scored.
    drivers: name -> (T,); power relative to the rated power, absolute humidity [g/m³], all others in SI.
        `cabinet_relative_humidity` and `cabinet_temperature` are *simulated*: the error of a reading must not
        select the condition under which it is tested.
    operating, preheating: (T,) whether the turbine operates, whether pre-heating is on; in bins of a length
        `step_h` [h], `preheating` is the share of time.
    validation: (T,) bool, True after the end of the identification period.
    sensor_error: quantity -> (T,) standard deviation [K], [g/m³] of the error due to the stated accuracy of
        the cabinet's and of the ambient sensors.
    time_constants: quantity -> [h] of the cabinet's low pass.
    measured, simulated, sd: quantity -> (T,) [K], [g/m³]: reading, free run and its standard deviation.
    """

    time_h: np.ndarray
    origin_s: float
    error: Mapping[str, np.ndarray]
    operating: np.ndarray
    preheating: np.ndarray
    validation: np.ndarray
    sensor_error: Mapping[str, np.ndarray]
    drivers: Mapping[str, np.ndarray] = field(default_factory=dict)
    step_h: float = math.nan
    time_constants: Mapping[str, float] = field(default_factory=dict)
    measured: Mapping[str, np.ndarray] = field(default_factory=dict)
    simulated: Mapping[str, np.ndarray] = field(default_factory=dict)
    sd: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def time_s(self) -> np.ndarray:
        """Instants (T,) [s] since 1970-01-01T00:00Z."""
        return self.origin_s + 3600.0 * self.time_h

    def rmse(self, quantity: str) -> float:
        """Root mean square of the free run's error [K], [g/m³] in the identification period."""
        return root_mean_square(self.error[quantity][~self.validation])


def root_mean_square(values: np.ndarray) -> float:
    """Return the root mean square of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else math.nan


def residuals(fit: Fit, record: Record) -> Residuals:
    """Return the free run's errors of a fit, with all drivers on which they may depend.

    record: the one that was fitted; its drivers and the accuracy of its sensors are read.
    Raises ValueError for a fit without series, such as one read from fit.json.
    """
    series = fit.series
    if "time_s" not in series:
        raise ValueError(
            f"fit {fit.name}: expected its series, found none; a fit read from fit.json has no residuals, "
            "identify again"
        )
    time = np.asarray(series["time_s"], dtype=float)
    scored = np.asarray(series["scored"]) > 0
    until = float(series["until_s"])

    def course(ending: str) -> dict[str, np.ndarray]:
        """Return the series (T,) of every quantity whose name ends so."""
        return {
            q: np.asarray(series[f"{SERIES_STEMS[q]}_{ending}"], dtype=float) for q in RESIDUAL_QUANTITIES
        }

    measured, simulated = course("measured"), course("simulated")
    return Residuals(
        time_h=(time - time[0]) / 3600.0,
        origin_s=float(time[0]),
        error={q: np.where(scored, measured[q] - simulated[q], np.nan) for q in RESIDUAL_QUANTITIES},
        drivers=_drivers(series, record, time),
        operating=np.asarray(series["operating"]) > 0.5,
        preheating=np.nan_to_num(np.asarray(series["preheating"], dtype=float)) > 0.5,
        validation=time > until if math.isfinite(until) else np.zeros(len(time), bool),
        sensor_error=_sensor_error(series, record),
        time_constants={q: fit.values[name] for q, name in TIME_CONSTANT.items() if name in fit.values},
        measured=measured,
        simulated=simulated,
        sd=course("sd"),
    )


def _drivers(fit_series: Mapping[str, np.ndarray], record: Record, time: np.ndarray) -> dict[str, np.ndarray]:
    """Return every driver (T,) at the instants `time` [s]: signals that vary and do not respond to the
    cabinet."""
    fit_signals = ("ambient_temperature", "ambient_absolute_humidity", "power", "preheating")
    names = {name: name for name in fit_signals} | {
        "cabinet_temperature": "temperature_simulated",
        "cabinet_relative_humidity": "relative_humidity_simulated",
    }
    drivers = {name: np.asarray(fit_series[key], dtype=float) for name, key in names.items()}
    if not np.isfinite(drivers["ambient_absolute_humidity"]).any():
        prepared_record = prepare(record)
        if prepared_record.ambient_vapour is not None:
            drivers[VAPOUR] = 1e3 * at_times(prepared_record.path(VAPOUR), time, AMBIENT_BRIDGE_H)
    for series in record.series:
        is_excluded = series.signal in (*drivers, *SAME_AIR, "active_power") or series.signal.startswith(
            RESPONSES
        )
        if not is_excluded and not series.missing.all():
            drivers[series.signal] = at_times(series, time, bridge_h(series, AMBIENT_BRIDGE_H))
    return {name: value for name, value in drivers.items() if _varies(value)}


def _varies(value: np.ndarray) -> bool:
    """Whether enough values are known and they are not constant."""
    finite = value[np.isfinite(value)]
    return len(finite) >= LEAST_KNOWN * len(value) and bool(
        np.ptp(finite) > 1e-9 * max(1.0, np.abs(finite).max())
    )


def _sensor_error(fit_series: Mapping[str, np.ndarray], record: Record) -> dict[str, np.ndarray]:
    """Return the standard deviation (T,) of the error due to the sensors' stated accuracy, by quantity.

    The errors of the cabinet's and of the ambient sensors are independent.
    """

    def sd(name: str) -> float:
        """Return the standard deviation of a cabinet sensor's error; 0 without the sensor."""
        return accuracy_of(record[name]) / NORMAL_95 if name in record else 0.0

    cabinet_sd, ambient_temperature_sd = sd("cabinet_temperature"), ambient_sd(record, "ambient_temperature")
    cabinet_K, relative_humidity, vapour, ambient_K = (
        np.asarray(fit_series[name], dtype=float)
        for name in (
            "temperature_simulated", "relative_humidity_simulated", "absolute_humidity_simulated",
            "ambient_temperature",
        )
    )  # fmt: skip
    variance_parts = [
        1e3 * absolute_humidity(1.0, cabinet_K) * sd("cabinet_relative_humidity"),
        1e3
        * absolute_humidity_slope_temperature(
            np.where(np.isfinite(relative_humidity), relative_humidity, 0.5), cabinet_K
        )
        * cabinet_sd,
        1e3 * absolute_humidity(1.0, ambient_K) * ambient_sd(record, "ambient_relative_humidity"),
        np.full(len(cabinet_K), 1e3 * sd("cabinet_absolute_humidity")),
        np.full(len(cabinet_K), 1e3 * ambient_sd(record, "ambient_absolute_humidity")),
    ]
    vapour_variance = np.sum([deviation**2 for deviation in variance_parts], axis=0)
    return {
        TEMPERATURE: np.full(len(cabinet_K), math.hypot(cabinet_sd, ambient_temperature_sd)),
        HUMIDITY: np.sqrt(np.where(np.isfinite(vapour), vapour_variance, np.nan)),
    }


_CABINET_SIBLING = {
    "ambient_temperature": "cabinet_temperature",
    "ambient_relative_humidity": "cabinet_relative_humidity",
}


def ambient_sd(record: Record, name: str) -> float:
    """Return the standard deviation of an ambient sensor's error; 0 without the sensor.

    Without a stated accuracy, that of the cabinet's sensor of the same kind counts.
    """
    if name not in record:
        return 0.0
    stated = accuracy_of(record[name])
    if not stated and name in _CABINET_SIBLING and _CABINET_SIBLING[name] in record:
        stated = accuracy_of(record[_CABINET_SIBLING[name]])
    return stated / NORMAL_95


# --- in words --------------------------------------------------------------------------------

_SYMBOLS = {"degC": "°C", "deg": "°", "W/m2": "W/m²", "g/m3": "g/m³", "1": ""}


def words(driver: str) -> str:
    """Return the name of a driver as words for a sentence."""
    return driver.replace("_", " ").replace("cabinet ", "simulated cabinet ")


def displayed(driver: str, value: np.ndarray, difference: bool = False) -> tuple[np.ndarray, str]:
    """Return a driver's values (or differences of values) in the unit that reports show, and that unit."""
    if driver == "power":
        return 100.0 * value, "% of the rated power"
    if driver == "ambient_absolute_humidity":
        return value, "g/m³"
    signal = SIGNALS.get(driver)
    if signal is None:
        return value, ""
    unit = CASE_UNITS[signal.display or signal.unit]
    symbol = _SYMBOLS.get(unit.name, unit.name)
    if difference:
        return value / unit.factor, "K" if unit.name == "degC" else symbol
    return (value - unit.offset) / unit.factor, symbol


# --- hourly bins -----------------------------------------------------------------------------


def binned(residuals: Residuals, least_h: float = 1.0) -> Residuals:
    """Average the residuals of the identification period over bins of equal length.

    A bin is `least_h` [h] long, or a multiple of it that holds a step of the readings; times are its middle.
    `preheating` becomes the share of time.
    """
    in_period = ~residuals.validation
    time = residuals.time_s[in_period]
    if not len(time):
        raise ValueError("binned: expected instants in the identification period, found none")
    has_error = np.any([np.isfinite(residuals.error[q][in_period]) for q in RESIDUAL_QUANTITIES], axis=0)
    step_h = float(np.median(np.diff(time[has_error]))) / 3600.0 if has_error.sum() > 1 else 1.0
    bin_h = least_h * max(1, math.ceil(step_h / least_h - 0.05))
    bin_index = np.floor(time / (3600.0 * bin_h)).astype(np.int64)
    first = int(bin_index[0])
    bin_index -= first
    count = int(bin_index[-1]) + 1

    def mean(values: np.ndarray) -> np.ndarray:
        """Return the mean (bins,) of values (T,); NaN for a bin without known values."""
        values = np.asarray(values, dtype=float)[in_period]
        is_known = np.isfinite(values)
        count_in_bin = np.bincount(bin_index[is_known], minlength=count).astype(float)
        sum_in_bin = np.bincount(bin_index[is_known], weights=values[is_known], minlength=count)
        return np.divide(sum_in_bin, count_in_bin, out=np.full(count, np.nan), where=count_in_bin > 0)

    def circular(values: np.ndarray) -> np.ndarray:
        """Return the mean direction (bins,) of angles (T,) [rad]."""
        return np.arctan2(mean(np.sin(values)), mean(np.cos(values))) % (2.0 * math.pi)

    return Residuals(
        time_h=bin_h * np.arange(count),
        origin_s=(first + 0.5) * 3600.0 * bin_h,
        step_h=bin_h,
        error={q: mean(residuals.error[q]) for q in RESIDUAL_QUANTITIES},
        drivers={
            name: circular(value) if name.endswith("_direction") else mean(value)
            for name, value in residuals.drivers.items()
        },
        operating=np.nan_to_num(_carried(mean(residuals.operating))) > 0.5,
        preheating=np.nan_to_num(mean(residuals.preheating)),
        validation=np.zeros(count, bool),
        sensor_error={q: mean(values) for q, values in residuals.sensor_error.items()},
    )


def _carried(values: np.ndarray) -> np.ndarray:
    """Return the values with each gap filled by the last known value."""
    is_known = np.isfinite(values)
    last_known = np.maximum.accumulate(np.where(is_known, np.arange(len(values)), 0))
    return values[last_known]


def run_lengths(flag: np.ndarray) -> list[tuple[int, int]]:
    """Return the runs [first, end) in which `flag` (n,) is True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(flag, dtype=int), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def closed(inside: np.ndarray, step_h: float) -> np.ndarray:
    """Return the bins (n,) of a condition with pauses shorter than `PAUSE_H` filled, so that runs are
    episodes."""
    result = inside.copy()
    for first, last in run_lengths(~inside):
        if first > 0 and last < len(inside) and (last - first) * step_h < PAUSE_H:
            result[first:last] = True
    return result


def duration_h(error: np.ndarray, episodes: Sequence[tuple[int, int]], step_h: float) -> float:
    """Return how long [h] the mean error of the episodes stays above half of its maximum.

    episodes: (first, end) positions in `error` (n,).  NaN if an episode is longer than `LONGEST_DURATION_H`.
    """
    longest = max(end - begin for begin, end in episodes)
    if step_h * longest > LONGEST_DURATION_H:
        return math.nan
    errors_of_episodes = np.full((len(episodes), longest), np.nan)
    for row, (begin, end) in enumerate(episodes):
        errors_of_episodes[row, : end - begin] = error[begin:end]
    episode_count = np.isfinite(errors_of_episodes).sum(axis=0)
    mean_error = np.divide(
        np.nansum(errors_of_episodes, axis=0),
        episode_count,
        out=np.full(longest, -np.inf),
        where=episode_count > 0,
    )
    mean_error = mean_error[episode_count >= max(1.0, 0.5 * len(episodes))]
    if not len(mean_error):
        return math.nan
    peak = int(np.argmax(mean_error))
    above_half = mean_error >= 0.5 * mean_error[peak]
    before = int(np.argmin(np.append(above_half[peak::-1], False)))
    after = int(np.argmin(np.append(above_half[peak:], False)))
    return step_h * (before + after - 1)
