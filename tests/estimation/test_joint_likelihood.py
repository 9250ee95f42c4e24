"""Several records in one likelihood: sums against single records and the dense joint normal distribution."""

from __future__ import annotations

import numpy as np
import pytest
from builders.dense_gaussian import Course, loglik
from builders.linear_oracles import van_loan

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.inference import confidence_intervals, modal_time_constants
from hygrokf.estimation.joint_likelihood import JointLikelihood
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import fit_mle
from hygrokf.estimation.smoother import smoothed_states
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter

VALUES = {"rate": 0.6, "wander": 0.4, "offset": 0.3}
NOISE = 0.04


def level() -> Model:
    network = linear_network(
        "level",
        [
            Parameter("rate", "1/h", 0.5, 0.01, 20.0, positive=True),
            Parameter("wander", "1", 0.3, 0.01, 10.0, positive=True, noise=True),
            Parameter("offset", "1", 0.0, -9.0, 9.0),
        ],
        ["x"],
        [],
        lambda p, x, u: {"x": -p.rate * x.x},
        {"read": lambda p, x, u: (x.x + p.offset, NOISE)},
        lambda p: {"x": p.wander * p.wander},
        lambda p, u: {"x": (0.0, 1.0)},
    )
    return compose([network])


def record(model: Model, seed: int, count: int, offset: float = 0.3) -> Likelihood:
    """Simulated exactly: an Ornstein–Uhlenbeck process read at irregular instants."""
    random = np.random.default_rng(seed)
    time = 100.0 + np.cumsum(random.uniform(0.1, 1.0, count))
    x, read = random.normal(), np.empty(count)
    for k in range(count):
        f = np.exp(-0.6 * (time[k] - time[k - 1])) if k else 1.0
        x = f * x + np.sqrt(0.16 * (1.0 - f * f) / 1.2) * random.normal()
        read[k] = x + offset + 0.2 * random.normal()
    return Likelihood(model, timeline(model, time, {}, {"read": read}))


def dense(one: Likelihood, values: dict[str, float]) -> float:
    a, q = np.array([[-values["rate"]]]), np.array([[values["wander"] ** 2]])
    steps = [(*van_loan(a, q, h),) for h in np.diff(one.timeline.time)]
    course = Course(
        [(f, np.zeros(1), n) for f, n in steps], np.zeros(1), np.eye(1), np.eye(1), np.array([NOISE])
    )
    return loglik(course, one.timeline.y - values["offset"])


def test_the_sum_over_records_is_the_sum_of_the_dense_likelihoods():
    model = level()
    parts = [record(model, seed, count) for seed, count in ((1, 12), (2, 30), (3, 1))]
    joint = JointLikelihood(parts)
    expected = sum(dense(one, VALUES) for one in parts)
    assert joint.value(VALUES) == pytest.approx(expected, rel=1e-10)
    value, slopes = joint.score(VALUES)
    assert value == pytest.approx(expected, rel=1e-10)
    np.testing.assert_allclose(slopes, np.sum([one.score(VALUES)[1] for one in parts], axis=0), rtol=1e-12)
    along = joint.sensitivities(VALUES, np.eye(3), each=True)
    single = [one.sensitivities(VALUES, np.eye(3), each=True) for one in parts]
    np.testing.assert_allclose(
        along.information, np.sum([one.information for one in single], axis=0), rtol=1e-12
    )
    np.testing.assert_array_equal(along.scores, np.concatenate([one.scores for one in single]))
    assert (
        len(joint.timeline) == 43 == joint.timeline.n_readings and (np.diff(joint.timeline.time) > 0.0).all()
    )
    assert joint.steps_per_instant(VALUES) == pytest.approx(1.0, abs=0.2)


def test_own_parameters_of_every_record_are_their_own():
    model = level()
    parts = [record(model, 1, 40, 0.3), record(model, 2, 50, -2.0)]
    joint = JointLikelihood(parts, own=["offset"])
    assert [p.name for p in joint.parameters] == ["rate", "wander", "offset_1", "offset_2"]
    values = {"rate": 0.6, "wander": 0.4, "offset_1": 0.2, "offset_2": -1.7}
    own = [{**VALUES, "offset": offset} for offset in (0.2, -1.7)]
    assert joint.value(values) == pytest.approx(
        sum(dense(one, v) for one, v in zip(parts, own, strict=True)), rel=1e-10
    )
    first, second = (one.score(v)[1] for one, v in zip(parts, own, strict=True))
    slopes = [first[0] + second[0], first[1] + second[1], first[2], second[2]]
    np.testing.assert_allclose(joint.score(values)[1], slopes, rtol=1e-12)
    np.testing.assert_allclose(joint.sensitivities(values, np.eye(4)).score, slopes, rtol=1e-9)


def test_records_are_fitted_together():
    """Two records of 400 readings with offsets of their own: truth within the bounds, narrower than of one
    alone."""
    model = level()
    parts = [record(model, 11, 400, 0.3), record(model, 12, 400, -2.0)]
    joint = JointLikelihood(parts, own=("offset",))
    found = fit_mle(joint, count=1)
    assert found.converged and set(found.values) == {"rate", "wander", "offset_1", "offset_2"}
    assert found.loglik == pytest.approx(
        sum(one.value(joint.values_of(found.values, k)) for k, one in enumerate(parts))
    )
    for method in ("wald", "profile"):
        bounds = confidence_intervals(joint, found, ["rate", "offset_2"], method)
        assert bounds["rate"].lower < 0.6 < bounds["rate"].upper
        assert bounds["offset_2"].lower < -2.0 < bounds["offset_2"].upper
    alone = fit_mle(parts[0], count=1)
    one = confidence_intervals(parts[0], alone, ["rate"], "wald")["rate"]
    both = confidence_intervals(joint, found, ["rate"], "wald")["rate"]
    assert both.upper / both.lower < 0.9 * one.upper / one.lower
    (tau,) = modal_time_constants(joint, found)
    assert tau.value == pytest.approx(1.0 / found.values["rate"])


def test_what_needs_one_record_and_what_does_not_fit_is_refused():
    model = level()
    joint = JointLikelihood([record(model, 1, 5), record(model, 2, 5)])
    with pytest.raises(AttributeError, match=r"expected the likelihood of one record, found that of 2; take"):
        smoothed_states(joint, VALUES)
    assert smoothed_states(joint.parts[1], joint.values_of(VALUES, 1))[0].shape == (5, 1)
    with pytest.raises(ValueError, match='found "ofset"; did you mean "offset"'):
        JointLikelihood(joint.parts, own=["ofset"])
    with pytest.raises(ValueError, match="at least one record"):
        JointLikelihood([])
    other = compose(
        [
            linear_network(
                "other", [], ["x"], [], lambda p, x, u: {"x": -x.x}, {"read": lambda p, x, u: (x.x, 1.0)},
                lambda p: {"x": 1.0}, lambda p, u: {"x": (0.0, 1.0)},
            )
        ]
    )  # fmt: skip
    with pytest.raises(ValueError, match="part 1: expected the parameters of the first part"):
        JointLikelihood([joint.parts[0], record(other, 1, 5)])
