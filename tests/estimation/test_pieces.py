"""Runs in pieces, missing readings and values that cannot be: the likelihood of one run all the same."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from builders.constant_level import constant_level
from builders.scores import check_score

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter


# -- pieces --------------------------------------------------------------------------------------------------
def pieces(
    case: object, values: dict[str, float], cuts: list[int]
) -> tuple[np.ndarray, np.ndarray, float, Gaussian]:
    means, covariances, total, last = [], [], 0.0, None
    edges = [0, *cuts, len(case.timeline)]
    for first, end in pairwise(edges):
        found = Likelihood(case.model, case.timeline.window(first, end)).trace(values, start=last)
        means.append(found.mean)
        covariances.append(found.covariance)
        total += found.loglik
        last = found.last
    return np.concatenate(means), np.concatenate(covariances), total, last


@pytest.mark.parametrize("name", ["thermal", "joint", "averaged"])
@pytest.mark.parametrize("cuts", [[137, 140, 300], list(range(1, 60))], ids=["some", "online"])
def test_stop_checkpoint_resume_is_one_run_bit_for_bit(
    name: str, cuts: list[int], request: pytest.FixtureRequest
) -> None:
    """Windows of the same run, each from the Gaussian that the one before left; `online` takes instant by
    instant."""
    case = request.getfixturevalue(name)
    whole = case.likelihood.trace(case.values)
    means, covariances, total, last = pieces(case, case.values, cuts)
    np.testing.assert_array_equal(means, whole.mean)
    np.testing.assert_array_equal(covariances, whole.covariance)
    np.testing.assert_array_equal(last.mean, whole.last.mean)
    np.testing.assert_array_equal(last.covariance, whole.last.covariance)
    assert last.time_h == whole.last.time_h
    assert total == pytest.approx(whole.loglik, rel=1e-12)  # sums in another order


def test_pieces_are_one_run_wherever_the_rates_lie(joint: object) -> None:
    """Sub-steps must not depend on what a piece of the run happens to hold."""
    for factor in np.geomspace(0.5, 2.0, 12):
        values = joint.values | {"hygric_k": joint.values["hygric_k"] * factor}
        mean = pieces(joint, values, [200])[0]
        np.testing.assert_array_equal(mean, joint.likelihood.trace(values).mean)


# -- readings that are missing, and values that cannot be ----------------------------------------------------
def test_a_missing_reading_is_one_that_was_never_there(joint: object) -> None:
    case = joint.first(300)
    silent = case.timeline.with_readings(np.full_like(case.timeline.y, np.nan))
    assert Likelihood(case.model, silent).value(case.values) == 0.0
    only = case.timeline.y.copy()
    only[:, 1] = np.nan
    found = Likelihood(case.model, case.timeline.with_readings(only))
    assert found.timeline.n_readings == np.isfinite(only[:, 0]).sum()
    # a dead humidity sensor: what is left is the thermal model's likelihood
    thermal = compose([m for m in case.model.mechanisms if m.name not in HYGRIC], case.model.holds)
    inputs = {name: case.inputs[name] for name in thermal.inputs}
    alone = Likelihood(
        thermal, timeline(thermal, case.timeline.time, inputs, {"cabinet_temperature": only[:, 0]})
    )
    assert found.value(case.values) == pytest.approx(
        alone.value({p.name: case.values[p.name] for p in thermal.parameters}), rel=1e-11
    )


HYGRIC = {"hygric_exchange", "vapour_disturbance", "hygric_diffusion", "humidity_sensor"}


def test_the_running_sum_of_logarithms_does_not_overflow() -> None:
    """50,000 readings with variances near 1e-6 and 1e6: a plain product would leave the range of doubles."""
    for size in (1e-3, 1e3):
        y = size * np.random.default_rng(1).normal(size=50_000)
        likelihood = constant_level([Parameter("s", "1", 1.0, 0.0, 1e9)], y, lambda p: 0.0, lambda p: p.s)
        expected = -0.5 * np.sum(y**2 / size**2 + math.log(2 * math.pi * size**2))
        assert likelihood.value({"s": size**2}) == pytest.approx(expected, rel=1e-12)


def test_a_likelihood_that_breaks_down_is_minus_infinity(thermal: object) -> None:
    case = thermal.first(20)
    assert case.likelihood.value(case.values | {"cabinet_temperature_noise": math.nan}) == -math.inf
    with pytest.raises(
        FloatingPointError, match=r"rates.*converter_temperature.*thermal_time_constant = 1e-320"
    ):
        case.likelihood.value(case.values | {"thermal_time_constant": 1e-320})


def test_a_given_gaussian_is_the_start(thermal: object) -> None:
    case = thermal.first(30)
    first = case.likelihood.first_gaussian(case.values)
    again = replace(case.likelihood, initial=first)
    assert again.value(case.values) == case.likelihood.value(case.values)
    shifted = replace(case.likelihood, initial=replace(first, mean=first.mean + 1.0))
    assert shifted.value(case.values) != case.likelihood.value(case.values)
    check_score(shifted, case.values)
