"""Simulated runs to measure on: drivers, readings of the models themselves, five in a hundred missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.physics.expression import exp
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.mechanisms.hygric import (
    exchange_factor,
    hygric_diffusion,
    hygric_exchange,
    vapour_disturbance,
)
from hygrokf.physics.mechanisms.sensors import humidity_sensor, temperature_sensor
from hygrokf.physics.mechanisms.thermal import (
    heat_disturbance,
    heat_release,
    thermal_diffusion,
    thermal_network,
)
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.psychrometrics import saturation_pressure_water

STEP_H = 1.0 / 6.0
MISSING = 0.05
VAPOUR = 461.5e-3
HOLDS = {
    "ambient_temperature": "linear",
    "ambient_absolute_humidity": "linear",
    "exchange_factor": "linear",
    "operating": "mean",
    "power_1": "mean",
}


@dataclass(frozen=True)
class Case:
    """A likelihood, parameter values near its maximum, and what went in: inputs and readings (T,) by name."""

    likelihood: Likelihood
    values: dict[str, float]
    inputs: Mapping[str, np.ndarray]
    readings: Mapping[str, np.ndarray]


def _recursion(factor: float, drive: np.ndarray, start: float) -> np.ndarray:
    """x_k = factor x_{k-1} + drive_k, x_0 = start."""
    from scipy.signal import lfilter

    drive = drive.copy()
    drive[0] = start
    return lfilter([1.0], [1.0, -factor], drive)


def _ramp(rate: np.ndarray | float, drive: np.ndarray) -> np.ndarray:
    """What a linear course of the drive adds over each step to a first-order lag; `rate` step over time
    constant [1]."""
    factor = np.exp(-rate)
    late = 1.0 - (1.0 - factor) / rate
    before = np.concatenate([drive[:1], drive[:-1]])
    return (1.0 - factor - late) * before + late * drive


def _coloured(random: np.random.Generator, count: int, sd: float, time_h: float) -> np.ndarray:
    factor = np.exp(-STEP_H / time_h)
    return _recursion(factor, sd * np.sqrt(1.0 - factor**2) * random.normal(size=count), sd * random.normal())


def _drivers(random: np.random.Generator, count: int) -> dict[str, np.ndarray]:
    hour = STEP_H * np.arange(count)
    season = 8.0 * np.sin(2.0 * np.pi * hour / 8766.0)
    kelvin = 283.0 + season + 3.0 * np.sin(2.0 * np.pi * hour / 24.0) + _coloured(random, count, 3.0, 60.0)
    wind = _coloured(random, count, 1.0, 15.0)
    operating = (wind > -0.8).astype(float)
    return {
        "ambient_temperature": kelvin,
        "ambient_absolute_humidity": 8.0 * np.exp(0.04 * (kelvin - 283.0)) * 0.85
        + _coloured(random, count, 0.4, 30.0),
        "exchange_factor": exchange_factor(kelvin),
        "operating": operating,
        "power_1": operating * np.clip(0.5 + 0.5 * wind, 0.02, 1.0),
    }


def _with_gaps(random: np.random.Generator, values: np.ndarray) -> np.ndarray:
    return np.where(random.random(len(values)) < MISSING, np.nan, values)


def _temperature(
    random: np.random.Generator, u: Mapping[str, np.ndarray], v: Mapping[str, float], release: np.ndarray
) -> np.ndarray:
    """Converter temperature [K] of the thermal network with white diffusion: ambient linear, release held
    over a step."""
    rate = STEP_H / v["thermal_time_constant"]
    factor = np.exp(-rate)
    ambient = u["ambient_temperature"]
    noise = v["thermal_diffusion"] * np.sqrt(0.5 * v["thermal_time_constant"] * (1.0 - factor**2))
    drive = _ramp(rate, ambient) + (1.0 - factor) * release / v["resistance_ratio"]
    return _recursion(factor, drive + noise * random.normal(size=len(ambient)), ambient[0] + release[0])


def thermal(count: int, seed: int = 1) -> Case:
    """One state: the thermal network with R_IC = 0 and white diffusion, driven by ambient and heat
    release."""
    random = np.random.default_rng(seed)
    v = {
        "thermal_time_constant": 1.5,
        "resistance_ratio": 1.0,
        "heat_release_operation": 7.0,
        "heat_release_power_1": 5.0,
        "thermal_diffusion": 0.3,
        "cabinet_temperature_noise": 0.1,
    }
    u = _drivers(random, count)
    release = v["heat_release_operation"] + v["heat_release_power_1"] * u["power_1"]
    converter = _temperature(random, u, v, release)
    readings = {"cabinet_temperature": _with_gaps(random, converter + 0.1 * random.normal(size=count))}
    parts = (
        thermal_network(),
        heat_release(order=1, ambient=False, standstill=False),
        thermal_diffusion(),
        temperature_sensor(accuracy=0.0),
    )
    return _case(parts, v, u, readings)


def joint(count: int, seed: int = 2) -> Case:
    """Four states, two readings, sixteen parameters: thermal and hygric model with their coloured
    disturbances."""
    random = np.random.default_rng(seed)
    v = {
        "thermal_time_constant": 1.5,
        "resistance_ratio": 0.85,
        "heat_release_operation": 7.0,
        "heat_release_power_1": 5.0,
        "heat_release_standstill": 4.5,
        "heat_disturbance_sd": 1.5,
        "heat_disturbance_time": 8.0,
        "thermal_diffusion": 0.1,
        "cabinet_temperature_bias": 0.1,
        "cabinet_temperature_noise": 0.05,
        "hygric_k": 0.35,
        "vapour_disturbance_sd": 0.4,
        "vapour_disturbance_time": 6.0,
        "hygric_diffusion": 0.05,
        "cabinet_relative_humidity_bias": 0.002,
        "cabinet_relative_humidity_noise": 0.003,
    }
    u = _drivers(random, count)
    on = u["operating"]
    release = on * v["heat_release_operation"] + v["heat_release_power_1"] * u["power_1"]
    release = release + (1.0 - on) * v["heat_release_standstill"]
    release = release + _coloured(random, count, v["heat_disturbance_sd"], v["heat_disturbance_time"])
    ambient = u["ambient_temperature"]
    air = ambient + v["resistance_ratio"] * (_temperature(random, u, v, release) - ambient)
    drive = u["ambient_absolute_humidity"] + _coloured(
        random, count, v["vapour_disturbance_sd"], v["vapour_disturbance_time"]
    )
    rate = STEP_H * air * u["exchange_factor"] / v["hygric_k"]
    kicks = v["hygric_diffusion"] * np.sqrt(STEP_H) * random.normal(size=count)
    vapour = np.empty(count)
    now = drive[0]
    for k, (keep, push) in enumerate(
        zip(np.exp(-rate).tolist(), (_ramp(rate, drive) + kicks).tolist(), strict=True)
    ):
        now = keep * now + push
        vapour[k] = now
    humidity = vapour * VAPOUR * ambient / saturation_pressure_water(air)
    readings = {
        "cabinet_temperature": _with_gaps(random, air + 0.1 + 0.05 * random.normal(size=count)),
        "cabinet_relative_humidity": _with_gaps(random, humidity + 0.002 + 0.003 * random.normal(size=count)),
    }
    parts = (
        thermal_network(),
        heat_release(order=1, ambient=False, standstill_ambient=False),
        heat_disturbance(),
        thermal_diffusion(),
        temperature_sensor(),
        hygric_exchange(),
        vapour_disturbance(),
        hygric_diffusion(),
        humidity_sensor(),
    )
    return _case(parts, v, u, readings)


def _case(parts: tuple, v: dict[str, float], u: Mapping[str, np.ndarray], readings: Mapping) -> Case:
    model = compose(parts, HOLDS)
    inputs = {name: u[name] for name in model.inputs}
    count = len(u["ambient_temperature"])
    run = timeline(model, STEP_H * np.arange(count), inputs, readings)
    return Case(Likelihood(model, run), {p.name: v[p.name] for p in model.parameters}, inputs, readings)


# -- two thermal masses, seven parameters --------------------------------------------------------------------
LOGARITHMS = ("lC1", "lC2", "lR12", "lRa", "ls1", "ls2", "lsy")
STARTS = {"lC1": 0.0, "lC2": 1.0, "lR12": 0.0, "lRa": 0.0, "ls1": -2.0, "ls2": -2.0, "lsy": -2.0}
"""Start values of the logarithms; the noise parameters' are those that several starts would vary."""
TRUTH = {"lC1": np.log(0.5), "lC2": np.log(4.0), "lR12": np.log(0.8), "lRa": np.log(2.5)}
TRUTH |= {"ls1": np.log(0.15), "ls2": np.log(0.05), "lsy": np.log(0.08)}


