"""The likelihood against the joint Gaussian of all readings, statsmodels, closed forms; its derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from builders.linear_oracles import (
    first_of,
    thermal_force,
    thermal_matrices,
    van_loan,
)
from builders.scores import check_score
from scipy.integrate import solve_ivp
from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.physics.expression import exp
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.mechanisms.hygric import hygric_diffusion, hygric_exchange, vapour_disturbance
from hygrokf.physics.mechanisms.sensors import absolute_humidity_sensor
from hygrokf.physics.mechanisms.thermal import measured_air
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter

AGREE = 1e-9


# -- the joint Gaussian of all readings ----------------------------------------------------------------------
@dataclass(frozen=True)
class Linear:
    """dx = (A x + b) dt + dW, cov dW = Q dt, from a Gaussian at the first of `time` (T,) [h].

    A and b are functions of the time and of the step (by the instant that ends it): power jumps at instants.
    """

    a: Callable[[float, int], np.ndarray]
    b: Callable[[float, int], np.ndarray]
    q: np.ndarray
    first: Gaussian
    time: np.ndarray

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (T n,) and covariance (T n, T n) of the states at all instants together."""
        n, count = len(self.q), len(self.time)
        mean, covariance = np.empty((count, n)), np.empty((count, n, count, n))
        mean[0], covariance[0, :, 0] = self.first.mean, self.first.covariance

        def rates(t: float, z: np.ndarray, k: int) -> np.ndarray:
            flow, noise = z[n : n + n * n].reshape(n, n), z[n + n * n :].reshape(n, n)
            a = self.a(t, k)
            spread = a @ noise
            return np.concatenate(
                [a @ z[:n] + self.b(t, k), (a @ flow).ravel(), (spread + spread.T + self.q).ravel()]
            )

        for k in range(1, count):
            start = np.concatenate([mean[k - 1], np.eye(n).ravel(), np.zeros(n * n)])
            span = (self.time[k - 1], self.time[k])
            end = solve_ivp(rates, span, start, args=(k,), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
            flow, noise = end[n : n + n * n].reshape(n, n), end[n + n * n :].reshape(n, n)
            mean[k] = end[:n]
            covariance[k, :, k] = flow @ covariance[k - 1, :, k - 1] @ flow.T + noise
            for j in range(k):
                covariance[k, :, j] = flow @ covariance[k - 1, :, j]
                covariance[j, :, k] = covariance[k, :, j].T
        return mean.ravel(), covariance.reshape(count * n, count * n)


def dense(
    system: Linear, rows: np.ndarray, shift: np.ndarray, variance: np.ndarray, readings: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Log-density of the readings rows·x + shift + noise, and mean and covariance of the last state given
    them."""
    mean, covariance = system.moments()
    expected = rows @ mean + shift
    spread = rows @ covariance @ rows.T + np.diag(variance)
    error = readings - expected
    factor = np.linalg.cholesky(spread)
    white = np.linalg.solve(factor, error)
    loglik = -0.5 * white @ white - np.log(np.diag(factor)).sum() - 0.5 * len(error) * math.log(2 * math.pi)
    n = len(system.q)
    gain = np.linalg.solve(spread, rows @ covariance[:, -n:]).T
    return loglik, mean[-n:] + gain @ error, covariance[-n:, -n:] - gain @ rows @ covariance[:, -n:]


def within(case: object, name: str) -> Callable[[float, int], float]:
    """An input at a time within a step, by its hold."""
    time, values = case.timeline.time, case.inputs[name]
    if case.model.holds[name] == "linear":
        return lambda t, k: np.interp(t, time, values)
    return lambda t, k: values[k]


def thermal_system(case: object) -> Linear:
    u = {name: within(case, name) for name in case.inputs}

    def force(t: float, k: int) -> np.ndarray:
        at = (u[name](t, k) for name in ("ambient_temperature", "operating", "power_1"))
        return thermal_force(case.values, *at)

    slope, noise = thermal_matrices(case.values)
    return Linear(lambda t, k: slope, force, noise, first_of(case), case.timeline.time)


def cascade_system(case: object) -> Linear:
    p = case.values
    u = {name: within(case, name) for name in case.inputs}
    colour = p["vapour_disturbance_time"]

    def rate(t: float, k: int) -> float:
        return u["cabinet_temperature"](t, k) * u["exchange_factor"](t, k) / p["hygric_k"]

    def slope(t: float, k: int) -> np.ndarray:
        return np.array([[-rate(t, k), rate(t, k)], [0, -1 / colour]])

    noise = np.diag([p["hygric_diffusion"] ** 2, 2 * p["vapour_disturbance_sd"] ** 2 / colour])

    def force(t: float, k: int) -> np.ndarray:
        return np.array([rate(t, k) * u["ambient_absolute_humidity"](t, k), 0.0])

    return Linear(slope, force, noise, first_of(case), case.timeline.time)


def absolute(case: object) -> object:
    """The cascade with the absolute humidity c* T_amb/T as its reading; the readings are turned by the same
    ratio."""
    mechanisms = [
        measured_air(),
        hygric_exchange(),
        vapour_disturbance(),
        hygric_diffusion(),
        absolute_humidity_sensor(),
    ]
    model = compose(mechanisms, case.model.holds)
    grams = 30.0 * case.readings["cabinet_relative_humidity"] - 5.0
    values = {n: v for n, v in case.values.items() if "relative" not in n} | {
        "cabinet_absolute_humidity_noise": 0.05
    }
    readings = {"cabinet_absolute_humidity": grams}
    made = timeline(model, case.timeline.time, case.inputs, readings)
    return replace(case, model=model, timeline=made, values=values, readings=readings, resets={})


def compare(case: object, expected: tuple[float, np.ndarray, np.ndarray], states: int) -> None:
    found = case.likelihood.trace(case.values)
    assert found.loglik == pytest.approx(expected[0], rel=AGREE)
    assert case.likelihood.value(case.values) == pytest.approx(expected[0], rel=AGREE)
    np.testing.assert_allclose(found.mean[-1][:states], expected[1][:states], rtol=AGREE, atol=AGREE)
    np.testing.assert_allclose(
        found.covariance[-1][:states, :states], expected[2][:states, :states], rtol=1e-8, atol=AGREE
    )


def test_thermal_filter_is_the_joint_gaussian(thermal: object) -> None:
    case = thermal.first(50)
    p, ratio = case.values, case.values["resistance_ratio"]
    read = case.readings["cabinet_temperature"]
    seen = np.flatnonzero(~np.isnan(read))
    rows = np.zeros((len(seen), 2 * len(read)))
    rows[np.arange(len(seen)), 2 * seen] = ratio
    shift = (1 - ratio) * case.inputs["ambient_temperature"][seen] + p["cabinet_temperature_bias"]
    variance = np.full(len(seen), p["cabinet_temperature_noise"] ** 2)
    compare(case, dense(thermal_system(case), rows, shift, variance, read[seen]), 2)


def test_cascade_filter_is_the_joint_gaussian_in_the_limit_of_small_sub_steps(cascade: object) -> None:
    case = absolute(cascade.first(50))
    read = case.readings["cabinet_absolute_humidity"]
    seen = np.flatnonzero(~np.isnan(read))
    rows = np.zeros((len(seen), 2 * len(read)))
    rows[np.arange(len(seen)), 2 * seen] = (
        case.inputs["ambient_temperature"] / case.inputs["cabinet_temperature"]
    )[seen]
    variance = np.full(len(seen), case.values["cabinet_absolute_humidity_noise"] ** 2)
    expected = dense(cascade_system(case), rows, np.zeros(len(seen)), variance, read[seen])
    time = case.timeline.time
    fine = case.split(np.concatenate([time[:-1] + np.diff(time) * i / 16 for i in range(1, 16)]))
    compare(fine, expected, 2)


def with_integral(system: Linear, row: np.ndarray, shift: Callable[[float, int], float]) -> Linear:
    """The system with the running integral of row·x + shift since the first instant as one more state."""
    n = len(system.q)

    def a(t: float, k: int) -> np.ndarray:
        return np.block([[system.a(t, k), np.zeros((n, 1))], [row[None], np.zeros((1, 1))]])

    first = Gaussian(np.append(system.first.mean, 0.0), np.pad(system.first.covariance, (0, 1)))
    noise = np.pad(system.q, (0, 1))
    return Linear(a, lambda t, k: np.append(system.b(t, k), shift(t, k)), noise, first, system.time)


def test_readings_that_are_interval_means_are_differences_of_the_integral(make_case: Callable) -> None:
    """The filter's running mean begins anew at each interval; the oracle never resets and takes
    differences."""
    case = make_case("thermal", 0.25 * np.arange(41), 6, means=True, missing=0.2)
    p, name, ratio = case.values, "cabinet_temperature", case.values["resistance_ratio"]
    ambient = within(case, "ambient_temperature")
    shown = np.array([ratio, 0.0])
    system = with_integral(thermal_system(case), shown, lambda t, k: (1 - ratio) * ambient(t, k))
    read = case.readings[name]
    # a reading stands for two quarters of an hour where the reset between them is left out
    resets = case.resets[name].copy()
    resets[[10, 20]] = False
    read[[10, 20]] = np.nan
    read[[11, 21]] = np.nan  # half an hour is not the model's interval
    seen = np.flatnonzero(~np.isnan(read))
    rows = np.zeros((len(seen), 3 * len(read)))
    rows[np.arange(len(seen)), 3 * seen + 2] = 4.0
    rows[np.arange(len(seen)), 3 * (seen - 1) + 2] = -4.0
    variance = np.full(len(seen), p[f"{name}_noise"] ** 2)
    # the sensor's bias is added to the mean as to an instant
    shift = np.full(len(seen), p[f"{name}_bias"])
    expected = dense(system, rows, shift, variance, read[seen])
    made = timeline(case.model, case.timeline.time, case.inputs, {name: read}, {name: resets})
    compare(replace(case, timeline=made, readings={name: read}, resets={name: resets}), expected, 2)


# -- statsmodels ---------------------------------------------------------------------------------------------
def two_outputs(count: int, seed: int) -> tuple[Likelihood, dict[str, float], np.ndarray]:
    """A linear network of two states and two sensors, partly missing, at equal steps without inputs."""
    names = ("k1", "k2", "q1", "q2", "r1", "r2")
    made = linear_network(
        "pair",
        [Parameter(n, "1", 1.0, -9.0, 9.0) for n in names],
        ["a", "b"],
        [],
        lambda p, x, u: {"a": p.k1 * (x.b - x.a), "b": -p.k2 * x.b},
        {
            "first": lambda p, x, u: (x.a, exp(p.r1)),
            "second": lambda p, x, u: (x.a + 0.5 * x.b, exp(p.r2)),
        },
        lambda p: {"a": exp(p.q1), "b": exp(p.q2)},
        lambda p, u: {"a": (1.0, 2.0), "b": (-1.0, 0.5)},
    )
    model = compose([made])
    random = np.random.default_rng(seed)
    y = np.cumsum(random.normal(size=(count, 2)), axis=0) * 0.2
    y[random.random((count, 2)) < 0.3] = np.nan
    made_timeline = timeline(model, 0.5 * np.arange(count), {}, {"first": y[:, 0], "second": y[:, 1]})
    values = {"k1": 0.8, "k2": 0.2, "q1": -1.0, "q2": -0.5, "r1": -2.0, "r2": -1.5}
    return Likelihood(model, made_timeline), values, y


def matrices(values: dict[str, float], h: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise of the pair by Van Loan."""
    a = np.array([[-values["k1"], values["k1"]], [0, -values["k2"]]])
    return van_loan(a, np.diag([math.exp(values["q1"]), math.exp(values["q2"])]), h)


def in_statsmodels(values: dict[str, float], y: np.ndarray) -> KalmanFilter:
    f, q = matrices(values, 0.5)
    made = KalmanFilter(2, 2)
    made["design"] = np.array([[1.0, 0.0], [1.0, 0.5]])
    made["obs_cov"] = np.diag([math.exp(values["r1"]), math.exp(values["r2"])])
    made["transition"], made["selection"], made["state_cov"] = f, np.eye(2), q
    made.bind(np.ascontiguousarray(y))
    return made


def test_two_sensors_missing_one_by_one_agree_with_statsmodels() -> None:
    likelihood, values, y = two_outputs(400, 1)
    made = in_statsmodels(values, y)
    made.initialize_known(np.array([1.0, -1.0]), np.diag([2.0, 0.5]))
    expected = made.filter()
    found = likelihood.trace(values)
    assert found.loglik == pytest.approx(expected.llf_obs.sum(), rel=AGREE)
    np.testing.assert_allclose(found.mean, expected.filtered_state.T, rtol=AGREE, atol=AGREE)
    np.testing.assert_allclose(
        found.covariance, expected.filtered_state_cov.transpose(2, 0, 1), rtol=AGREE, atol=AGREE
    )
    np.testing.assert_allclose(found.prior_mean, expected.predicted_state.T[:-1], rtol=AGREE, atol=AGREE)


@pytest.mark.parametrize("states", [("a", "b"), ("b",)])
def test_exact_diffuse_starts_agree_with_statsmodels(states: tuple[str, ...]) -> None:
    from statsmodels.tsa.statespace.initialization import Initialization

    likelihood, values, y = two_outputs(120, 2)
    y[:3, 0] = np.nan
    y[1, 1] = np.nan
    made = in_statsmodels(values, y)
    start = Initialization(2)
    for place, name in enumerate(("a", "b")):
        if name in states:
            start.set(place, "diffuse")
        else:
            start.set(place, "known", constant=np.array([1.0]), stationary_cov=np.array([[2.0]]))
    made.initialize(start)
    made.set_filter_method(filter_univariate=True)  # readings one by one, as here
    changed = likelihood.timeline.with_readings(y)
    diffuse = replace(likelihood, timeline=changed, initial="diffuse", diffuse_states=states)
    assert diffuse.value(values) == pytest.approx(made.loglike(), rel=AGREE)
    check_score(diffuse, values)


def test_the_stationary_start_of_the_joint_model_is_an_equilibrium(joint: object) -> None:
    likelihood = replace(joint.likelihood, initial="stationary")
    first = likelihood.first_gaussian(joint.values)
    u = {n: v[0] for n, v in joint.inputs.items()}
    rates = joint.model.evaluate(list(first.mean), u, joint.values).rates
    np.testing.assert_allclose(rates, 0.0, atol=1e-11)
    assert first.mean[2] == pytest.approx(u["ambient_absolute_humidity"], rel=1e-12)
    assert np.linalg.eigvalsh(first.covariance).min() > 0


def test_a_model_without_stationary_state_says_so() -> None:
    walk = linear_network(
        "walk", [Parameter("q", "1", 1.0, 0.0, 9.0)], ["x"], [], lambda p, x, u: {"x": 0.1 * x.x},
        {"y": lambda p, x, u: (x.x, 1.0)}, lambda p: {"x": p.q}, lambda p, u: {"x": (0.0, 1.0)},
    )  # fmt: skip
    model = compose([walk])
    likelihood = Likelihood(model, timeline(model, np.arange(3.0), {}, {"y": np.zeros(3)}), "stationary")
    with pytest.raises(ValueError, match=r"stationary.*'prior', 'diffuse'"):
        likelihood.value({"q": 1.0})


# -- derivatives ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["thermal", "joint", "averaged"])
def test_score_is_the_central_difference_and_the_sensitivities_score(
    name: str, request: pytest.FixtureRequest
) -> None:
    """All base models; `averaged` has interval means with resets, pre-heating and a gap in the power (a
    regime)."""
    case = request.getfixturevalue(name)
    moved = {n: v * 1.1 for n, v in case.values.items()} | {"resistance_ratio": 0.8}  # not at the optimum
    check_score(case.likelihood, {n: moved[n] for n in case.values})


def test_directions_combine_the_parameters(joint: object) -> None:
    likelihood = joint.first(200).likelihood
    random = np.random.default_rng(6)
    directions = random.normal(size=(len(joint.values), 11))  # more than one block of lanes
    full = likelihood.sensitivities(joint.values, np.eye(len(joint.values)))
    some = likelihood.sensitivities(joint.values, directions)
    np.testing.assert_allclose(some.score, full.score @ directions, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(some.information, directions.T @ full.information @ directions, rtol=1e-8)


def test_free_run_residuals_and_their_slopes(averaged: object) -> None:
    averaged = averaged.first(300)
    likelihood = averaged.likelihood
    names = list(averaged.values)
    e, slopes = likelihood.residuals(averaged.values, np.eye(len(names)))
    free = likelihood.trace(averaged.values, gain=False)
    np.testing.assert_allclose(e, averaged.timeline.y - free.prediction, rtol=0, atol=1e-9)
    for i, name in enumerate(names):
        step = 1e-5 * max(abs(averaged.values[name]), 0.1)
        up, down = (
            likelihood.trace(averaged.values | {name: averaged.values[name] + s}, gain=False).prediction
            for s in (step, -step)
        )
        expected = np.where(np.isnan(e), 0.0, -(up - down) / (2 * step))
        seen = np.where(np.isnan(e), 0.0, slopes[..., i])
        np.testing.assert_allclose(seen, expected, rtol=1e-5, atol=1e-6 * max(1.0, np.abs(expected).max()))


def test_a_run_in_chunks_is_the_same_run(joint: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step has a length of its own, so that a chunk tabulates fewer distinct steps than the run has."""
    values, likelihood = joint.values, joint.likelihood
    directions = np.eye(len(joint.model.parameters))
    line = likelihood.timeline
    own = line.steps[line.key]
    own[:, 0] *= 1.0 + 0.1 * np.random.default_rng(3).random(len(own))
    own_key = np.arange(len(own), dtype=line.key.dtype)
    likelihood = replace(likelihood, timeline=replace(line, steps=own, key=own_key))

    def run(chunk: int) -> tuple[np.ndarray, ...]:
        monkeypatch.setattr("hygrokf.estimation.likelihood.CHUNK", chunk)
        trace, (e, de) = likelihood.trace(values), likelihood.residuals(values, directions)
        return trace.mean, trace.covariance, trace.variance, e, de, likelihood.slopes(values, directions)

    whole = run(1_000_000)
    for chunk in (7, 100):
        for one, other in zip(whole, run(chunk), strict=True):
            np.testing.assert_array_equal(one, other)
    assert len(own) > 200 and np.isfinite(whole[-1]).any()


def test_expected_information_is_the_covariance_of_the_score() -> None:
    """A small linear model simulated 3,000 times from its own joint Gaussian.

    Oracles: the sample covariance of the scores (standard error of a variance √(2/3000) = 2.6 %, bound four
    of it) and Fisher's formula ∂μ'S⁻¹∂μ + ½ tr(S⁻¹∂S S⁻¹∂S) of the joint Gaussian by differences, which the
    mean of the information must meet within four of its own standard errors.
    """
    count, runs = 30, 3000
    likelihood, values, _ = two_outputs(count, 4)
    names = list(values)

    def joint_covariance(at: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        f, q = matrices(at, 0.5)
        rows = np.array([[1.0, 0.0], [1.0, 0.5]])
        means, blocks = [np.array([1.0, -1.0])], [np.diag([2.0, 0.5])]
        for _ in range(count - 1):
            means.append(f @ means[-1])
            blocks.append(f @ blocks[-1] @ f.T + q)
        covariance = np.zeros((count, 2, count, 2))
        for j in range(count):
            block = blocks[j]
            for k in range(j, count):
                covariance[k, :, j], covariance[j, :, k] = rows @ block @ rows.T, (rows @ block @ rows.T).T
                block = f @ block
            covariance[j, :, j] += np.diag([math.exp(at["r1"]), math.exp(at["r2"])])
        return np.concatenate([rows @ m for m in means]), covariance.reshape(2 * count, 2 * count)

    mean, covariance = joint_covariance(values)
    slopes = []
    for name in names:
        up, down = (joint_covariance(values | {name: values[name] + s}) for s in (1e-5, -1e-5))
        slopes.append([(a - b) / 2e-5 for a, b in zip(up, down, strict=True)])
    inverse = np.linalg.inv(covariance)
    fisher = np.array(
        [
            [a[0] @ inverse @ b[0] + 0.5 * np.trace(inverse @ a[1] @ inverse @ b[1]) for b in slopes]
            for a in slopes
        ]
    )
    draws = np.random.default_rng(9).multivariate_normal(mean, covariance, size=runs).reshape(runs, count, 2)
    scores, information = np.empty((runs, len(names))), np.empty((runs, len(names), len(names)))
    for i, y in enumerate(draws):
        one = replace(likelihood, timeline=likelihood.timeline.with_readings(y))
        found = one.sensitivities(values, np.eye(len(names)))
        scores[i], information[i] = found.score, found.information
    root = np.sqrt(np.diag(fisher))
    scale = np.outer(root, root)
    error = information.std(axis=0) / math.sqrt(runs)
    assert np.all(np.abs(information.mean(axis=0) - fisher) < 4 * error + 1e-6 * scale)
    assert np.all(error < 0.05 * scale)
    np.testing.assert_allclose(np.cov(scores.T) / scale, fisher / scale, atol=4 * math.sqrt(2 / runs))
    np.testing.assert_allclose(scores.mean(axis=0) / root, 0.0, atol=4 / math.sqrt(runs))
