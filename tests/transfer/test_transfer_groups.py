"""The selection of groups that differ: quadratic forms by least squares, false alarms and power by
simulation."""

from __future__ import annotations

import numpy as np
import pytest

from hygrokf.transfer.baseline import (
    DISTURBANCES,
    HEAT_GROUP,
    HYGRIC_GROUP,
    OFFSETS,
    THERMAL_GROUP,
    Difference,
    group_of,
    members,
    selection,
    unexplained,
)

NAMES = ("tau", "rho", "a", "b", "c", "k")
GROUPS = dict(
    zip(NAMES, (THERMAL_GROUP, THERMAL_GROUP, HEAT_GROUP, HEAT_GROUP, HEAT_GROUP, HYGRIC_GROUP), strict=True)
)


def difference_of(seed: int, shift: dict[str, float] | None = None) -> Difference:
    """A draw from N(shift in standard errors, Σ) with a Σ that is anything but diagonal."""
    random = np.random.default_rng([71, seed])
    root = np.eye(6) + 0.6 * np.random.default_rng(70).standard_normal((6, 6))
    covariance = root @ root.T
    sd = np.sqrt(np.diag(covariance))
    mean = np.array([(shift or {}).get(n, 0.0) for n in NAMES]) * sd
    return Difference(NAMES, mean + root @ random.standard_normal(6), covariance)


def test_the_unexplained_distance_is_that_of_generalised_least_squares() -> None:
    found = difference_of(1)
    precision = np.linalg.inv(found.covariance)
    for differing in ((), ("tau", "rho"), ("k",), ("tau", "rho", "k")):
        columns = np.eye(6)[:, [NAMES.index(n) for n in differing]]
        rest = found.value
        if differing:
            moved = np.linalg.solve(columns.T @ precision @ columns, columns.T @ precision @ found.value)
            rest = found.value - columns @ moved
        assert unexplained(found, differing) == pytest.approx(rest @ precision @ rest, rel=1e-9)
    assert unexplained(found, NAMES) == 0.0


def selected(found: Difference) -> list[str]:
    return [group for group, test in selection(found, GROUPS).items() if test.significant]


def test_false_alarms_are_as_rare_as_stated() -> None:
    alarms = sum(bool(selected(difference_of(seed))) for seed in range(600))
    assert alarms / 600 < 0.075


@pytest.mark.parametrize(
    "right", [{"tau": 12.0}, {"a": 12.0, "k": -12.0}, {"rho": 15.0, "b": 15.0, "k": 15.0}]
)
def test_large_differences_are_named_and_no_others(right: dict[str, float]) -> None:
    wanted = {GROUPS[n] for n in right}
    hits = sum(set(selected(difference_of(seed, right))) == wanted for seed in range(100))
    assert hits >= 92


def test_the_most_telling_comes_first_even_where_p_underflows() -> None:
    found = Difference(("tau", "k"), np.array([60.0, 90.0]), np.eye(2))
    assert selected(found) == [HYGRIC_GROUP, THERMAL_GROUP]
    tests = selection(found, GROUPS)
    assert tests[HYGRIC_GROUP].p == 0.0 and tests[THERMAL_GROUP].p_adjusted <= 1.0


def test_groups_of_a_base_model_and_of_an_added_mechanism() -> None:
    from hygrokf.modelling.design import Design, extended

    base = Design(
        (
            ("thermal_network", {}),
            ("heat_release", {}),
            ("heat_disturbance", {}),
            ("thermal_diffusion", {}),
            ("temperature_sensor", {}),
        )
    )
    groups = group_of(extended(base, [("wall_thermal_mass", {})]).model)
    assert members(groups, THERMAL_GROUP) == ("thermal_time_constant", "resistance_ratio")
    assert "heat_release_power_2" in members(groups, HEAT_GROUP)
    assert members(groups, OFFSETS) == ("cabinet_temperature_bias",)
    assert "cabinet_temperature_noise" in members(groups, DISTURBANCES)
    assert members(groups, "wall thermal mass") == ("wall_conductance", "wall_time_constant", "wall_position")
    assert len(groups) == len(set(groups)) and all(groups.values())
