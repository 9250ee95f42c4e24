"""Linear models whose time constants lie orders apart, against a Kalman filter in decimals of 60 digits."""

from __future__ import annotations

import math
import time
from decimal import Decimal, localcontext

import numpy as np
import pytest

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.batch_filter import SideBySide
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import fit_mle
from hygrokf.estimation.smoother import transition
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter

VALUES = {"a": 1.0}
NOISE = Decimal.from_float(0.1)
TEN_MINUTES = np.arange(30) / 6.0
YEAR_H = 8766.0
ROTATION = 2.0 * math.pi * 60.0


def model(rates: list[list[float]], noise: list[float], seen: int) -> Model:
    """dx = a A x dt + dw, y = x[seen] + e, e ~ N(0, 0.1); x(0) ~ N(0, I)."""
    n = len(rates)
    states = [f"x{i}" for i in range(n)]

    def drift(p: object, x: object, u: object) -> dict:
        return {
            s: sum((p.a * rates[i][j] * getattr(x, states[j]) for j in range(n) if rates[i][j]), 0.0)
            for i, s in enumerate(states)
        }

    return compose([
        linear_network(
            "network", [Parameter("a", "1", 1.0, 0.5, 2.0, positive=True)], states, [], drift,
            {"y": lambda p, x, u: (getattr(x, states[seen]), 0.1)},
            lambda p: dict(zip(states, noise, strict=True)), lambda p, u: {s: (0.0, 1.0) for s in states},
        )
    ])  # fmt: skip


def exact(rates: list[list[float]], noise: list[float], seen: int, hours: np.ndarray, y: np.ndarray) -> float:
    """ln L by scaling, Taylor's series of 40 terms and squaring, in decimals of 60 digits."""
    with localcontext() as context:
        context.prec, n = 60, len(rates)
        context.Emin, context.Emax = -(10**9), 10**9
        a = np.array([[Decimal(v) for v in row] for row in rates])
        q = np.array([[Decimal(noise[i] if i == j else 0.0) for j in range(n)] for i in range(n)])
        eye = np.array([[Decimal(int(i == j)) for j in range(n)] for i in range(n)])

        def over(h: Decimal) -> tuple[np.ndarray, np.ndarray]:
            times = max(0, math.ceil(math.log2(float(max(abs(a).sum(axis=1)) * h) + 1e-9)) + 4)
            short = h / 2**times
            f, term, gained, spread = eye, eye, q * short, q * short
            for k in range(1, 40):
                term = term.dot(a) * short / k
                f = f + term
                half = a.dot(spread) * short / (k + 1)
                spread = half + half.T
                gained = gained + spread
            for _ in range(times):
                gained, f = gained + f.dot(gained).dot(f.T), f.dot(f)
            return f, gained

        m, p, total, known = np.array([Decimal(0)] * n), eye, Decimal(0), {}
        for k in range(len(hours)):
            if k:
                h = round((Decimal(hours[k]) - Decimal(hours[k - 1])) * 3600000000) / Decimal(3600000000)
                f, gained = known.setdefault(h, None) or over(h)
                known[h] = f, gained
                m, p = f.dot(m), f.dot(p).dot(f.T) + gained
            s, e = p[seen, seen] + NOISE, Decimal(y[k]) - m[seen]
            total -= ((2 * Decimal(math.pi) * s).ln() + e * e / s) / 2
            gain = p[:, seen] / s
            m, p = m + gain * e, p - np.outer(gain, p[seen])
        return float(total)


