"""The command line: what each command writes and says, and what it masks."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from builders.case_edits import NO_CABINET, case, column, content, leave_out
from builders.command_line import EVALUATE, SIMULATE, Said, interrupted, run

from hygrokf.cases.case_file import read_case
from hygrokf.data.files import RESULTS
from hygrokf.data.structured import plain
from hygrokf.identification.fit import read_fit, read_series
from hygrokf.identification.fit_on_record import evaluate, simulate_fit, simulation_summary
from hygrokf.identification.identify import DEFAULT_KIND
from hygrokf.report.fit_tables import evaluation_text
from hygrokf.version import __version__

COMMANDS = ("demo", "check", "fit", "simulate", "evaluate", "export", "track", "doctor", "report")


# --- every command ---------------------------------------------------------------------------


def test_help_names_every_command():
    said = run("--help")
    assert (said.status, said.err) == (0, "")
    for name in COMMANDS:
        assert re.search(rf"^    {name} +\w", said.out, re.MULTILINE)


def test_version_and_no_command_at_all():
    assert run("--version") == Said(0, f"hygrokf {__version__}\n", "")
    said = run("")
    assert (said.status, said.err) == (0, "")
    assert said.out.startswith("usage: hygrokf")
    assert len(re.findall(r"^  \w", said.out, re.MULTILINE)) == 5


@pytest.mark.slow
def test_demo_makes_fits_and_reports(tmp_path):
    """The whole demo, as in the README; its truth is a time constant of 1.5 h and one of 0.30 h."""
    said = run(f"demo --out {tmp_path}/demo --json")
    assert said.status == 0
    tables = {"cabinet.csv", "ambient.csv", "scada.csv", "case.toml"}
    written = tables | {"fit.json", "series.npz", "report.html"}
    assert set(content(tmp_path / "demo")) == written
    first, last = said.err.splitlines()
    assert first == f"synthetic turbine written: {tmp_path}/demo/case.toml"
    assert last == f"report: {tmp_path}/demo/report.html"
    found = json.loads(said.out)
    assert found["provenance"] == "synthetic"
    assert found["converged"] is True
    for name, truth in (("thermal", 1.5), ("hygric", 0.30)):
        entry = found["time_constants"][name]
        assert entry["lower_h"] / 1.05 < truth < entry["upper_h"] * 1.05


def test_demo_of_another_seed_is_another_turbine(tmp_path, monkeypatch):
    """The seed reaches the turbine; what follows is broken off."""
    monkeypatch.setattr("hygrokf.identification.identify.identify", interrupted)
    assert run(f"demo --out {tmp_path}/demo --seed 7").status == 130
    assert 'name = "synthetic-turbine-7"' in (tmp_path / "demo" / "case.toml").read_text()
    assert len(content(tmp_path / "demo")) == 4


def test_check_says_what_was_read(folder):
    said = run("check case.toml")
    assert (said.status, said.err) == (0, "")
    assert said.out.startswith("synthetic-turbine-3: 2020-07-15T00:00Z to 2020-08-04T00:00Z, 20.0 d")
    for words in ("cabinet_relative_humidity", "P_kW", "hygrokf fit case.toml --out result"):
        assert words in said.out
    found = json.loads(run("check case.toml --json").out)
    assert found["rated_power_kW"] == 2050.0
    assert found["validation"]["days"] == 3.0
    assert [name for name, _ in found["files"]] == ["cabinet.csv", "ambient.csv", "scada.csv"]


def test_check_takes_a_case_without_cabinet(folder):
    NO_CABINET(folder)
    said = run("check case.toml")
    assert said.status == 0
    assert "no cabinet signal" in said.out


def test_fit_prints_the_tables_and_writes_three_files(fitted):
    folder, said = fitted
    assert set(content(folder / "result")) == {"fit.json", "series.npz", "report.html"}
    assert said.err == f"report: {folder}/result/report.html\n"
    for words in ("synthetic-turbine-3", "SYNTHETIC", "thermal_time_constant", "validation"):
        assert words in said.out
    assert "synthetic-turbine-3" in (folder / "result" / "report.html").read_text()
    entry = json.loads((folder / "result" / "fit.json").read_text())["time_constants"]["thermal"]
    assert f"thermal time constant: {entry['value_h']:.3g} h" in said.out


def test_fit_json_has_the_keys_that_others_rely_on(fitted):
    found = json.loads((fitted[0] / "result" / "fit.json").read_text())
    for name in ("thermal", "hygric"):
        entry = found["time_constants"][name]
        assert {"value_h", "lower_h", "upper_h", "level", "method", "modes"} <= set(entry)
        assert 0 < entry["lower_h"] < entry["value_h"] < entry["upper_h"]
        assert entry["level"] == 0.95
        assert entry["modes"][0] == pytest.approx(entry["value_h"])
    assert set(found["time_constants"]["hygric"]["mean_temperatures"]) == {
        "cabinet_temperature_K", "ambient_temperature_K",
    }  # fmt: skip
    for row in found["parameters"].values():
        assert {"value", "unit", "se", "lower", "upper"} <= set(row)
        assert math.isfinite(row["value"])
    tau = found["parameters"]["thermal_time_constant"]
    assert (tau["unit"], tau["value"]) == ("h", found["time_constants"]["thermal"]["value_h"])
    for period in ("identification", "validation"):
        for quantity in ("temperature_K", "absolute_humidity_g_m3"):
            cells = found["rmse"][period][quantity]
            assert all(cells[regime] > 0 for regime in ("operation", "standstill", "total"))
        assert set(found["baselines"][period]) == {"ambient", "ambient_pressure_balance", "no_dynamics"}
    count = sum(not row["fixed"] and not row["at_bound"] for row in found["parameters"].values())
    for key in ("aic", "bic"):
        penalty = (found[key] + 2 * found["loglik"]) / (2.0 if key == "aic" else math.log(found["n_obs"]))
        assert penalty == pytest.approx(round(penalty))
        assert count <= round(penalty) <= len(found["parameters"])
    (doubt,) = found["doubts"]
    assert doubt["code"] == "short_period" and doubt["values"]["days"] == pytest.approx(3.0, abs=0.05)
    for period in ("identification", "validation"):
        assert found["readings_sd"][period]["temperature_K"] > found["rmse"][period]["temperature_K"]["total"]
    assert found["n_obs"] > 2500
    assert found["converged"] is True
    assert [one["code"] for one in found["messages"]] == ["converged"]
    assert found["version"] == __version__


def test_fit_as_json_is_what_it_writes(folder, monkeypatch):
    stored = replace(read_fit(folder / "result"), series=read_series(folder / "result"))
    monkeypatch.setattr("hygrokf.commands.fit_commands.case_fit", lambda *_: stored)
    monkeypatch.setattr("hygrokf.report.fit_page.write_report", lambda out: out / "report.html")
    said = run("fit case.toml --out made/here --json")
    assert said.status == 0
    assert said.out == (folder / "made/here/fit.json").read_text()
    assert set(content(folder / "made/here")) == {"fit.json", "series.npz"}


def test_options_of_fit_reach_the_identification(folder, monkeypatch):
    seen = {}

    def identify(record, *, progress, **options):
        seen.update(options, name=record.name)
        raise KeyboardInterrupt

    monkeypatch.setattr("hygrokf.identification.identify.identify", identify)
    run("fit case.toml --out made")
    usual = {"criterion": "likelihood", "starts": 5, "kind": DEFAULT_KIND, "model": None}
    assert seen == {"name": "synthetic-turbine-3", **usual}
    run("fit case.toml --out made --kind joint --criterion simulation --starts 7 --model result/fit.json")
    assert seen.pop("model").name == "synthetic-turbine-3"
    assert seen == {"name": "synthetic-turbine-3", "criterion": "simulation", "starts": 7, "kind": "joint"}


def test_simulate_writes_the_free_run(folder):
    said = run(SIMULATE)
    head, *lines = (folder / "simulated.csv").read_text().splitlines()
    assert (said.status, said.err) == (0, "")
    assert said.out.startswith(f"{len(lines)} instants written: simulated.csv\n")
    names = ("temperature_degC", "relative_humidity_pct", "absolute_humidity_g_m3")
    columns = ["time", *(f"cabinet_{name}{end}" for name in names for end in ("", "_sd")), "inputs_known"]
    assert head.split(",") == columns
    cells = np.array([line.split(",")[1:] for line in lines], dtype=float)
    fit, record = read_fit(folder / "result"), read_case(folder / "case.toml")
    _, made, predicted = simulate_fit(fit, record)
    seconds = [datetime.fromisoformat(line.split(",")[0]).timestamp() for line in lines]
    np.testing.assert_allclose(seconds, made.timeline.origin_s + 3600 * made.timeline.time, atol=1e-3)
    np.testing.assert_allclose(cells[:, 0], predicted.temperature[0] - 273.15, atol=6e-5)
    np.testing.assert_allclose(cells[:, 1], predicted.temperature[1], atol=6e-5)
    np.testing.assert_allclose(cells[:, 2], 100 * predicted.relative_humidity[0], atol=6e-5)
    np.testing.assert_allclose(cells[:, 4], predicted.absolute_humidity[0], atol=6e-5)
    np.testing.assert_array_equal(cells[:, 6], made.scored)
    again = run(f"{SIMULATE} --json")
    assert json.loads(again.out) == plain(simulation_summary(fit, made, predicted))


def test_simulate_needs_no_cabinet(folder):
    case(("cabinet_temperature", "nacelle_temperature"), ("cabinet_relative", "nacelle_relative"))(folder)
    assert run(SIMULATE).status == 0
    assert (folder / "simulated.csv").read_text().count("\n") > 2000


def test_simulate_without_power_says_that_no_row_counts(folder):
    leave_out("active_power")(folder)
    said = run(SIMULATE)
    assert said.status == 0
    assert said.err.startswith("note: ") and "inputs_known" in said.err
    lines = (folder / "simulated.csv").read_text().splitlines()[1:]
    assert {line[-1] for line in lines} == {"0"}


def test_evaluate_notes_another_rated_power(folder):
    case(("rated_power_kW = 2050", "rated_power_kW = 3075"))(folder)
    assert "1.50 times" in run(EVALUATE).out


def test_fit_says_whose_fit_it_replaces(folder, monkeypatch):
    monkeypatch.setattr("hygrokf.commands.fit_commands.case_fit", lambda *_: read_fit(folder / "result"))
    monkeypatch.setattr(
        "hygrokf.commands.fit_commands.write_fit_and_page", lambda fit, out: out / "report.html"
    )
    assert "replaces" not in run("fit case.toml --out result").err
    case(("synthetic-turbine-3", "uk-01"))(folder)
    assert "replaces the fit of synthetic-turbine-3\n" in run("fit case.toml --out result").err


def test_evaluate_prints_the_scores(folder):
    found = evaluate(read_fit(folder / "result"), read_case(folder / "case.toml"))
    assert run(EVALUATE) == Said(0, evaluation_text(found) + "\n", "")
    shown = json.loads(run(f"{EVALUATE} --json").out)
    assert shown == plain(found)
    assert shown["rmse"] == json.loads((folder / "result/fit.json").read_text())["rmse"]


def test_report_is_written_again_from_the_two_files(folder):
    page = (folder / "result/report.html").read_bytes()
    (folder / "result/report.html").unlink()
    assert run("report result") == Said(0, "result/report.html\n", "")
    assert (folder / "result/report.html").read_bytes() == page


def test_report_as_json_names_the_page(folder, monkeypatch):
    monkeypatch.setattr("hygrokf.report.fit_page.page_html", lambda page: "a page")
    assert json.loads(run("report result --json").out) == {"report": "result/report.html"}
    assert (folder / "result/report.html").read_text() == "a page"


# --- what is masked, and what is not overwritten ---------------------------------------------


def test_warnings_do_not_stop_the_other_commands(folder):
    column("T_cab_degC", lambda row, cell: "-273.0" if row == 7 else cell)(folder)
    for line in (EVALUATE, SIMULATE):
        said = run(line)
        assert said.status == 0
        (warning,) = said.err.splitlines()
        assert warning.startswith("warning: cabinet_temperature (cabinet.csv, ")
        assert "-273" not in said.out
    (checked,) = json.loads(run("check case.toml --json").out)["warnings"]
    assert "cabinet.csv" in checked


@pytest.mark.parametrize(
    ("command", "own"),
    [
        ("fit case.toml", "fit.json"),
        ("discover case.toml", "discovery.json"),
        ("compare case.toml case.toml", "compare.json"),
        ("transfer fit case.toml", "transfer.json"),
        ("climate fit.json --weather w.epw --standstill", "climate.json"),
        ("fleet fleet.toml", "fleet.json"),
    ],
)
def test_results_are_not_written_over_results_of_another_kind(command: str, own: str, tmp_path: Path) -> None:
    """Refused before anything is read; a directory with results of the same kind is accepted, a discovery's
    with its fit too."""
    for name in RESULTS:
        out = tmp_path / name.partition(".")[0]
        out.mkdir()
        (out / name).write_text("{}")
        said = run(f"{command} --out {out}")
        assert said.status == 2
        assert ("a directory of its own" in said.err) == (name != own), said.err
    if own == "discovery.json":
        (tmp_path / "discovery" / "fit.json").write_text("{}")
        assert "a directory of its own" not in run(f"{command} --out {tmp_path}/discovery").err
