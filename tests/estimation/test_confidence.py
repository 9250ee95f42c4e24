"""Bounds: in closed form on normal samples, against statsmodels on sums, and on plants where the data do not
tell."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from builders.constant_level import constant_level
from plants import Truth, plant
from plants.as_record import to_record
from scipy.optimize import brentq
from scipy.stats import norm
from statsmodels.stats.sandwich_covariance import S_hac_simple

from hygrokf.cases.case_file import read_case
from hygrokf.data.prepared import prepare
from hygrokf.estimation.confidence import (
    Bounds,
    Uncertainty,
    positive_inverse,
    standard_error,
    uncertainty,
    wald_bounds,
)
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective, fit_mle
from hygrokf.estimation.output_error import long_run_variance
from hygrokf.estimation.profile_likelihood import limit_statements, profile
from hygrokf.identification.estimation import assess_stage, estimate_design
from hygrokf.identification.identify import identify_stages
from hygrokf.modelling.design import design, extended
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter, Prior
from hygrokf.texts.fit_codes import FitCode

LEVEL = 0.95
CHI_SQUARED = norm.ppf(0.975) ** 2


def sample(read: np.ndarray, extra: float = 0.0, bias: bool = False, idle: bool = False) -> Likelihood:
    """Normal readings an hour apart as a filter; `extra` known variance, a `bias` beside the mean, an `idle`
    one."""
    parameters = [
        Parameter("mean", "K", 1.0, -50.0, 50.0),
        Parameter("spread", "K", 1.0, 1e-3, 1e3, positive=True),
    ]
    if bias:
        parameters.append(Parameter("bias", "K", 0.0, -4.0, 4.0, prior=Prior(0.0, 1.0)))
    if idle:
        parameters.append(Parameter("idle", "h", 1.0, 0.1, 10.0, positive=True))
    return constant_level(
        parameters,
        read,
        lambda p: p.mean + (p.bias if bias else 0.0),
        lambda p: p.spread * p.spread + extra,
    )


@dataclass(frozen=True)
class Fitted:
    objective: Objective
    estimate: Estimate
    known: Uncertainty

    def profile(self, name: str, level: float = LEVEL) -> Bounds:
        return profile(self.objective, self.estimate, self.known, name, level)


def fitted(likelihood: Likelihood) -> Fitted:
    found = fit_mle(likelihood, count=1)
    objective = Objective(likelihood, found.coordinates)
    return Fitted(objective, found, uncertainty(objective, found))


def plain(one: Fitted) -> Fitted:
    """As if the model were known to be right: no factor on the threshold."""
    return replace(one, known=replace(one.known, factor=np.ones_like(one.known.factor)))


INDEPENDENT = 3.0 + 0.7 * np.random.default_rng(1).normal(size=4000)


@pytest.fixture(scope="module")
def normal() -> Fitted:
    return fitted(sample(INDEPENDENT))


@pytest.fixture(scope="module")
def short() -> Fitted:
    """Forty readings: the profile is visibly not a parabola."""
    return plain(fitted(sample(INDEPENDENT[:40])))


def test_an_estimate_at_which_the_model_runs_away_is_told(normal: Fitted) -> None:
    nowhere = replace(normal.estimate, z=np.array([np.nan, 0.0]))
    with pytest.raises(ValueError, match="the model diverges with mean = "):
        uncertainty(normal.objective, nowhere)


# -- long-run variance ---------------------------------------------------------------------------------------
def test_the_long_run_variance_is_statsmodels_on_block_sums() -> None:
    random = np.random.default_rng(2)
    time = np.sort(random.uniform(3.0, 1003.0, 5000))
    scores = np.cumsum(random.normal(size=(5000, 3)), axis=0) * 0.01 + random.normal(size=(5000, 3))
    block = np.floor((time - time[0]) / 24.0)
    sums = np.array([scores[block == b].sum(axis=0) for b in range(int(block[-1]) + 1)])
    expected = S_hac_simple(sums - sums.mean(axis=0), nlags=1)
    np.testing.assert_allclose(long_run_variance(scores, time, 24.0), expected, rtol=1e-10)


# -- second-order picture ------------------------------------------------------------------------------------
def test_wald_is_the_closed_form_of_a_normal_sample(normal: Fitted) -> None:
    spread, count = INDEPENDENT.std(), len(INDEPENDENT)
    # the score's central difference over 2 % of a standard error errs by 1e-4 of its third derivative
    expected = np.diag([count / spread**2, 2.0 * count])
    np.testing.assert_allclose(normal.known.curvature, expected, rtol=2e-3, atol=2e-2 * count)
    np.testing.assert_allclose(np.diag(normal.known.wald), [spread**2 / count, 1 / (2 * count)], rtol=2e-3)
    assert normal.known.names == ("mean", "spread") and normal.known.flat == () == normal.known.trade_offs
    assert normal.known.place("spread") == 1 and normal.known.place("nobody") is None


def test_standard_errors_are_in_the_parameters_unit(normal: Fitted) -> None:
    spread, count = INDEPENDENT.std(), len(INDEPENDENT)
    calm = replace(normal.known, sandwich=normal.known.wald)
    assert standard_error(normal.estimate, calm, "mean") == pytest.approx(spread / math.sqrt(count), rel=2e-3)
    assert standard_error(normal.estimate, calm, "spread") == pytest.approx(
        spread / math.sqrt(2 * count), rel=2e-3
    )
    wide = replace(normal.known, sandwich=4.0 * normal.known.wald)
    assert standard_error(normal.estimate, wide, "mean") == pytest.approx(
        2 * spread / math.sqrt(count), rel=2e-3
    )


def test_wald_bounds_are_symmetric_in_the_coordinate(normal: Fitted) -> None:
    calm = replace(normal.known, sandwich=normal.known.wald)
    bounds = wald_bounds(normal.estimate, calm, "spread", 0.9)
    error = 1 / math.sqrt(2 * len(INDEPENDENT))
    assert math.log(bounds.upper / bounds.value) == pytest.approx(norm.ppf(0.95) * error, rel=2e-3)
    assert math.log(bounds.value / bounds.lower) == pytest.approx(norm.ppf(0.95) * error, rel=2e-3)
    assert (bounds.method, bounds.level) == ("wald", 0.9)


def test_the_sandwich_of_a_right_model_is_wald(normal: Fitted) -> None:
    """167 blocks of a day: a variance known to √(2/167)·√(19/9) = 16 %; bound two of it and a half."""
    ratio = np.diag(normal.known.sandwich) / np.diag(normal.known.wald)
    assert np.all(np.abs(ratio - 1.0) < 0.4)
    assert np.all(normal.known.factor >= 1.0)
    np.testing.assert_allclose(normal.known.factor, np.maximum(1.0, ratio))


def test_the_sandwich_sees_dependence_that_the_model_denies() -> None:
    """Readings with correlation 0.8 an hour: the variance of their mean is (1+0.8)/(1−0.8) = 9 times as
    large.

    Blocks of 24 h with Bartlett weights over two neighbours see 9 (1 − 0.05) of it; their own error is 16 %.
    """
    random = np.random.default_rng(3)
    read, value = np.empty(4000), 0.0
    for k, kick in enumerate(random.normal(size=4000)):
        value = 0.8 * value + 0.6 * kick
        read[k] = value
    one = fitted(sample(read))
    place = one.known.place("mean")
    assert 5.5 < one.known.factor[place] < 13.0
    narrow, wide = plain(one).profile("mean"), one.profile("mean")
    stretch = (wide.upper - wide.lower) / (narrow.upper - narrow.lower)
    assert stretch == pytest.approx(math.sqrt(one.known.factor[place]), rel=0.02)
    assert wald_bounds(one.estimate, one.known, "mean").upper == pytest.approx(wide.upper, rel=0.02)


def test_a_prior_counts_in_both_covariances() -> None:
    likelihood = sample(INDEPENDENT, bias=True)
    one = fitted(likelihood)
    # mean and bias enter as a sum: together they are known, each on its own by the prior alone
    assert one.known.trade_offs[0][:2] == ("bias", "mean")
    assert one.known.trade_offs[0][2] == pytest.approx(-1.0, abs=1e-3)
    for covariance in (one.known.wald, one.known.sandwich):
        assert covariance[2, 2] == pytest.approx(1.0, rel=0.01)
        total = covariance[0, 0] + 2 * covariance[0, 2] + covariance[2, 2]
        assert total == pytest.approx(INDEPENDENT.var() / len(INDEPENDENT), rel=0.45)


def test_a_parameter_without_effect_is_flat() -> None:
    one = fitted(sample(INDEPENDENT[:200], idle=True))
    assert one.known.flat == ("idle",)
    bounds = one.profile("idle")
    assert (bounds.lower, bounds.upper) == (0.0, math.inf)
    assert bounds.statements == (FitCode.OPEN_ON_BOTH_SIDES(),)


def test_the_inverse_never_promises_a_negative_variance() -> None:
    random = np.random.default_rng(5)
    root = random.normal(size=(4, 4))
    positive = root @ root.T
    np.testing.assert_allclose(positive_inverse(positive), np.linalg.inv(positive), rtol=1e-8)
    scale = np.array([1e-6, 1.0, 1e6, 1e3])
    badly = positive * np.outer(scale, scale)
    np.testing.assert_allclose(
        positive_inverse(badly) * np.outer(scale, scale), np.linalg.inv(positive), rtol=1e-6
    )
    saddle = np.diag([4.0, -1.0, 0.0])
    found = positive_inverse(saddle)
    assert found[0, 0] == pytest.approx(0.25)
    assert np.linalg.eigvalsh(found).min() >= 0 and found[1, 1] > 1e6 and found[2, 2] > 1e6


# -- profiles ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("level", [0.8, 0.95, 0.99])
def test_profile_bounds_of_a_mean_are_in_closed_form(short: Fitted, level: float) -> None:
    """n ln(1 + (μ − ȳ)²/s²) = χ².  The ends are found to 0.01 in the root of the drop: 0.6 % of the half
    width."""
    read = INDEPENDENT[:40]
    threshold = norm.ppf(0.5 + level / 2) ** 2
    half = read.std() * math.sqrt(math.exp(threshold / 40) - 1)
    bounds = short.profile("mean", level)
    tolerance = 0.012 / math.sqrt(threshold) * half
    assert bounds.lower == pytest.approx(read.mean() - half, abs=tolerance)
    assert bounds.upper == pytest.approx(read.mean() + half, abs=tolerance)
    assert (bounds.method, bounds.level, bounds.statements) == ("profile", level, ())
    for value, drop in bounds.curve:
        expected = 40 * math.log1p(((value - read.mean()) / read.std()) ** 2)
        assert drop == pytest.approx(expected, abs=5e-3)  # re-estimation stops within 2e-3 of its optimum
    assert np.all(np.diff(bounds.curve[:, 0]) > 0)


def test_profile_bounds_of_a_spread_are_not_symmetric(short: Fitted) -> None:
    """n (2 ln(σ/s) + s²/σ² − 1) = χ²."""
    own = INDEPENDENT[:40].std()

    def excess(log_ratio: float) -> float:
        return 40 * (2 * log_ratio + math.exp(-2 * log_ratio) - 1) - CHI_SQUARED

    ends = [math.exp(brentq(excess, *side)) * own for side in ((-1.0, 0.0), (0.0, 1.0))]
    bounds = short.profile("spread")
    assert bounds.lower == pytest.approx(ends[0], rel=2e-3)
    assert bounds.upper == pytest.approx(ends[1], rel=2e-3)
    assert bounds.upper / bounds.value > 1.02 * bounds.value / bounds.lower


def test_a_positive_parameter_at_its_lower_bound_is_at_most_x() -> None:
    """Readings no wider than the known noise: the estimate is zero and the bound one-sided."""
    read = INDEPENDENT[:100]
    extra = 1.05 * read.var()
    one = fitted(sample(read, extra=extra))
    assert one.estimate.at_bounds == ("spread",) and one.known.place("spread") is None
    bounds = one.profile("spread")

    def excess(spread: float) -> float:
        def deviance(added: float) -> float:
            return 100 * (math.log(extra + added**2) + read.var() / (extra + added**2))

        return deviance(spread) - deviance(1e-3) - CHI_SQUARED

    assert bounds.lower == 0.0
    assert bounds.upper == pytest.approx(brentq(excess, 0.01, 5.0), rel=0.01)
    assert bounds.statements == (FitCode.AT_MOST(bound=bounds.upper, unit="K"),)
    assert math.isnan(standard_error(one.estimate, one.known, "spread"))
    wald = wald_bounds(one.estimate, one.known, "spread")
    assert (wald.lower, wald.upper, wald.method) == (-math.inf, math.inf, "none")


# -- limits of other parameters ------------------------------------------------------------------------------
UNSURE = Prior(0.0, 1.0)


def summed(
    limit: float, physical: tuple[float, float] = (-math.inf, math.inf), prior: Prior | None = UNSURE
) -> Fitted:
    """Forty readings of mean + bias with known noise: all that tells the two apart is the prior of the
    bias."""
    parameters = [
        Parameter("mean", "K", 3.0, -50.0, 50.0),
        Parameter("bias", "K", 0.0, -limit, limit, prior=prior, physical=physical),
    ]
    return plain(
        fitted(constant_level(parameters, INDEPENDENT[:40], lambda p: p.mean + p.bias, lambda p: 0.49))
    )


def test_a_guard_of_another_parameter_is_lifted_not_a_cliff() -> None:
    """The mean is known to √(σ²/n + 1): 1.97 K to either side, although the search stops the bias at 0.5
    K."""
    bounds, centre = summed(0.5).profile("mean"), INDEPENDENT[:40].mean()
    half = math.sqrt(CHI_SQUARED * (0.49 / 40 + 1.0))
    assert bounds.lower == pytest.approx(centre - half, abs=0.01 * half)
    assert bounds.upper == pytest.approx(centre + half, abs=0.01 * half)
    assert bounds.statements == () and bounds.better is None
    reached = {limit.end: limit for limit in bounds.limited_by}
    share = half / (
        1.0 + 0.49 / 40
    )  # of the departure that the bias takes, prior and readings being what they are
    for end, sign in (("lower", 1.0), ("upper", -1.0)):
        assert reached[end].parameter == "bias" and reached[end].effect == "lifted"
        assert reached[end].limit == sign * 0.5
        assert reached[end].value == pytest.approx(sign * share, rel=0.02)
    first = limit_statements("mean", bounds)[0]
    assert first.code is FitCode.BOUND_BEYOND_GUARD
    lower = reached["lower"]
    assert first.values == {
        "bounded": "mean", "end": "lower", "parameter": "bias", "unit": "K", "value": lower.value,
        "limit": 0.5,
    }  # fmt: skip
    far = summed(5.0).profile("mean")
    assert far.limited_by == ()
    assert (far.lower, far.upper) == pytest.approx((bounds.lower, bounds.upper), abs=0.01 * half)


def test_a_physical_limit_of_another_parameter_holds() -> None:
    """A bias that cannot exceed 0.5 K leaves n (μ − ȳ − 0.5)²/σ² + 0.5² = χ² for the mean."""
    bounds, centre = summed(0.5, physical=(-0.5, 0.5)).profile("mean"), INDEPENDENT[:40].mean()
    half = 0.5 + math.sqrt((CHI_SQUARED - 0.5**2) * 0.49 / 40)
    assert bounds.lower == pytest.approx(centre - half, abs=0.005)
    assert bounds.upper == pytest.approx(centre + half, abs=0.005)
    assert {(limit.end, limit.parameter, limit.effect) for limit in bounds.limited_by} == {
        ("lower", "bias", "held"),
        ("upper", "bias", "held"),
    }
    assert bounds.statements == ()
    second = limit_statements("mean", bounds)[1]
    assert second.code is FitCode.BOUND_AT_PHYSICAL_LIMIT
    assert (second.values["parameter"], second.values["value"]) == ("bias", -0.5)


def test_a_profile_that_outruns_a_lifted_guard_is_open_and_names_it() -> None:
    """Nothing tells mean and bias apart: the profile is flat until the bias is as far as a walk lets it
    go."""
    bounds = summed(0.5, prior=None).profile("mean")
    assert (bounds.lower, bounds.upper) == (-50.0, 50.0)
    first, *ends = bounds.statements
    assert first == FitCode.OPEN_ON_BOTH_SIDES()
    assert {one.code for one in ends} == {FitCode.END_STAYS_OPEN}
    assert {(one.values["parameter"], one.values["value"], one.values["limit"]) for one in ends} == {
        ("bias", 10.0, 0.5), ("bias", -10.0, -0.5),
    }  # fmt: skip
    assert {limit.effect for limit in bounds.limited_by} == {"open"}
    assert limit_statements("mean", bounds) == []


def test_what_wants_back_from_its_limit_is_let_go() -> None:
    """The bias ends on its limit, 0 K; where the mean is too high it turns negative, and the profile with
    it."""
    one = summed(2.0)
    at_zero = Parameter("bias", "K", 0.0, -2.0, 0.0, prior=Prior(1.0, 1.0))
    model = one.objective.likelihood.model
    constant = replace(model.mechanisms[0], parameters=(model.parameters[0], at_zero))
    likelihood = Likelihood(compose([constant]), one.objective.likelihood.timeline)
    edge = plain(fitted(likelihood))
    assert edge.estimate.at_bounds == ("bias",) and edge.estimate.converged
    bounds, centre = edge.profile("mean"), INDEPENDENT[:40].mean()

    def drop(mean: float) -> float:
        bias = min(((centre - mean) * 40 / 0.49 + 1.0) / (40 / 0.49 + 1.0), 0.0)
        return 40 / 0.49 * (centre - mean - bias) ** 2 + (bias - 1.0) ** 2 - 1.0 - CHI_SQUARED

    assert bounds.upper == pytest.approx(brentq(drop, centre, centre + 5.0), abs=0.01)
    assert bounds.lower == pytest.approx(brentq(drop, centre - 5.0, centre), abs=0.01)
    assert bounds.upper - centre > 2.0 * (centre - bounds.lower)


def test_a_profile_tells_of_a_point_above_the_estimate(normal: Fitted) -> None:
    off = normal.estimate.z + np.array([0.02, 0.0])  # two standard errors
    objective = normal.objective.value(off)
    values = normal.objective.coordinates.values(off)
    wrong = replace(
        normal, estimate=replace(normal.estimate, z=off, objective=objective, values=values)
    ).profile("mean")
    assert wrong.better is not None
    gain = normal.objective.likelihood.value(wrong.better) - objective
    assert gain > 1.0
    assert normal.profile("mean").better is None


ROOM_9 = """\
name = "house"
[[source]]
file = "{file}"
time = "date"
time_format = "%Y/%m/%d %H:%M"
timezone = "+01:00"
signals.cabinet_temperature = {{ column = "T9", unit = "degC" }}
signals.cabinet_relative_humidity = {{ column = "RH_9", unit = "%", accuracy = 0.05 }}
signals.ambient_temperature = {{ column = "T_out", unit = "degC" }}
signals.ambient_relative_humidity = {{ column = "RH_out", unit = "%" }}
"""


@pytest.mark.slow
def test_a_measured_house_ends_on_no_cliff(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Room 9, the first three months: along the profile of k a disturbance grows with k and passes its limit,
    20 g/m³.

    Stopped there, the drop goes from 1.4 at 97 h to 10 at 99 h, and 98 h is called an upper bound.  That is
    the profile of the exact Gaussian likelihood; where readings have a bounded influence, this record leaves
    both ends open.
    """
    monkeypatch.setattr("hygrokf.modelling.design.BOUND", math.inf)
    monkeypatch.setattr("hygrokf.modelling.design._models", {})
    file = Path(__file__).resolve().parents[2] / "../shared/data/house_uci_energy_10min.csv.gz"
    if not file.is_file():
        pytest.skip(f"../shared/data/{file.name} is not there")
    case = tmp_path / "case.toml"
    case.write_text(ROOM_9.format(file=file.resolve()), encoding="utf-8")
    record = read_case(case)
    record = replace(record, until_s=record.start_s + 2.0 / 3.0 * (record.end_s - record.start_s))
    early, quiet = prepare(record.identification()), lambda text: None
    driven = identify_stages(early, "cascade", 4, False, quiet).stages[1].run.record
    twice = extended(design(driven, kind="cascade"), [("second_vapour_disturbance", {})])
    stage = assess_stage(estimate_design(driven, twice, 4, quiet), True, quiet)
    bounds = stage.bounds["hygric_k"]
    larger = max(("vapour_disturbance_sd", "second_vapour_disturbance_sd"), key=stage.estimate.values.get)
    assert stage.estimate.converged and 10.0 < stage.estimate.values[larger] < 20.0
    (limit,) = [limit for limit in bounds.limited_by if limit.parameter == larger]
    assert (limit.end, limit.effect, limit.limit) == ("upper", "lifted", 20.0) and limit.value > 20.0
    assert bounds.upper > bounds.value * 20.0 / stage.estimate.values[larger]
    # without a cliff the root of the drop is nearly a straight line: no step is steeper than thrice the mean
    # slope
    root = np.sqrt(np.maximum(bounds.curve[:, 1], 0.0)) * np.sign(bounds.curve[:, 0] - bounds.value)
    slope = np.diff(root) / np.diff(np.log(bounds.curve[:, 0]))
    assert np.all(slope < 3.0 * (root[-1] - root[0]) / np.log(bounds.curve[-1, 0] / bounds.curve[0, 0]))


