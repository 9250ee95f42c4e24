"""The whole way from a record to a fit, on plants made by other means (tests/plants) and on the synthetic
turbine."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from builders.record_edits import changed, without
from plants import plant
from plants.as_record import to_record

from hygrokf.data.result_file import ResultFault, result_text
from hygrokf.data.structured import plain
from hygrokf.estimation.confidence import Limit, describe
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import BETTER_GAIN, Objective
from hygrokf.identification.estimation import assess_stage, estimate_design, identify_stage
from hygrokf.identification.fit import Fit, read_fit, write_fit
from hygrokf.identification.identify import identify, shared_error, undetermined
from hygrokf.identification.time_constants import hygric_entry
from hygrokf.modelling.design import Design, design, extended
from hygrokf.physics.parameters import Parameter
from hygrokf.texts.fit_codes import FitCode

DAYS = 45


@pytest.fixture(scope="module")
def made():
    return plant(7, days=DAYS)


@pytest.fixture(scope="module")
def record(made):
    whole = to_record(made)
    return replace(whole, until_s=whole.end_s - 10 * 86400.0)


@pytest.fixture(scope="module")
def short(record):
    return record.window(record.start_s, record.start_s + 20 * 86400.0)


@pytest.fixture(scope="module")
def fit(record) -> Fit:
    return identify(record, starts=2)


@pytest.fixture(scope="module")
def joint(short) -> Fit:
    return identify(short, kind="joint", starts=1, profiles=False)


def test_time_constants_are_recovered_within_their_bounds(fit, made):
    """Seed 7 is one draw: the bounds are 95 %, so three times their half width is what must hold here."""
    for part, truth in (("thermal", made.truth.tau_h), ("hygric", made.truth.hygric_h)):
        entry = fit.results.time_constants[part]
        half = 0.5 * math.log(entry.upper_h / entry.lower_h)
        assert abs(math.log(entry.value_h / truth)) < 1.5 * half
        assert half < 0.15
        assert (entry.method, entry.composition[0].source) == ("composed", "profile")
    assert fit.results.converged is True


def test_free_run_errs_as_the_plant_does(fit, made):
    """Free-run errors are those of the plant's own disturbances (1–2 K, 0.3–0.5 g/m³), and the baselines are
    worse."""
    found = fit.results.rmse["identification"]
    assert 0.9 < found["temperature_K"].total < 2.2
    assert 0.25 < found["absolute_humidity_g_m3"].total < 0.6
    static = fit.results.baselines["identification"]["no_dynamics"]["temperature_K"].total
    assert static > found["temperature_K"].total


def test_bands_hold_on_the_validation_period(fit):
    """The 1 h and 6 h bands hold 95 % to within what ten days of dependent forecasts allow."""
    for lead in ("1h", "6h"):
        for quantity in ("temperature_K", "absolute_humidity_g_m3"):
            cell = fit.results.bands[lead][quantity]
            assert cell.n > 100
            assert 0.85 < cell.coverage <= 1.0


def test_the_model_of_a_fit_is_estimated_from_its_values(short, fit, joint):
    """A model with a second mass contains the one without: it is no less likely, and it says whose it is."""
    wider = replace(fit, design=extended(fit.design, [("wall_thermal_mass", {})]))
    again = identify(short, model=fit, starts=1, profiles=False)
    other = identify(short, model=wider, starts=1, profiles=False)
    assert "wall_thermal_mass" in dict(other.design.mechanisms)
    assert other.results.converged and other.results.loglik > again.results.loglik - 0.5
    assert FitCode.MODEL_OF_FIT(fit=fit.name, criterion="likelihood") in other.results.statements
    # estimated in one filter, the same model has the constants of the cascade, and one maximum from any start
    assert again.results.loglik == pytest.approx(joint.results.loglik, abs=1e-3)
    for part in ("thermal", "hygric"):
        entry = fit.results.time_constants[part]
        value = again.results.time_constants[part].value_h
        assert entry.lower_h < value < entry.upper_h
        assert value == pytest.approx(joint.results.time_constants[part].value_h, rel=1e-4)


def test_what_does_not_go_with_a_model_is_refused_all_at_once(record, fit):
    dry = without(record, "cabinet_relative_humidity")
    with pytest.raises(ValueError, match=r"prior: expected none .*criterion: expected 'like") as fault:
        identify(dry, model=fit, criterion="simulation", prior=lambda one: {})
    assert re.search(r"cabinet_relative_humidity: expected at least .* found 0; add them", str(fault.value))


def test_a_model_is_estimated_with_the_loggers_of_its_record(record, fit):
    coarse = replace(record["cabinet_temperature"], accuracy=2.0, resolution=1.0)
    coarse = record.replace_series(coarse).window(record.start_s, record.start_s + 10 * 86400.0)
    other = identify(coarse, model=fit, starts=1, profiles=False)
    settings = dict(other.design.mechanisms)["temperature_sensor"]
    assert (settings["accuracy"], settings["resolution"]) == (2.0, 1.0)
    assert FitCode.FORMS_NOT_COMPARED() in other.results.statements


def test_validation_readings_touch_nothing(record, fit):
    """Readings after `until` may change scores, never an estimate."""
    late = record["cabinet_temperature"].value + 5.0
    other = identify(changed(record, "cabinet_temperature", late, record.until_s), starts=2)
    assert other.values == fit.values
    # a verdict may rest on the held-out scores, a number may not
    judged_by_it = {"verdict": None, "reasons": ()}
    for name, entry in fit.results.time_constants.items():
        there = other.results.time_constants[name]
        assert plain(replace(there, **judged_by_it)) == plain(replace(entry, **judged_by_it))
    before = fit.results.rmse["validation"]["temperature_K"].total
    assert other.results.rmse["validation"]["temperature_K"].total > before + 1.0


def test_an_estimate_below_its_own_profile_is_climbed_on(record):
    """Stopped four hundredths of τ short, the estimate is passed by its profile; the maximum is then found
    from there."""
    early = record.identification()
    base = design(early, kind="thermal")
    whole = estimate_design(early, base, 1, print)
    coordinates = whole.estimate.coordinates
    off = {
        **whole.estimate.values,
        "thermal_time_constant": 0.96 * whole.estimate.values["thermal_time_constant"],
    }
    z = coordinates.start(off)
    objective = Objective(whole.likelihood, coordinates).value(z)
    assert objective < whole.estimate.objective - BETTER_GAIN
    short = replace(whole, estimate=replace(whole.estimate, z=z, values=off, objective=objective))
    stage = assess_stage(short, True, print)
    assert stage.estimate.objective == pytest.approx(whole.estimate.objective, abs=1e-3)
    assert stage.bounds["thermal_time_constant"].better is None
    assert stage.bounds["thermal_time_constant"].value == stage.estimate.values["thermal_time_constant"]


def test_an_open_end_names_the_parameter_that_leaves_it_open(record):
    """The limits that were met reach the entry of `fit.json`, and the fit states what left k open."""
    stage = identify_stage(
        record.identification(), design(record.identification(), kind="cascade"), 1, True, print
    )
    limit = Limit("upper", "vapour_disturbance_sd", "g/m3", 400.0, 20.0, "open")
    bounds = stage.bounds["hygric_k"]
    said = describe("h", bounds.lower, math.inf, [0.0, None], [limit])
    open_ = replace(bounds, upper=math.inf, statements=said, limited_by=(limit,))
    stage = replace(stage, bounds={"hygric_k": open_})
    entry = hygric_entry(stage, {})
    assert math.isnan(entry.upper_h) and entry.limited_by[0].parameter == "vapour_disturbance_sd"
    assert FitCode.BOUNDS_OF(parameter="hygric_k", bounds=said) in undetermined(stage)
    assert said[0] == FitCode.AT_LEAST(bound=bounds.lower, unit="h")
    assert (said[1].values["parameter"], said[1].values["limit"]) == ("vapour_disturbance_sd", 20.0)


def test_joint_and_cascade_agree(joint, fit):
    for part in ("thermal", "hygric"):
        entry = joint.results.time_constants[part]
        assert entry.lower_h < fit.results.time_constants[part].value_h < entry.upper_h


def test_without_coloured_disturbances_the_time_constant_is_far_too_long(record, made):
    """The warning that everything rests on: without coloured disturbances τ comes out far too long."""
    from hygrokf.estimation.optimiser import fit_mle
    from hygrokf.modelling.inputs import model_inputs

    early = record.identification()
    white = design(early, kind="thermal", coloured=False)
    found = fit_mle(Likelihood(white.model, model_inputs(white, early).timeline), count=2)
    assert found.values["thermal_time_constant"] > 1.5 * made.truth.tau_h


def test_record_without_humidity_or_power_is_legal(short):
    dry = identify(without(short, "cabinet_relative_humidity"), starts=1, profiles=False)
    assert list(dry.results.time_constants) == ["thermal"]
    assert math.isnan(dry.results.errors("identification", "absolute_humidity_g_m3").total)
    idle = identify(without(short, "active_power"), starts=1, profiles=False)
    assert FitCode.NO_POWER() in idle.results.statements
    assert math.isnan(idle.results.errors("identification", "temperature_K").operation)
    assert idle.results.errors("identification", "temperature_K").standstill > 0


def test_record_without_cabinet_temperature_is_refused(record):
    with pytest.raises(ValueError, match="cabinet_temperature: expected at least 50 readings"):
        identify(without(record, "cabinet_temperature"))
    with pytest.raises(ValueError, match="criterion: expected one of"):
        identify(record, criterion="guess")
    with pytest.raises(ValueError, match="kind: expected"):
        identify(record, kind="both")


def test_simulation_criterion_puts_the_free_run_first(record, fit):
    other = identify(record, criterion="simulation", starts=1)
    entry = other.results.time_constants["thermal"]
    assert entry.method.startswith("output error")
    assert entry.likelihood.value_h == pytest.approx(fit.results.time_constants["thermal"].value_h, rel=0.02)
    ours = other.results.rmse["identification"]["temperature_K"].total
    assert ours <= fit.results.rmse["identification"]["temperature_K"].total + 0.01
    assert other.values["thermal_time_constant"] == pytest.approx(entry.value_h)


def test_simulation_criterion_knows_no_errors_of_the_sensors():
    """A logger that reads 1 K and 2 % too high: what is scored, tabled and written is the model that the
    criterion fitted, without sensor errors, and its temperature has the least error; the likelihood's biases
    are not added."""
    wrong = to_record(plant(8, days=24))
    for name, amount in {"cabinet_temperature": 1.0, "cabinet_relative_humidity": 0.02}.items():
        wrong = changed(wrong, name, wrong[name].value + amount)
    by_likelihood = identify(wrong, starts=1, profiles=False)
    other = identify(wrong, criterion="simulation", starts=1, profiles=False)
    held = [name for name in other.values if name.endswith("_bias")]
    assert len(held) == 2 and all(abs(by_likelihood.values[name]) > 1e-3 for name in held)
    for name in held:
        row = other.results.parameters[name]
        assert other.values[name] == row.value == 0.0 and row.fixed and math.isnan(row.se)
        assert name not in other.results.covariance.names
    assert FitCode.SENSOR_ERRORS_ZERO() in other.results.statements
    least, ours = (f.results.rmse["identification"]["temperature_K"].total for f in (other, by_likelihood))
    assert least <= ours * 1.002


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"power": "constant"}, "standstill"),
        ({"standstill": False}, "standstill"),
        ({"rho": 1.0}, ""),
        ({"ambient_step_min": 60}, ""),
        ({"logger_mean": True}, ""),
        ({"power_gap_days": 4}, ""),
    ],
)
def test_poor_records_give_honest_bounds(options, part):
    """Constant power, no standstill, R_IC = 0, hourly ambient, interval means, a long power gap: bounds hold
    the truth or at the least lie within half again of it, and what is missing is said."""
    other = plant(8, days=40, **options)
    found = identify(to_record(other), starts=1).results
    for name, truth in (("thermal", other.truth.tau_h), ("hygric", other.truth.hygric_h)):
        entry = found.time_constants[name]
        upper = math.inf if math.isnan(entry.upper_h) else entry.upper_h
        assert entry.lower_h / 1.15 < truth < upper * 1.15
    assert any(part in one.text for one in found.statements) or not part


def test_clock_uncertainty_widens_the_hygric_bounds(record, fit):
    series = [
        replace(s, clock_uncertainty_s=180.0, source="ambient.csv, " + s.signal)
        for s in record.series
        if s.signal.startswith("ambient_")
    ]
    other = identify(record.replace_series(*series), starts=1)
    plain, wide = (f.results.time_constants["hygric"] for f in (fit, other))
    ratio = math.log(wide.upper_h / wide.lower_h) / math.log(plain.upper_h / plain.lower_h)
    assert ratio > 1.1
    (clock,) = wide.clock
    # the readings know the offset better than the three minutes that are stated
    assert clock.prior_s == 180.0 and 10.0 < clock.sd_s < 120.0
    added = {row.source: row.sd_ln for row in wide.composition}
    assert added["clocks"] > 0.02


def test_fit_round_trip(fit, tmp_path):
    path = write_fit(fit, tmp_path)
    text = path.read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    again = read_fit(path)
    assert dict(again.values) == {n: row["value"] for n, row in json.loads(text)["parameters"].items()}
    assert again.design.model.states == fit.design.model.states
    assert Design.from_json(json.loads(result_text(fit.design))) == again.design
    arrays = np.load(tmp_path / "series.npz")
    assert len(arrays["time_s"]) == len(arrays["temperature_simulated"])


def test_damaged_fit_files_are_refused_in_one_line(fit, tmp_path):
    with pytest.raises(ResultFault, match="no such file"):
        read_fit(tmp_path / "none.json")
    (tmp_path / "half.json").write_text(result_text(fit.to_json())[:2000])
    with pytest.raises(ResultFault, match=r"expected the results of `hygrokf fit`, found: .*; run it again"):
        read_fit(tmp_path / "half.json")
    (tmp_path / "other.json").write_text('{"a": 1}')
    with pytest.raises(ResultFault, match="it lacks covariance, design, name"):
        read_fit(tmp_path / "other.json")


def test_a_fit_keeps_the_ranges_of_its_inputs(fit, record):
    found = fit.results.identified_on
    assert set(found) == {"ambient_temperature_K", "ambient_absolute_humidity_g_m3", "power_share"}
    early = record["ambient_temperature"].window(record.start_s, record.until_s).known[1]
    low, high = found["ambient_temperature_K"]
    assert early.min() <= low < early.min() + 1.0 and early.max() - 1.0 < high <= early.max()
    assert 0.0 <= found["power_share"][0] < 0.1 and 0.9 < found["power_share"][1] < 1.1
    assert (
        1.0 < found["ambient_absolute_humidity_g_m3"][0] < found["ambient_absolute_humidity_g_m3"][1] < 25.0
    )


@pytest.mark.parametrize(
    ("positive", "values", "errors", "correlation", "words"),
    [
        (False, (8.0, -9.0), (0.2, 0.25), 0.97, ("0.97", "their difference")),
        (False, (8.0, 9.0), (0.2, 0.25), -0.97, ("−0.97", "their sum")),
        (True, (8.0, 1.0), (0.2, 0.03), 0.97, ("their ratio",)),
        (False, (8.0, 90.0), (0.2, 2.5), 0.97, ("a combination is known better",)),
        (False, (8.0, 9.0), (0.2, 0.95), 0.97, ("a and b are strongly correlated", "0.97")),
        (True, (8.0, 9.0), (0.2, math.nan), 0.97, ("only a combination",)),
    ],
)
def test_two_well_known_parameters_do_not_trade_off(positive, values, errors, correlation, words):
    ends = (1e-3, 1e3) if positive else (-1e3, 1e3)
    pair = [Parameter(name, "K", 1.0, *ends, positive) for name in "ab"]
    text = shared_error(pair, values, errors, correlation).text
    assert all(word in text for word in words)
