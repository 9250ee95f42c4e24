"""Random plants: a cabinet under weather, operation and disturbances, what its loggers wrote, and its
truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from other_make.cabinet import Cabinet, Trajectory, integrate
from other_make.loggers import Channel, Clock, Sensor, write_down
from other_make.moist_air import FREEZING_K, relative_humidity
from other_make.operation import make_power
from other_make.random_processes import flaring, ornstein_uhlenbeck
from other_make.weather import Weather, make_weather

GRID_S = 20.0
"""[s] step of the integration and of all true courses."""
SCADA_STEP_S = 600.0
"""[s] over which SCADA averages the power."""
LEAST_KG_M3 = 2e-4
"""[kg/m³] below which a disturbance does not take the vapour around the cabinet."""

SYSTEMS = ("cabinet", "ambient", "scada")
Range = tuple[float, float]


@dataclass(frozen=True)
class Scenario:
    """What differs from ordinary records; a range is drawn from uniformly, None: absent.

    The power moves within the ten minutes that SCADA averages, and starts and stops fall anywhere.
    cabinet_step_s, ambient_step_s: [s]; ambient_mean: whether the ambient readings are means over that step.
    humidity_lag_s: [s] response of the cabinet's humidity sensor; lag_stated: whether the record says so.
    clock_s: [s] by which one system's stamps are off, early or late. exponent: [-] n of natural convection.
    second_mass: share of C; second_h: [h] its resistance times its capacity.
    resolution: cabinet readings' grid ([K], [-]). degrees, outliers: see `Sensor`, for the cabinet's.
    flare: [-] how much disturbances flare up, see `flaring`. fast: share of the disturbances' variance that
    comes and goes within two hours.
    free_run_K [K], free_run_kg_m3 [kg/m³]: how far disturbances carry the cabinet from its undisturbed course
    (root mean square).
    """

    cabinet_step_s: float = 900.0
    ambient_step_s: float = 600.0
    ambient_mean: bool = False
    humidity_lag_s: Range | None = None
    lag_stated: bool = True
    clock_s: float = 0.0
    exponent: Range | None = None
    second_mass: Range | None = None
    second_h: Range = (2.0, 6.0)
    resolution: tuple[float, float] = (0.1, 0.001)
    degrees: float | None = None
    outliers: float = 0.0
    flare: float = 0.0
    fast: Range = (0.02, 0.08)
    free_run_K: Range = (1.0, 1.5)
    free_run_kg_m3: Range = (2.8e-4, 4.0e-4)


@dataclass(frozen=True)
class Truth:
    """What estimates are held against.

    thermal_h: [h] (R_AT+R_IC) C of the converter; under convection at the median difference. small_signal_h:
    [h] the constant of small changes about the median difference, the same without convection. dominant_h:
    [h] the network's longest time constant, the same without a second mass. resistance_ratio: [-].
    hygric_k_h: [h] k of equation (4). differences_K: [K] 10, 50 and 90 % of the difference between cabinet
    and ambient air. exponent: [-] n.
    lags_s: [s] by signal. late_s: [s] by system. free_run_K, free_run_kg_m3: distance from the undisturbed
        course.
    """

    cabinet: Cabinet
    differences_K: tuple[float, float, float]
    free_run_K: float
    free_run_kg_m3: float
    lags_s: Mapping[str, float] = field(default_factory=dict)
    late_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def thermal_h(self) -> float:
        return self.cabinet.resistance_capacity_h(self.differences_K[1])

    @property
    def small_signal_h(self) -> float:
        return self.cabinet.small_signal_h(self.differences_K[1])

    @property
    def dominant_h(self) -> float:
        return self.cabinet.poles_h(self.differences_K[1])[0]

    @property
    def resistance_ratio(self) -> float:
        return self.cabinet.resistance_ratio

    @property
    def hygric_k_h(self) -> float:
        return self.cabinet.hygric_k_h

    def hygric_h(self, cabinet_K: float, ambient_K: float) -> float:
        """R_D* V* [h] at a cabinet and an ambient temperature [K]."""
        return self.cabinet.hygric_h(cabinet_K, ambient_K)


@dataclass(frozen=True)
class Plant:
    """One simulated plant; `power_W` (T,) and `trajectory` on the grid of the weather."""

    name: str
    seed: int
    scenario: Scenario
    weather: Weather
    power_W: np.ndarray
    rated_W: float
    trajectory: Trajectory
    channels: tuple[Channel, ...]
    truth: Truth

    def __getitem__(self, signal: str) -> Channel:
        return {one.signal: one for one in self.channels}[signal]


def make_plant(seed: int, scenario: Scenario | None = None, days: float = 90.0) -> Plant:
    """The plant of a seed; scenarios leave alone what they do not name, so that rows can be compared seed by
    seed."""
    scenario = scenario or Scenario()
    weather_random, power_random, cabinet_random, noise_random, logger_random, further = (
        np.random.default_rng(child) for child in np.random.SeedSequence([seed, 0x07E7]).spawn(6)
    )
    weather = make_weather(weather_random, days, GRID_S)
    rated_W = float(power_random.uniform(1.5e6, 3.6e6))
    power_W = make_power(power_random, weather, rated_W)
    cabinet = random_cabinet(cabinet_random, weather, scenario, further)
    heat_W, outside_kg_m3, calm_W = _forced(noise_random, cabinet, weather, power_W, rated_W, scenario)
    trajectory = integrate(cabinet, GRID_S, weather.ambient_K, outside_kg_m3, heat_W)
    calm = integrate(cabinet, GRID_S, weather.ambient_K, weather.ambient_kg_m3, calm_W)
    channels, lags_s, late_s = _logged(logger_random, further, weather, power_W, trajectory, scenario)
    difference = trajectory.cabinet_K - weather.ambient_K
    truth = Truth(
        cabinet=cabinet,
        differences_K=tuple(np.percentile(difference, (10.0, 50.0, 90.0)).tolist()),
        free_run_K=_rms(trajectory.cabinet_K - calm.cabinet_K),
        free_run_kg_m3=_rms(
            trajectory.cabinet_kg_m3(weather.ambient_K) - calm.cabinet_kg_m3(weather.ambient_K)
        ),
        lags_s=lags_s,
        late_s=late_s,
    )
    return Plant(f"other-{seed}", seed, scenario, weather, power_W, rated_W, trajectory, channels, truth)


def random_cabinet(
    random: np.random.Generator, weather: Weather, scenario: Scenario, further: np.random.Generator
) -> Cabinet:
    """A cabinet with a thermal constant of 0.8 … 4 h and a hygric one of 0.15 … 0.6 h at the weather's
    mean."""
    thermal_h = _between(random, 0.8, 4.0)
    hygric_h = _between(random, 0.15, 0.6)
    ratio = random.uniform(0.70, 0.95)
    outer = random.uniform(0.008, 0.03)
    volume = random.uniform(1.0, 5.0)
    capacity = 3600.0 * thermal_h * ratio / outer
    span, bend = random.uniform(3.0, 8.0), random.uniform(-1.5, 2.5)
    operation_K = (random.uniform(5.0, 9.0), span - bend, bend, random.uniform(-0.15, 0.05))
    standstill_K = (random.uniform(2.5, 5.5), random.uniform(-0.12, 0.03))
    cabinet = Cabinet(
        heat_capacity=capacity,
        outer_resistance=outer,
        inner_resistance=outer * (1.0 / ratio - 1.0),
        volume=volume,
        gap=1.0,
        operation_W=tuple(kelvin / outer for kelvin in operation_K),
        standstill_W=tuple(kelvin / outer for kelvin in standstill_K),
    )
    ambient_K = float(weather.ambient_K.mean())
    cabinet = replace(cabinet, gap=cabinet.hygric_h(ambient_K + 9.0, ambient_K) / hygric_h)
    if scenario.exponent is not None:
        cabinet = replace(cabinet, exponent=float(further.uniform(*scenario.exponent)))
    if scenario.second_mass is not None:
        second = capacity * further.uniform(*scenario.second_mass)
        resistance = 3600.0 * _between(further, *scenario.second_h) / second
        cabinet = replace(cabinet, second_capacity=second, second_resistance=resistance)
    return cabinet


def _forced(
    random: np.random.Generator,
    cabinet: Cabinet,
    weather: Weather,
    power_W: np.ndarray,
    rated_W: float,
    scenario: Scenario,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heat release with its disturbance [W], vapour around the cabinet [kg/m³], heat release without [W]."""
    running = power_W > 0.0
    share = np.where(running, power_W / rated_W, 0.0)
    calm_W = cabinet.heat_release_W(share, running, weather.ambient_K)
    kelvin = random.uniform(*scenario.free_run_K)
    heat_K = kelvin * _two_scales(
        random,
        weather,
        (6.0, 16.0),
        (0.7, 2.0),
        random.uniform(*scenario.fast),
        cabinet.resistance_capacity_h(),
        scenario,
    )
    vapour = random.uniform(*scenario.free_run_kg_m3) * _two_scales(
        random, weather, (4.0, 12.0), (0.4, 1.0), random.uniform(*scenario.fast), 0.3, scenario
    )
    outside = np.maximum(weather.ambient_kg_m3 + vapour, LEAST_KG_M3)
    return calm_W + heat_K / cabinet.outer_resistance, outside, calm_W