# -- plants whose records do not tell everything -------------------------------------------------------------
def cabinet(**given: object) -> tuple[Fitted, Truth]:
    made = plant(5, days=30.0, **given)
    record = to_record(made)
    chosen = design(record, kind="thermal")
    return fitted(Likelihood(chosen.model, model_inputs(chosen, record).timeline)), made.truth


def holds(bounds: Bounds, truth: float) -> bool:
    return bounds.lower <= truth <= bounds.upper


def test_a_usual_record_bounds_both_thermal_parameters() -> None:
    one, truth = cabinet()
    assert one.estimate.converged and one.estimate.at_bounds == () == one.known.flat
    tau, rho = one.profile("thermal_time_constant"), one.profile("resistance_ratio")
    assert holds(tau, truth.tau_h) and tau.upper / tau.lower < 1.2
    assert holds(rho, truth.rho) and rho.upper - rho.lower < 0.06


def test_without_inner_resistance_the_ratio_is_bounded_on_one_side() -> None:
    """R_IC = 0: ρ = 1 is the edge of its range, and nothing closes the upper end."""
    one, truth = cabinet(rho=1.0)
    bounds = one.profile("resistance_ratio")
    assert bounds.upper == 1.0 and 0.9 < bounds.lower < 1.0
    assert bounds.statements == (FitCode.AT_LEAST(bound=bounds.lower, unit="1"),)
    assert holds(one.profile("thermal_time_constant"), truth.tau_h)


