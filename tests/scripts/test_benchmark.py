"""The benchmark compares like with like: every rival computes the package's own log-likelihood."""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks import cases, command, fleet, identify, measure, rivals


# -- like with like ------------------------------------------------------------------------------------------
def test_statsmodels_has_the_same_thermal_likelihood() -> None:
    case = cases.thermal(3000)
    own = case.likelihood.value(case.values)
    variants = rivals.statsmodels_variants(case)
    assert variants
    for name, loglike in variants.items():
        assert loglike() == pytest.approx(own, rel=1e-11), name


def test_filterpy_has_the_same_joint_likelihood() -> None:
    """At sub-steps so short that it does not matter that each program chooses them from its own moments."""
    case = cases.joint(250)
    case = replace(case, likelihood=replace(case.likelihood, tolerance=1e-11))
    own = case.likelihood.value(case.values)
    assert rivals.filterpy_loop(case, 250, rivals.JointStep(case))() == pytest.approx(own, rel=1e-10)
    assert rivals.filterpy_loop(case, 250, rivals.remembered(case, 250))() == pytest.approx(own, rel=1e-10)
    shorter = replace(case.likelihood, timeline=case.likelihood.timeline.window(0, 100))
    assert rivals.filterpy_loop(case, 100, rivals.JointStep(case))() == pytest.approx(
        shorter.value(case.values), rel=1e-10
    )


@pytest.mark.parametrize(
    ("name", "states", "readings", "parameters"), [("thermal", 1, 1, 6), ("joint", 4, 2, 16)]
)
def test_cases_are_what_the_figures_say(name: str, states: int, readings: int, parameters: int) -> None:
    case = getattr(cases, name)(2000)
    model, t = case.likelihood.model, case.likelihood.timeline
    assert (len(model.states), len(model.outputs), len(case.values)) == (states, readings, parameters)
    assert len(t) == 2000
    assert 1.0 - t.n_readings / (2000 * readings) == pytest.approx(cases.MISSING, abs=0.02)


@pytest.mark.parametrize("name", ["thermal", "joint"])
def test_simulated_readings_are_those_of_the_model(name: str) -> None:
    """At the truth the score is zero within its own spread: its square form is a χ² of as many degrees as
    parameters."""
    case = getattr(cases, name)(6000)
    names = [p.name for p in case.likelihood.model.parameters]
    free = np.array(
        [not n.endswith("bias") and n != "resistance_ratio" for n in names]
    )  # 1 is a bound of the ratio
    found = case.likelihood.sensitivities(case.values, np.eye(len(names)))
    score, information = found.score[free], found.information[np.ix_(free, free)]
    square = float(score @ np.linalg.solve(information, score))
    # the 1 − 1e-6 quantile of the widest of them, χ² with 13 degrees of freedom
    assert 0.0 <= square < 53.0


def test_two_masses_are_simulated_at_their_truth() -> None:
    likelihood = cases.simulated_two_masses(4000)
    found = likelihood.sensitivities({n: float(v) for n, v in cases.TRUTH.items()}, np.eye(7))
    square = float(found.score @ np.linalg.solve(found.information, found.score))
    assert 0.0 <= square < 41.0  # the 1 − 1e-6 quantile of χ² with 7 degrees of freedom


# -- measuring -----------------------------------------------------------------------------------------------
def test_contenders_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "SLICE_S", 0.0)  # one call a turn
    log: list[str] = []
    found = measure.interleaved({name: lambda name=name: log.append(name) for name in "ab"}, 4)
    assert "".join(log) == "aabb" + 4 * "ab"  # first call and calibration of each, then turns
    assert [len(found[name].seconds) for name in "ab"] == [4, 4]


def test_ratios_are_taken_turn_by_turn() -> None:
    slow, fast = measure.Times(np.array([2.0, 20.0, 6.0])), measure.Times(np.array([1.0, 10.0, 2.0]))
    assert measure.ratio(slow, fast).median == 2.0
    assert (slow * 3.0).median == 18.0


@pytest.mark.parametrize(
    ("reached", "target", "met"),
    [
        (1.0, {"at_most": 2.0}, True),
        (3.0, {"at_most": 2.0}, False),
        (3.0, {"at_least": 2.0}, True),
        (1.0, {"at_least": 2.0}, False),
        (math.nan, {"at_most": 2.0}, False),
        (1.0, {}, None),
    ],
)
def test_a_figure_knows_whether_it_is_met(reached: float, target: dict, met: bool | None) -> None:
    figure = measure.Figure("section", "name", "s", reached, **target)
    assert figure.met is met
    assert figure.to_json()["met"] is met
    row = measure.table([figure]).splitlines()[2]
    assert row.endswith({True: "yes", False: "NO", None: f"{reached:.4g}"}[met])


# -- the command ---------------------------------------------------------------------------------------------
def test_the_command_prints_a_table_or_json(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    figure = measure.Figure("section", "name", "s", 1.0, at_most=2.0, note="a note")
    monkeypatch.setitem(identify.SECTIONS, "memory", lambda quick: [figure] if quick else [])
    assert command.main(["--quick", "--only", "memory"]) == 0
    printed = capsys.readouterr().out
    assert "section: name [s]" in printed and "≤ 2" in printed and "a note" in printed
    assert command.main(["identify", "--quick", "--json", "--only", "memory"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["figures"] == [figure.to_json()] and "numpy" in data["machine"]


@pytest.mark.parametrize("arguments", [["--only", "nothing"], ["another"], ["--fast"]])
def test_unknown_words_end_with_status_2(arguments: list[str], capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        command.main(arguments)
    assert ended.value.code == 2
    assert "nothing" not in arguments or "memory" in capsys.readouterr().err


def test_every_topic_has_sections() -> None:
    assert command.TOPICS
    for module in command.TOPICS.values():
        sections = importlib.import_module(module).SECTIONS
        assert sections and all(callable(function) for function in sections.values())


def test_a_command_that_cannot_run_is_said_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        identify.sys, "executable", "/bin/false" if Path("/bin/false").exists() else "/usr/bin/false"
    )
    (figure,) = identify.command_line(True)
    assert math.isnan(figure.reached) and "not run" in figure.note and figure.met is None


def test_memory_counts_what_a_likelihood_keeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A backward pass keeps two rows of moments for every instant: 32 bytes with one state."""
    monkeypatch.setattr(identify.cases, "joint", identify.cases.thermal)
    found = {f.name: f.reached for f in identify.memory(True)}
    assert found["value"] + 20.0 < found["score"] < found["value"] + 60.0


@pytest.mark.slow
def test_the_figures_of_fleets_can_be_measured() -> None:
    figures = [one for section in fleet.SECTIONS.values() for one in section(True)]
    assert len(figures) >= 8 and all(math.isfinite(one.reached) and one.reached > 0 for one in figures)
