"""The synthetic turbine of `hygrokf demo`: weather, cabinet, three loggers, four files.

Nothing here is measured. Synthetic weather drives the thermal network of equations (2) and
(3) and the hygric network of (4) and (5), integrated at one minute. Ornstein-Uhlenbeck
disturbances in the heat flow and in the vapour flow, sensor bias, noise, resolution, gaps and
standstills with pre-heating make the record as difficult as a measured one. This module shares
no code with the estimation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

import numpy as np

from hygrokf.data.files import write_text_whole
from hygrokf.data.timestamps import DAY_S
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K, absolute_humidity_from_dew_point, relative_humidity

STEP_S = 60
MINUTE_H = 1.0 / 60.0
START = "2020-07-15T00:00:00"
"""UTC, the first instant of the record."""

LATITUDE_DEG = 52.4
LONGITUDE_DEG = -0.95

_REFERENCE_K = 283.15


@dataclass(frozen=True)
class SyntheticParameters:
    """Parameters of the synthetic cabinet; the defaults resemble the paper's UK turbine.

    thermal_time_constant_h: [h] (R_AT + R_IC) C_conv.
    resistance_ratio: [-] rho = R_AT / (R_AT + R_IC), 0...1.
    hygric_time_constant_h: [h] R_D* V* at the record's mean temperatures.
    operation_release: heat release in operation [K, K, K, K/K]: b0 + b1 p + b2 p^2 +
        b3 (T_amb - 283.15 K) with p = P / rated power.
    standstill_release: heat release at standstill [K, K/K]: s0 + s1 (T_amb - 283.15 K).
    preheating_release_K: [K] added while the pre-heating is on.
    heat_disturbance_K, heat_correlation_h: standard deviation [K] and correlation time [h] of
        the coloured disturbance in the heat release.
    vapour_disturbance_kg_m3, vapour_correlation_h: the same for the vapour flow, expressed as the
        stationary excess concentration [kg/m3] at the record's mean temperatures.
    temperature_diffusion_K: [K/sqrt(h)] white diffusion of T_conv.
    humidity_diffusion_kg_m3: [kg/(m3 sqrt(h))] white diffusion of c*.
    """

    rated_power_W: float = 2.05e6
    thermal_time_constant_h: float = 1.5
    resistance_ratio: float = 0.85
    hygric_time_constant_h: float = 0.30
    operation_release: tuple[float, float, float, float] = (7.5, 7.0, -2.0, -0.15)
    standstill_release: tuple[float, float] = (5.0, -0.10)
    preheating_release_K: float = 9.0
    heat_disturbance_K: float = 1.55
    heat_correlation_h: float = 8.0
    vapour_disturbance_kg_m3: float = 0.42e-3
    vapour_correlation_h: float = 6.0
    temperature_diffusion_K: float = 0.05
    humidity_diffusion_kg_m3: float = 0.02e-3


@dataclass(frozen=True)
class SyntheticTruth:
    """Quantities that no logger records: true signals each minute and the errors of the sensors.

    time: [s] since the Unix epoch, (T,). The other arrays are (T,) at these instants;
    active_power and preheating hold over the minute that follows.
    converter_temperature, cabinet_temperature, ambient_temperature: [K].
    equivalent_humidity (c*), cabinet_absolute_humidity, ambient_absolute_humidity: [kg/m3].
    active_power: [W]. preheating: [-]. heat_release: [K] without the disturbance.
    hygric_constant_s: [s] k of equation (4), with a reference temperature of exactly 273 K.
    sensor_bias: ((file.column, bias in the column's unit), ...).
    """

    parameters: SyntheticParameters
    time: np.ndarray
    converter_temperature: np.ndarray
    cabinet_temperature: np.ndarray
    ambient_temperature: np.ndarray
    equivalent_humidity: np.ndarray
    cabinet_absolute_humidity: np.ndarray
    ambient_absolute_humidity: np.ndarray
    active_power: np.ndarray
    preheating: np.ndarray
    heat_release: np.ndarray
    hygric_constant_s: float
    sensor_bias: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class SyntheticTable:
    """One CSV file: its name, its stamps and its columns.

    time: [s] since the Unix epoch, (T,). columns: (name, values (T,), decimals); NaN is written
    as an empty cell.
    """

    file: str
    time: np.ndarray
    columns: tuple[tuple[str, np.ndarray, int], ...]

    def __getitem__(self, column: str) -> np.ndarray:
        """Values of one column, in the unit that its name states."""
        for name, values, _ in self.columns:
            if name == column:
                return values
        names = ", ".join(name for name, _, _ in self.columns)
        raise KeyError(f"{self.file} has no column {column!r}; it has {names}")


@dataclass(frozen=True)
class SyntheticTurbine:
    """A synthetic record with its truth.

    until_s: [s] since the Unix epoch, end of the identification period.
    """

    name: str
    cabinet: SyntheticTable
    ambient: SyntheticTable
    scada: SyntheticTable
    until_s: float
    truth: SyntheticTruth = field(repr=False)


def _recursion(gain: float, drive: np.ndarray, start: float) -> np.ndarray:
    """The sequence x[0] = start, x[n + 1] = gain x[n] + drive[n], one element longer than `drive`."""
    from scipy.signal import lfilter  # takes longer to load than most commands need

    return lfilter([1.0], [1.0, -gain], np.append(start, drive))


def _ornstein_uhlenbeck(random: np.random.Generator, steps: int, correlation_h: float) -> np.ndarray:
    """Stationary Ornstein-Uhlenbeck process of unit variance, exact at each minute, (steps,)."""
    gain = math.exp(-MINUTE_H / correlation_h)
    noise = math.sqrt(1.0 - gain * gain) * random.standard_normal(steps - 1)
    return _recursion(gain, noise, float(random.standard_normal()))


def _low_pass(drive: np.ndarray, lag_h: float) -> np.ndarray:
    gain = math.exp(-MINUTE_H / lag_h)
    return _recursion(gain, (1.0 - gain) * drive[1:], float(drive[0]))


def _weather(seed: np.random.SeedSequence, time: np.ndarray) -> dict[str, np.ndarray]:
    """Weather of an English site each minute: seasons, days, fronts, clouds, rain, wind."""
    random, gusts = (np.random.default_rng(child) for child in seed.spawn(2))

    # outdoor air varies within a minute: a logger's reading every ten minutes is a sample, not a mean
    def wander(correlation_h: float) -> np.ndarray:
        return _ornstein_uhlenbeck(random, time.size, correlation_h)

    day = (time - np.datetime64("2020-01-01", "s").astype(float)) / DAY_S
    winter = np.cos(2.0 * np.pi * (day - 20.0) / 365.25)
    front = wander(70.0)
    cloud = 1.0 / (1.0 + np.exp(-(1.8 * wander(18.0) + 0.9)))
    declination = np.radians(-23.44) * np.cos(2.0 * np.pi * (day + 10.0) / 365.25)
    hour_angle = 2.0 * np.pi * (day % 1.0 - 0.5) + math.radians(LONGITUDE_DEG)
    latitude = math.radians(LATITUDE_DEG)
    # sine of the sun's elevation
    height = np.sin(latitude) * np.sin(declination)
    height = np.maximum(height + np.cos(latitude) * np.cos(declination) * np.cos(hour_angle), 0.0)
    irradiance = 1050.0 * height**1.15 * (1.0 - 0.75 * cloud**3) * (1.0 + 0.05 * wander(0.3))
    sunshine = _low_pass(irradiance, 3.0)
    clear_night = _low_pass((1.0 - cloud) * (height <= 0.0), 4.0)
    air_mass = 9.3 - 6.2 * winter + 3.0 * front + 0.9 * wander(9.0)
    celsius = air_mass + 0.014 * sunshine - 2.5 * clear_night + 0.15 * wander(0.7)
    spread = 1.2 + 0.9 * np.abs(wander(30.0)) + 0.5 * wander(5.0)
    dew = air_mass - 1.5 * (1.0 - cloud) - spread
    # A soft ceiling keeps the dew point below the temperature, as fog and dew do outside.
    ceiling = celsius - 0.35
    dew = ceiling - np.logaddexp(0.0, 2.0 * (ceiling - dew)) / 2.0
    rain = ((cloud > 0.75) & (wander(3.0) + 0.4 * front > 0.9)).astype(float)

    strength = 0.88 * wander(22.0) + 0.42 * wander(2.5) + 0.15 * front
    speed = (8.2 + 0.7 * winter) * np.logaddexp(0.0, 1.702 * strength) ** (1.0 / 2.1)
    gust = _ornstein_uhlenbeck(gusts, time.size, 4.0 / 60.0)
    temperature, dew_point = celsius + ZERO_CELSIUS_K, dew + ZERO_CELSIUS_K
    return {
        "temperature": temperature,
        "absolute_humidity": absolute_humidity_from_dew_point(dew_point, temperature),
        "irradiance": irradiance,
        "rain": rain,
        "wind_speed": speed * np.maximum(1.0 + 0.09 * gust, 0.2),
    }


def _operation(
    seed: np.random.SeedSequence, time: np.ndarray, wind_speed: np.ndarray, rated_W: float
) -> tuple[np.ndarray, np.ndarray]:
    """Active power [W] and pre-heating [-] over each minute: power curve, faults, heaters."""
    random = np.random.default_rng(seed)
    cube = wind_speed**3
    power = rated_W * np.clip((cube - 3.2**3) / (12.3**3 - 3.2**3), 0.0, 1.0)
    idle = -7.0e3 - 1.5e3 * np.abs(random.standard_normal(time.size))
    power = np.where(power > 4.0e3, power, idle)
    preheating = np.zeros(time.size)
    span = float(time[-1] - time[0])
    scale = min(1.0, span / (60.0 * DAY_S))
    # (place in the record, days of standstill, hours of pre-heating, power while stopped)
    for place, days, hours, stopped_W in (
        (0.355, 6.0, 9.0, 0.0),
        (0.56, 3.0, 6.0, -4.0e3),
        (0.90, 2.6, 5.0, -5.0e3),
    ):
        begin = time[0] + span * (place + random.uniform(-0.01, 0.01))
        end = begin + scale * days * DAY_S
        stopped = (time >= begin) & (time < end)
        power[stopped] = stopped_W
        preheating[stopped & (time >= end - hours * 3600.0)] = 1.0
    return power, preheating


def _step_with_ramp(rate: np.ndarray, before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and drive of dx/dt = rate (u - x) over a minute in which u is linear."""
    decay = rate * MINUTE_H
    gain = np.exp(-decay)
    ramp = 1.0 + np.expm1(-decay) / decay
    return gain, (1.0 - gain) * before + ramp * (after - before)


def _cabinet_temperature(
    seed: np.random.SeedSequence,
    parameters: SyntheticParameters,
    ambient: np.ndarray,
    power: np.ndarray,
    preheating: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_conv, T_conv,a [K] by equations (2) and (3), and the undisturbed heat release [K]."""
    coloured, white = (np.random.default_rng(child) for child in seed.spawn(2))
    share = power / parameters.rated_power_W
    difference_K = ambient - _REFERENCE_K
    b0, b1, b2, b3 = parameters.operation_release
    s0, s1 = parameters.standstill_release
    release = np.where(
        power > 0.0, b0 + (b1 + b2 * share) * share + b3 * difference_K, s0 + s1 * difference_K
    )
    release = release + parameters.preheating_release_K * preheating
    disturbance = parameters.heat_disturbance_K * _ornstein_uhlenbeck(
        coloured, ambient.size, parameters.heat_correlation_h
    )
    mean_release = release[:-1] + 0.5 * (disturbance[:-1] + disturbance[1:])
    rise_K = mean_release / parameters.resistance_ratio
    rate = np.array(1.0 / parameters.thermal_time_constant_h)
    gain, drive = _step_with_ramp(rate, ambient[:-1] + rise_K, ambient[1:] + rise_K)
    noise_sd = math.sqrt(MINUTE_H) * parameters.temperature_diffusion_K
    drive = drive + noise_sd * white.standard_normal(drive.size)
    start = ambient[0] + float(release[0] + disturbance[0]) / parameters.resistance_ratio
    converter = _recursion(float(gain), drive, start)
    ratio = parameters.resistance_ratio
    return converter, ratio * converter + (1.0 - ratio) * ambient, release


def _cabinet_humidity(
    seed: np.random.SeedSequence,
    parameters: SyntheticParameters,
    weather: dict[str, np.ndarray],
    cabinet_K: np.ndarray,
) -> tuple[np.ndarray, float]:
    """c* [kg/m3] by equation (4), and k [s] such that R_D* V* is as stated at the means."""
    coloured, white = (np.random.default_rng(child) for child in seed.spawn(2))
    ambient_K = weather["temperature"]
    relative_rate = cabinet_K.mean() * ambient_K.mean() ** 0.8
    rate_constant_h = parameters.hygric_time_constant_h * relative_rate / 273.0**1.8
    rate = cabinet_K * ambient_K**0.8 / (rate_constant_h * 273.0**1.8)
    rate = 0.5 * (rate[:-1] + rate[1:])
    disturbance = parameters.vapour_disturbance_kg_m3 * _ornstein_uhlenbeck(
        coloured, ambient_K.size, parameters.vapour_correlation_h
    )
    # the disturbance is a vapour flow per volume, which does not depend on the exchange rate
    inflow = 0.5 * (disturbance[:-1] + disturbance[1:]) / parameters.hygric_time_constant_h
    outside = weather["absolute_humidity"]
    gain, drive = _step_with_ramp(rate, outside[:-1] + inflow / rate, outside[1:] + inflow / rate)
    noise_sd = math.sqrt(MINUTE_H) * parameters.humidity_diffusion_kg_m3
    drive = drive + noise_sd * white.standard_normal(drive.size)
    start = float(outside[0] + disturbance[0])
    pairs = zip(gain.tolist(), drive.tolist(), strict=True)
    states = accumulate(pairs, lambda state, step: step[0] * state + step[1], initial=start)
    return np.array(list(states)), rate_constant_h * 3600.0


def _stops(random: np.random.Generator, time: np.ndarray, lengths_h: Sequence[float]) -> np.ndarray:
    """True where a reading exists; each length [h] leaves one gap at a random place."""
    kept = np.ones(time.size, dtype=bool)
    span = float(time[-1] - time[0])
    for hours in lengths_h:
        begin = time[0] + random.uniform(0.02, 0.97) * span
        kept &= (time < begin) | (time >= begin + hours * 3600.0)
    return kept


def _blank(values: np.ndarray, time: np.ndarray, place: float, days: float) -> np.ndarray:
    begin = time[0] + place * float(time[-1] - time[0])
    return np.where((time >= begin) & (time < begin + days * DAY_S), np.nan, values)


def _tables(
    seed: np.random.SeedSequence, weather: dict[str, np.ndarray], truth_arrays: dict[str, np.ndarray]
) -> tuple[SyntheticTable, SyntheticTable, SyntheticTable, tuple[tuple[str, float], ...]]:
    sensing, failing = (np.random.default_rng(child) for child in seed.spawn(2))
    biases: list[tuple[str, float]] = []
    minutes = truth_arrays["time"]
    span = float(minutes[-1] - minutes[0])
    scale = min(1.0, span / (60.0 * DAY_S))

    def at(time: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.interp(time, minutes, values)

    def read(column: str, true: np.ndarray, accuracy: float, noise: float, resolution: float) -> np.ndarray:
        # the stated accuracy is a 95 % bound; no sensor in the demo lies outside it
        bias = float(np.clip(0.5 * accuracy * sensing.standard_normal(), -accuracy, accuracy))
        biases.append((column, bias))
        reading = true + bias + noise * sensing.standard_normal(true.size)
        return np.round(reading / resolution) * resolution

    def climate(time: np.ndarray, place: str, short: str) -> tuple[np.ndarray, np.ndarray]:
        kelvin = at(time, truth_arrays[f"{place}_temperature"])
        celsius = read(f"{place}.T_{short}_degC", kelvin - ZERO_CELSIUS_K, 0.3, 0.03, 0.1)
        percent = 100.0 * relative_humidity(at(time, truth_arrays[f"{place}_absolute_humidity"]), kelvin)
        return celsius, np.clip(read(f"{place}.RH_{short}_pct", percent, 2.0, 0.2, 0.1), 0.0, 100.0)

    # Cabinet logger: instants every 15 minutes, its clock 3 min 20 s past the quarter.
    time = np.arange(minutes[0] + 200.0, minutes[-1], 900.0)
    celsius, percent = climate(time, "cabinet", "cab")
    percent = _blank(percent, time, 0.70, scale * 3.7)
    kept = _stops(failing, time, (scale * 31.0, 5.5, 1.6, 0.8))
    cabinet = SyntheticTable(
        "cabinet.csv", time[kept], (("T_cab_degC", celsius[kept], 1), ("RH_cab_pct", percent[kept], 1))
    )

    # Ambient logger: instants every 10 minutes, 6 min 40 s past its own tens.
    time = np.arange(minutes[0] + 400.0, minutes[-1], 600.0)
    celsius, percent = climate(time, "ambient", "amb")
    irradiance = np.maximum(np.round(at(time, weather["irradiance"])), 0.0)
    kept = _stops(failing, time, (2.4, 1.2, 0.7))
    ambient = SyntheticTable(
        "ambient.csv",
        time[kept],
        (
            ("T_amb_degC", celsius[kept], 1),
            ("RH_amb_pct", percent[kept], 1),
            ("GHI_W_m2", irradiance[kept], 0),
            ("rain", np.round(at(time, weather["rain"]))[kept], 0),
        ),
    )

    # SCADA: means over ten minutes, stamped at their start.
    intervals = (minutes.size - 1) // 10
    time = minutes[0] + 600.0 * np.arange(intervals)

    def mean(values: np.ndarray) -> np.ndarray:
        return values[: 10 * intervals].reshape(intervals, 10).mean(axis=1)

    kilowatts = np.round(mean(truth_arrays["active_power"]) / 1e3, 1)
    kilowatts[failing.random(intervals) < 0.002] = np.nan
    kept = _stops(failing, time, (3.0, 1.5, 0.8, 0.5))
    kept &= ~np.isnan(_blank(np.zeros(intervals), time, 0.47, scale * 2.0))
    scada = SyntheticTable(
        "scada.csv",
        time[kept],
        (
            ("P_kW", kilowatts[kept], 1),
            ("wind_speed_m_s", np.round(mean(weather["wind_speed"]), 2)[kept], 2),
            ("preheating", mean(truth_arrays["preheating"])[kept], 1),
        ),
    )
    return cabinet, ambient, scada, tuple(biases)


def synthetic_turbine(
    seed: int = 1, *, days: float = 201.0, start: str = START, parameters: SyntheticParameters | None = None
) -> SyntheticTurbine:
    """Simulate a turbine whose time constants are known.

    seed: the same seed gives the same turbine.
    days: [d] length of the record, at least 2.  The default runs from 15 July to 31 January as in the paper;
        identification ends 31 days before the end (in records under 200 days: 15 % of the length).
    start: first instant, UTC, ISO 8601 without an offset.
    parameters: of the cabinet; None for the default cabinet.

    Returns tables of cabinet, ambient and SCADA logger, and the truth behind them.
    Raises ValueError for fewer than 2 days.
    """
    if not days >= 2.0:
        raise ValueError(
            f"a synthetic turbine needs days >= 2 for its seasons, found days = {days}: "
            "ask for a longer record"
        )
    parameters = parameters or SyntheticParameters()
    seeds = np.random.SeedSequence(seed).spawn(5)
    first = float(np.datetime64(start, "s").astype(np.int64))
    time = first + STEP_S * np.arange(round(days * DAY_S / STEP_S) + 1, dtype=float)
    weather = _weather(seeds[0], time)
    power, preheating = _operation(seeds[1], time, weather["wind_speed"], parameters.rated_power_W)
    converter, cabinet_K, release = _cabinet_temperature(
        seeds[2], parameters, weather["temperature"], power, preheating
    )
    equivalent, constant_s = _cabinet_humidity(seeds[3], parameters, weather, cabinet_K)
    arrays = {
        "time": time,
        "converter_temperature": converter,
        "cabinet_temperature": cabinet_K,
        "ambient_temperature": weather["temperature"],
        "equivalent_humidity": equivalent,
        "cabinet_absolute_humidity": equivalent * weather["temperature"] / cabinet_K,
        "ambient_absolute_humidity": weather["absolute_humidity"],
        "active_power": power,
        "preheating": preheating,
        "heat_release": release,
    }
    cabinet, ambient, scada, biases = _tables(seeds[4], weather, arrays)
    for values in arrays.values():
        values.flags.writeable = False
    validation_days = 31.0 if days >= 200.0 else 0.15 * days
    return SyntheticTurbine(
        name=f"synthetic-turbine-{seed}",
        cabinet=cabinet,
        ambient=ambient,
        scada=scada,
        until_s=first + DAY_S * (days - validation_days),
        truth=SyntheticTruth(
            parameters=parameters,
            hygric_constant_s=constant_s,
            sensor_bias=biases,
            **arrays,
        ),
    )


_CASE = """\
# Synthetic turbine: nothing in this case and its files is measured.
name = "{name}"
provenance = "synthetic"
rated_power_kW = {rated_power_kW!r}

[site]
latitude_deg = {latitude_deg!r}
longitude_deg = {longitude_deg!r}

[[source]]
file = "cabinet.csv"
time = "time"
signals.cabinet_temperature = {{ column = "T_cab_degC", unit = "degC" }}
signals.cabinet_relative_humidity = {{ column = "RH_cab_pct", unit = "%" }}

[[source]]
file = "ambient.csv"
time = "time"
signals.ambient_temperature = {{ column = "T_amb_degC", unit = "degC" }}
signals.ambient_relative_humidity = {{ column = "RH_amb_pct", unit = "%" }}
signals.global_horizontal_irradiance = {{ column = "GHI_W_m2", unit = "W/m2" }}
signals.rain = {{ column = "rain", unit = "1" }}

[[source]]
file = "scada.csv"
time = "time"
stamp = "start"
signals.active_power = {{ column = "P_kW", unit = "kW" }}
signals.wind_speed = {{ column = "wind_speed_m_s", unit = "m/s" }}
signals.preheating = {{ column = "preheating", unit = "1" }}

[identification]
until = "{until}"
"""


def _stamp(time: np.ndarray) -> np.ndarray:
    instants = np.asarray(time).round().astype(np.int64).astype("datetime64[s]")
    return np.datetime_as_string(instants)


def _csv(table: SyntheticTable) -> str:
    """The table as text; a column of ones named `synthetic` labels every file."""
    cells = [[f"{stamp}Z" for stamp in _stamp(table.time)]]
    for _, values, decimals in table.columns:
        # Adding zero turns a rounded -0.0 into 0.0.
        rounded = (np.round(values, decimals) + 0.0).tolist()
        cells.append(["" if math.isnan(value) else f"{value:.{decimals}f}" for value in rounded])
    names = ",".join(["time", *(name for name, _, _ in table.columns), "synthetic"])
    lines = [",".join(row) + ",1" for row in zip(*cells, strict=True)]
    return "\n".join([names, *lines, ""])


def write_case(turbine: SyntheticTurbine, directory: str | Path) -> Path:
    """Write a synthetic turbine as cabinet.csv, ambient.csv, scada.csv and case.toml.

    turbine: of `synthetic_turbine`; every column states its unit.
    directory: made if absent; files of these names in it are replaced, the case file last.

    Returns the path of case.toml.  Raises OSError where the directory cannot be written.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    for table in (turbine.cabinet, turbine.ambient, turbine.scada):
        write_text_whole(folder / table.file, _csv(table))
    case = folder / "case.toml"
    text = _CASE.format(
        name=turbine.name,
        rated_power_kW=turbine.truth.parameters.rated_power_W / 1e3,
        latitude_deg=LATITUDE_DEG,
        longitude_deg=LONGITUDE_DEG,
        until=f"{_stamp(np.array(turbine.until_s))}Z",
    )
    write_text_whole(case, text)
    return case
