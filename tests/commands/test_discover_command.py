"""`hygrokf discover` from a case file to discovery.json, with few causes; and what it refuses before the
work."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from builders.command_line import run

from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.discovery.discover import MOST_SIMULATIONS
from hygrokf.identification.fit import read_fit
from hygrokf.modelling.library import LIBRARY


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_case(synthetic_turbine(seed=4, days=14), tmp_path_factory.mktemp("turbine"))


def test_a_case_becomes_a_discovery(case: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = LIBRARY.only("solar_gain", "humidity_sensor_drift", "clock_shift")
    monkeypatch.setattr("hygrokf.modelling.library.LIBRARY", few)
    said = run(f"discover {case} --out {tmp_path}/made --json")
    assert said.status == 0
    data = json.loads((tmp_path / "made" / "discovery.json").read_text())
    assert json.loads(said.out) == data
    assert data["provenance"] == "synthetic"
    assert data["verdict"] in ("none", "unexplained") and data["causes"] == []
    assert {row["cause"] for row in data["rejected"]} == {cause.name for cause in few.causes}
    assert data["work"]["budget"] == MOST_SIMULATIONS > data["work"]["simulations"] > 0
    assert data["extended"] is None and data["baseline"]["rmse"]["identification"]
    page = (tmp_path / "made" / "report.html").read_text(encoding="utf-8")
    assert data["name"] in page and "is left out" not in page
    assert data["name"] in (tmp_path / "made" / "fit_report.html").read_text(encoding="utf-8")
    assert read_fit(tmp_path / "made").name == data["name"]
    # the model goes on from there
    assert run(f"simulate {tmp_path}/made/fit.json {case} --out {tmp_path}/simulated.csv").status == 0


def test_a_small_budget_ends_the_search_and_is_told_first(
    case: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hygrokf.modelling.library.LIBRARY", LIBRARY.only("solar_gain"))
    drawn = "hygrokf.report.discovery_page.write_discovery_report"
    monkeypatch.setattr(drawn, lambda found, out: out / "report.html")
    said = run(f"discover {case} --out {tmp_path}/made --budget 1")
    assert said.status == 0
    verdict = said.out.split("\n\n")[1]
    assert "1 simulation" in verdict and "not judged: solar gain" in verdict


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("discover none.toml --out {out}", "none.toml: 1 fault"),
        ("discover {case} --out {out} --starts 3", "--starts"),
        ("discover {case} --out {out} --library none.py", "none.py"),
    ],
)
def test_mistakes_are_told_before_the_work(case: Path, tmp_path: Path, line: str, words: str) -> None:
    said = run(line.format(case=case, out=tmp_path / "made"))
    assert said.status == 2 and words in said.err and "Traceback" not in said.err
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("text", ["0", "-3", "nan", "1.5", "9" * 5000])
def test_a_budget_that_is_no_number_of_simulations_is_told(text: str, tmp_path: Path) -> None:
    said = run(f"discover {tmp_path}/case.toml --out {tmp_path}/out --budget {text}")
    assert said.status == 2 and f"--budget: expected a whole number from 1 on, found '{text}'" in said.err


def test_the_help_states_the_budget_of_the_package() -> None:
    assert f"(default: {MOST_SIMULATIONS})" in " ".join(run("discover --help").out.split())