def test_a_cabinet_faster_than_its_logger_is_at_most_x() -> None:
    one, truth = cabinet(tau_h=0.03, logger_step_min=60.0)
    bounds = one.profile("thermal_time_constant")
    assert bounds.lower == 0.0 and truth.tau_h < bounds.upper < 0.2
    assert bounds.statements == (FitCode.AT_MOST(bound=bounds.upper, unit="h"),)
    # with a reading an hour, white noise of the air and of the sensor act alike: one of them is open
    alike = {"thermal_diffusion", "cabinet_temperature_noise"}
    assert alike & {*one.known.flat, *one.estimate.at_bounds}
    white = one.profile("thermal_diffusion")
    assert white.lower == 0.0 and math.isfinite(white.upper)


def test_a_record_that_tells_little_says_so_by_name() -> None:
    """A fast cabinet read once an hour by imperfect sensors: what it cannot tell has a name."""
    one, truth = cabinet(tau_h=0.1, rho=0.75, logger_step_min=60.0, ambient_step_min=60, sensor_errors="all")
    ratio = one.profile("resistance_ratio")
    assert ratio.upper == 1.0 and ratio.lower < truth.rho
    at_least = FitCode.AT_LEAST(bound=ratio.lower, unit="1")
    assert ratio.statements in ((FitCode.OPEN_ON_BOTH_SIDES(),), (at_least,))
    named = {*one.known.flat, *one.estimate.at_bounds}
    assert "thermal_diffusion" in named
