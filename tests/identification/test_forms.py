"""Forms that compete with the base, offsets of clocks, and the interval that is composed of all of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from other_make import ROWS, make_plant
from other_make.as_record import to_record
from scipy.integrate import solve_ivp

from hygrokf import identify
from hygrokf.data.record import Record, Series
from hygrokf.data.structured import plain
from hygrokf.engine.timeline import timeline
from hygrokf.estimation.confidence import Uncertainty, normal_quantile, part_shifts, uncertainty
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective, climb
from hygrokf.identification.clock_offsets import (
    ONE_SYSTEM_S,
    TWO_SYSTEMS_S,
    _solved,
    clock_offsets,
    prior_s,
)
from hygrokf.identification.composition import (
    AlternativeEstimate,
    compose_interval,
    of_forms,
    of_free_run,
    of_parts,
)
from hygrokf.identification.estimation import estimate_design, smoothed_temperature
from hygrokf.identification.model_forms import (
    CONVECTION,
    RESPONSE_FORM,
    SECOND,
    SECOND_MASS,
    _within_ranges,
    candidates,
)
from hygrokf.modelling.design import Design, design
from hygrokf.modelling.inputs import model_inputs
from hygrokf.modelling.thermal_system import thermal_system
from hygrokf.physics.mechanisms import MECHANISMS
from hygrokf.physics.mechanisms.thermal import STILL_K, natural_convection, small_signal
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Coordinates, Parameter

Z = normal_quantile(0.95)


def plant_record(row: str, seed: int, days: float = 45.0) -> tuple[Record, object]:
    made = make_plant(seed=seed, scenario=ROWS[row], days=days)
    return to_record(made), made.truth


# --- natural convection ---------------------------------------------------------------------


def convecting(exponent: float, difference: float = 8.0) -> tuple[Design, dict]:
    made = Design(mechanisms=(("thermal_network", {}), ("natural_convection", {"difference_K": difference})))
    return made, {"thermal_time_constant": 1.7, "resistance_ratio": 0.8, "convection_exponent": exponent}


@pytest.mark.parametrize("exponent", [0.0, 0.25, 1.0 / 3.0])
def test_small_changes_decay_with_the_time_constant_and_heat_counts_less(exponent):
    """About ΔT₀ the pole is −1/τ, and a kelvin of heat release warms the air by 1/(1+n), as ΔT^(1+n) has
    it."""
    found = thermal_system(*convecting(exponent))
    a, b, c, d = found.A, found.B, found.C, found.D
    # the still air's half kelvin beside 8 K is 0.4 % of its square
    assert a[0, 0] == pytest.approx(-1.0 / 1.7, rel=2e-3)
    gain = d[0, 1] - (c @ np.linalg.solve(a, b))[0, 1]
    assert gain == pytest.approx(1.0 / (1.0 + exponent), rel=4e-3)


@pytest.mark.parametrize("difference", [3.0, 8.0, 20.0])
def test_the_balance_is_that_of_natural_convection(difference):
    """With heat f the cabinet settles where (ΔT/ΔT₀)ⁿ ΔT = f; what is left decays as `small_signal` says."""
    exponent, at, tau, rho = 0.25, 8.0, 1.7, 0.8
    heat = (math.hypot(difference, STILL_K) / at) ** exponent * difference
    mechanism = natural_convection(at)
    network = MECHANISMS["thermal_network"]()
    fixed = replace(MECHANISMS["heat_release"](operation=False, standstill_ambient=False), initial=None)
    model = compose([network, mechanism, fixed], {"ambient_temperature": "linear"})
    values = {
        "thermal_time_constant": tau,
        "resistance_ratio": rho,
        "convection_exponent": exponent,
        "heat_release_standstill": heat,
    }

    def rate(_, x):
        return model.evaluate(list(x), {"ambient_temperature": 283.0}, values).rates

    rest = 283.0 + difference / rho
    settled = solve_ivp(rate, (0.0, 60.0), [rest + 2.0], rtol=1e-9, atol=1e-9).y[0, -1]
    assert settled == pytest.approx(rest, abs=1e-4)
    end = solve_ivp(rate, (0.0, 0.5), [rest + 0.01], rtol=1e-10, atol=1e-12).y[0, -1]
    decay = 0.5 / math.log(0.01 / (end - rest))
    assert decay == pytest.approx(small_signal(tau, exponent, at, difference), rel=8e-3)


# --- sensors with a response ---------------------------------------------------------------


def test_a_reading_follows_a_step_of_the_air_with_the_response_time():
    """Air that starts 10 K above a constant ambient and relaxes: two first-order lags in a row, in closed
    form."""
    tau, response = 2.0, 0.2
    model = compose(
        [
            MECHANISMS["thermal_network"](),
            MECHANISMS["thermal_diffusion"](),
            MECHANISMS["temperature_sensor"](accuracy=0.0, response_h=response),
        ],
        {"ambient_temperature": "linear"},
    )
    time = np.arange(0.0, 6.0, 0.25)
    made = timeline(model, time, {"ambient_temperature": np.full(len(time), 283.0)}, {})
    values = {p.name: p.start for p in model.parameters} | {
        "thermal_time_constant": tau,
        "resistance_ratio": 1.0,
    }
    likelihood = Likelihood(model, made)
    start = likelihood.first_gaussian(values)
    mean = dict(zip(model.states, start.mean, strict=True))
    mean |= {"converter_temperature": 293.0, "cabinet_temperature_sensor": 283.0}
    begun = replace(start, mean=np.array([mean[name] for name in model.states]))
    found = likelihood.trace(values, gain=False, start=begun).prediction[:, 0]
    expected = 283.0 + 10.0 * tau / (tau - response) * (np.exp(-time / tau) - np.exp(-time / response))
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("kind", ["temperature_sensor", "humidity_sensor", "absolute_humidity_sensor"])
def test_a_stated_and_an_estimated_response_of_the_same_length_are_one_model(kind):
    stated = MECHANISMS[kind](response_h=0.15)
    free = MECHANISMS[kind](longest_response_h=0.5)
    assert stated.states == free.states and len(stated.states) == 1
    (more,) = {p.name for p in free.parameters} - {p.name for p in stated.parameters}
    assert more == f"{next(iter(stated.outputs))}_response"
    assert MECHANISMS[kind]().states == ()


# --- forms on records -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def slow_sensor():
    record, truth = plant_record("lag_unstated", 31001)
    return identify(record, starts=1), truth


def test_a_slow_humidity_sensor_is_told_from_a_slow_exchange(slow_sensor):
    """The temperature beside it tells: the response is found within its bounds, and the constant is the
    exchange's own."""
    fit, truth = slow_sensor
    entry = fit.results.time_constants["hygric"]
    weights = {form.form: form.weight for form in entry.forms}
    assert sum(weight for form, weight in weights.items() if form.startswith(RESPONSE_FORM)) > 0.95
    said = entry.response
    assert said.kind == "estimated"
    assert said.lower_minutes < truth.lags_s["cabinet_relative_humidity"] / 60.0 < said.upper_minutes
    reference = entry.mean_temperatures
    true = truth.hygric_h(reference.cabinet_temperature_K, reference.ambient_temperature_K)
    base = next(form for form in entry.forms if form.form == "base")
    assert base.value_h > 1.2 * true
    assert entry.lower_h < true < entry.upper_h


