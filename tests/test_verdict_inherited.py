"""What uses a number inherits its verdict: every command says it, in the same words, and no number contradicts another page."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from climate_case import known_fit, made_up_weather
from discovery_case import discovery_case
from html_page import Page

from hygrokf import identify, read_case, synthetic_turbine, write_case, write_fit
from hygrokf.climate.region import Region
from hygrokf.climate.study import climate_profile
from hygrokf.commands.main import main
from hygrokf.data.record import Record
from hygrokf.fleet.outliers import spreads
from hygrokf.fleet.page import fleet_page
from hygrokf.fleet.table import columns_of
from hygrokf.fleet.tasks import TASKS
from hygrokf.fleet.text import fleet_text
from hygrokf.identification.fit import Fit
from hygrokf.identification.results import dump
from hygrokf.identification.tables import evaluate, evaluation_text, simulation_summary
from hygrokf.identification.turbine_type import TypeFault, pool_types
from hygrokf.identification.verdict import BELIEVE, CAUTION, REJECT, Reason, Verdict, inherited, verdicts
from hygrokf.live.alarms import Level, resting_on
from hygrokf.live.defaults import usual_config
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.views import fleet_view, turbine_view
from hygrokf.report.climate_page import climate_page
from hygrokf.report.climate_tables import climate_text
from hygrokf.report.comparison_page import comparison_page
from hygrokf.report.discovery_page import discovery_page
from hygrokf.report.discovery_text import discovery_text, gain_sentence
from hygrokf.report.transfer_page import transfer_page, transfer_text
from hygrokf.transfer.comparison import compare, comparison_column, comparison_text
from hygrokf.transfer.procedure import transfer_fit, transfer_json

WHY = "the free run would choose another number"
SAID = f"thermal time constant not to be believed, 1.50 h (1.40 … 1.60): {WHY}"


def rejected(fit: Fit, part: str = "thermal") -> Fit:
    """The fit with one number that is not to be believed and the other that is."""
    entries = copy.deepcopy(dict(fit.results["time_constants"]))
    for name, entry in entries.items():
        entry |= Verdict().to_json()
        if name == part:
            entry |= {"value_h": 1.5, "lower_h": 1.4, "upper_h": 1.6}
            entry |= Verdict.of([Reason("criteria_disagree", REJECT, WHY, {"apart": 3.0})]).to_json()
    return replace(fit, results={**fit.results, "time_constants": entries})


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_case(synthetic_turbine(seed=5, days=12), tmp_path_factory.mktemp("turbine"))


@pytest.fixture(scope="module")
def record(case: Path) -> Record:
    made = read_case(case)
    return replace(made, until_s=made.start_s + 9 * 86400.0)


@pytest.fixture(scope="module")
def fit(record: Record) -> Fit:
    return identify(record, starts=1, profiles=False)


def struck(page: str) -> list[str]:
    """What is struck through on a page."""
    return [one.replace("&nbsp;", " ") for one in re.findall(r"<s>(.*?)</s>", page)]


# --- every command ---------------------------------------------------------------------------


def test_simulate_and_evaluate(case: Path, record: Record, fit: Fit, tmp_path, capsys) -> None:
    doubtful = rejected(fit)
    file = write_fit(doubtful, tmp_path / "fit")
    assert main(["simulate", str(file), str(case), "--out", str(tmp_path / "run.csv")]) == 0
    assert f"x {SAID}" in capsys.readouterr().out
    assert (tmp_path / "run.csv").read_text().startswith("time,")  # the file stays a plain table
    for found in (simulation_summary(doubtful, record), evaluate(doubtful, record)):
        assert found["verdicts"] == inherited(doubtful.results)
        assert found["verdicts"]["thermal"]["reasons"] == [
            {"code": "criteria_disagree", "verdict": REJECT, "text": WHY, "apart": 3.0}
        ]
        assert json.loads(dump(found))["verdicts"]["hygric"]["verdict"] == BELIEVE
    lines = evaluation_text(evaluate(doubtful, record)).splitlines()
    assert lines[1] == f"x {SAID}" and lines[2].startswith("+ hygric time constant ")


def test_compare(record: Record, fit: Fit) -> None:
    columns = [comparison_column(fit, record, "one"), comparison_column(rejected(fit), record, "other")]
    found = compare(columns).to_json()
    assert [one["verdicts"] for one in found["columns"]] == [
        inherited(fit.results),
        inherited(rejected(fit).results),
    ]
    assert f"other: x {SAID}" in comparison_text(found)
    page = comparison_page(found)
    assert struck(page) == ["1.50 h (1.40 … 1.60)"] and WHY in page
    found["columns"][0].pop("verdicts")  # results of an older version
    assert comparison_text(found) and comparison_page(found)


def test_transfer(record: Record, fit: Fit) -> None:
    made = transfer_fit(rejected(fit), record)
    data = json.loads(dump(transfer_json([made])))
    assert data["from"]["verdicts"]["thermal"]["verdict"] == REJECT
    (one,) = data["records"]
    own = verdicts(made.adapted.results)
    assert {part: entry["verdict"] for part, entry in one["verdicts"].items()} == {
        part: verdict.verdict for part, verdict in own.items()
    }
    text, page = transfer_text(data), transfer_page(data, [made.series])
    assert f"{fit.name}: x {SAID}" in text and "1.50 h (1.40 … 1.60)" in struck(page)
    # on its own record nothing is re-estimated: a number that was taken over keeps what speaks against it
    assert made.adapted.results["parameters"]["thermal_time_constant"]["fixed"]
    assert own["thermal"].verdict == REJECT
    assert any(reason.text == f"on {fit.name}: {WHY}" for reason in own["thermal"].reasons)
    assert not any(
        "on " + fit.name in reason.text for reason in verdicts(made.own.results)["thermal"].reasons
    )


def test_a_type_is_made_of_numbers_that_can_be_believed(fit: Fit) -> None:
    good = replace(rejected(fit), name="a")
    good.results["time_constants"]["thermal"] |= Verdict().to_json()
    second, third = (replace(good, name=name) for name in "bc")
    assert "thermal_time_constant" in pool_types([good, second, third]).parameters
    doubtful = [replace(rejected(fit), name=name) for name in "bc"]
    assert "thermal_time_constant" not in pool_types([good, *doubtful]).parameters
    assert pool_types([good, second, doubtful[1]]).parameters["thermal_time_constant"].turbines == 2
    assert pool_types([good, *doubtful]).parameters["hygric_k"].turbines == 3
    with pytest.raises(TypeFault):
        pool_types([good])


@pytest.fixture(scope="module")
def climate() -> dict:
    fit = known_fit()
    entry = {"value_h": 1.5, "lower_h": 1.4, "upper_h": 1.6}
    reasons = [Reason("criteria_disagree", REJECT, WHY)]
    constants = {"thermal": entry | Verdict.of(reasons).to_json(), "hygric": entry | Verdict().to_json()}
    doubtful = replace(fit, results={**fit.results, "time_constants": constants})
    study = climate_profile(doubtful, [Region("here", made_up_weather(40))], members=10)
    return json.loads(dump(study.to_json()))


def test_climate(climate: dict) -> None:
    assert climate["verdicts"]["thermal"]["verdict"] == REJECT
    (region,) = climate["regions"]
    rests = "the model's thermal time constant, on which this rests, is not to be believed"
    assert rests in region["statements"] and rests in climate_text(climate)
    assert f"x {SAID}" in climate_text(climate)
    page = climate_page(climate)
    cards = re.findall(r"<div class='?card([^>']*)'?>", page)
    assert cards and set(cards) == {" reject resting"}
    assert struck(page) == ["1.50 h (1.40 … 1.60)"]
    believed = copy.deepcopy(climate)
    believed["verdicts"]["thermal"] |= Verdict().to_json()
    assert "card reject" not in climate_page(believed)


def test_discovery() -> None:
    found = discovery_case()
    reasons = [Reason("worse_than_rule", REJECT, WHY)]
    found["baseline"]["time_constants"]["thermal"] |= Verdict.of(reasons).to_json()
    assert struck(discovery_page(found)) == ["1.36 h (1.31 … 1.41)"]
    text = " ".join(discovery_text(found).split())
    assert f"base model: x thermal time constant not to be believed, 1.36 h (1.31 … 1.41): {WHY}" in text
    nothing = found | {"verdict": "none", "causes": [], "extended": None}
    words = Page(discovery_page(nothing)).text
    assert "Nothing is missing" not in words and "the model is not right" in words
    # an extended model that is not to be believed does not tell how wrong the base was
    found["extended"]["time_constants"]["thermal"] |= Verdict.of(reasons).to_json()
    words = Page(discovery_page(found)).text
    assert "too long" not in words and "does not tell how wrong the base model's is" in words


def row(name: str, value: float, verdict: str) -> dict:
    return {
        "turbine": name, "status": "done", "reason": "", "task": "fit", "record": name, "synthetic": False,
        "thermal_value_h": value, "thermal_lower_h": 0.95 * value, "thermal_upper_h": 1.05 * value,
        "thermal_verdict": verdict, "hygric_verdict": BELIEVE, "temperature_rmse_K": 1.2,
    }  # fmt: skip


def test_a_fleet_leaves_out_what_is_not_to_be_believed() -> None:
    rows = [row(f"T{i}", 1.5 + 0.02 * i, BELIEVE) for i in range(6)]
    rows += [row("T6", 9.0, REJECT), row("T7", 1.6, CAUTION)]
    for task in TASKS:
        assert {"thermal_verdict", "hygric_verdict"} <= set(columns_of(task))
    constant = next(
        one for one in spreads(rows, TASKS["fit"].compared) if one.compared.column == "thermal_value_h"
    )
    assert constant.rejected == ("T6",) and "T6" not in constant.turbines and "T7" in constant.turbines
    words = Page(fleet_page({"task": "fit", "name": "park", "rows": rows})).text
    assert "Thermal time constant: 6 to be believed, 1 with caution, 1 not to be believed" in words
    assert "T6 not to be believed to be believed T7 with caution to be believed" in words
    assert "Not to be believed, so not compared: thermal time constant of T6" in words
    assert "9.00" not in words
    line = next(one for one in fleet_text("fit", rows).splitlines() if one.startswith("T6"))
    assert "not to be believed" in line and "9.00" not in line


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    made = open_store(f"sqlite:{tmp_path / 'live.db'}")
    made.add_turbines({"A": "digest", "B": "digest"})
    yield made
    made.close()


def test_track(store: Store, fit: Fit, tmp_path: Path) -> None:
    file = write_fit(rejected(fit), tmp_path / "fit")
    config = usual_config([file], ["stdin"], "sqlite:live.db", PageSettings("127.0.0.1", 8080))
    (turbine,) = config.turbines.values()
    assert turbine.verdicts["thermal"]["verdict"] == REJECT
    known = {"A": turbine.verdicts}
    assert [(r["turbine"], r["model"]) for r in fleet_view(store, "AB", 0.0, known)] == [
        ("A", REJECT),
        ("B", None),
    ]
    model = turbine_view(store, "A", 0.0, 0.0, turbine.verdicts)["model"]
    assert model["verdict"] == REJECT
    thermal, hygric = model["numbers"]
    assert (thermal["mark"], thermal["words"], thermal["why"]) == ("✕", "not to be believed", WHY)
    assert (thermal["property"], hygric["property"], hygric["verdict"]) == (
        "thermal_time_constant",
        "hygric_k",
        BELIEVE,
    )
    assert turbine_view(store, "B", 0.0, 0.0)["model"] == {"verdict": None, "numbers": []}


def test_an_alarm_that_rests_on_a_rejected_number_says_so(fit: Fit) -> None:
    known = inherited(rejected(fit).results)
    tail = "; the model's thermal time constant, on which this rests, is not to be believed"
    levels = [
        Level("condensation", 0.9, "water condenses"),
        Level("condensation", 0.1, ""),
        Level("cabinet changed", 1.0, "loses heat", subject="thermal_time_constant"),
        Level("cabinet changed", 1.0, "exchanges air", subject="hygric_k"),
    ]
    said = [one.statement for one in resting_on(levels, known)]
    assert said == [f"water condenses{tail}", "", f"loses heat{tail}", "exchanges air"]
    assert (
        resting_on(levels, inherited(fit.results | {"time_constants": {}}))
        == levels
        == resting_on(levels, {})
    )


# --- one number on every page ----------------------------------------------------------------


def test_the_same_period_has_the_same_error_everywhere(record: Record, fit: Fit) -> None:
    assert evaluate(fit, record)["rmse"] == fit.results["rmse"]
    assert evaluate(fit, record)["baselines"] == fit.results["baselines"]
    (first, _) = compare([comparison_column(fit, record, "a"), comparison_column(fit, record, "b")]).to_json()["columns"]
    for period in ("identification", "validation"):
        for quantity, known in fit.results["rmse"][period].items():
            for regime in ("operation", "standstill", "total"):
                one = first["scores"][period][quantity][regime]
                assert one["n"] == known["n"][regime]
                if known[regime] is not None and one["rmse"] is not None:
                    assert one["rmse"] == pytest.approx(known[regime], rel=1e-12)
    moved = transfer_fit(fit, record, fits=False).results
    for quantity, known in fit.results["rmse"]["validation"].items():
        table = moved["rmse"][quantity]["as_is"]
        if table["n"]["total"] == known["n"]["total"]:
            assert table["total"] == pytest.approx(known["total"], rel=1e-9)
        else:  # the page says that it scores what all sets and rules score
            assert table["n"]["total"] < known["n"]["total"]


def test_the_card_of_a_discovery_shows_the_errors_of_its_tables_and_says_what_the_gain_compares() -> None:
    found = discovery_case()
    base, wider = (found[w]["rmse"]["validation"]["temperature_K"]["total"] for w in ("baseline", "extended"))
    gain = found["causes"][0]["gain"]
    assert gain["rmse_before"] != base  # the gain is measured against a better simulator
    page = discovery_page(found)
    cards = re.findall(r"<p class=value>([^<]*K)</p>", page)
    assert cards == [f"{base:.2f} → {wider:.2f} K"]
    words = Page(page).text
    assert (
        f"as the better simulators that both can be: {gain['rmse_before']:.2f} → {gain['rmse_after']:.2f} K"
        in words
    )
    assert f"they err by {base:.2f} and {wider:.2f} K" in gain_sentence(found["causes"][0])
    gain |= {"rmse_before": base, "rmse_after": wider}
    assert "better simulators that both" not in Page(discovery_page(found)).text


def test_a_climate_states_one_share_for_its_bounds(climate: dict) -> None:
    (region,) = climate["regions"]
    assert region["bounds_hold"] == pytest.approx(9 / 11)
    words = Page(climate_page(climate)).text + climate_text(climate)
    assert "82 % of single years" in words and "95 % of single years" not in words
    assert "95 % bounds" not in words and "in 82 % of cases, not in 95 %" in words
    old = copy.deepcopy(climate)
    for key in ("bounds_hold", "mean_bounds_hold"):
        del old["regions"][0][key]  # older results state the members
    assert "82 % of single years" in Page(climate_page(old)).text
    assert np.isfinite(climate["members"])
