"""Maximum likelihood where the maximum is known in closed form, and on simulated cabinets."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from builders.constant_level import constant_level

from hygrokf.engine.timeline import timeline
from hygrokf.estimation import optimiser
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.newton_steps import bounded_step
from hygrokf.estimation.optimiser import (
    BETTER_GAIN,
    Objective,
    Optimum,
    climb,
    fit_mle,
    least_objective,
    nested_starts,
    starts,
)
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Coordinates, Parameter, Prior
from hygrokf.texts.fit_codes import FitCode

COUNT = 50
HILLS = 2.0 + 0.2 * np.random.default_rng(2).normal(size=30)
READ = 3.0 + 0.7 * np.random.default_rng(1).normal(size=COUNT)


def sample(
    read: np.ndarray = READ, centre: Callable = lambda p: p.mean, prior: Prior | None = None, **bounds: tuple
) -> Likelihood:
    """Independent normal readings about `centre`."""
    low, high = bounds.get("mean", (-50.0, 50.0))
    small, large = bounds.get("spread", (1e-3, 1e3))
    parameters = [
        Parameter("mean", "1", min(max(1.0, low), high), low, high, prior=prior),
        Parameter("spread", "1", min(max(2.0, small), large), small, large, positive=True, noise=True),
    ]
    return constant_level(parameters, read, centre, lambda p: p.spread * p.spread)


def normal(read: np.ndarray, mean: float, spread: float) -> float:
    return float(-0.5 * np.sum(((read - mean) / spread) ** 2 + math.log(2 * math.pi * spread**2)))


# the climb promises 1e-9 of the log-likelihood, √(2e-9) = 4.5e-5 standard errors
NEAR = 5e-5


def test_mean_and_spread_of_a_normal_sample() -> None:
    found = fit_mle(sample(), count=1)
    spread = READ.std()
    assert found.converged and found.message == FitCode.CONVERGED() and found.at_bounds == ()
    assert found.values["mean"] == pytest.approx(READ.mean(), abs=NEAR * spread / math.sqrt(COUNT))
    assert math.log(found.values["spread"] / spread) == pytest.approx(0.0, abs=NEAR / math.sqrt(2 * COUNT))
    assert found.loglik == pytest.approx(normal(READ, READ.mean(), spread), abs=1e-9)
    assert found.objective == pytest.approx(found.loglik, rel=1e-12)
    np.testing.assert_allclose(found.coordinates.start(found.values), found.z, rtol=1e-12)


def test_a_prior_pulls_by_its_precision() -> None:
    likelihood = sample(prior=Prior(0.0, 0.05))
    found = fit_mle(likelihood, fixed={"spread": 0.7}, count=1)
    data, knowledge = COUNT / 0.7**2, 1 / 0.05**2
    expected = data * READ.mean() / (data + knowledge)
    assert found.values == {
        "mean": pytest.approx(expected, abs=NEAR / math.sqrt(data + knowledge)),
        "spread": 0.7,
    }
    assert found.loglik == pytest.approx(normal(READ, found.values["mean"], 0.7), abs=1e-9)
    density = -0.5 * (found.values["mean"] / 0.05) ** 2 - math.log(0.05 * math.sqrt(2 * math.pi))
    assert found.objective == pytest.approx(found.loglik + density, abs=1e-9)


def test_bounds_hold_and_are_reported() -> None:
    found = fit_mle(sample(mean=(-50.0, 2.0)), count=1)
    assert found.converged and found.at_bounds == ("mean",) and found.values["mean"] == 2.0
    expected = math.sqrt(np.mean((READ - 2.0) ** 2))  # the others are at their optimum given the bound
    assert found.values["spread"] == pytest.approx(expected, rel=NEAR)
    both = fit_mle(sample(mean=(5.0, 9.0), spread=(3.0, 4.0)), {"mean": 7.0}, count=1)
    assert both.at_bounds == ("mean", "spread") and both.values == {"mean": 5.0, "spread": pytest.approx(3.0)}
    assert both.converged


def test_objective_gradient_and_information_in_coordinates() -> None:
    likelihood = sample(prior=Prior(1.0, 0.5))
    objective = Objective(likelihood, Coordinates(likelihood.model.parameters))
    z = np.array([2.0, math.log(1.3)])
    at = objective.information(z)
    again, score = objective.score(z)
    assert at.loglik == pytest.approx(again) == pytest.approx(objective.value(z))
    residual = (READ - 2.0) / 1.3
    expected = [residual.sum() / 1.3 - (2.0 - 1.0) / 0.25, np.sum(residual**2) - COUNT]
    np.testing.assert_allclose(at.score, expected, rtol=1e-10)
    np.testing.assert_allclose(score, expected, rtol=1e-10)
    np.testing.assert_allclose(at.information, np.diag([COUNT / 1.3**2 + 4.0, 2.0 * COUNT]), rtol=1e-10)
    scores = objective.information(z, each=True).scores
    np.testing.assert_allclose(
        scores, np.column_stack([residual / 1.3, residual**2 - 1.0]), rtol=1e-9, atol=1e-9
    )


def two_hills(p: object) -> object:
    """mean² + mean/20: a sample mean of 4.1 or of 3.9 is met on either side of zero."""
    return p.mean * p.mean + 0.05 * p.mean


def test_other_optima_are_reported_and_are_optima() -> None:
    likelihood = sample(HILLS, two_hills, prior=Prior(0.5, 1.0))
    found = fit_mle(likelihood, {"mean": -1.0}, count=1, more_starts=[{"mean": 1.0}])
    right, left = (-0.05 + s * math.sqrt(0.05**2 + 4 * HILLS.mean()) for s in (1, -1))
    assert found.values["mean"] == pytest.approx(right / 2, abs=0.03)  # the prior prefers it
    assert len(found.others) == 1
    objective, values = found.others[0]
    assert values["mean"] == pytest.approx(left / 2, abs=0.03) and objective < found.objective
    _, gradient = Objective(likelihood, found.coordinates).score(found.coordinates.start(values))
    np.testing.assert_allclose(gradient, 0.0, atol=0.1)
    alone = fit_mle(likelihood, {"mean": -1.0}, count=1)
    assert alone.values["mean"] == pytest.approx(left / 2, abs=0.03) and alone.others == ()


def test_where_a_climb_did_not_converge_is_not_reported_as_an_optimum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    climbs = optimiser.climb

    def tired(objective: Objective, start: np.ndarray, *rest: object, **more: object) -> Optimum:
        if start[0] < 0:
            return Optimum(start, objective.value(start), False, "stopped after 60 passes")
        return climbs(objective, start, *rest, **more)

    monkeypatch.setattr(optimiser, "climb", tired)
    found = fit_mle(
        sample(HILLS, two_hills), {"mean": 1.4}, count=1, more_starts=[{"mean": -1.3, "spread": 0.5}]
    )
    assert found.converged and found.values["mean"] > 0
    assert found.others == ()


def test_starts_vary_noise_always_and_all_else_in_every_second_one() -> None:
    coordinates = Coordinates(sample().model.parameters)
    made = starts(coordinates, {"mean": 2.0, "spread": 0.5}, 9)
    np.testing.assert_allclose(made[0], [2.0, math.log(0.5)])
    assert len(made) == 9 and len({z[1] for z in made}) == 9
    for k, z in enumerate(made):
        assert abs(z[1] - math.log(0.5)) <= 2.5
        assert (z[0] == 2.0) == (k % 2 == 1 or k == 0)
        assert abs(z[0] - 2.0) <= 0.25 * 100.0
    assert np.ptp([z[1] for z in made]) > 3.0 and np.ptp([z[0] for z in made]) > 25.0
    np.testing.assert_array_equal(made, starts(coordinates, {"mean": 2.0, "spread": 0.5}, 9))
    edge = starts(coordinates, {"spread": 1e-3}, 5)
    assert all(np.all(z >= coordinates.lower) for z in edge)
    quiet = Coordinates(sample().model.parameters, {"spread": 1.0})
    # without noise parameters all others vary each time
    assert len({float(z[0]) for z in starts(quiet, None, 9)}) == 9


def test_starts_stay_where_a_prior_is() -> None:
    likelihood = sample(prior=Prior(3.0, 0.1))
    made = starts(Coordinates(likelihood.model.parameters), {"mean": 3.0}, 30)
    means = [z[0] for z in made]
    assert max(abs(mean - 3.0) for mean in means) <= 0.2 and np.ptp(means) > 0.2


def hills(lowest: float = -50.0, shift: bool = False) -> Likelihood:
    """Readings about mean² + mean/20, with a prior that prefers the hill at positive means; and a shift of
    it, if wanted."""
    parameters = [
        Parameter("mean", "1", -1.0, lowest, 50.0 if lowest == -50.0 else -0.1, prior=Prior(0.5, 1.0)),
        Parameter("spread", "1", 2.0, 1e-3, 1e3, positive=True, noise=True),
        *([Parameter("shift", "1", 0.005, -0.01, 0.01, null=0.0)] if shift else []),
    ]
    return constant_level(
        parameters, HILLS, lambda p: two_hills(p) + (p.shift if shift else 0.0), lambda p: p.spread * p.spread
    )


def test_a_model_starts_from_one_that_it_contains() -> None:
    parent = fit_mle(hills(), {"mean": 1.0}, count=1)
    larger = hills(shift=True)
    cold = fit_mle(larger, count=1)
    assert cold.values["mean"] < 0 and cold.objective < parent.objective - BETTER_GAIN  # the wrong hill
    nested = fit_mle(larger, count=1, parents=[parent])
    assert nested.converged and nested.objective >= parent.objective
    assert nested.values["mean"] == pytest.approx(parent.values["mean"], abs=0.05)
    made = nested_starts(nested.coordinates, None, parent)
    assert [z[nested.coordinates.names.index("shift")] for z in made] == [0.005, 0.0]


def test_what_is_below_a_model_that_it_contains_has_not_converged() -> None:
    parent = fit_mle(hills(), {"mean": 1.0}, count=1)
    # the larger model's bounds keep the parent's hill out
    held = fit_mle(hills(lowest=-40.0, shift=True), count=1, parents=[parent])
    assert not held.converged
    short = parent.objective - held.objective
    assert held.message == FitCode.NESTED_MODEL_HIGHER(gain=short)
    assert fit_mle(hills(lowest=-40.0, shift=True), count=1).converged


def test_a_prior_of_what_a_parent_lacks_counts_at_its_null() -> None:
    parent = fit_mle(hills(), {"mean": 1.0}, count=1)
    own = Parameter("drift", "1", 0.3, -1.0, 1.0, prior=Prior(0.0, 0.1), null=0.0)
    coordinates = Coordinates([*parent.coordinates.parameters, own])
    density = -math.log(0.1 * math.sqrt(2 * math.pi))
    assert least_objective(coordinates, [parent]) == pytest.approx(parent.objective + density)
    assert least_objective(coordinates, []) == -math.inf


def stiff() -> Likelihood:
    """A reading every hour through a first-order lag whose time constant starts at a second."""
    lag = linear_network(
        "lag",
        [
            Parameter("lag", "h", 1 / 3600.0, 1 / 7200.0, 1 / 600.0, positive=True),
            Parameter("noise", "1", 1.0, 1e-3, 1e3, positive=True, noise=True),
        ],
        ["x"],
        ["u"],
        lambda p, x, u: {"x": (u.u - x.x) / p.lag},
        {"y": lambda p, x, u: (x.x, p.noise * p.noise)},
        lambda p: {"x": 0.01},
        lambda p, u: {"x": (0.0, 1.0)},
    )
    random = np.random.default_rng(7)
    model = compose([lag], {"u": "mean"})
    course = random.normal(size=100).cumsum()
    read = course + 0.1 * random.normal(size=100)
    return Likelihood(model, timeline(model, np.arange(100.0), {"u": course}, {"y": read}))


def test_a_stiff_corner_ends_with_its_budget() -> None:
    likelihood = stiff()
    first = {"lag": 1 / 3600.0, "noise": 1.0}
    each = likelihood.steps_per_instant(first)
    assert each == 1.0  # a second's lag over an hour is one step
    begun = Objective(likelihood, Coordinates(likelihood.model.parameters))
    start = begun.coordinates.start(first)
    ended = climb(begun, start, budget=2.5 * each)
    assert not ended.converged and ended.end.code is FitCode.BUDGET_SPENT
    assert ended.objective >= begun.value(start)
    said = fit_mle(likelihood, count=1, budget=2.5 * each)
    assert not said.converged and said.message.code is FitCode.SEARCH_UNFINISHED
    assert said.message.values["end"].code is FitCode.BUDGET_SPENT
    with_room = climb(begun, start, budget=100 * each)
    assert with_room.converged and with_room.objective > ended.objective


def test_progress_names_every_start() -> None:
    said: list[str] = []
    fit_mle(sample(), count=3, progress=said.append)
    assert said[:3] == ["start 1 of 3", "start 2 of 3", "start 3 of 3"] and said[-1] == "climb"


def test_a_search_on_a_shorter_record_ends_on_the_whole() -> None:
    found = fit_mle(sample(), count=3, search=sample(READ[:20]))
    assert found.loglik == pytest.approx(normal(READ, READ.mean(), READ.std()), abs=1e-9)


def test_a_climb_that_stops_early_says_so() -> None:
    objective = Objective(sample(), Coordinates(sample().model.parameters))
    far = np.array([40.0, math.log(0.01)])
    stopped = climb(objective, far, passes=2)
    assert not stopped.converged and stopped.end == FitCode.PASSES_SPENT(passes=2)
    assert stopped.objective > objective.value(far)  # never worse than where it began
    assert climb(objective, far).converged


def test_a_start_without_a_likelihood_says_so() -> None:
    broken = sample(np.append(READ, 1e200))  # its square is infinite
    found = fit_mle(broken, count=1)
    assert not found.converged
    assert found.message == FitCode.SEARCH_UNFINISHED(end=FitCode.START_NOT_FINITE())


def test_a_flat_direction_does_not_feign_convergence() -> None:
    """A coordinate with hardly any information asks for a step without end; the others must still be
    moved."""
    information = np.diag([100.0, 1e-13])
    gradient = np.array([50.0, -1e-7])
    z, lower, upper = np.zeros(2), np.full(2, -20.0), np.full(2, 20.0)
    free, reach = np.ones(2, bool), np.full(2, 1.5)
    step, promised = bounded_step(information, gradient, free, z, lower, upper, 1e-9, reach)
    assert step[0] == pytest.approx(0.5, rel=1e-6)
    assert promised == pytest.approx(12.5, rel=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_promise_is_kept_within_the_box_and_never_negative(seed: int) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(4, 4)) * 10.0 ** random.uniform(-4, 2, 4)
    information, gradient = root @ root.T, random.normal(size=4) * 10.0 ** random.uniform(-6, 3)
    z = random.uniform(-3.0, 3.0, 4)
    free, reach = np.ones(4, bool), np.full(4, 1.5)
    step, promised = bounded_step(information, gradient, free, z, z - 2.0, z + 0.5, 1e-9, reach)
    assert np.all(step >= -2.0 - 1e-12) and np.all(step <= 0.5 + 1e-12)
    assert promised == pytest.approx(gradient @ step - 0.5 * step @ information @ step, rel=1e-9, abs=1e-12)
    assert promised >= 0.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"values": {"maen": 1.0}}, 'values: .*found "maen"; did you mean "mean"'),
        ({"fixed": {"spraed": 1.0}}, 'fixed: .*found "spraed"; did you mean "spread"'),
        (
            {"more_starts": [{"mean": 1.0}, {"men": 2.0}]},
            r'more_starts\[1\]: .*found "men"; did you mean "mean"',
        ),
        ({"values": {"spread": 1e9}}, r"values: expected spread within 0\.001 … 1000 1, found 1000000000"),
        (
            {"count": 0, "budget": 0.0, "tolerance": float("nan")},
            "count: expected at least 1 start, found 0; budget: expected a number above 0, found 0.0; "
            "tolerance: expected a number above 0, found nan",
        ),
    ],
)
def test_misspelt_and_impossible_options_are_refused(options: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        fit_mle(sample(), **options)


def test_a_model_is_no_likelihood_and_a_likelihood_needs_a_timeline() -> None:
    likelihood = sample()
    with pytest.raises(
        ValueError, match=r"expected a Likelihood, found a Model; Likelihood\(model, timeline"
    ):
        fit_mle(likelihood.model)
    with pytest.raises(ValueError, match=r"timeline: expected a Timeline, found nothing; timeline\(model"):
        replace(likelihood, timeline=None)
    with pytest.raises(ValueError, match="tolerance: expected a number above 0, found -1"):
        replace(likelihood, tolerance=-1)


def test_a_record_without_readings_is_refused() -> None:
    """Its ln L is 0 everywhere: nothing could be estimated, and nothing has converged."""
    with pytest.raises(ValueError, match=r"expected readings, found none at any instant.*of y"):
        fit_mle(sample(np.full(5, np.nan)))


def test_misspelt_values_of_a_likelihood_are_refused_by_every_verb() -> None:
    likelihood = sample()
    for verb in (likelihood.value, likelihood.score, likelihood.trace):
        with pytest.raises(ValueError, match=r'found none of spread; .*did you mean "spread"'):
            verb({"mean": 1.0, "spred": 2.0})
    with pytest.raises(ValueError, match=r'found none of spread; .*did you mean "spread"'):
        likelihood.sensitivities({"mean": 1.0, "spred": 2.0}, np.eye(2))


def test_an_end_point_is_stationary_also_where_scoring_zigzags() -> None:
    """Readings of a mean with a spread of its square root: I⁻¹H reaches 2 where the readings scatter less
    than the model says, and scoring's steps go back and forth."""
    rough = 9.0 + 0.05 * np.random.default_rng(4).normal(size=40)
    scale = Parameter("scale", "1", 1.0, 0.2, 50.0, positive=True)
    parameters = [Parameter("mean", "1", 4.0, 0.1, 50.0), scale]
    likelihood = constant_level(parameters, rough, lambda p: p.mean, lambda p: p.scale * p.mean**4)
    found = fit_mle(likelihood, count=2)
    assert found.converged and found.at_bounds == ("scale",)
    objective = Objective(likelihood, found.coordinates)
    gradient = objective.score(found.z)[1][0]
    step = 1e-4
    up, down = (objective.score(found.z + np.array([s * step, 0.0]))[1][0] for s in (1.0, -1.0))
    assert 0.5 * gradient**2 / (-(up - down) / (2.0 * step)) <= 1e-9


def test_a_tolerance_is_what_the_next_step_promises() -> None:
    ends = [fit_mle(sample(), count=1, tolerance=t).loglik for t in (1.0, 1e-9)]
    best = normal(READ, READ.mean(), READ.std())
    assert best - ends[1] <= 1e-9 < best - ends[0] <= 1.0


def test_an_estimate_fits_a_screen() -> None:
    shown = repr(fit_mle(sample(mean=(-50.0, 2.0)), count=1))
    assert shown.splitlines()[0].startswith("Estimate: ln L = ") and "converged" in shown
    assert "  mean = 2  (at a limit)" in shown and max(map(len, shown.splitlines())) <= 100
