"""What uses a number inherits its verdict: every command says it, in the same words, and no number
contradicts another page."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from builders.climate_case import known_fit, study_of
from builders.discovery_case import discovery_case, typed
from builders.fit_case import with_parts
from builders.html_page import Page

from hygrokf import identify, read_case, synthetic_turbine, write_case, write_fit
from hygrokf.commands.main import main
from hygrokf.data.record import Record
from hygrokf.data.result_file import result_text
from hygrokf.data.structured import plain
from hygrokf.fleet.fleet_results import FleetResults, task_columns
from hygrokf.fleet.outliers import spreads
from hygrokf.fleet.tasks import TASKS
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_on_record import evaluate, simulate_fit, simulation_summary
from hygrokf.identification.turbine_type import TypeFault, pool_types
from hygrokf.identification.verdict import inherited
from hygrokf.live.alarms import Level, with_doubts
from hygrokf.live.defaults import default_config
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.views import fleet_view, turbine_view
from hygrokf.report.blocks import Cards, Verdicts
from hygrokf.report.climate_page import climate_blocks
from hygrokf.report.comparison_page import comparison_blocks
from hygrokf.report.discovery_page import discovery_blocks
from hygrokf.report.fit_tables import evaluation_text
from hygrokf.report.fleet_page import fleet_blocks
from hygrokf.report.page import page_html
from hygrokf.report.terminal import page_text
from hygrokf.report.transfer_page import transfer_blocks
from hygrokf.texts.live_codes import CauseCode, StateCode
from hygrokf.texts.reasons import BELIEVE, CAUTION, REJECT, ReasonCode, VerdictCode
from hygrokf.texts.wording import sentence
from hygrokf.transfer.comparison import compare, comparison_column
from hygrokf.transfer.transfer_fit import transfer_fit
from hygrokf.transfer.transfer_results import transfer_results

WHY = "its interval spans a factor of 9 on either side: not even its order of magnitude is known"
SAID = f"x thermal time constant, not reliable: {WHY} – 1.50 h (1.40 … 1.60)"
BELIEVED = {"verdict": BELIEVE, "reasons": []}


def refuted() -> dict:
    """The verdict of a time constant that is not reliable, as data."""
    return {"verdict": REJECT, "reasons": [plain(ReasonCode.UNDETERMINED(spread="a factor of 9"))]}


def rejected(fit: Fit, part: str = "thermal") -> Fit:
    """The fit with one number that is not reliable and the other that is."""
    entries = copy.deepcopy(dict(fit.to_json()["time_constants"]))
    for name, entry in entries.items():
        entry |= BELIEVED
        if name == part:
            entry |= {"value_h": 1.5, "lower_h": 1.4, "upper_h": 1.6}
            entry |= refuted()
    return with_parts(fit, time_constants=entries)


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
    return [one.replace("&nbsp;", " ").replace("\xa0", " ") for one in re.findall(r"<s>(.*?)</s>", page)]


# --- every command ---------------------------------------------------------------------------


def test_simulate_and_evaluate(case: Path, record: Record, fit: Fit, tmp_path, capsys) -> None:
    doubtful = rejected(fit)
    file = write_fit(doubtful, tmp_path / "fit")
    assert main(["simulate", str(file), str(case), "--out", str(tmp_path / "run.csv")]) == 0
    assert SAID in capsys.readouterr().out
    assert (tmp_path / "run.csv").read_text().startswith("time,")  # the file stays a plain table
    _, free, predicted = simulate_fit(doubtful, record)
    for made in (simulation_summary(doubtful, free, predicted), evaluate(doubtful, record)):
        found = plain(made)
        assert found["verdicts"] == plain(inherited(doubtful.results))
        assert found["verdicts"]["thermal"]["reasons"] == [
            plain(ReasonCode.UNDETERMINED(spread="a factor of 9"))
        ]
        assert json.loads(result_text(found))["verdicts"]["hygric"]["verdict"] == BELIEVE
    text = " ".join(evaluation_text(evaluate(doubtful, record)).split())
    assert f"x thermal time constant, not reliable: {WHY} – 1.50 h (1.40 … 1.60)" in text
    assert "+ hygric time constant " in text


def test_compare(record: Record, fit: Fit) -> None:
    columns = [comparison_column(fit, record, "one"), comparison_column(rejected(fit), record, "other")]
    found = compare(columns)
    assert [plain(one.verdicts) for one in found.columns] == [
        plain(inherited(fit.results)),
        plain(inherited(rejected(fit).results)),
    ]
    assert SAID in " ".join(page_text(comparison_blocks(found)).split())
    page = page_html(comparison_blocks(found))
    assert struck(page) == ["1.50 h (1.40 … 1.60)"] and WHY in page


def test_transfer(record: Record, fit: Fit) -> None:
    made = transfer_fit(rejected(fit), record)
    found = transfer_results([made])
    assert found.source.verdicts["thermal"].verdict == REJECT
    own = inherited(made.adapted.results)
    assert {part: one.verdict for part, one in made.results.verdicts.items()} == {
        part: verdict.verdict for part, verdict in own.items()
    }
    text, page = page_text(transfer_blocks(found)), page_html(transfer_blocks(found, [made.course]))
    assert SAID in " ".join(text.split()) and "1.50 h (1.40 … 1.60)" in struck(page)
    # on its own record nothing is re-estimated: a number that was taken over keeps what speaks against it
    assert made.adapted.to_json()["parameters"]["thermal_time_constant"]["fixed"]
    assert own["thermal"].verdict == REJECT
    assert any(reason.text == f"on {fit.name}: {WHY}" for reason in own["thermal"].reasons)
    assert not any(
        "on " + fit.name in reason.text for reason in inherited(made.own.results)["thermal"].reasons
    )


def test_a_type_is_made_of_numbers_that_can_be_believed(fit: Fit) -> None:
    constants = rejected(fit).to_json()["time_constants"]
    good = replace(
        with_parts(fit, time_constants=constants | {"thermal": constants["thermal"] | BELIEVED}),
        name="a",
    )
    second, third = (replace(good, name=name) for name in "bc")
    assert "thermal_time_constant" in pool_types([good, second, third]).parameters
    doubtful = [replace(rejected(fit), name=name) for name in "bc"]
    assert "thermal_time_constant" not in pool_types([good, *doubtful]).parameters
    assert pool_types([good, second, doubtful[1]]).parameters["thermal_time_constant"].turbines == 2
    assert pool_types([good, *doubtful]).parameters["hygric_k"].turbines == 3
    with pytest.raises(TypeFault):
        pool_types([good])


def test_climate() -> None:
    entry = {"value_h": 1.5, "lower_h": 1.4, "upper_h": 1.6}
    constants = {"thermal": entry | refuted(), "hygric": entry | BELIEVED}
    study = study_of(fit=known_fit(found={"time_constants": constants}), members=3)
    assert study.verdicts["thermal"].verdict == REJECT
    (region,) = study.regions
    rests = VerdictCode.RESTS_ON_REJECTED(parts=("thermal",), count=1)
    assert rests in region.statements
    page = climate_blocks(study)
    (cards,) = (block.cards for block in page.lead if isinstance(block, Cards))
    assert {card.kind for card in cards} == {REJECT}
    assert {card.reason for card in cards} == {sentence(rests.text)}
    (numbers,) = (block for block in page.body if isinstance(block, Verdicts))
    assert numbers.lines[0].struck == "1.50 h (1.40 … 1.60)" and WHY in numbers.lines[0].text
    believed = replace(study, verdicts={**study.verdicts, "thermal": study.verdicts["hygric"]})
    assert "card reject" not in page_html(climate_blocks(believed))


def test_discovery() -> None:
    found = discovery_case()
    found["baseline"]["time_constants"]["thermal"] |= refuted()
    assert struck(page_html(discovery_blocks(typed(found)))) == ["1.36 h (1.31 … 1.41)"]
    text = " ".join(page_text(discovery_blocks(typed(found))).split())
    assert f"x thermal time constant, not reliable: {WHY} – 1.36 h (1.31 … 1.41)" in text
    nothing = found | {"verdict": "none", "causes": [], "extended": None}
    words = Page(page_html(discovery_blocks(typed(nothing)))).text
    assert "no missing cause" not in words and "the model is not right" in words


def row(name: str, value: float, verdict: str) -> dict:
    return {
        "turbine": name, "status": "done", "reason": "", "task": "fit", "record": name,
        "provenance": "measured",
        "thermal_value_h": value, "thermal_lower_h": 0.95 * value, "thermal_upper_h": 1.05 * value,
        "thermal_verdict": verdict, "hygric_verdict": BELIEVE, "temperature_rmse_K": 1.2,
    }  # fmt: skip


def test_a_fleet_leaves_out_what_is_not_to_be_believed() -> None:
    rows = [row(f"T{i}", 1.5 + 0.02 * i, BELIEVE) for i in range(6)]
    rows += [row("T6", 9.0, REJECT), row("T7", 1.6, CAUTION)]
    for task in TASKS:
        assert {"thermal_verdict", "hygric_verdict"} <= set(task_columns(task))
    constant = next(
        one for one in spreads(rows, TASKS["fit"].compared) if one.compared.column == "thermal_value_h"
    )
    assert constant.rejected == ("T6",) and "T6" not in constant.turbines and "T7" in constant.turbines
    words = Page(page_html(fleet_blocks(FleetResults("fit", tuple(rows), "park")))).text
    assert "thermal time constant reliable 6 T0, T1, T2, T3, T4, T5" in words
    assert "not reliable 1 T6" in words and "with caution 1 T7" in words
    assert "Not reliable, so not compared: thermal time constant of T6" in words
    assert "9.00" not in words
    line = next(
        one
        for one in page_text(fleet_blocks(FleetResults("fit", tuple(rows), "park"))).splitlines()
        if " T6 " in one and one[:1].isdigit()
    )
    assert "not reliable" in line and "9.00" not in line


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    made = open_store(f"sqlite:{tmp_path / 'live.db'}")
    made.add_turbines({"A": "digest", "B": "digest"})
    yield made
    made.close()


def test_track(store: Store, fit: Fit, tmp_path: Path) -> None:
    file = write_fit(rejected(fit), tmp_path / "fit")
    config = default_config([file], ["stdin"], "sqlite:live.db", PageSettings("127.0.0.1", 8080))
    (turbine,) = config.turbines.values()
    assert turbine.verdicts["thermal"].verdict == REJECT
    known = {"A": turbine.verdicts}
    assert [(r["turbine"], r["model"]) for r in fleet_view(store, "AB", 0.0, known)] == [
        ("A", REJECT),
        ("B", None),
    ]
    model = turbine_view(store, "A", 0.0, 0.0, turbine.verdicts)["model"]
    assert model["verdict"] == REJECT
    thermal, hygric = model["numbers"]
    assert (thermal["mark"], thermal["words"], thermal["why"]) == ("✕", "not reliable", WHY)
    assert (thermal["property"], hygric["property"], hygric["verdict"]) == (
        "thermal_time_constant",
        "hygric_k",
        BELIEVE,
    )
    assert turbine_view(store, "B", 0.0, 0.0)["model"] == {"verdict": None, "numbers": []}


def test_an_alarm_that_rests_on_a_rejected_number_says_so(fit: Fit) -> None:
    known = inherited(rejected(fit).results)
    levels = [
        Level("condensation", 0.9, (StateCode.CONDENSATION_LIKELY_NOW(),)),
        Level("condensation", 0.1),
        Level("cabinet changed", 1.0, (CauseCode.CHANGED_HEAT_LOSS(),), "thermal_time_constant"),
        Level("cabinet changed", 1.0, (CauseCode.CHANGED_AIR_EXCHANGE(),), "hygric_k"),
    ]
    first, calm, heat, air = with_doubts(levels, known)
    doubt = VerdictCode.RESTS_ON_REJECTED(parts=("thermal",), count=1)
    assert [one.statements[1:] for one in (first, heat, air)] == [(doubt,), (doubt,), ()]
    assert calm.statements == ()
    assert (
        with_doubts(levels, inherited(replace(fit.results, time_constants={})))
        == levels
        == with_doubts(levels, {})
    )


# --- one number on every page ----------------------------------------------------------------


def test_the_same_period_has_the_same_error_everywhere(record: Record, fit: Fit) -> None:
    assert plain(evaluate(fit, record))["rmse"] == fit.to_json()["rmse"]
    assert plain(evaluate(fit, record))["baselines"] == fit.to_json()["baselines"]
    found = compare([comparison_column(fit, record, "a"), comparison_column(fit, record, "b")])
    for period in ("identification", "validation"):
        for quantity, known in fit.to_json()["rmse"][period].items():
            for regime in ("operation", "standstill", "total"):
                one = found.row("rmse", "a", period, quantity, regime)
                assert one.n == known["n"][regime]
                if known[regime] is not None:
                    assert one.value == pytest.approx(known[regime], rel=1e-12)
    moved = transfer_fit(fit, record, fits=False).results
    for quantity, known in fit.to_json()["rmse"]["validation"].items():
        table = moved.rmse[quantity]["as_is"]
        if table.n.total == known["n"]["total"]:
            assert table.total == pytest.approx(known["total"], rel=1e-9)
        else:  # the page says that it scores what all sets and rules score
            assert table.n.total < known["n"]["total"]
