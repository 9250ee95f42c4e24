"""The compiled filter against filterpy on moments computed otherwise, and against a particle filter."""

from __future__ import annotations

import gc
import math
import weakref
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from builders.linear_oracles import first_of
from builders.linear_oracles import heat_release as released
from filterpy.kalman import ExtendedKalmanFilter

from hygrokf.engine.filter_loops import filter_loop
from hygrokf.engine.packing import pack, unpack
from hygrokf.engine.timeline import timeline
from hygrokf.engine.traced_filter import traced
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.physics.expression import where
from hygrokf.physics.holds import REGIME
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.mechanisms.sensors import temperature_sensor
from hygrokf.physics.mechanisms.thermal import heat_release, thermal_diffusion, thermal_network
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.psychrometrics import (
    GAS_CONSTANT_VAPOUR,
    saturation_pressure_water,
    saturation_pressure_water_slope,
)

AGREE = 1e-9


class Extended(ExtendedKalmanFilter):
    """filterpy's filter whose prediction of the mean is handed in; all algebra is filterpy's."""

    def predict_x(self, u: object = 0) -> None:
        self.x = self.following


def shown(case: object, output: str, k: int, x: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Prediction, slopes and noise variance of a reading of the joint model, written once more."""
    p, row, variance = case.values, np.zeros(4), case.values[f"{output}_noise"] ** 2
    outside, ratio = case.inputs["ambient_temperature"][k], p["resistance_ratio"]
    air = ratio * x[0] + (1 - ratio) * outside
    if output == "cabinet_temperature":
        row[0] = ratio
        return air + p["cabinet_temperature_bias"], row, variance
    pressure = float(saturation_pressure_water(air))
    row[2] = 1e-3 * GAS_CONSTANT_VAPOUR * outside / pressure
    value = x[2] * row[2]
    row[0] = -value * float(saturation_pressure_water_slope(air)) / pressure * ratio
    return value + p["cabinet_relative_humidity_bias"], row, variance


def test_filterpy_on_integrated_moments_agrees_in_the_limit_of_small_sub_steps(
    joint: object, joint_moments: Callable
) -> None:
    """The joint model without any code of the package: moments by scipy's integrator, the filter by
    filterpy."""
    case = joint.first(45)
    advance, first, total = joint_moments(case, case.values), first_of(case), 0.0
    time = case.timeline.time
    fine = case.split(np.concatenate([time[:-1] + np.diff(time) * i / 24 for i in range(1, 24)]))
    rows = np.searchsorted(fine.timeline.time, time)
    found = fine.likelihood.trace(case.values)
    made = Extended(dim_x=4, dim_z=1)
    made.x, made.P = first.mean.copy(), first.covariance.copy()
    for k in range(len(time)):
        if k:
            made.following, made.Q = advance(k, made.x, np.zeros((4, 4)))
            columns = []
            for i in range(4):  # the covariance that starts as e_i e_i' ends as F e_i (F e_i)' + Q
                grown = advance(k, made.x, np.diag(np.eye(4)[i]))[1] - made.Q
                place = int(np.argmax(np.diag(grown)))
                columns.append(grown[:, place] / math.sqrt(grown[place, place]))
                columns[-1] *= np.sign(columns[-1][i])  # a state keeps its sign within a step
            made.F = np.column_stack(columns)
            made.predict()
        for name, read in case.readings.items():
            if not np.isnan(read[k]):
                prediction, row, variance = shown(case, name, k, made.x)
                made.update(
                    np.array([read[k]]),
                    lambda x, row=row: row[None, :],
                    lambda x, prediction=prediction: np.array([prediction]),
                    R=np.array([[variance]]),
                )
                spread, error = made.S[0, 0], made.y[0]
                total -= 0.5 * (math.log(2 * math.pi * spread) + error**2 / spread)
        np.testing.assert_allclose(found.mean[rows[k]], made.x, rtol=AGREE, atol=AGREE)
        np.testing.assert_allclose(found.covariance[rows[k]], made.P, rtol=AGREE, atol=AGREE)
    assert found.loglik == pytest.approx(total, rel=AGREE)


# -- what one step is made of --------------------------------------------------------------------------------
CONDITIONS = {
    "parameter": lambda p, u, yes, no: where(p.a < 1.1, yes, no),
    "regime": lambda p, u, yes, no: where(u.r > 0.5, yes, no),
    "regime_and_parameter": lambda p, u, yes, no: where(u.r > p.a - 0.5, yes, no),
    "input": lambda p, u, yes, no: where(u.c > 2.4, yes, no),
}


def test_conditions_hold_whenever_their_operands_are_known() -> None:
    """`where` on parameters, regimes and inputs, in rates and readings: value, score and sensitivities of
    each compiled loop."""
    network = linear_network(
        "switched",
        [Parameter("a", "1", 1.0, -5, 5), Parameter("b", "1/h", 1.0, -5, 5)],
        ["s"],
        ["r", "c"],
        lambda p, x, u: {
            "s": -0.25 * p.b * sum(at(p, u, 2.0 * x.s, x.s + 0.3) for at in CONDITIONS.values())
        },
        {
            name: lambda p, x, u, at=at: (at(p, u, 2.0 * x.s, p.a * x.s), 0.01)
            for name, at in CONDITIONS.items()
        },
        lambda p: {"s": 0.1},
        lambda p, u: {"s": (0.5, 1.0)},
    )
    model, time = compose([network], {"r": REGIME, "c": "linear"}), 0.25 * np.arange(24)
    inputs = {"r": (time > 2.1).astype(float), "c": time.copy()}
    readings = {name: np.sin(time + i) * 0.5 for i, name in enumerate(CONDITIONS)}
    # far from where the number of sub-steps changes: a jump of a rate falls in other places
    values = {"a": 0.9, "b": 0.6}
    likelihood = Likelihood(model, timeline(model, time, inputs, readings))
    value, score = likelihood.score(values)
    assert likelihood.value(values) == pytest.approx(value, rel=1e-12)
    found = likelihood.sensitivities(values, np.eye(2))
    np.testing.assert_allclose(found.score, score, rtol=1e-9, atol=1e-9)
    step = 1e-6
    for i, name in enumerate(values):
        up, down = (likelihood.value(values | {name: values[name] + s}) for s in (step, -step))
        assert score[i] == pytest.approx((up - down) / (2 * step), rel=1e-6, abs=1e-6)
    trace = likelihood.trace(values, gain=False)
    for place, holds in enumerate((time > -1, time > 2.1, time > 2.1, time > 2.4)):
        expected = np.where(holds, 2.0, values["a"]) * trace.prior_mean[:, 0]
        np.testing.assert_allclose(trace.prediction[:, place], expected, rtol=1e-14)


def test_packed_triangles_unpack_to_the_matrix() -> None:
    random = np.random.default_rng(2)
    for n in (1, 2, 5):
        a = random.normal(size=(3, n, n))
        a = a + a.swapaxes(1, 2)
        packed = pack(a)
        assert packed.shape == (3, n * (n + 1) // 2)
        np.testing.assert_array_equal(unpack(packed, n), a)


def test_without_gain_the_filter_runs_free(joint: object, joint_moments: Callable) -> None:
    case = joint.first(40)
    free = case.likelihood.trace(case.values, gain=False)
    silent = Likelihood(case.model, case.timeline.with_readings(np.full_like(case.timeline.y, np.nan)))
    forecast = silent.trace(case.values)
    np.testing.assert_array_equal(free.mean, forecast.mean)
    np.testing.assert_array_equal(free.covariance, forecast.covariance)
    np.testing.assert_array_equal(free.prediction, forecast.prediction)
    np.testing.assert_array_equal(free.mean, free.prior_mean)
    assert forecast.loglik == 0.0
    advance, first = joint_moments(case, case.values), first_of(case)
    mean, covariance = first.mean, first.covariance
    for k in range(1, 40):
        mean, covariance = advance(k, mean, covariance)
    # forty steps of the stated local error; the readings would tell temperatures to 0.06 K
    np.testing.assert_allclose(free.mean[-1], mean, rtol=0, atol=1e-5)
    np.testing.assert_allclose(free.covariance[-1], covariance, rtol=0, atol=1e-5)


# -- how far an extended filter is from the exact one --------------------------------------------------------
class Particles:
    """A bootstrap particle filter of the joint cabinet: states (N, 4), systematic resampling at every
    reading."""

    def __init__(self, case: object, count: int, seed: int) -> None:
        self.p, self.u, self.time = case.values, case.inputs, case.timeline.time
        self.readings, self.count = case.readings, count
        self.random = np.random.default_rng(seed)
        first = first_of(case)
        self.x = first.mean + np.sqrt(np.diag(first.covariance)) * self.random.normal(size=(count, 4))

    def _move(self, k: int, parts: int) -> None:
        p, u, z = self.p, self.u, self.x
        h = (self.time[k] - self.time[k - 1]) / parts
        on, ratio, tau = u["operating"][k], p["resistance_ratio"], p["thermal_time_constant"]
        keep = [math.exp(-h / p["heat_disturbance_time"]), math.exp(-h / p["vapour_disturbance_time"])]
        kick = [p["heat_disturbance_sd"], p["vapour_disturbance_sd"]]
        kick = [s * math.sqrt(1 - e * e) for s, e in zip(kick, keep, strict=True)]
        fade = math.exp(-h / tau)
        white = p["thermal_diffusion"] * math.sqrt(tau / 2 * (1 - fade * fade))
        for j in range(parts):
            share = (j + 0.5) / parts
            outside, damp, factor = (
                (1 - share) * u[n][k - 1] + share * u[n][k]
                for n in ("ambient_temperature", "ambient_absolute_humidity", "exchange_factor")
            )
            release = released(p, outside, on, u["power_1"][k])
            normal = self.random.standard_normal((4, self.count))
            heat = keep[0] * z[:, 1] + kick[0] * normal[0]
            error = keep[1] * z[:, 3] + kick[1] * normal[1]
            goal = outside + (release + 0.5 * (z[:, 1] + heat)) / ratio
            converter = goal + (z[:, 0] - goal) * fade + white * normal[2]
            rate = (ratio * 0.5 * (z[:, 0] + converter) + (1 - ratio) * outside) * factor / p["hygric_k"]
            away = np.exp(-rate * h)
            level = damp + 0.5 * (z[:, 3] + error)
            spread = p["hygric_diffusion"] * np.sqrt((1 - away * away) / (2 * rate))
            z = np.column_stack(
                [converter, heat, level + (z[:, 2] - level) * away + spread * normal[3], error]
            )
        self.x = z

    def run(self, parts: int) -> Iterator[tuple[float, np.ndarray]]:
        """Log-likelihood of each instant's readings and the filtered mean there."""
        p, names = self.p, ("cabinet_temperature", "cabinet_relative_humidity")
        for k in range(len(self.time)):
            if k:
                self._move(k, parts)
            outside = self.u["ambient_temperature"][k]
            air = p["resistance_ratio"] * self.x[:, 0] + (1 - p["resistance_ratio"]) * outside
            humidity = 1e-3 * GAS_CONSTANT_VAPOUR * self.x[:, 2] * outside / saturation_pressure_water(air)
            weight = np.zeros(self.count)
            for name, shown in zip(names, (air, humidity), strict=True):
                read = self.readings[name][k]
                if not np.isnan(read):
                    sd = p[f"{name}_noise"]
                    error = (read - shown - p[f"{name}_bias"]) / sd
                    weight -= 0.5 * error**2 + math.log(sd * math.sqrt(2 * math.pi))
            top = weight.max()
            share = np.exp(weight - top)
            total = share.sum()
            yield top + math.log(total / self.count), share @ self.x / total
            place = (self.random.random() + np.arange(self.count)) / self.count
            self.x = self.x[np.minimum(np.searchsorted(np.cumsum(share) / total, place), self.count - 1)]


def test_the_extended_filter_is_as_good_as_exact(make_case: Callable) -> None:
    """Two days, 362 readings every quarter of an hour, a cabinet like the paper's.

    Measured on a week: with 80,000 particles (two runs) the log-likelihood of the extended filter is
    0.04 ± 0.2 higher, 3e-5 a reading, and its states are off by less than 0.001 standard deviations on
    average.  With the 10,000 of this test the particle filter's own noise is 1.1 in the log-likelihood (3e-3
    a reading) and 0.008 in the means; the bounds below are three of it.
    """
    case = make_case("joint", 0.25 * np.arange(192), 21, missing=0.05)
    found = list(Particles(case, 10_000, 0).run(parts=5))
    trace = case.likelihood.trace(case.values)
    difference = trace.loglik - sum(value for value, _ in found)
    assert abs(difference) / case.timeline.n_readings < 9e-3
    away = (trace.mean - [mean for _, mean in found]) / np.sqrt(np.einsum("tii->ti", trace.covariance))
    settled = away[24:]  # six hours
    assert np.all(np.abs(settled.mean(axis=0)) < 0.025)
    assert np.all(np.sqrt((settled**2).mean(axis=0)) < 0.07)  # single means carry the particles' noise


def test_a_model_takes_its_filters_along_when_it_goes() -> None:
    release = heat_release(order=0, standstill=False)
    parts = (thermal_network(), release, thermal_diffusion(), temperature_sensor(0.3, 0.1))
    model = compose(parts, {"ambient_temperature": "linear"})
    kept = [weakref.ref(traced(model, diffuse)) for diffuse in (False, True)]
    assert traced(model) is kept[0]() and traced(model, True) is kept[1]()
    del model
    gc.collect()
    assert [one() for one in kept] == [None, None]


def test_models_that_differ_in_a_records_numbers_share_their_code() -> None:
    """The reference temperature and the resolution are no part of the code, and are read where they
    belong."""
    time = np.arange(40.0)
    inputs = {"ambient_temperature": 283.0 + np.sin(time)}
    readings = {"cabinet_temperature": 289.0 + np.cos(time)}
    found = []
    for reference, resolution in ((280.0, 0.1), (290.0, 0.5)):
        parts = (
            thermal_network(),
            heat_release(order=0, standstill=False, reference_K=reference),
            thermal_diffusion(),
            temperature_sensor(0.3, resolution),
        )
        model = compose(parts, {"ambient_temperature": "linear"})
        values = {p.name: p.start for p in model.parameters} | {"heat_release_operation_ambient": -0.1}
        found.append((Likelihood(model, timeline(model, time, inputs, readings)), values))
    (one, values), (other, _) = found
    assert traced(one.model) is not traced(other.model)
    for kind in ("value", "adjoint", "tangent", "trace"):
        assert filter_loop(traced(one.model), kind) is filter_loop(traced(other.model), kind)
    assert one.value(values) != other.value(values)
    same = values | {"cabinet_temperature_noise": math.sqrt(values["cabinet_temperature_noise"] ** 2 + 0.04)}
    # f + a (T − 280) is (f + 10 a) + a (T − 290), and the noises add in quadrature
    noise = math.sqrt(same["cabinet_temperature_noise"] ** 2 + (0.1**2 - 0.5**2) / 12.0)
    back = values | {
        "heat_release_operation": values["heat_release_operation"] + 10.0 * -0.1,
        "cabinet_temperature_noise": noise,
    }
    assert other.value(back) == pytest.approx(one.value(same), rel=1e-12)
    value, score = other.score(back)
    assert len(score) == len(values) and value == pytest.approx(one.score(same)[0], rel=1e-12)
    assert score[0] == pytest.approx(one.score(same)[1][0], rel=1e-9)