def _two_scales(
    random: np.random.Generator,
    weather: Weather,
    slow_h: Range,
    fast_h: Range,
    fast_share: float,
    cabinet_h: float,
    scenario: Scenario,
) -> np.ndarray:
    """Two Ornstein–Uhlenbeck processes whose sum behind the cabinet's time constant has variance 1."""
    total = np.zeros(len(weather.time))
    for range_h, part in ((slow_h, 1.0 - fast_share), (fast_h, fast_share)):
        correlation_h = _between(random, *range_h)
        step_h, size = weather.step_s / 3600.0, len(total)
        intensity = flaring(random, size, step_h, scenario.flare, 36.0) if scenario.flare else None
        passed = correlation_h / (correlation_h + cabinet_h)
        course = ornstein_uhlenbeck(random, size, step_h, correlation_h, intensity)
        total += np.sqrt(part / passed) * course
    return total


def _logged(
    random: np.random.Generator,
    further: np.random.Generator,
    weather: Weather,
    power_W: np.ndarray,
    trajectory: Trajectory,
    scenario: Scenario,
) -> tuple[tuple[Channel, ...], dict[str, float], dict[str, float]]:
    """Channels of the three systems; lags [s] by signal and late stamps [s] by system."""
    lags_s = {}
    if scenario.humidity_lag_s is not None:
        lags_s["cabinet_relative_humidity"] = float(further.uniform(*scenario.humidity_lag_s))
    late_s = dict.fromkeys(SYSTEMS, 0.0)
    if scenario.clock_s:
        struck = str(further.choice(SYSTEMS))
        late_s[struck] = scenario.clock_s * float(further.choice([-1.0, 1.0]))
    phase_s = 60.0 * random.integers(15) % scenario.cabinet_step_s
    cabinet_clock = Clock(scenario.cabinet_step_s, phase_s, late_s["cabinet"])
    ambient_clock = Clock(scenario.ambient_step_s, 0.0, late_s["ambient"], scenario.ambient_mean)
    scada_clock = Clock(SCADA_STEP_S, 0.0, late_s["scada"], True)
    tail = {"degrees": scenario.degrees, "outliers": scenario.outliers, "missing": 0.005}
    ambient_tail = {"missing": 0.002}
    coarse_K, coarse_humidity = scenario.resolution
    outside, inside = weather.ambient_K, trajectory.cabinet_K
    courses = {
        "cabinet_temperature": (
            inside,
            cabinet_clock,
            Sensor(random.uniform(0.03, 0.08), random.normal(0.0, 0.15), coarse_K, FREEZING_K, **tail),
        ),
        "cabinet_relative_humidity": (
            relative_humidity(trajectory.cabinet_kg_m3(outside), inside),
            cabinet_clock,
            Sensor(random.uniform(0.002, 0.005), random.normal(0.0, 0.008), coarse_humidity, **tail),
        ),
        "ambient_temperature": (
            outside,
            ambient_clock,
            Sensor(resolution=0.01, zero=FREEZING_K, **ambient_tail),
        ),
        "ambient_relative_humidity": (
            relative_humidity(weather.ambient_kg_m3, outside),
            ambient_clock,
            Sensor(resolution=0.0005, **ambient_tail),
        ),
        "active_power": (power_W, scada_clock, Sensor(resolution=100.0, missing=0.001)),
    }
    channels = []
    for signal, (course, clock, sensor) in courses.items():
        system = {"cabinet": "cabinet", "ambient": "ambient"}.get(signal.split("_")[0], "scada")
        channels.append(
            write_down(
                random,
                signal,
                system,
                weather.time,
                course,
                clock,
                replace(sensor, lag_s=lags_s.get(signal, 0.0)),
                stated=scenario.lag_stated and signal in lags_s,
                held=signal == "active_power",
            )
        )
    return tuple(channels), lags_s, late_s


def _between(random: np.random.Generator, low: float, high: float) -> float:
    """A number drawn evenly on the logarithm."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def _rms(course: np.ndarray) -> float:
    return float(np.sqrt(np.mean(course**2)))
