"""Settings of all tests; cases that several filter, simulated by a few lines of their own."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from builders.browser import browser  # noqa: F401  (a fixture)
from builders.databases import postgresql, store_url  # noqa: F401  (fixtures)
from builders.known_values import RELEASE
from hypothesis import settings

from hygrokf.engine.timeline import Timeline, timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.physics.holds import REGIME
from hygrokf.physics.mechanisms.hygric import hygric_diffusion, hygric_exchange, vapour_disturbance
from hygrokf.physics.mechanisms.sensors import humidity_sensor, temperature_sensor
from hygrokf.physics.mechanisms.thermal import (
    heat_disturbance,
    heat_release,
    measured_air,
    thermal_diffusion,
    thermal_network,
)
from hygrokf.physics.model import Model, compose

# The same examples at every run, so that a failure comes from the change that was tried.  New examples:
# `scripts/test -m hypothesis --hypothesis-profile random`.  No deadline: machines are shared.
settings.register_profile("random", deadline=None)
settings.register_profile("repeated", deadline=None, derandomize=True)
settings.load_profile("repeated")

HOLDS = {
    "ambient_temperature": "linear",
    "ambient_absolute_humidity": "linear",
    "exchange_factor": "linear",
    "cabinet_temperature": "linear",
    "operating": "mean",
    "power_1": "mean",
    "power_2": "mean",
    "preheating": "mean",
    "power_unknown": REGIME,
}
VALUES = {
    "thermal_time_constant": 1.5,
    "resistance_ratio": 0.85,
    **RELEASE,
    "preheating_heat": 9.0,
    "heat_disturbance_sd": 1.5,
    "heat_disturbance_time": 8.0,
    "thermal_diffusion": 0.07,
    "cabinet_temperature_bias": 0.1,
    "cabinet_temperature_noise": 0.06,
    "hygric_k": 0.32,
    "vapour_disturbance_sd": 0.42,
    "vapour_disturbance_time": 6.0,
    "hygric_diffusion": 0.03,
    "cabinet_relative_humidity_bias": 0.003,
    "cabinet_relative_humidity_noise": 0.004,
}
GAP_COVARIANCE = ((0.2, 0.05, 0.04), (0.05, 0.08, 0.07), (0.04, 0.07, 0.08))
SUBSTEPS = 30


def pytest_configure() -> None:
    """Look for no garbage while tests are collected: their million objects stay."""
    gc.disable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop() -> None:
    """Look for garbage among the objects of the tests alone; each pass over all others took a second."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def no_thread_goes_on() -> Iterator[None]:
    """No thread of the package outlives its test: it would disturb the tests after it."""
    before = set(threading.enumerate())
    yield
    for thread in set(threading.enumerate()) - before:
        if getattr(getattr(thread, "_target", None), "__module__", "").startswith("hygrokf."):
            thread.join(timeout=10.0)
            assert not thread.is_alive(), f"thread {thread.name} goes on after its test"


@dataclass(frozen=True)
class Case:
    """A model, the instants of a run, parameter values near the truth, and the inputs and readings (T,) by
    name."""

    model: Model
    timeline: Timeline
    values: dict[str, float]
    inputs: Mapping[str, np.ndarray]
    readings: Mapping[str, np.ndarray]
    resets: Mapping[str, np.ndarray]

    @property
    def likelihood(self) -> Likelihood:
        return Likelihood(self.model, self.timeline)

    def first(self, count: int) -> Case:
        """The case cut after `count` instants."""
        return replace(
            self,
            timeline=timeline(
                self.model,
                self.timeline.time[:count],
                {name: v[:count] for name, v in self.inputs.items()},
                {name: v[:count] for name, v in self.readings.items()},
                {name: v[:count] for name, v in self.resets.items()},
            ),
            inputs={name: v[:count] for name, v in self.inputs.items()},
            readings={name: v[:count] for name, v in self.readings.items()},
            resets={name: v[:count] for name, v in self.resets.items()},
        )

    def split(self, times: np.ndarray) -> Case:
        """The same run with further instants [h] at which nothing is read."""
        old = self.timeline.time
        time = np.union1d(old, times)
        place = np.searchsorted(old, time)  # of the instant that ends the step
        inputs = {
            name: np.interp(time, old, v) if self.model.holds[name] == "linear" else v[place]
            for name, v in self.inputs.items()
        }
        at = np.searchsorted(time, old)
        readings = {}
        for name, v in self.readings.items():
            readings[name] = np.full(len(time), np.nan)
            readings[name][at] = v
        resets = {}
        for name, v in self.resets.items():
            resets[name] = np.zeros(len(time), dtype=bool)
            resets[name][at] = v
        made = timeline(self.model, time, inputs, readings, resets)
        return replace(self, timeline=made, inputs=inputs, readings=readings, resets=resets)


