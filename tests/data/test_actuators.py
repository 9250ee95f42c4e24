"""Logged actuators: which are used, what they turn out to do, and every command that meets them.

The plants are those of `tests/plants`, an integrator of their own, with a heater, a fan, a dehumidifier and a
door whose effects are known; the amplitudes below are the plants' own."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from builders.actuated import (
    DOOR_CONDUCTANCE,
    DRYING_A_HOUR,
    FAN_CONDUCTANCE,
    FAN_EXCHANGE,
    HEATER_W,
    actuated,
)

from hygrokf import identify
from hygrokf.cases.summary import describe
from hygrokf.climate.region import driven
from hygrokf.data.actuators import ACTUATORS, FEWEST_EACH_SIDE, actuators
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SIGNALS
from hygrokf.discovery.starting_model import base_designs
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.identification.fit import Fit
from hygrokf.live.plan import plan
from hygrokf.modelling.causes.forms import doors, ground_of
from hygrokf.modelling.design import CASCADE, design
from hygrokf.modelling.inputs import model_inputs
from hygrokf.modelling.thermal_system import thermal_system
from hygrokf.physics.mechanisms import MECHANISMS
from hygrokf.report.fit_page import fit_blocks
from hygrokf.report.page import page_html
from hygrokf.report.record_text import describe_text
from hygrokf.report.terminal import page_text
from hygrokf.texts.fit_codes import FitCode


@pytest.fixture(scope="module")
def all_logged() -> tuple[Record, Fit, object]:
    """A pump that never stops is not used."""
    record, _, made = actuated(41001, "heater_duty", "fan_duty", "dehumidifier_duty", "door_open")
    pump = replace(record["fan_duty"], signal="pump_duty", value=np.ones(len(record["fan_duty"])))
    record = replace(record, series=(*record.series, pump))
    return record, identify(record, starts=2, profiles=False), made


def within(fit: Fit, name: str, true: float, slack: float) -> None:
    """The truth lies within the bounds, which reach by `slack` of it at most."""
    row = fit.to_json()["parameters"][name]
    assert row["lower"] - slack * true < true < row["upper"] + slack * true
    assert row["upper"] - row["lower"] < true


def test_what_logged_actuators_do_is_found(all_logged) -> None:
    """Heat, conductance and drying within their bounds and 5 % of the truth: the means over ten minutes smear
    a switch."""
    _, fit, made = all_logged
    within(fit, "logged_heater_heat", HEATER_W * made.cabinet.outer_resistance, 0.05)
    within(fit, "fan_conductance", FAN_CONDUCTANCE, 0.05)
    within(fit, "door_conductance", DOOR_CONDUCTANCE, 0.05)
    # the plant dries by the vapour of the cabinet without any actuator, the model by the vapour that is there
    assert fit.values["logged_drying_rate"] == pytest.approx(DRYING_A_HOUR, rel=0.25)
    assert fit.values["fan_exchange"] == pytest.approx(FAN_EXCHANGE, rel=0.5)
    thermal = fit.to_json()["time_constants"]["thermal"]
    assert thermal["lower_h"] < made.truth.tau_h < thermal["upper_h"]


def test_effects_are_told_in_kelvin_and_percent(all_logged) -> None:
    record, fit, made = all_logged
    found = {one["signal"]: one for one in fit.to_json()["actuators"]}
    assert list(found) == ["heater_duty", "fan_duty", "pump_duty", "dehumidifier_duty", "door_open"]
    on = record["heater_duty"].value > 0.5
    assert found["heater_duty"]["on_share"] == pytest.approx(on.mean(), abs=0.01)
    for one in found.values():
        for change in (one.get("changes") or {}).values():
            assert change["lower"] <= change["value"] <= change["upper"]
    heat = found["heater_duty"]["changes"]["temperature_K"]
    # 300 W at 90 days: less than in a steady state, as it is not always on for long
    assert 0.5 < heat["value"] / (HEATER_W * made.cabinet.outer_resistance) < 1.0
    assert found["heater_duty"]["changes"]["relative_humidity"]["upper"] < 0.0
    assert found["fan_duty"]["changes"]["temperature_K"]["upper"] < 0.0
    assert found["dehumidifier_duty"]["changes"]["absolute_humidity_g_m3"]["upper"] < 0.0
    for text in (page_text(fit_blocks(fit.results, {})), page_html(fit_blocks(fit.results, {}))):
        assert "heater_duty" in text and "pump_duty is not used: it never changes" in " ".join(text.split())
    assert "pump_duty – – – –" in " ".join(page_text(fit_blocks(fit.results, {})).split())


# --- which are used -----------------------------------------------------------------------------------------
def _record(**courses: np.ndarray) -> Record:
    hour = 3600.0 * np.arange(400.0)
    series = [
        Series("cabinet_temperature", hour, 293.0 + np.sin(hour / 20000.0)),
        Series("ambient_temperature", hour, 283.0 + np.sin(hour / 14000.0)),
    ]
    series += [Series(name, hour, value, "mean", 3600.0) for name, value in courses.items()]
    return Record("made by hand", tuple(series))


SQUARE = (np.arange(400) % 20 < 5).astype(float)


@pytest.mark.parametrize("signal", list(ACTUATORS))
def test_every_actuator_of_the_table_is_an_input(signal: str) -> None:
    assert signal in SIGNALS
    value = 500.0 * SQUARE if signal == "heater_power" else SQUARE
    record = _record(**{signal: value})
    (one,) = actuators(record)
    assert one.used and one.statement.code is FitCode.ACTUATOR_USED
    assert one.statement.values["signal"] == signal
    assert signal in design(record, kind="thermal").model.inputs
    for chosen in (one.thermal, one.hygric):
        if chosen is not None:
            made = MECHANISMS[chosen[0]](**chosen[1])
            (parameter,) = made.parameters
            assert parameter.null == 0.0 and parameter.start == 0.0
            assert signal in made.inputs


@pytest.mark.parametrize(
    ("value", "word"),
    [
        (np.ones(400), "never changes"),
        (np.zeros(400), "never changes"),
        ((np.arange(400) < FEWEST_EACH_SIDE - 1).astype(float), f"{FEWEST_EACH_SIDE - 1} readings above"),
        ((np.arange(400) >= 3).astype(float), "3 below"),
        (np.full(400, np.nan), "no reading"),
    ],
)
def test_what_cannot_be_seen_is_not_used_and_said(value: np.ndarray, word: str) -> None:
    record = _record(fan_duty=value)
    (one,) = actuators(record)
    assert not one.used and one.statement.code is FitCode.ACTUATOR_UNUSED
    assert word in one.statement.text
    assert "fan_duty" not in design(record, kind="thermal").model.inputs
    assert word in describe_text(describe(record))


def test_of_power_and_duty_of_a_heater_the_power_is_used() -> None:
    record = _record(heater_duty=SQUARE, heater_power=800.0 * SQUARE)
    assert {one.signal: one.used for one in actuators(record)} == {"heater_power": True, "heater_duty": False}
    assert dict(design(record, kind="thermal").mechanisms)["logged_heater"] == {
        "signal": "heater_power",
        "full": 800.0,
    }


def test_check_says_what_will_be_used() -> None:
    record = _record(fan_duty=SQUARE, pump_duty=np.ones(400))
    said = describe(record).actuators
    assert [one.values["signal"] for one in said] == ["fan_duty", "pump_duty"]
    assert [one.code for one in said] == [FitCode.ACTUATOR_USED, FitCode.ACTUATOR_UNUSED]
    assert all(one.text in describe_text(describe(record)) for one in said)


# --- physics ------------------------------------------------------------------------------------------------
def test_a_fan_is_a_conductance_beside_the_outer_resistance() -> None:
    """At full duty the network is the one with R_AT/(1+g): the same steady state and time constant as that
    network has."""
    record = _record(fan_duty=SQUARE)
    base = design(record, kind="thermal")
    model = base.model
    tau, ratio, g, heat = 3.0, 0.8, 0.7, 10.0
    values = {p.name: p.start for p in model.parameters}
    values |= {"thermal_time_constant": tau, "resistance_ratio": ratio, "fan_conductance": g}
    values |= {"heat_release_standstill": heat, "heat_release_standstill_ambient": 0.0}
    u = {name: 0.0 for name in model.inputs} | {"ambient_temperature": 280.0, "fan_duty": 1.0}
    outer, inner = ratio / (1.0 + g), 1.0 - ratio  # in units of R_AT + R_IC
    flow = heat / ratio  # Q in units of K over that
    x = [280.0 + flow * (outer + inner)] + [0.0] * (len(model.states) - 1)
    found = model.evaluate(x, u, values)
    assert found.rates[0] == pytest.approx(0.0, abs=1e-12)
    assert found.quantities["cabinet_air_temperature"] == pytest.approx(280.0 + flow * outer, abs=1e-12)
    warmer = model.evaluate([x[0] + 1.0, *x[1:]], u, values)
    assert -1.0 / warmer.rates[0] == pytest.approx(tau * (outer + inner), rel=1e-12)


def test_with_nulls_the_model_is_the_one_without() -> None:
    courses = {
        name: (500.0 if name == "heater_power" else 1.0) * SQUARE
        for name in ACTUATORS
        if name != "heater_duty"
    }
    record = _record(**courses)
    plain = _record()
    bases = [design(one, kind="thermal") for one in (record, plain)]
    values = {p.name: p.start for p in bases[0].model.parameters}
    both = [
        Likelihood(base.model, model_inputs(base, one).timeline).value(values)
        for base, one in zip(bases, (record, plain), strict=True)
    ]
    # rates that may vary take polynomials with a remainder of 4e-13 a step, constant ones are exact
    assert both[0] == pytest.approx(both[1], rel=1e-10)


# --- every command ------------------------------------------------------------------------------------------
def test_the_design_comes_back_from_its_json(all_logged) -> None:
    from hygrokf.modelling.design import Design

    _, fit, _ = all_logged
    again = Design.from_json(json.loads(json.dumps(fit.design.to_json())))
    assert again.model is fit.design.model
    assert thermal_system(again, fit.values).A.shape == (1, 1)


def test_the_tracker_awaits_what_the_model_reads(all_logged) -> None:
    _, fit, _ = all_logged
    assert set(plan(fit).extra_signals) == {"heater_duty", "fan_duty", "dehumidifier_duty", "door_open"}


def test_a_climate_has_actuators_off_or_as_the_power_s_record_has_them(all_logged) -> None:
    record, fit, _ = all_logged
    weather = replace(
        record, series=tuple(s for s in record.series if s.signal.startswith("ambient_")), until_s=None
    )
    made, said = driven(fit, weather, None)
    assert set(made["heater_duty"].value) == {0.0}
    assert any(one.text.startswith("heater_duty is off all year") for one in said)
    made, said = driven(fit, weather, replace(record, until_s=None))
    assert any(one.text.startswith("fan_duty follows the record of the power") for one in said)
    assert made["fan_duty"] is record["fan_duty"]
    model_inputs(fit.design, made)


def test_discovery_takes_what_is_logged_as_known() -> None:
    record, _, _ = actuated(41002, "heater_duty", "door_open", days=40.0)
    heat, vapour = base_designs(record)
    assert vapour is not None and "door_open" in vapour.model.inputs
    assert {"heater_duty", "door_open"} <= set(heat.model.inputs)
    assert not [*doors(ground_of(record, heat, vapour))]


def test_a_cascade_s_hygric_part_has_its_own(all_logged) -> None:
    record, _, _ = all_logged
    names = [name for name, _ in design(record, kind=CASCADE).mechanisms]
    assert {"fan_exchange", "open_exchange", "dehumidifier_drying"} <= set(names)
    assert "logged_heater" not in names