def test_a_stated_response_is_modelled_and_no_form_of_its_own():
    record, truth = plant_record("lag_stated", 31001, days=15.0)
    fit = identify(record, starts=1, profiles=False)
    entry = fit.results.time_constants["hygric"]
    assert [form.form for form in entry.forms] == ["base", SECOND["vapour_disturbance"]]
    assert entry.response.kind == "stated"
    assert entry.response.minutes == pytest.approx(truth.lags_s["cabinet_relative_humidity"] / 60.0)
    assert "cabinet_relative_humidity_sensor" in fit.design.model.states


def test_a_response_at_an_end_of_its_range_is_not_adopted():
    """Ambient stamps a minute early look like a humidity sensor of two minutes, the shortest that can be
    told."""
    record, truth = plant_record("clock", 30021)
    assert truth.late_s["ambient"] == -60.0
    fit = identify(record, starts=1, profiles=False)
    entry = fit.results.time_constants["hygric"]
    assert entry.response.kind == "included"
    (clock,) = (one for one in entry.clock if one.source.startswith("ambient"))
    assert clock.offset_s + 2.0 * clock.sd_s < 0.0


def test_without_lag_convection_or_second_mass_the_base_stays():
    record, truth = plant_record("instants", 31002, days=30.0)
    fit = identify(record, starts=1, profiles=False)
    assert "natural_convection" not in dict(fit.design.mechanisms)
    thermal, moist = (fit.results.time_constants[name] for name in ("thermal", "hygric"))
    assert {form.form for form in thermal.forms} == {
        "base",
        CONVECTION,
        SECOND_MASS,
        SECOND["heat_disturbance"],
    }
    assert sum(form.weight for form in thermal.forms) == pytest.approx(1.0)
    assert moist.response.kind == "included"
    assert thermal.lower_h < truth.thermal_h < thermal.upper_h


