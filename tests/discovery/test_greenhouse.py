"""Measured compartments whose actuators were logged: known inputs in the base model, or withheld and looked
for."""

from __future__ import annotations

import math

import pytest
from builders import greenhouse

from hygrokf import discover
from hygrokf.data.actuators import ACTUATORS
from hygrokf.data.record import Record
from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.submodel import HYGRIC, THERMAL, submodel_of
from hygrokf.identification.procedure import identify_stages
from hygrokf.modelling.design import CASCADE

UNTIL = "2022-03-01T00:00+01:00"


def record(compartment: str, *withheld: str) -> Record:
    return greenhouse.record(compartment, greenhouse.excerpt(compartment), withheld, UNTIL)


def base_scene(measured: Record) -> Baseline:
    early = measured.identification()
    basis = identify_stages(early, CASCADE, 2, True, lambda text: None)
    stages = zip((THERMAL, HYGRIC), basis.records, basis.stages, strict=True)
    return Baseline(early, {name: submodel_of(name, driven, stage) for name, driven, stage in stages})


@pytest.fixture(scope="module")
def vented() -> Baseline:
    """Koala without its vents."""
    return base_scene(record("Koala", "fan_duty"))


def test_the_excerpts_have_what_they_are_said_to_have() -> None:
    for compartment in ("Koala", "CVA"):
        measured = record(compartment)
        assert {*greenhouse.ACTUATORS, "global_horizontal_irradiance", "cabinet_relative_humidity"} <= {
            *measured.signals
        }
        assert set(greenhouse.ACTUATORS) <= set(ACTUATORS)
        assert len(measured["cabinet_temperature"].time) > 2300
        assert "fan_duty" not in record(compartment, "fan_duty")


def test_a_measured_box_is_far_from_the_model_and_its_likelihood_is_tempered(vented: Baseline) -> None:
    assert vented.tempers[THERMAL] > 1.5 and vented.tempers[HYGRIC] > 2.0


def test_vents_that_nobody_logged_show_in_their_hours(vented: Baseline) -> None:
    """They are open from 17 to 23 h, UTC+1, and cool: among the forms of the cause the one by the clock has
    the evidence."""
    from hygrokf.discovery.candidate import attempt
    from hygrokf.discovery.library import named

    candidates = [attempt(vented, one) for one in named("cooling_switching").variants(vented)]
    best = max(candidates, key=lambda one: one.bic_gain)
    assert best.variant.form == "vent, by the clock" and best.bic_gain > 60.0
    begin, hours = (float(best.variant.settings[key]) for key in ("start_h", "hours"))
    assert 15.0 <= begin <= 17.0 and 21.0 <= begin + hours <= 23.0
    assert all(one > 50.0 for one in best.lrs.values())


@pytest.mark.slow
def test_nothing_of_a_logged_actuators_class_is_named_and_what_is_named_simulates_better() -> None:
    """Plants give vapour (a wet surface), the sun warms; the held-out errors fall by a third and more."""
    found = discover(record("Koala"), budget_s=math.inf).results
    named = [one.cause for one in found.causes]
    assert "internal_moisture_source" in named and found.causes[0].form == "from a wet surface"
    assert not set(named) & {"unlogged_heater", "cooling_switching"}
    assert all(one.gain.rmse_after < one.gain.rmse_before for one in found.causes)
    assert found.causes[0].gain.rmse_after < 0.67 * found.causes[0].gain.rmse_before