def _weather(random: np.random.Generator, time: np.ndarray) -> dict[str, np.ndarray]:
    """Inputs at the instants; power for the step that ends there."""
    root = np.sqrt(np.diff(time, prepend=time[0]))
    walk = np.cumsum(random.normal(size=(2, len(time))) * root, axis=1)
    kelvin = 283.0 + 5.0 * np.sin(2 * np.pi * time / 24.0) + 0.3 * walk[0]
    operating = (np.sin(time / 11.0) > -0.6).astype(float)
    power = operating * np.clip(
        0.5 + 0.4 * np.sin(time / 5.0) + 0.1 * random.normal(size=len(time)), 0.02, 1.0
    )
    return {
        "ambient_temperature": kelvin,
        "ambient_absolute_humidity": 7.5 + np.sin(time / 30.0) + 0.15 * walk[1],
        "exchange_factor": kelvin**0.8 / 273.0**1.8,
        "operating": operating,
        "power_1": power,
        "power_2": power**2,
        "preheating": ((time % 37.0) < 4.0).astype(float),
        "power_unknown": ((time > 0.6 * time[-1]) & (time < 0.75 * time[-1])).astype(float),
    }


def _simulated(
    random: np.random.Generator, time: np.ndarray, inputs: Mapping[str, np.ndarray], p: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Temperature [K] and relative humidity [1] of the cabinet air, at the instants and as means over the
    steps."""
    count = len(time)
    heat = p["heat_disturbance_sd"] * random.normal()
    damp = p["vapour_disturbance_sd"] * random.normal()
    converter = inputs["ambient_temperature"][0] + 8.0
    vapour = inputs["ambient_absolute_humidity"][0]
    ratio = p["resistance_ratio"]
    air, humidity = np.empty(count), np.empty(count)
    mean_air, mean_humidity = np.empty(count), np.empty(count)
    kicks = random.normal(size=(count, SUBSTEPS, 4))

    def shown(kelvin: float, outside: float) -> float:
        pressure = np.exp(-6096.9385 / kelvin + 16.635794 - 2.711193e-2 * kelvin + 1.673952e-5 * kelvin**2)
        return 461.5e-3 * vapour * outside / (100.0 * pressure * kelvin**2.433502)

    for k in range(count):
        totals = [0.0, 0.0]
        h = (time[k] - time[k - 1]) / SUBSTEPS if k else 0.0
        for j in range(SUBSTEPS if k else 1):
            share = (j + 0.5) / SUBSTEPS if k else 1.0
            now = {
                n: (1 - share) * v[max(k - 1, 0)] + share * v[k]
                for n, v in inputs.items()
                if HOLDS[n] == "linear"
            }
            outside, warm = now["ambient_temperature"], now["ambient_temperature"] - 283.15
            on = inputs["operating"][k]
            release = on * (p["heat_release_operation"] + p["heat_release_operation_ambient"] * warm)
            release += (1 - on) * (p["heat_release_standstill"] + p["heat_release_standstill_ambient"] * warm)
            release += (
                p["heat_release_power_1"] * inputs["power_1"][k]
                + p["heat_release_power_2"] * inputs["power_2"][k]
            )
            release += p["preheating_heat"] * inputs["preheating"][k]
            kelvin = ratio * converter + (1 - ratio) * outside
            totals[0] += kelvin
            totals[1] += shown(kelvin, outside)
            rate = kelvin * now["exchange_factor"] / p["hygric_k"]
            converter += h * (outside - converter + (release + heat) / ratio) / p["thermal_time_constant"]
            vapour += h * rate * (now["ambient_absolute_humidity"] - vapour + damp)
            heat += -h * heat / p["heat_disturbance_time"]
            damp += -h * damp / p["vapour_disturbance_time"]
            root = np.sqrt(h) * kicks[k, j]
            converter += p["thermal_diffusion"] * root[0]
            vapour += p["hygric_diffusion"] * root[1]
            heat += p["heat_disturbance_sd"] * np.sqrt(2.0 / p["heat_disturbance_time"]) * root[2]
            damp += p["vapour_disturbance_sd"] * np.sqrt(2.0 / p["vapour_disturbance_time"]) * root[3]
        outside = inputs["ambient_temperature"][k]
        air[k] = ratio * converter + (1 - ratio) * outside
        humidity[k] = shown(air[k], outside)
        parts = SUBSTEPS if k else 1
        mean_air[k], mean_humidity[k] = totals[0] / parts, totals[1] / parts
    return {"air": air, "humidity": humidity, "mean_air": mean_air, "mean_humidity": mean_humidity}


def _mechanisms(kind: str, preheating: bool, gap: bool) -> list:
    release = heat_release(
        order=2, preheating=preheating, gap_covariance=GAP_COVARIANCE if gap else None, gap_time_h=10.0
    )
    thermal = [thermal_network(), release, heat_disturbance(), thermal_diffusion(), temperature_sensor()]
    hygric = [hygric_exchange(), vapour_disturbance(), hygric_diffusion(), humidity_sensor()]
    return {"thermal": thermal, "cascade": [measured_air(), *hygric], "joint": [*thermal, *hygric]}[kind]


def _make_case(
    kind: str,
    time: np.ndarray,
    seed: int,
    *,
    missing: float = 0.2,
    means: bool = False,
    preheating: bool = False,
    gap: bool = False,
) -> Case:
    random = np.random.default_rng(seed)
    inputs = _weather(random, time)
    if not preheating:
        inputs["preheating"] = np.zeros(len(time))
    truth = _simulated(random, time, inputs, VALUES)
    interval = float(time[1] - time[0])
    outputs = {"cabinet_temperature": "air", "cabinet_relative_humidity": "humidity"}
    if kind == "cascade":
        inputs["cabinet_temperature"] = truth["air"] + 0.03 * random.normal(size=len(time))
    mechanisms = _mechanisms(kind, preheating, gap)
    read_by = [name for mechanism in mechanisms for name in mechanism.outputs]
    averaged = {name: interval for name in read_by} if means else {}
    model = compose(mechanisms, HOLDS, averaged)
    values = {p.name: VALUES[p.name] for p in model.parameters}
    readings, resets = {}, {}
    for name, truth_name in outputs.items():
        read = truth[f"mean_{truth_name}" if means else truth_name] + values.get(f"{name}_bias", 0.0)
        read = read + values.get(f"{name}_noise", 0.0) * random.normal(size=len(time))
        read[random.random(len(time)) < missing] = np.nan
        if means:
            read[0] = np.nan
        if name in model.outputs:
            readings[name] = read
            resets[name] = np.full(len(time), means)
    inputs = {name: inputs[name] for name in model.inputs}
    return Case(model, timeline(model, time, inputs, readings, resets), values, inputs, readings, resets)


def _irregular(count: int) -> np.ndarray:
    """Readings every quarter of an hour and power every ten minutes on a clock three minutes late [h]."""
    minutes = np.union1d(np.arange(0, 60 * count, 15), np.arange(3, 60 * count, 10))
    return minutes[:count] / 60.0


@pytest.fixture(scope="session")
def make_case() -> Callable[..., Case]:
    """(kind, time [h], seed, missing, means, preheating, gap) -> a simulated case of that base model."""
    return _make_case


@pytest.fixture(scope="session")
def thermal() -> Case:
    """1,000 instants of the thermal model at irregular steps."""
    return _make_case("thermal", _irregular(1000), 11)


@pytest.fixture(scope="session")
def cascade() -> Case:
    """1,000 instants of the hygric model on the measured temperature."""
    return _make_case("cascade", _irregular(1000), 12)


@pytest.fixture(scope="session")
def joint() -> Case:
    """1,000 instants of the joint model."""
    return _make_case("joint", _irregular(1000), 13)


@pytest.fixture(scope="session")
def averaged() -> Case:
    """600 instants of the joint model read as means over each step, with pre-heating and a gap in the
    power."""
    return _make_case("joint", 0.25 * np.arange(600), 14, means=True, preheating=True, gap=True)


@pytest.fixture(scope="session")
def joint_moments() -> Callable[..., Callable]:
    """(case, values) -> (k, mean, covariance) -> moments at instant k from those at k−1, by scipy's
    integrator.

    The extended Kalman filter's moment equations of the joint model, written here once more: states are the
    converter's temperature, the heat disturbance, c* and the vapour disturbance, in the model's order.
    """
    from scipy.integrate import solve_ivp

    def prepare(case: Case, p: Mapping[str, float]) -> Callable:
        order = ["converter_temperature", "heat_disturbance", "vapour", "vapour_disturbance"]
        assert list(case.model.states) == order
        time, u = case.timeline.time, case.inputs
        ratio, tau = p["resistance_ratio"], p["thermal_time_constant"]
        noise = np.diag(
            [
                p["thermal_diffusion"] ** 2,
                2 * p["heat_disturbance_sd"] ** 2 / p["heat_disturbance_time"],
                p["hygric_diffusion"] ** 2,
                2 * p["vapour_disturbance_sd"] ** 2 / p["vapour_disturbance_time"],
            ]
        )

        def advance(k: int, mean: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            on = u["operating"][k]
            power = p["heat_release_power_1"] * u["power_1"][k] + p["heat_release_power_2"] * u["power_2"][k]
            length = time[k] - time[k - 1]

            def rates(t: float, z: np.ndarray) -> np.ndarray:
                share = t / length
                outside, damp, factor = (
                    (1 - share) * u[n][k - 1] + share * u[n][k]
                    for n in ("ambient_temperature", "ambient_absolute_humidity", "exchange_factor")
                )
                warm = outside - 283.15
                release = power + on * (
                    p["heat_release_operation"] + p["heat_release_operation_ambient"] * warm
                )
                release += (1 - on) * (
                    p["heat_release_standstill"] + p["heat_release_standstill_ambient"] * warm
                )
                converter, heat, vapour, vapour_error = z[:4]
                rate = (ratio * converter + (1 - ratio) * outside) * factor / p["hygric_k"]
                drive = damp - vapour + vapour_error
                drift = [
                    (outside - converter + (release + heat) / ratio) / tau,
                    -heat / p["heat_disturbance_time"],
                    rate * drive,
                    -vapour_error / p["vapour_disturbance_time"],
                ]
                slope = np.array(
                    [
                        [-1 / tau, 1 / ratio / tau, 0, 0],
                        [0, -1 / p["heat_disturbance_time"], 0, 0],
                        [ratio * factor / p["hygric_k"] * drive, 0, -rate, rate],
                        [0, 0, 0, -1 / p["vapour_disturbance_time"]],
                    ]
                )
                product = slope @ z[4:].reshape(4, 4)
                return np.concatenate([drift, (product + product.T + noise).ravel()])

            start = np.concatenate([mean, covariance.ravel()])
            end = solve_ivp(rates, (0.0, length), start, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
            return end[:4], end[4:].reshape(4, 4)

        return advance

    return prepare