def test_no_form_that_a_design_has_already_is_a_candidate():
    record, _ = plant_record("instants", 31003, days=12.0)
    base = design(record, kind="thermal")
    made = model_inputs(base, record)
    values = {p.name: p.start for p in base.model.parameters}
    left = [CONVECTION, SECOND_MASS, SECOND["heat_disturbance"]]
    read = base.model.inputs, base.model.outputs
    for name in left.copy():
        tried = candidates(base, made, values)
        assert [one.name for one in tried] == left
        base = next(one.design for one in tried if one.name == name)
        values = {p.name: p.start for p in base.model.parameters} | values
        left.remove(name)
        assert (base.model.inputs, base.model.outputs) == read  # the run is theirs, too
    assert candidates(base, made, values) == []


def test_the_forms_of_the_hygric_part_read_its_inputs_alone():
    record, _ = plant_record("lag_unstated", 31001, days=12.0)
    base = design(record, kind="cascade")
    values = {p.name: p.start for p in base.model.parameters}
    tried = candidates(base, model_inputs(base, record), values)
    assert [one.name for one in tried] == [RESPONSE_FORM, SECOND["vapour_disturbance"]]
    for one in tried:
        assert one.design.model.inputs == base.model.inputs
        assert one.design.model.outputs == base.model.outputs


def test_the_smoothed_temperature_is_better_between_readings_than_a_straight_line(thermal_part):
    """Ambient and power between the cabinet's readings tell its temperature better than the chord does."""
    record, found = thermal_part
    values = found.estimate.values
    smoothed = smoothed_temperature(found.base, found.run, values, "cabinet_relative_humidity")
    made = make_plant(seed=31004, scenario=ROWS["instants"], days=45.0)
    read = record["cabinet_temperature"].known[0]
    middle = 0.5 * (read[1:] + read[:-1])[10:-10]
    true = np.interp(middle, made.weather.time, made.trajectory.cabinet_K)
    chord = np.interp(middle, read, np.interp(read, smoothed.time, smoothed.value))
    errors = [np.std(course - true) for course in (np.interp(middle, smoothed.time, smoothed.value), chord)]
    assert errors[0] < 0.95 * errors[1]


# --- clocks ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def thermal_part():
    record, _ = plant_record("instants", 31004)
    base = design(record, kind="thermal")
    return record, estimate_design(record, base, 1, lambda text: None)


def test_an_offset_of_a_source_and_its_effect_are_found(thermal_part):
    """Stamps of the power made 90 s late: the offset moves by 90 s, and the estimate moves as foreseen to
    first order."""
    record, found = thermal_part
    right = offsets(found)
    late = record.replace_series(
        *(replace(s, time=s.time + 90.0) for s in record.series if s.source.startswith("scada"))
    )
    made = model_inputs(found.base, late)
    objective = Objective(Likelihood(found.base.model, made.timeline), found.estimate.coordinates)
    moved = climb(objective, found.estimate.z, passes=30)
    there = replace(
        found,
        run=made,
        estimate=replace(
            found.estimate,
            z=moved.z,
            values=found.estimate.coordinates.values(moved.z),
            objective=moved.objective,
        ),
    )
    wrong = offsets(there)
    before, after = (
        next(one for one in each.sources if one.source.startswith("scada")) for each in (right, wrong)
    )
    # the prior of 60 s pulls both toward 0 by its share
    share = 1.0 - (before.sd_s / 60.0) ** 2
    assert after.offset_s - before.offset_s == pytest.approx(90.0 * share, abs=25.0)
    assert before.sd_s < 30.0
    place = found.estimate.coordinates.names.index("thermal_time_constant")
    real = found.estimate.z[place] - moved.z[place]
    foreseen = wrong.shift["thermal_time_constant"] - right.shift["thermal_time_constant"]
    assert foreseen == pytest.approx(real, abs=0.3 * abs(real) + 0.004)


