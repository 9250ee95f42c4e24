"""Starts and readings at which doubles lose their digits: exact against 200 digits, or refused.

The oracle is `builders.many_digits`.  ln L is asked to 1e-6, the loss that plain covariances are allowed;
what is computed in factors is a hundred times better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from builders.many_digits import decay, filtered, trend
from builders.scores import check_score

from hygrokf.engine.gaps import widened, widened_slopes
from hygrokf.engine.square_root import factored, factored_slopes
from hygrokf.engine.timeline import timeline
from hygrokf.engine.traced_filter import Recursion
from hygrokf.estimation.inference import confidence_intervals
from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.estimation.moments import DigitsFault
from hygrokf.estimation.optimiser import fit_mle
from hygrokf.estimation.smoother import smoothed_states, to_filterpy
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter

ONE = {"one": 1.0}
WIDE = {"noise": 0.25, "wide": 1.0, "place": 0.1, "speed": 0.3}
PARAMETERS = [Parameter("one", "1", 1.0, 0.5, 2.0, positive=True)]


def moving(sensors: int = 1) -> Model:
    """A position with a random velocity; every output reads the position."""
    made = linear_network(
        "moving", [Parameter(name, "1", 1.0, 0.0, 1e30) for name in WIDE], ["place", "speed"], [],
        lambda p, x, u: {"place": x.speed, "speed": 0.0 * x.speed},
        {f"y{j}": lambda p, x, u: (x.place * 1.0, p.noise) for j in range(sensors)},
        lambda p: {"place": p.place, "speed": p.speed},
        lambda p, u: {"place": (0.0, p.wide), "speed": (0.0, p.wide)},
    )  # fmt: skip
    return compose([made])


def returning(tau: float, gain: float, noise: tuple[float, ...], intensity: float, variance: float) -> Model:
    made = linear_network(
        "returning", PARAMETERS, ["x"], [], lambda p, x, u: {"x": -p.one * x.x / tau},
        {f"y{j}": lambda p, x, u, r=r: (gain * x.x, r * p.one) for j, r in enumerate(noise)},
        lambda p: {"x": intensity * p.one}, lambda p, u: {"x": (0.0, variance)},
    )  # fmt: skip
    return compose([made])


def line(model: Model, time: np.ndarray, y: np.ndarray):
    return timeline(model, time, {}, {f"y{j}": y[:, j] for j in range(y.shape[1])})


# -- covariances ---------------------------------------------------------------------------------------------
WIDTHS = [1.0, 1e4, 1e8, 1e12, 1e16, 1e20]
NOISES = [1.0, 1e-4, 1e-8, 1e-12, 1e-16]


@pytest.mark.parametrize("sensors", [1, 2])
def test_wide_starts_and_exact_readings_have_all_digits_or_are_refused(sensors: int) -> None:
    """Variances of the start from 1 to 1e20 by variances of the readings from 1 to 1e-16."""
    random = np.random.default_rng(0)
    time = np.arange(40.0) / 10
    truth = np.cumsum(random.normal(0.0, 0.1, 40))
    model, refused = moving(sensors), 0
    for wide in WIDTHS:
        for noise in NOISES:
            y = truth[:, None] + np.sqrt(noise) * np.arange(sensors)
            values = {"noise": noise, "wide": wide, "place": 0.0, "speed": 0.01}
            likelihood = Likelihood(model, line(model, time, y))
            try:
                found, trace = likelihood.value(values), likelihood.trace(values)
                smoothed = smoothed_states(likelihood, values)[1]
            except DigitsFault as fault:
                assert "narrower start" in str(fault) and wide / noise > 1e22
                refused += 1
                continue
            steps = [trend(b - a, (0.0, 0.01)) for a, b in pairwise(time)]
            rows, start = [[1.0, 0.0]] * sensors, ([0.0, 0.0], [wide, wide])
            expected, means, covariances = filtered(steps, rows, [noise] * sensors, start, y)
            assert found == pytest.approx(expected, abs=1e-6)
            assert likelihood.score(values)[0] == pytest.approx(expected, abs=1e-6)
            assert trace.loglik == pytest.approx(expected, abs=1e-6)
            for some in (trace.prior_covariance, trace.covariance, smoothed):
                assert np.einsum("tii->ti", some).min() >= 0.0
            spread = np.sqrt(np.einsum("tii->ti", covariances))
            assert np.max(np.abs(trace.mean - means) / spread) < 1e-5
    assert 0 < refused < 12


@pytest.mark.parametrize("bound", [np.inf, 3.0])
@pytest.mark.parametrize(
    "name",
    [
        "thermal",
        pytest.param("joint", marks=pytest.mark.slow),
        pytest.param("averaged", marks=pytest.mark.slow),
    ],
)
def test_factors_are_the_same_filter(name: str, bound: float, request: pytest.FixtureRequest) -> None:
    """Several outputs, gaps in the readings, regimes, running means that begin anew, and the bound."""
    case = request.getfixturevalue(name).first(200)
    model, eye = replace(case.model, bound=bound), np.eye(len(case.values))
    plain = Likelihood(model, case.timeline)
    factors = replace(plain, square_root=True)
    assert factors.value(case.values) == pytest.approx(plain.value(case.values), rel=1e-12)
    np.testing.assert_allclose(
        factors.score(case.values)[1], plain.score(case.values)[1], rtol=1e-9, atol=1e-8
    )
    one, other = (some.sensitivities(case.values, eye) for some in (plain, factors))
    scale = np.sqrt(np.diag(one.information))
    assert np.all(np.abs(other.information - one.information) <= 1e-10 * np.outer(scale, scale))
    a, b = plain.trace(case.values), factors.trace(case.values)
    np.testing.assert_allclose(b.mean, a.mean, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-9, atol=1e-13)
    for x, y in zip(smoothed_states(plain, case.values), smoothed_states(factors, case.values), strict=True):
        np.testing.assert_allclose(y, x, rtol=1e-9, atol=1e-10)


def test_factors_cross_long_steps(thermal: object) -> None:
    """The jump of a long step in both forms."""
    case = thermal.first(60)
    steps = np.vstack([case.timeline.steps, [*case.timeline.steps[0]]])
    steps[-1, 0] = 2.0e4
    key = case.timeline.key.copy()
    key[30] = len(steps) - 1
    plain = Likelihood(case.model, replace(case.timeline, steps=steps, key=key))
    factors = replace(plain, square_root=True)
    assert factors.value(case.values) == pytest.approx(plain.value(case.values), rel=1e-11)
    np.testing.assert_allclose(
        factors.score(case.values)[1], plain.score(case.values)[1], rtol=1e-8, atol=1e-7
    )
    eye = np.eye(len(case.values))
    np.testing.assert_allclose(
        factors.sensitivities(case.values, eye).score, plain.score(case.values)[1], rtol=1e-8, atol=1e-7
    )


def test_exact_readings_have_a_score() -> None:
    """R = 0: the score of the value, where the first reading leaves nothing unknown."""
    made = linear_network(
        "exact", [Parameter("tau", "h", 2.0, 0.1, 9.0), Parameter("q", "1", 0.3, 0.0, 9.0)], ["x"], [],
        lambda p, x, u: {"x": -x.x / p.tau}, {"y": lambda p, x, u: (x.x, 0.0)}, lambda p: {"x": p.q},
        lambda p, u: {"x": (0.0, p.q * p.tau / 2)},
    )  # fmt: skip
    model, random = compose([made]), np.random.default_rng(3)
    likelihood = Likelihood(model, timeline(model, np.arange(30.0) / 2, {}, {"y": random.normal(size=30)}))
    for one in (likelihood, replace(likelihood, initial="diffuse"), replace(likelihood, square_root=True)):
        check_score(one, {"tau": 1.7, "q": 0.4})


# -- diffuse starts ------------------------------------------------------------------------------------------
@pytest.mark.parametrize("gain", [1.0, 1e-3, 3e-5, 1e-6, 1e-12])
def test_a_diffuse_start_has_no_unit(gain: float) -> None:
    """A heat content in J with a reading in K: gains that an absolute floor takes for nothing."""
    random, time = np.random.default_rng(2), np.arange(40.0) / 6
    y = (293.0 + np.cumsum(random.normal(0.0, 0.1, 40)))[:, None]
    model = returning(2.0, gain, (0.01,), (0.3 / gain) ** 2, 1.0)
    likelihood = Likelihood(model, line(model, time, y), initial="diffuse")
    steps = [decay(h, 2.0, (0.3 / gain) ** 2) for h in np.diff(time)]
    expected, *_ = filtered(steps, [[gain]], [0.01], ([0.0], [1.0]), y, [0])
    assert likelihood.value(ONE) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("hours", [0.1, 1.0, 100.0, 1e3, 1e5])
def test_a_trend_with_long_steps_is_known_once(hours: float) -> None:
    """Rounding of what two readings have told does not count as unknown again."""
    random = np.random.default_rng(3)
    time = np.concatenate([[0.0], np.cumsum(hours * (1.0 + random.random(12)))])
    y = (20.0 + 0.001 * time + random.normal(0.0, 0.5, 13))[:, None]
    y[1] = np.nan
    values = WIDE | {"place": 1e-4, "speed": 1e-12}
    model = moving()
    likelihood = Likelihood(model, line(model, time, y), initial="diffuse")
    steps = [trend(h, (1e-4, 1e-12)) for h in np.diff(time)]
    expected, means, covariances = filtered(steps, [[1.0, 0.0]], [0.25], ([0.0] * 2, [1.0] * 2), y, [0, 1])
    assert likelihood.value(values) == pytest.approx(expected, abs=1e-9)
    assert replace(likelihood, square_root=True).value(values) == pytest.approx(expected, abs=1e-9)
    trace = likelihood.trace(values)
    np.testing.assert_allclose(trace.mean[3:], means[3:], rtol=1e-8)
    np.testing.assert_allclose(trace.covariance[3:], covariances[3:], rtol=1e-7)
    assert np.isinf(trace.covariance[:2, 1, 1]).all() and np.isfinite(trace.covariance[2:]).all()
    assert np.isinf(trace.variance[[0, 1, 2], 0]).tolist() == [True, True, True]
    assert trace.covariance[0, 0, 0] == pytest.approx(0.25)


def test_readings_that_begin_late() -> None:
    """Named, a state is unknown at the first instant, and its decay counts; by default nothing is known at
    the first reading, so that what lies before it changes nothing."""
    random, time = np.random.default_rng(4), np.concatenate([[0.0], 20.0 + np.arange(30.0) / 6])
    y = np.concatenate([[np.nan], random.normal(0.0, 0.5, 30)])[:, None]
    for tau in (0.5, 1.2, 1.93, 1.94):
        model = returning(tau, 1.0, (0.01,), 0.25, 1.0)
        whole = Likelihood(model, line(model, time, y), initial="diffuse")
        steps = [decay(h, tau, 0.25) for h in np.diff(time)]
        named = replace(whole, diffuse_states=("x",)).value(ONE)
        assert named == pytest.approx(filtered(steps, [[1.0]], [0.01], ([0.0], [1.0]), y, [0])[0], abs=1e-9)
        late = filtered(steps[1:], [[1.0]], [0.01], ([0.0], [1.0]), y[1:], [0])[0]
        assert whole.value(ONE) == pytest.approx(late, abs=1e-9)


def test_bounds_of_a_late_diffuse_start_hold_the_truth() -> None:
    """300 readings from 20 h on of a state with the time constant 1.2 h."""
    parameters = [Parameter("tau", "h", 2.0, 0.01, 100.0, positive=True)]
    made = linear_network(
        "box", parameters, ["x"], [], lambda p, x, u: {"x": (280.0 - x.x) / p.tau},
        {"y": lambda p, x, u: (x.x, 0.01)}, lambda p: {"x": 0.25}, lambda p, u: {"x": (280.0, 100.0)},
    )  # fmt: skip
    model, random, x, y = compose([made]), np.random.default_rng(4), 280.0, [np.nan]
    keep, spread = np.exp(-1 / 6 / 1.2), np.sqrt(0.25 * 0.6 * (1.0 - np.exp(-2 / 6 / 1.2)))
    for _ in range(300):
        x += (280.0 - x) * (1.0 - keep) + spread * random.normal()
        y.append(x + 0.1 * random.normal())
    time = np.concatenate([[0.0], 20.0 + np.arange(300) / 6])
    likelihood = Likelihood(model, timeline(model, time, {}, {"y": np.array(y)}), initial="diffuse")
    found = confidence_intervals(likelihood, fit_mle(likelihood, count=2), ["tau"])["tau"]
    assert found.lower < 1.2 < found.upper


@pytest.mark.parametrize("states", [("place", "speed"), ("speed",)])
def test_smoothing_from_a_diffuse_start_is_the_regression(states: tuple[str, ...]) -> None:
    """Generalised least squares of all states on the readings: the unknown start is a free coefficient."""
    random, time = np.random.default_rng(5), np.cumsum([0.0, 0.3, 0.2, 1.1, 0.4, 0.4, 2.0, 0.1])
    y = random.normal(5.0, 1.0, (8, 1))
    y[[0, 3]] = np.nan
    model = moving()
    likelihood = Likelihood(model, line(model, time, y), initial="diffuse", diffuse_states=states)
    unknown = [i for i, name in enumerate(("place", "speed")) if name in states]
    first = np.diag([0.0 if i in unknown else 1.0 for i in range(2)])
    f, covariance = [np.eye(2)], [first]
    for h in np.diff(time):
        step, noise = (np.array(part, dtype=float) for part in trend(h, (0.1, 0.3)))
        f.append(step @ f[-1])
        covariance.append(step @ covariance[-1] @ step.T + noise)
    joint = np.zeros((16, 16))
    for k in range(8):
        for j in range(k, 8):
            block = f[j] @ np.linalg.inv(f[k]) @ covariance[k]
            joint[2 * j : 2 * j + 2, 2 * k : 2 * k + 2] = block
            joint[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = block.T
    seen = np.flatnonzero(np.isfinite(y[:, 0]))
    h = np.zeros((len(seen), 16))
    h[np.arange(len(seen)), 2 * seen] = 1.0
    loads = np.vstack(f)[:, unknown]
    s = np.linalg.inv(h @ joint @ h.T + 0.25 * np.eye(len(seen)))
    information = (h @ loads).T @ s @ (h @ loads)
    start = np.linalg.solve(information, (h @ loads).T @ s @ y[seen, 0])
    gain = joint @ h.T @ s
    mean = loads @ start + gain @ (y[seen, 0] - h @ loads @ start)
    rest = loads - gain @ h @ loads
    spread = joint - gain @ h @ joint + rest @ np.linalg.solve(information, rest.T)
    found, around = smoothed_states(likelihood, WIDE)
    np.testing.assert_allclose(found.ravel(), mean, rtol=1e-9)
    for k in range(8):
        np.testing.assert_allclose(
            around[k], spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], rtol=1e-9, atol=1e-10
        )


def test_what_no_reading_tells_stays_infinite() -> None:
    """One reading of a place says nothing of its speed, at any instant."""
    model = moving()
    y = np.full((4, 1), np.nan)
    y[2] = 3.0
    likelihood = Likelihood(model, line(model, np.arange(4.0), y), initial="diffuse")
    mean, around = smoothed_states(likelihood, WIDE)
    assert np.isinf(around[:, 1, 1]).all() and np.isinf(around[[0, 1, 3], 0, 0]).all()
    assert around[2, 0, 0] == pytest.approx(0.25) and mean[2, 0] == pytest.approx(3.0)


def test_an_unstable_model_resolves_its_start_and_goes_on() -> None:
    """Loadings that grow by e^2000 if they are kept beside a filter that readings hold."""
    made = linear_network(
        "grows", PARAMETERS, ["x"], [], lambda p, x, u: {"x": p.one * x.x},
        {"y": lambda p, x, u: (x.x, 0.01)}, lambda p: {"x": 0.1}, lambda p, u: {"x": (0.0, 1.0)},
    )  # fmt: skip
    model = compose([made])
    y = np.random.default_rng(1).normal(size=2000)
    likelihood = Likelihood(model, timeline(model, np.arange(2000.0), {}, {"y": y}), initial="diffuse")
    value, score = likelihood.score(ONE)
    assert np.isfinite(value) and np.isfinite(score).all()


def test_a_diffuse_start_is_not_exported_but_what_follows_is(thermal: object, make_case: Callable) -> None:
    case = make_case("thermal", 0.25 * np.arange(60), 8)
    diffuse = replace(case.likelihood, initial="diffuse")
    with pytest.raises(ValueError, match="finite variances, found a diffuse start"):
        to_filterpy(diffuse, case.values)
    line, values = case.timeline, case.values
    begun = replace(diffuse, timeline=line.window(0, 20)).trace(values).last
    rest = replace(diffuse, timeline=line.window(20, 60), initial=Gaussian(begun.mean, begun.covariance))
    made, trace, total = to_filterpy(rest, values), diffuse.trace(values), 0.0
    for k in range(40):
        made.advance(k)
        total += made.observe(k)
        np.testing.assert_allclose(made.x, trace.mean[20 + k], rtol=1e-9, atol=1e-8)
    first = replace(diffuse, timeline=line.window(0, 20)).value(values)
    assert total + first == pytest.approx(diffuse.value(values), abs=1e-7)


# -- derivatives of factors ----------------------------------------------------------------------------------
@pytest.mark.parametrize("rank", [4, 2])
def test_slopes_of_factors_are_central_differences(rank: int) -> None:
    """Of a covariance of full rank, and of one with states that are known exactly."""
    random = np.random.default_rng(rank)
    known = np.zeros((4, 4))
    known[[0, 2, 1, 3][:rank], [0, 2, 1, 3][:rank]] = 1.0
    roots = [known @ random.normal(size=(4, 4)) for _ in range(4)]
    covariance, *slopes = [root @ root.T for root in roots]
    step = 1e-5
    expected = [
        (factored(covariance + step * slope) - factored(covariance - step * slope)) / (2 * step)
        for slope in slopes
    ]
    found = factored_slopes(covariance, np.array(slopes))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("is_factored", [True, False])
def test_slopes_of_widened_moments_are_central_differences(averaged: object, is_factored: bool) -> None:
    """With a running mean, whose row of the factor has a diagonal of its own."""
    recursion = Recursion(averaged.model, 1, is_factored)
    random = np.random.default_rng(3)
    root, added = random.normal(size=(recursion.n, recursion.n)), random.uniform(0.1, 1.0, recursion.n)
    state = recursion.packed_moments(random.normal(size=recursion.n), root @ root.T)
    state[recursion.loaded :] = random.normal(size=len(state) - recursion.loaded)
    step = 1e-5
    expected = [
        (widened(recursion, state + move, added) - widened(recursion, state - move, added)) / (2 * step)
        for move in step * np.eye(len(state))
    ]
    found = widened_slopes(recursion, state, added)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
