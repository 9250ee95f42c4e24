"""The test profile: what it has to reproduce, and chambers that cannot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hygrokf.climate.bounds import bounded
from hygrokf.climate.chamber import (
    BOLTZMANN_EV,
    Acceleration,
    Chamber,
    ProfileLength,
    ProfilePlan,
)
from hygrokf.climate.chamber_profile import (
    ChamberProfile,
    Days,
    build_profile,
    choose_days,
    closeness,
    ordered,
    set_points,
    shares,
)
from hygrokf.data.toml_form import FormFault, read_toml_form


def many_days(count: int = 400, seed: int = 6) -> Days:
    """Days with season, day and chance, as one cabinet might have them."""
    random = np.random.default_rng(seed)
    hour = np.arange(24)
    level = 18 + 8 * np.sin(2 * np.pi * np.arange(count) / 365) + 3 * random.standard_normal(count)
    swing = np.abs(3 + 2 * random.standard_normal(count))
    celsius = level[:, None] + swing[:, None] * np.cos(2 * np.pi * (hour - 15) / 24)
    percent = 55 + 12 * random.standard_normal((count, 1)) - 2.0 * (celsius - level[:, None])
    return np.stack([celsius, np.clip(percent, 5, 100)])


DAYS = many_days()
COUNT = DAYS.shape[1]
LAW = Acceleration()
AGEING = float(LAW.rate(DAYS[0] + 273.15, DAYS[1] / 100).mean() * 8766)


def profile_of(length_h: float, service_years: float, ageing: np.ndarray, **chamber: Any) -> ChamberProfile:
    plan = ProfilePlan(ProfileLength(length_h, service_years), chamber=Chamber(**chamber))
    return build_profile(DAYS, plan, bounded(ageing), np.array([200.0, 100.0, 2.0]))


def test_a_profile_ages_as_much_as_the_service() -> None:
    made = profile_of(1000, 10, np.full((1, 50), AGEING))
    aged = LAW.rate(made.temperature_degC + 273.15, made.relative_humidity_percent / 100).sum()
    assert made.reached and len(made.temperature_degC) == 1000
    assert made.closeness.ageing.test_h == pytest.approx(10 * AGEING, rel=1e-6)
    assert aged == pytest.approx(10 * AGEING, rel=1e-4)  # of what is written, with two decimals
    assert made.temperature_degC.max() <= 85.0 and made.relative_humidity_percent.max() <= 95.0


def test_chosen_days_are_like_all_of_them_and_random_ones_less_so() -> None:
    site = shares(DAYS)
    chosen = choose_days(DAYS, 42, LAW)
    assert len(set(chosen.tolist())) == 42

    def distance(places: np.ndarray) -> float:
        return 0.5 * np.abs(shares(DAYS[:, places]) - site).sum()

    random = np.random.default_rng(1)
    others = [distance(random.choice(COUNT, 42, replace=False)) for _ in range(50)]
    assert distance(chosen) < 0.1 < min(others)
    everything = choose_days(DAYS, COUNT + 10, LAW)  # more than there are
    assert len(everything) == 410 and np.bincount(everything).max() == 2


def test_warming_by_the_law_keeps_every_condition_s_share_of_the_ageing() -> None:
    wide = Chamber((-80.0, 200.0), (0.0, 100.0), 6000.0, 6000.0)
    celsius, percent = DAYS.reshape(2, -1)
    before = LAW.rate(celsius + 273.15, percent / 100)
    warm, damp = set_points(DAYS.reshape(2, -1), 5e-4, wide)
    after = LAW.rate(warm + 273.15, damp / 100)
    assert after / before == pytest.approx(np.full(len(celsius), np.exp(0.79 / BOLTZMANN_EV * 5e-4)))
    assert np.array_equal(damp, percent)


@settings(max_examples=40)
@given(
    shift=st.floats(-1e-4, 1.2e-3), ramp=st.floats(0.5, 50.0), humid=st.floats(1.0, 50.0),
    top=st.floats(40.0, 120.0)
)  # fmt: skip
def test_a_chamber_is_never_asked_for_more_than_it_can(
    shift: float, ramp: float, humid: float, top: float
) -> None:
    chamber = Chamber((-10.0, top), (20.0, 90.0), ramp, humid)
    warm, damp = set_points(DAYS[:, :20].reshape(2, -1), shift, chamber)
    assert -10.0 <= warm.min() and warm.max() <= top and 20.0 <= damp.min() and damp.max() <= 90.0
    assert np.abs(np.diff(warm)).max() <= ramp + 1e-9 and np.abs(np.diff(damp)).max() <= humid + 1e-9


def test_what_is_out_of_reach_is_said() -> None:
    made = profile_of(48, 50, np.full((1, 50), AGEING), temperature_degC=(-20.0, 60.0))
    found = made.closeness
    aged = LAW.rate(made.temperature_degC + 273.15, made.relative_humidity_percent / 100).sum()
    assert not made.reached and aged < 50 * AGEING and found.ageing.test_h == pytest.approx(aged, rel=1e-3)
    assert found.ageing.years == pytest.approx(found.ageing.test_h / AGEING) and found.ageing.years < 50


def test_closeness_tells_what_the_test_has() -> None:
    years = np.random.default_rng(3).normal(AGEING, 0.05 * AGEING, (1, 200))
    found = profile_of(480, 5, years).closeness
    assert found.ageing.years_lower < 5.0 < found.ageing.years_upper
    assert found.joint_distance < 0.15 and found.ageing_distance < 0.2
    numbers = {one.name.text: one.site for one in found.numbers}
    assert numbers["temperature cycles of 10 K and more, in service"] == 500.0
    all_of_them = DAYS.reshape(2, -1)
    whole = closeness(DAYS, all_of_them, all_of_them, ProfilePlan(), bounded(years), np.zeros(3))
    assert whole.joint_distance == 0.0 and whole.ageing_distance == pytest.approx(0.0, abs=1e-12)
    assert all(one.site == pytest.approx(one.test) for one in whole.numbers[:3])


def test_days_are_put_in_an_order_with_small_jumps() -> None:
    part = DAYS[:, ::10]
    order = ordered(part)
    assert sorted(order.tolist()) == list(range(40))

    def jumps(days: Days) -> float:
        ends, starts = days[0, :-1, -1], days[0, 1:, 0]
        return float(np.abs(ends - starts).mean())

    random = np.random.default_rng(0)
    assert jumps(part[:, order]) < 0.6 * np.mean([jumps(part[:, random.permutation(40)]) for _ in range(20)])


def test_plans_are_read_and_all_faults_told(tmp_path: Path) -> None:
    file = tmp_path / "test.toml"
    file.write_text(
        "[test]\nlength_h = 500\n[law]\nhumidity_exponent = 0\n[chamber]\ntemperature_degC = [-40, 95]\n"
    )
    made = read_toml_form(ProfilePlan, file)
    assert (made.test.length_h, made.test.service_years, made.law.humid) == (500.0, 20.0, False)
    assert made.chamber.temperature_degC == (-40.0, 95.0)
    file.write_text(
        '[test]\nlength_h = 1\nspeed = 3\n[law]\nactivation_energy_eV = "x"\n[chamber]\ntemperature_degC = '
        "[90, 20]\n"
    )
    with pytest.raises(FormFault) as told:
        read_toml_form(ProfilePlan, file)
    assert len(told.value.faults) == 4 and "length_h" in str(told.value) and "rising" in str(told.value)