def offsets(found):
    objective = Objective(found.likelihood, found.estimate.coordinates)
    return clock_offsets(found.base, found.run, found.estimate, uncertainty(objective, found.estimate))


def test_clocks_of_an_estimate_whose_parameters_are_all_open_move_none_of_them(thermal_part):
    found = thermal_part[1]
    nothing = np.empty((0, 0))
    open_ = Uncertainty((), nothing, nothing, np.empty(0), (), (), nothing)
    free = clock_offsets(found.base, found.run, found.estimate, open_)
    assert len(free.sources) == len(offsets(found).sources) and free.shift == {}


@pytest.mark.parametrize("seed", range(8))
def test_offsets_are_the_posterior_of_one_linear_model_and_no_wider_than_their_prior(seed):
    """Readings linear in parameters and offsets, against the dense posterior; an offset that acts as a
    parameter does (last seeds) learns nothing."""
    random = np.random.default_rng(seed)
    slopes, moved = random.normal(size=(40, 1, 3)), random.normal(size=(40, 1, 2))
    if seed >= 4:
        moved[..., 0] = slopes @ np.array([1.0, -2.0, 10.0])
    weights, prior = random.uniform(0.5, 2.0, (40, 1)), np.array([30.0, 60.0])
    # at the maximum of the parameters their score is zero
    x, root = slopes.reshape(40, 3), np.sqrt(weights)
    errors = random.normal(size=(40, 1))
    errors -= x @ np.linalg.lstsq(root * x, root * errors, rcond=None)[0]
    known = np.linalg.inv(x.T @ (weights * x))
    found = _solved(("a", "b", "c"), known, ["one", "two"], prior, weights, errors, slopes, moved)
    both = np.concatenate([x, moved.reshape(40, 2)], axis=1)
    scale = np.linalg.norm(both, axis=0)
    joint = both.T @ (weights * both) + np.diag([0.0, 0.0, 0.0, *prior**-2.0])
    dense = np.linalg.inv(joint / np.outer(scale, scale)) / np.outer(scale, scale)
    step = -dense @ both.T @ (weights * errors)[:, 0]
    for place, one in enumerate(found.sources):
        assert one.sd_s <= prior[place] * (1.0 + 1e-12)
        assert one.sd_s == pytest.approx(math.sqrt(dense[3 + place, 3 + place]), rel=1e-4)
        assert one.offset_s == pytest.approx(step[3 + place], rel=1e-4, abs=1e-4)
    for place, name in enumerate("abc"):
        added = dense[place, place] - known[place, place]
        assert found.variance[name] == pytest.approx(added, rel=1e-3, abs=1e-6)


def test_a_source_whose_clock_is_known_exactly_has_no_offset(thermal_part):
    found = thermal_part[1]
    record = found.run.record
    exact = record.replace_series(*(replace(s, clock_uncertainty_s=0.0) for s in record.series))
    assert offsets(replace(found, run=replace(found.run, record=exact))).sources == ()


@pytest.mark.parametrize(
    ("stated", "source", "expected"),
    [
        ((None, None), ("a.csv, x", "b.csv, y"), TWO_SYSTEMS_S),
        ((None, None), ("a.csv, x", "a.csv, y"), ONE_SYSTEM_S),
        ((20.0, None), ("a.csv, x", "b.csv, y"), 20.0),
        ((3.0, 4.0), ("a.csv, x", "b.csv, y"), 5.0),
        ((0.0, 0.0), ("a.csv, x", "b.csv, y"), 0.0),
    ],
)
def test_prior_uncertainty_of_two_clocks(stated, source, expected):
    one, other = (
        Series("ambient_temperature", [0.0, 60.0], [280.0, 281.0], clock_uncertainty_s=s, source=name)
        for s, name in zip(stated, source, strict=True)
    )
    assert prior_s(one, other) == expected


# --- the interval ---------------------------------------------------------------------------


def test_without_further_sources_the_interval_is_the_profiles():
    found = compose_interval(2.0, (1.8, 2.3), 0.95, {})
    assert plain(found) == [{"source": "profile", "lower_h": 1.8, "upper_h": 2.3}]


