"""Type-level parameters: published numbers, statsmodels, coverage by simulation, and fits in each other's
terms."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from statsmodels.stats.meta_analysis import combine_effects

from hygrokf.data.result_file import ResultFault
from hygrokf.data.structured import plain
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_results import Covariance, FitResults, ParameterRow
from hygrokf.identification.turbine_type import (
    TurbineType,
    TypeFault,
    is_type,
    pool_types,
    random_effects,
    read_type,
    restricted_maximum_likelihood,
    student_quantile,
    write_type,
)
from hygrokf.modelling.design import Design
from hygrokf.physics.parameters import Coordinates, Parameter, Prior

BCG = np.array(
    [
        (4, 119, 11, 128), (6, 300, 29, 274), (3, 228, 11, 209), (62, 13536, 248, 12619),
        (33, 5036, 47, 5761),
        (180, 1361, 372, 1079), (8, 2537, 10, 619), (505, 87886, 499, 87892), (29, 7470, 45, 7232),
        (17, 1699, 65, 1600), (186, 50448, 141, 27197), (5, 2493, 3, 2338), (27, 16886, 29, 17825),
    ],
    dtype=float,
)  # fmt: skip
"""Thirteen trials of the BCG vaccine (Colditz et al. 1994): ill and well, vaccinated and not."""


def bcg() -> tuple[np.ndarray, np.ndarray]:
    """Log relative risks and their variances."""
    a, b, c, d = BCG.T
    return np.log(a / (a + b)) - np.log(c / (c + d)), 1 / a - 1 / (a + b) + 1 / c - 1 / (c + d)


def test_published_numbers_of_the_bcg_trials() -> None:
    """REML τ² 0.3132, mean −0.7145; Hartung & Knapp: se 0.1808, −1.1084 … −0.3206 (metafor, Viechtbauer
    2010)."""
    y, v = bcg()
    mean, se, spread = random_effects(y, v)
    assert spread**2 == pytest.approx(0.3132, abs=5e-5)
    assert mean == pytest.approx(-0.7145, abs=5e-5)
    assert se == pytest.approx(0.1808, abs=5e-5)
    reach = student_quantile(0.95, 12) * se
    assert (mean - reach, mean + reach) == pytest.approx((-1.1084, -0.3206), abs=5e-5)


def test_mean_of_a_given_spread_is_that_of_statsmodels() -> None:
    y, v = bcg()
    theirs = combine_effects(y, v, method_re="iterated")  # Paule and Mandel's spread
    w = 1.0 / (theirs.tau2 + v)
    assert w @ y / w.sum() == pytest.approx(theirs.mean_effect_re)
    # the two estimators of the spread differ, but not by much on these trials
    assert restricted_maximum_likelihood(y, v) == pytest.approx(theirs.tau2, rel=0.03)


def test_no_spread_where_estimates_agree_and_faults_are_named() -> None:
    v = np.full(5, 0.04)
    mean, se, spread = random_effects(np.array([1.0, 1.1, 0.95, 1.02, 0.98]), v)
    assert spread == 0.0 and mean == pytest.approx(1.01) and se == pytest.approx(math.sqrt(0.04 / 5))
    with pytest.raises(ValueError, match="at least 2"):
        random_effects(np.array([1.0]), np.array([0.1]))
    with pytest.raises(ValueError, match="above 0"):
        random_effects(np.array([1.0, 2.0]), np.array([0.1, 0.0]))


@pytest.mark.parametrize(("turbines", "spread"), [(3, 0.2), (5, 0.12), (8, 0.12)])
def test_bounds_of_type_and_prediction_of_the_next_turbine_hold(turbines: int, spread: float) -> None:
    runs, type_held, next_held = 300, 0, 0
    for seed in range(runs):
        random = np.random.default_rng([61, turbines, seed])
        v = random.uniform(0.03, 0.06, turbines) ** 2
        own = spread * random.standard_normal(turbines + 1)
        made = pool_types(
            [
                fit_of(
                    f"t{i}", math.exp(own[i] + math.sqrt(v[i]) * random.standard_normal()), math.sqrt(v[i])
                )
                for i in range(turbines)
            ]
        )
        found = made.parameters["thermal_time_constant"].in_unit()
        type_held += found["lower"] <= 1.0 <= found["upper"]
        next_held += found["next_lower"] <= math.exp(own[-1]) <= found["next_upper"]
    assert 0.91 <= type_held / runs <= 0.995
    assert 0.88 <= next_held / runs <= 0.995


def design_of(reference_K: float = 283.15, scale_W: float = 2e6) -> Design:
    release = {"order": 2, "reference_K": reference_K}
    mechanisms = (
        ("thermal_network", {}),
        ("heat_release", release),
        ("thermal_diffusion", {}),
        ("temperature_sensor", {}),
    )
    return Design(mechanisms, power_scale_W=scale_W, power_order=2, power_mean=(0.8, 0.4, 0.3))


def fit_of(
    name: str, tau: float, relative_se: float, design: Design | None = None, **more: tuple[float, float]
) -> Fit:
    """A fit that knows what is given as (value, se), without any estimation."""
    base = design or design_of()
    known = {"thermal_time_constant": (tau, relative_se * tau), **more}
    values = {p.name: p.start for p in base.model.parameters} | {n: v for n, (v, _) in known.items()}
    matrix = np.diag([se**2 for _, se in known.values()])
    return Fit(name, base, values, FitResults(covariance=Covariance(tuple(known), matrix)))


def test_levels_of_the_heat_release_are_brought_to_one_reference_and_scale() -> None:
    """a₀ + a_T (T − 283.15) and a₁ P/2 MW are the same functions, told with another reference and another
    scale."""
    told = {
        "heat_release_operation": (8.0, 0.1), "heat_release_operation_ambient": (-0.1, 1e-6),
        "heat_release_power_1": (6.0, 0.1)
    }  # fmt: skip
    other = design_of(293.15, 3e6)
    again = {
        "heat_release_operation": (7.0, 0.1), "heat_release_operation_ambient": (-0.1, 1e-6),
        "heat_release_power_1": (9.0, 0.15)
    }  # fmt: skip
    made = pool_types([fit_of("a", 1.5, 0.03, **told), fit_of("b", 1.5, 0.03, other, **again)])
    found = {name: p.mean for name, p in made.parameters.items()}
    assert found["heat_release_operation"] == pytest.approx(8.0, abs=1e-6)
    assert found["heat_release_power_1"] == pytest.approx(6.0)
    prior = made.prior(other)
    assert prior["heat_release_operation"].mean == pytest.approx(7.0, abs=1e-6)
    assert prior["heat_release_power_1"].mean == pytest.approx(9.0)
    assert prior["heat_release_power_1"].sd == pytest.approx(1.5 * made.prior()["heat_release_power_1"].sd)
    assert prior["thermal_time_constant"].logarithmic and not prior["heat_release_operation"].logarithmic


def test_offsets_of_loggers_are_no_part_of_a_type() -> None:
    more = {"cabinet_temperature_bias": (0.1, 0.1), "cabinet_temperature_noise": (0.05, 0.002)}
    made = pool_types([fit_of(name, 1.5, 0.03, **more) for name in "ab"])
    assert set(made.parameters) == {"thermal_time_constant"}


def test_parameters_of_another_turbine_are_not_counted_twice() -> None:
    fits = [fit_of("a", 1.5, 0.03), fit_of("b", 1.6, 0.03), fit_of("c", 1.5, 0.03)]
    results = replace(fits[2].results, parameters={"thermal_time_constant": ParameterRow(fixed=True)})
    made = pool_types([*fits[:2], replace(fits[2], results=results)])
    assert made.parameters["thermal_time_constant"].turbines == 2


def test_fits_that_cannot_be_pooled_are_refused() -> None:
    with pytest.raises(TypeFault, match="at least 2 turbines, found 1"):
        pool_types([fit_of("a", 1.5, 0.03)])
    with pytest.raises(TypeFault, match="several fits of a"):
        pool_types([fit_of("a", 1.5, 0.03)] * 2)
    with pytest.raises(TypeFault, match="found none"):
        pool_types([fit_of("a", 1.5, 5.0), fit_of("b", 1.5, 5.0)])


def test_a_type_is_read_again_as_it_was_written(tmp_path: Path) -> None:
    made = pool_types([fit_of("a", 1.4, 0.03), fit_of("b", 1.6, 0.04), fit_of("c", 1.5, 0.03)], "DFIG 2 MW")
    path = write_type(made, tmp_path / "type.json")
    again = read_type(path)
    assert again == made and again.prior() == made.prior() and is_type(path)
    assert isinstance(again, TurbineType) and again.values["thermal_time_constant"] == pytest.approx(
        1.5, rel=0.02
    )
    (tmp_path / "none.json").write_text(json.dumps({"name": "x"}))
    assert not is_type(tmp_path / "none.json") and not is_type(tmp_path / "absent.json")
    for name in ("none.json", "absent.json"):
        with pytest.raises(ResultFault, match=name):
            read_type(tmp_path / name)


@pytest.mark.parametrize(
    "key, value", [("mean", "x"), ("mean", 1e9), ("next_sd", -1.0), ("se", None), ("upper", -99.0)]
)
def test_a_type_with_impossible_numbers_is_refused(tmp_path: Path, key: str, value: object) -> None:
    data = plain(pool_types([fit_of("a", 1.4, 0.03), fit_of("b", 1.6, 0.04)]))
    data["parameters"]["thermal_time_constant"][key] = value
    path = tmp_path / "type.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ResultFault, match="thermal_time_constant"):
        read_type(path)


def test_a_logarithmic_prior_has_the_derivatives_of_its_density() -> None:
    p = Parameter(
        "thermal_time_constant", "h", 2.0, 0.02, 200.0, positive=True, prior=Prior(math.log(1.5), 0.1, True)
    )
    coordinates = Coordinates([p])
    for z in (0.2, 0.5):
        value, gradient, curvature = coordinates.log_prior(np.array([z]))
        up, down = (coordinates.log_prior(np.array([z + h]))[0] for h in (1e-5, -1e-5))
        assert gradient[0] == pytest.approx((up - down) / 2e-5, rel=1e-6)
        assert curvature[0] == pytest.approx(100.0)
        assert value == pytest.approx(
            -0.5 * ((z - math.log(1.5)) / 0.1) ** 2 - math.log(0.1 * math.sqrt(2 * math.pi))
        )
    with pytest.raises(ValueError, match="positive parameter"):
        replace(p, positive=False)


def test_priors_of_a_design_reach_its_model_and_survive_json() -> None:
    base = replace(design_of(), priors={"thermal_time_constant": (0.4, 0.1, True)})
    again = Design.from_json(json.loads(json.dumps(base.to_json())))
    for one in (base, again):
        p = next(p for p in one.model.parameters if p.name == "thermal_time_constant")
        assert p.prior == Prior(0.4, 0.1, True)
    assert next(iter(design_of().model.parameters)).prior is None