CASES = {
    "a second beside a year": ([[-3600.0, 1800.0], [1 / YEAR_H, -1 / YEAR_H]], [1.0, 0.01], 0, TEN_MINUTES),
    "a microsecond": ([[-3.6e9, 0.0], [0.5, -0.5]], [1e3, 0.01], 1, TEN_MINUTES),
    "a gap of ten years": (
        [[-3600.0, 1800.0], [1 / YEAR_H, -1 / YEAR_H]], [1.0, 0.01], 0,
        np.concatenate([TEN_MINUTES, 10.0 * YEAR_H + TEN_MINUTES]),
    ),
    "an undamped oscillator": ([[0.0, ROTATION], [-ROTATION, 0.0]], [0.0, 1.0], 0, TEN_MINUTES),
    "one way, steep": ([[-1.0, 1e6], [0.0, -1.0]], [0.1, 0.1], 1, TEN_MINUTES),
    "a ring of three": (
        [[-0.1, 30.0, 0.0], [0.0, -0.1, 30.0], [-30.0, 0.0, -0.1]], [0.1, 0.1, 0.1], 0, TEN_MINUTES[:8],
    ),
    "a ring that grows": (
        [[-1.0, 1e3, 0.0], [0.0, -1.0, 1e3], [1e3, 0.0, -1.0]], [0.1, 0.1, 0.1], 0, TEN_MINUTES[:6] / 1e3,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("rates", "noise", "seen", "hours"), CASES.values(), ids=CASES)
def test_a_stiff_model_is_the_decimal_one(
    rates: list[list[float]], noise: list[float], seen: int, hours: np.ndarray
) -> None:
    """To 1e-11 of ln L: some hundred roundings of 1e-16 at each of some ten instants."""
    made, y = model(rates, noise, seen), np.random.default_rng(5).normal(size=len(hours))
    likelihood = Likelihood(made, timeline(made, hours, {}, {"y": y}))
    expected = exact(rates, noise, seen, hours, y)
    assert likelihood.value(VALUES) == pytest.approx(expected, rel=1e-11)
    assert likelihood.steps_per_instant(VALUES) == 1.0
    value, score = likelihood.score(VALUES)
    assert value == pytest.approx(expected, rel=1e-11)
    assert likelihood.sensitivities(VALUES, np.eye(1)).score == pytest.approx(score, rel=1e-8)
    # a fifth-order difference; what rotates by 60 rad a step allows only short steps, of 2e-5
    ahead = {k: likelihood.value({"a": 1.0 + 2e-5 * k}) for k in (-2, -1, 1, 2)}
    slope = (8.0 * (ahead[1] - ahead[-1]) - (ahead[2] - ahead[-2])) / (12.0 * 2e-5)
    assert score == pytest.approx(slope, rel=1e-6, abs=1e-12 * abs(value) / 2e-5)


def test_stiff_runs_side_by_side_are_the_single_ones() -> None:
    """Lanes with numbers of doublings of their own."""
    rates, noise, seen, _ = CASES["a second beside a year"]
    made, lengths = model(rates, noise, seen), np.array([1e-4, 0.2, 30.0, 9e4, 0.0, 7.0])
    runs, expected, first = [], [], []
    for i, hours in enumerate(lengths):
        line = timeline(made, np.array([0.0, max(hours, 1.0)]), {}, {})
        line.steps[1] = hours
        one = Likelihood(made, line)
        values = {"a": 0.5 + 0.2 * i}
        runs.append(values)
        first.append(one.first_gaussian(values).mean)
        expected.append(transition(one, values, 1, first[-1]))
    mean, gained = SideBySide(made, runs).step(np.array(first), lengths, {})
    for i, (own, _, spread) in enumerate(expected):
        np.testing.assert_allclose(mean[i], own, rtol=1e-13)
        np.testing.assert_allclose(gained[i], spread, rtol=1e-12)


def test_a_disturbance_that_is_white_in_truth_is_found_at_no_greater_cost() -> None:
    """A level with a disturbance of some seconds, read every ten minutes: its time constant runs to its lower
    bound of 1 ms, through a rate of 600,000 a step, and costs what any other costs."""
    random = np.random.default_rng(8)
    count, h = 3000, 1.0 / 6.0
    level = np.zeros(count)
    for k in range(1, count):
        level[k] = level[k - 1] * math.exp(-h / 3.0) + 0.3 * math.sqrt(h) * random.normal()
    positive = {"positive": True}
    network = linear_network(
        "level",
        [
            Parameter("tau", "h", 2.0, 0.1, 100.0, **positive),
            Parameter("sigma", "1", 0.2, 1e-3, 10.0, **positive, noise=True),
            Parameter("time", "h", 1.0, 1e-3 / 3600.0, 100.0, **positive, noise=True),
        ],
        ["level", "d"], [],
        lambda p, x, u: {"level": (x.d - x.level) / p.tau, "d": -x.d / p.time},
        {"y": lambda p, x, u: (x.level, 0.01)},
        lambda p: {"level": 0.0, "d": p.sigma**2 / p.time**2},
        lambda p, u: {"level": (0.0, 1.0), "d": (0.0, p.sigma**2 / p.time)},
    )  # fmt: skip
    made = compose([network])
    y = level + 0.1 * random.normal(size=count)
    likelihood = Likelihood(made, timeline(made, h * np.arange(count), {}, {"y": y}))

    def seconds(time_h: float) -> float:
        taken = []
        for _ in range(7):
            begun = time.perf_counter()
            likelihood.score({"tau": 3.0, "sigma": 0.9, "time": time_h})
            taken.append(time.perf_counter() - begun)
        return min(taken)

    seconds(1.0)  # compiles
    assert seconds(1e-3 / 3600.0) < 1.5 * seconds(1.0)
    found = fit_mle(likelihood)
    assert found.converged, found.message
    best = likelihood.value(found.values)
    others = [likelihood.value(found.values | {"time": t}) for t in np.geomspace(1e-6, 10.0, 15)]
    assert best >= max(others) - 1e-6
    assert found.values["tau"] == pytest.approx(3.0, rel=0.15)