def two_masses(time: np.ndarray, ambient: np.ndarray, power: np.ndarray, reading: np.ndarray) -> Likelihood:
    """dT1 = ((T2−T1)/(C1 R12) + (Ta−T1)/(C1 Ra) + P/C1) dt + s1 dW,  dT2 = (T1−T2)/(C2 R12) dt + s2 dW,  y =
    T1 + v.

    Inputs are held from their instant on; T1, T2 start from N(15, 0.1).
    """

    def rates(p, x, u):
        c1, c2, r12, ra = exp(p.lC1), exp(p.lC2), exp(p.lR12), exp(p.lRa)
        first = (x.T2 - x.T1) / (c1 * r12) + (u.ambient - x.T1) / (c1 * ra) + u.power / c1
        return {"T1": first, "T2": (x.T1 - x.T2) / (c2 * r12)}

    network = linear_network(
        "two_masses",
        [Parameter(n, "1", STARTS[n], -10.0, 6.0, noise=n.startswith("ls")) for n in LOGARITHMS],
        ["T1", "T2"],
        ["ambient", "power"],
        rates,
        {"y": lambda p, x, u: (x.T1, exp(2.0 * p.lsy))},
        lambda p: {"T1": exp(2.0 * p.ls1), "T2": exp(2.0 * p.ls2)},
        lambda p, u: {"T1": (15.0, 0.1), "T2": (15.0, 0.1)},
    )
    model = compose([network], {"ambient": "mean", "power": "mean"})
    held = {"ambient": ambient, "power": power}
    held = {name: np.concatenate([v[:1], v[:-1]]) for name, v in held.items()}
    return Likelihood(model, timeline(model, time, held, {"y": reading}))


