"""The search by simulation on plants of another make: what is hidden is named, a plant that hides nothing is
not, and what leaves the search."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from builders import greenhouse
from plants.as_record import to_record
from plants.hidden import hidden_plant
from plants.plant import Plant

from hygrokf.discovery.discover import lines
from hygrokf.discovery.estimate import Calibration
from hygrokf.discovery.final_set import FinalSet, final_estimator, final_fit, final_set
from hygrokf.discovery.judgement import LEAST_IMPROVEMENT, Scores, judged, levelled, scores
from hygrokf.discovery.screening import parent_of, screened
from hygrokf.discovery.search import Search, refitted_with
from hygrokf.discovery.starting_model import (
    base_estimate,
    free_run_error,
    is_plausible,
    screening_point,
    update_error_models,
)
from hygrokf.modelling.causes.forms import ground_of
from hygrokf.modelling.library import LIBRARY

DAYS = 60.0
TRIED = ("solar_gain", "exchange_step", "condensation")
"""Causes of the temperature, of both quantities and of the vapour."""
Run = tuple[Plant, Search]


def found(cause: str, seed: int) -> Run:
    """A plant, and what the search finds in it."""
    made = hidden_plant(seed, cause, days=DAYS)
    record = to_record(made)
    record = replace(record, until_s=record.start_s + 2.0 / 3.0 * (record.end_s - record.start_s))
    base = base_estimate(record)
    ground = ground_of(record, base.simulator.heat, base.simulator.vapour)
    return made, Search(base, [form for one in TRIED for form in LIBRARY.cause(one).forms(ground)]).run()


@pytest.fixture(scope="module")
def sunny() -> Run:
    return found("solar_gain", 9101)


@pytest.fixture(scope="module")
def nothing() -> Run:
    return found("none", 9102)


@pytest.fixture(scope="module")
def final(sunny: Run) -> FinalSet:
    one = sunny[1].parent
    return final_set(one, final_estimator(one))


def test_a_hidden_sun_is_named_first_and_lowers_the_held_out_error(sunny: Run) -> None:
    first = sunny[1].accepted[0]
    assert first.cause == "solar_gain" and not first.judged.reason
    assert first.judged.after["temperature"] < 0.9 * first.judged.before["temperature"]
    assert first.strength > 25.0


def test_only_the_quantity_that_changed_is_fitted_again(sunny: Run) -> None:
    base, final = sunny[1].base, sunny[1].parent
    whole = refitted_with(base, [], final, final.quantities)
    for one in (refitted_with(base, [], final, {"temperature"}), update_error_models(final, {"temperature"})):
        assert one.variances["vapour"].tobytes() == final.variances["vapour"].tobytes()
        mine = [n for n in one.simulator.names if "vapour" in one.simulator.affects(n)]
        assert mine and all(one.values[n] == final.values[n] for n in mine)
        assert one.errors["vapour"] is final.errors["vapour"]
    one = refitted_with(base, [], final, {"temperature"})
    assert one.deviances["temperature"] == pytest.approx(whole.deviances["temperature"], abs=0.05)
    assert one.deviances["temperature"] > final.deviances["temperature"] + 50.0


def test_a_plant_that_hides_nothing_has_no_name_and_no_line(nothing: Run) -> None:
    assert nothing[1].accepted == [] and lines(nothing[1].parent, {}) == []


def test_a_wet_surface_shows_beside_a_time_constant_that_it_does_not_distort(nothing: Run) -> None:
    """Without the vapour of its plants, a greenhouse's likeliest model is tight and errs by three times what
    the readings vary; beside it no source gains.  A plausible model is screened where it is."""
    base = base_estimate(greenhouse.excerpt("Koala"))
    point = screening_point(base)
    assert not is_plausible(base, "vapour") and base.values["hygric_k"] > 50.0 > point.values["hygric_k"]
    ground = ground_of(base.simulator.scene.record, base.simulator.heat, base.simulator.vapour)
    forms = LIBRARY.cause("internal_moisture_source").forms(ground)
    (wet,) = (form for form in forms if form.code == "a_wet_surface")
    assert screened(parent_of(base), wet) == []
    assert screened(parent_of(point), wet)[0].gain > 50.0
    assert screening_point(nothing[1].base) is nothing[1].base


def test_base_and_final_set_hold_the_plants_time_constants(nothing: Run, sunny: Run, final: FinalSet) -> None:
    """Within 15 %: one plant each, and bounds of 95 % are for many."""
    base = nothing[1].base
    assert base.values["thermal_time_constant"] == pytest.approx(nothing[0].truth.tau_h, rel=0.15)
    assert base.values["hygric_k"] == pytest.approx(nothing[0].truth.hygric_constant_h, rel=0.15)
    assert final.estimate.values["thermal_time_constant"] == pytest.approx(sunny[0].truth.tau_h, rel=0.15)
    low, high = final.bounds("thermal_time_constant")
    assert 0.0 < low < final.estimate.values["thermal_time_constant"] < high < 2.0 * low


def test_a_final_set_is_a_fit_with_its_numbers(sunny: Run, final: FinalSet) -> None:
    fit = final_fit(sunny[1].base.simulator.scene.record, final)
    assert fit.results.criterion == final.estimator
    for name in ("thermal_time_constant", "solar_heat", "hygric_k"):
        assert fit.values[name] == pytest.approx(final.estimate.values[name], rel=1e-12)
    entry = fit.results.time_constants["thermal"]
    assert (entry.lower_h, entry.upper_h) == pytest.approx(final.bounds("thermal_time_constant"), rel=1e-3)
    # `simulate` of the fit errs as the search's own runs did
    told = fit.results.errors("validation", "temperature_K").total
    r = final.estimate.simulator.scene.readings["temperature"]
    error = np.where(r.identified, np.nan, r.value - final.estimate.simulated["temperature"])
    assert told == pytest.approx(math.sqrt(np.nanmean(error**2)), rel=0.02)


def test_levels_of_a_run_that_is_off_come_back(nothing: Run) -> None:
    one = nothing[1].base
    place = one.simulator.names.index("heat_release_operation")
    theta = one.theta.copy()
    theta[place] += 3.0
    off = replace(one, theta=theta, simulated=_simulated(one, theta))
    assert free_run_error(off, "temperature") > free_run_error(one, "temperature") + 0.5
    back = levelled(off)
    assert free_run_error(back, "temperature") < free_run_error(one, "temperature") + 0.05
    # what a slow disturbance seemed to be beside the wrong level is none
    assert back.variances["temperature"] == pytest.approx(one.variances["temperature"], rel=0.2, abs=0.02)


def _simulated(one: Calibration, theta: np.ndarray) -> dict[str, np.ndarray]:
    return {q: one.simulator.simulated(theta[:, None], q)[:, 0] for q in one.quantities}


def test_the_held_out_part_refutes_what_is_worse_and_what_gains_nothing(
    nothing: Run,
) -> None:
    one = nothing[1].base
    before = scores(one)

    def warmer(kelvin: float) -> dict[str, Scores]:
        theta = one.theta.copy()
        theta[one.simulator.names.index("heat_release_operation")] += kelvin
        return scores(replace(one, theta=theta, simulated=_simulated(one, theta)))

    worse = judged(before, warmer(6.0))
    assert worse.reason == "worse" and worse.after["temperature"] > worse.before["temperature"]
    assert judged(before, warmer(0.3)).reason == "no_gain"
    # more evidence than held-out readings take is left
    assert judged(before, warmer(0.3), spare=1e4).reason == "" == judged(before, before).reason


def test_little_evidence_needs_held_out_readings_that_bear_it_out(sunny: Run, nothing: Run) -> None:
    base = scores(levelled(sunny[1].base))
    borne_out = judged(base, scores(levelled(sunny[1].parent)), spare=1e4, weak=True)
    assert borne_out.reason == "" and borne_out.improvement > LEAST_IMPROVEMENT
    assert judged(base, base, weak=True).reason == "unproven"
    # nothing was held out
    one = nothing[1].base
    scene = one.simulator.scene
    readings = {q: replace(r, identified=np.full(len(r.value), True)) for q, r in scene.readings.items()}
    whole = scores(replace(one, simulator=replace(one.simulator, scene=replace(scene, readings=readings))))
    assert judged(whole, whole, weak=True).reason == ""


def test_a_rhythm_that_no_cause_describes_is_a_line(nothing: Run) -> None:
    """A heat flow of 12.42 h in the errors, as large as two fifths of them."""
    one = nothing[1].base
    r = one.simulator.scene.readings["temperature"]
    tide = 0.4 * free_run_error(one, "temperature") * np.sin(2.0 * np.pi * r.time_h / 12.42)
    simulated = {**one.simulated, "temperature": one.simulated["temperature"] + tide}
    (line,) = lines(replace(one, simulated=simulated), {})
    assert line.quantity == "temperature" and line.period_h == pytest.approx(12.42, rel=0.01)
