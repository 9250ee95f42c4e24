"""Three loggers with clocks of their own: what is known of a plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from plants.cabinet import Trajectory
from plants.drivers import FREEZING_K, MINUTE_S, POWER_STEP_MIN, Drivers
from plants.saturation import relative_humidity

SENSOR_ERRORS = ("none", "cabinet", "all")
TEMPERATURE_ACCURACY_K = 0.3
HUMIDITY_ACCURACY_PERCENT = 2.0


@dataclass(frozen=True)
class PlantSeries:
    """Readings of one signal.

    signal: `place_quantity`. unit: "degC", "%", "kW", "m/s", "W/m2", "mm" or "1".
    time: [s] since the Unix epoch, (T,); stamp: "instant", or "end" of the interval averaged
    over. value: (T,), NaN = missing. interval_s: [s]. resolution, accuracy: in the unit;
    0 and None = not stated. source: the logger.
    """

    signal: str
    unit: str
    time: np.ndarray
    value: np.ndarray
    stamp: str
    interval_s: float
    resolution: float
    accuracy: float | None
    source: str


@dataclass(frozen=True)
class Logging:
    """How the plant is logged.

    logger_step_min: [min] of the cabinet logger. logger_mean: its readings are means over that
    step instead of instants. sensor_errors: "none", "cabinet" (bias, noise and resolution in the
    cabinet, exact outside) or "all". missing: [-] share of the cabinet readings that is missing,
    each by chance.
    power_gap_days: [d] length of a gap in the power. ambient_humidity: "relative" or "absolute".
    logger_gaps: number of gaps of 4 to 40 h in which the cabinet logger wrote nothing.
    """

    logger_step_min: float = 15.0
    logger_mean: bool = False
    sensor_errors: str = "cabinet"
    missing: float = 0.01
    power_gap_days: float = 0.0
    ambient_humidity: str = "relative"
    logger_gaps: int = 0

    def __post_init__(self) -> None:
        if self.sensor_errors not in SENSOR_ERRORS:
            raise ValueError(f"sensor_errors must be one of {SENSOR_ERRORS}, found {self.sensor_errors!r}")
        if self.ambient_humidity not in ("relative", "absolute"):
            raise ValueError(
                f'ambient_humidity must be "relative" or "absolute", found {self.ambient_humidity!r}'
            )


def _sensed(
    random: np.random.Generator,
    true: np.ndarray,
    accuracy: float,
    noise: float,
    resolution: float,
    ideal: bool,
) -> tuple[np.ndarray, float]:
    """Reading and bias; the random numbers are drawn for an ideal sensor too."""
    bias = float(np.clip(random.normal(0.0, accuracy / 2.0), -accuracy, accuracy))
    jitter = random.normal(0.0, noise, true.size)
    if ideal:
        return true.copy(), 0.0
    return resolution * np.round((true + bias + jitter) / resolution), bias


def log_plant(
    random: np.random.Generator, drivers: Drivers, trajectory: Trajectory, logging: Logging
) -> tuple[tuple[PlantSeries, ...], tuple[tuple[str, float], ...]]:
    """All series of a plant, and the bias of each sensor in its unit."""
    inside, inside_biases = _cabinet_logger(random, drivers, trajectory, logging)
    outside, outside_biases = _ambient_logger(random, drivers, logging)
    scada = _scada(random, drivers, logging)
    if logging.logger_gaps:
        # The gaps are drawn last: a plant without gaps keeps its readings.
        inside = _with_gaps(random, inside, logging.logger_gaps)
    return (*inside, *outside, *scada), (*inside_biases, *outside_biases)


def _cabinet_logger(
    random: np.random.Generator, drivers: Drivers, trajectory: Trajectory, logging: Logging
) -> tuple[list[PlantSeries], list[tuple[str, float]]]:
    """Temperature and relative humidity in the cabinet, with the bias of each sensor."""
    begin, end = float(drivers.time[0]), float(drivers.time[-1])
    percent = 100.0 * relative_humidity(trajectory.cabinet_kg_m3, trajectory.cabinet_K)
    step = MINUTE_S * logging.logger_step_min
    offset = float(random.integers(0, int(step)))
    true_time = np.arange(begin + offset + (step if logging.logger_mean else 0.0), end, step)

    def logged(values: np.ndarray) -> np.ndarray:
        if not logging.logger_mean:
            return np.interp(true_time, drivers.time, values)
        # The running integral of straight pieces is exact at minutes and nearly so between.
        pieces = 0.5 * (values[:-1] + values[1:]) * MINUTE_S
        area = np.concatenate(([0.0], np.cumsum(pieces)))
        upper = np.interp(true_time, drivers.time, area)
        return (upper - np.interp(true_time - step, drivers.time, area)) / step

    exact = logging.sensor_errors == "none"
    stamp, interval_s = ("end", step) if logging.logger_mean else ("instant", 0.0)
    series, biases = [], []
    for signal, unit, true, accuracy, noise in (
        ("cabinet_temperature", "degC", trajectory.cabinet_K, TEMPERATURE_ACCURACY_K, 0.05),
        ("cabinet_relative_humidity", "%", percent, HUMIDITY_ACCURACY_PERCENT, 0.3),
    ):
        mean = logged(true) - (FREEZING_K if unit == "degC" else 0.0)
        value, bias = _sensed(random, mean, accuracy, noise, 0.1, exact)
        if unit == "%":
            value = np.clip(value, 0.0, 100.0)
        value[random.random(value.size) < logging.missing] = np.nan
        resolution = 0.0 if exact else 0.1
        source = "cabinet logger"
        series.append(
            PlantSeries(signal, unit, true_time, value, stamp, interval_s, resolution, accuracy, source)
        )
        biases.append((signal, bias))
    return series, biases


def _ambient_logger(
    random: np.random.Generator, drivers: Drivers, logging: Logging
) -> tuple[list[PlantSeries], list[tuple[str, float]]]:
    """Temperature, humidity and irradiance outdoors, with the bias of each sensor that has one."""
    exact = logging.sensor_errors != "all"
    places = slice(drivers.ambient_offset_min, None, drivers.ambient_step_min)
    time, source = drivers.time[places], "ambient logger"
    celsius = drivers.ambient_K - FREEZING_K
    rows = [("ambient_temperature", "degC", celsius, TEMPERATURE_ACCURACY_K, 0.05, 0.1)]
    if logging.ambient_humidity == "relative":
        percent = 100.0 * relative_humidity(drivers.ambient_kg_m3, drivers.ambient_K)
        rows.append(("ambient_relative_humidity", "%", percent, HUMIDITY_ACCURACY_PERCENT, 0.3, 0.1))
    else:
        rows.append(("ambient_absolute_humidity", "g/m3", 1e3 * drivers.ambient_kg_m3, 0.2, 0.03, 0.01))
    series, biases = [], []
    for signal, unit, true, accuracy, noise, resolution in rows:
        value, bias = _sensed(random, true[places], accuracy, noise, resolution, exact)
        if unit == "%":
            value = np.clip(value, 0.0, 100.0)
        stated = 0.0 if exact else resolution
        series.append(PlantSeries(signal, unit, time, value, "instant", 0.0, stated, accuracy, source))
        biases.append((signal, bias))
    signal, value = "global_horizontal_irradiance", drivers.irradiance_W_m2[places]
    series.append(PlantSeries(signal, "W/m2", time, value, "instant", 0.0, 0.0, None, source))
    return series, biases


def _scada(random: np.random.Generator, drivers: Drivers, logging: Logging) -> list[PlantSeries]:
    """Means of power, wind speed and, where the turbine pre-heats, pre-heating."""
    begin, end = float(drivers.time[0]), float(drivers.time[-1])
    intervals = (drivers.time.size - 1) // POWER_STEP_MIN

    def mean(values: np.ndarray) -> np.ndarray:
        blocks = values[: intervals * POWER_STEP_MIN].reshape(intervals, POWER_STEP_MIN)
        return blocks.mean(axis=1)

    interval_s = MINUTE_S * POWER_STEP_MIN
    ends = begin + interval_s * np.arange(1, intervals + 1)
    power = mean(np.where(drivers.power_known, drivers.power_W, np.nan)) / 1e3
    gap_begin = begin + random.uniform(0.2, 0.7) * (end - begin)
    gap_s = 86400.0 * logging.power_gap_days
    power[(ends > gap_begin) & (ends <= gap_begin + gap_s)] = np.nan
    rows = [("active_power", "kW", power), ("wind_speed", "m/s", mean(drivers.wind_m_s))]
    if drivers.preheating.any():
        rows.append(("preheating", "1", mean(drivers.preheating)))
    return [
        PlantSeries(signal, unit, ends, value, "end", interval_s, 0.0, None, "SCADA")
        for signal, unit, value in rows
    ]


def _with_gaps(random: np.random.Generator, series: list[PlantSeries], gaps: int) -> list[PlantSeries]:
    """Series of one logger without the readings of that many gaps of 4 to 40 h."""
    stamps = series[0].time
    kept = np.ones(stamps.size, dtype=bool)
    for _ in range(gaps):
        place, hours = random.random(), random.uniform(4.0, 40.0)
        gap = stamps[0] + place * (stamps[-1] - stamps[0])
        kept &= (stamps < gap) | (stamps > gap + 3600.0 * hours)
    return [replace(one, time=one.time[kept], value=one.value[kept]) for one in series]