def simulated_two_masses(count: int, seed: int = 3) -> Likelihood:
    """Readings of the two-mass network at its truth."""
    from scipy.linalg import expm

    random = np.random.default_rng(seed)
    c1, c2, r12, ra, s1, s2, noise = (float(np.exp(TRUTH[n])) for n in LOGARITHMS)
    a = np.array([[-1 / (c1 * r12) - 1 / (c1 * ra), 1 / (c1 * r12)], [1 / (c2 * r12), -1 / (c2 * r12)]])
    b = np.array([[1 / (c1 * ra), 1 / c1], [0.0, 0.0]])
    block = np.zeros((4, 4))
    block[:2, :2], block[:2, 2:] = a, b
    step = expm(block * STEP_H)
    parts = 20  # the noise is let in twenty times a step
    fine = expm(a * STEP_H / parts)
    spread = sum(
        np.linalg.matrix_power(fine, j) @ np.diag([s1**2, s2**2]) @ np.linalg.matrix_power(fine, j).T
        for j in range(parts)
    ) * (STEP_H / parts)
    kicks = random.normal(size=(count, 2)) @ np.linalg.cholesky(spread).T
    hour = STEP_H * np.arange(count)
    ambient = 10.0 + 6.0 * np.sin(2.0 * np.pi * hour / 24.0) + np.cumsum(0.05 * random.normal(size=count))
    power = np.repeat(random.uniform(0.0, 6.0, size=count // 12 + 1), 12)[:count]
    x = np.array([15.0, 15.0])
    reading = np.empty(count)
    for k in range(count):
        if k:
            x = step[:2, :2] @ x + step[:2, 2:] @ np.array([ambient[k - 1], power[k - 1]]) + kicks[k]
        reading[k] = x[0] + noise * random.normal()
    return two_masses(hour, ambient, power, _with_gaps(random, reading))