def test_sources_add_in_squares_on_the_logarithm_and_keep_the_profiles_skew():
    found = compose_interval(2.0, (1.8, 2.3), 0.95, {"a": 0.0009, "b": 0.0016})
    down, up = math.log(2.0 / 1.8), math.log(2.3 / 2.0)
    assert found[-1].lower_h == pytest.approx(2.0 * math.exp(-math.hypot(down, Z * 0.05)))
    assert found[-1].upper_h == pytest.approx(2.0 * math.exp(math.hypot(up, Z * 0.05)))
    widths = [math.log(step.upper_h / step.lower_h) for step in found]
    assert widths == sorted(widths)


@pytest.mark.parametrize(("lower", "upper"), [(0.0, 2.3), (1.8, math.inf)])
def test_an_open_side_stays_open(lower, upper):
    found = compose_interval(2.0, (lower, upper), 0.95, {"a": 0.01})
    assert (found[-1].lower_h == 0.0) == (lower == 0.0)
    assert math.isnan(found[-1].upper_h) == math.isinf(upper)


def test_forms_widen_to_the_variance_of_their_mixture():
    """Two forms of equal evidence 10 % apart, against a sample of the mixture itself."""
    forms = [AlternativeEstimate(0.0, 0.02**2, 0.5), AlternativeEstimate(0.1, 0.03**2, 0.5)]
    random = np.random.default_rng(3)
    sample = np.concatenate([random.normal(0.0, 0.02, 200_000), random.normal(0.1, 0.03, 200_000)])
    whole = 0.02**2 + of_forms(0.0, 0.02**2, forms)
    assert whole == pytest.approx(float(np.mean(sample**2)), rel=0.01)
    assert of_forms(0.0, 0.02**2, [forms[0], replace(forms[1], weight=0.0)]) == 0.0


def test_ranges_of_a_forms_parameters_bound_what_they_could_imitate() -> None:
    """Where a form hardly acts, its parameter is almost unknown and trades against the time constant: its
    range then counts as a prior of its variance, in one linear model."""
    tau, mass = (
        Parameter(name, "h", 1.0, 0.1, 10.0, positive=True) for name in ("thermal_time_constant", "mass")
    )
    slopes = np.array([[25.0, 1e-3], [10.0, 2e-3], [5.0, 1e-4]])
    information = slopes.T @ slopes
    wide = np.linalg.inv(information)
    coordinates = Coordinates((tau, mass), {})
    estimate = Estimate(coordinates, np.zeros(2), {}, 0.0, 0.0, True, "", ())
    known = Uncertainty(coordinates.names, wide, wide, np.ones(2), (), (), information)
    found = _within_ranges(estimate, known, ["mass"])
    width = math.log(10.0 / 0.1)
    expected = np.linalg.inv(information + np.diag([0.0, 12.0 / width**2]))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert math.sqrt(wide[0, 0]) > 0.05 > math.sqrt(found[0, 0])
    np.testing.assert_array_equal(_within_ranges(estimate, known, []), wide)


def test_a_free_run_that_agrees_adds_nothing():
    assert of_free_run(0.0, 0.02**2, AlternativeEstimate(0.05, 0.05**2)) == 0.0
    assert of_free_run(0.0, 0.02**2, AlternativeEstimate(0.1, 0.05**2)) == 0.0
    apart = of_free_run(0.0, 0.02**2, AlternativeEstimate(0.3, 0.05**2))
    assert apart == pytest.approx(0.5 * (0.09 - 0.0004 - 0.0025))


def test_parts_that_scatter_as_they_should_add_nothing():
    assert of_parts(0.7, 0.01) == 0.0
    assert of_parts(3.0, 0.01) == pytest.approx(0.02)


def test_parts_of_a_mean_are_the_means_of_the_parts():
    """Readings N(μ, 1): one step of Newton's from the common mean is exact, so parts are the quarters' own
    means."""
    random = np.random.default_rng(7)
    value = random.normal(size=4000)
    scores = (value - value.mean())[:, None]
    found = part_shifts(scores, value[:, None], np.array([[1.0 / 4000]]))
    expected = value.reshape(4, 1000).mean(axis=1) - value.mean()
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-3)
