"""The command line: what each command writes and says, and that every mistake is told in one message."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from hygrokf.case import read_case
from hygrokf.cli import main
from hygrokf.results import read_fit
from hygrokf.synthetic import synthetic_turbine, write_case
from hygrokf.tables import evaluation, evaluation_text, simulated, simulation_summary
from hygrokf.version import __version__

COMMANDS = ("demo", "check", "fit", "simulate", "evaluate", "report")
FIT = "fit case.toml --out made"
SIMULATE = "simulate result case.toml --out simulated.csv"
EVALUATE = "evaluate result/fit.json case.toml"
Edit = Callable[[Path], object]


@dataclass(frozen=True)
class Said:
    """Exit status of a command and its two streams."""

    status: int
    out: str
    err: str


def run(line: str) -> Said:
    """A command line without quotes, in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(line.split())
    return Said(status, out.getvalue(), err.getvalue())


def content(folder: Path) -> dict[str, bytes | None]:
    """Everything in a directory: files with their bytes, directories with None."""
    return {
        str(one.relative_to(folder)): one.read_bytes() if one.is_file() else None
        for one in folder.rglob("*")
    }


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> tuple[Path, Said]:
    """A synthetic turbine of 20 days, fitted once, and what the fit said."""
    folder = tmp_path_factory.mktemp("turbine")
    write_case(synthetic_turbine(seed=3, days=20), folder)
    said = run(f"fit {folder}/case.toml --out {folder}/result --starts 1")
    assert said.status == 0, said.err
    return folder, said


@pytest.fixture
def folder(fitted, tmp_path, monkeypatch) -> Path:
    """The working directory: a copy of the case, and its fit in `result`."""
    copy = tmp_path / "work"
    shutil.copytree(fitted[0], copy)
    monkeypatch.chdir(copy)
    return copy


@pytest.fixture
def told(capsys) -> Callable[[str], Said]:
    """A command in this process, also one that the parser refuses."""

    def command(line: str) -> Said:
        capsys.readouterr()
        try:
            status = main(line.split())
        except SystemExit as stop:
            status = stop.code
        return Said(status, *capsys.readouterr())

    return command


# --- what is done to a case ------------------------------------------------------------------


def case(*changes: tuple[str, str]) -> Edit:
    """Exchange texts of the case file, each where it stands first."""

    def edit(folder: Path) -> None:
        text = (folder / "case.toml").read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        (folder / "case.toml").write_text(text)

    return edit


def leave_out(*words: str) -> Edit:
    """Leave out the lines of the case file that hold one of the words."""

    def edit(folder: Path) -> None:
        lines = (folder / "case.toml").read_text().splitlines(keepends=True)
        kept = [line for line in lines if not any(word in line for word in words)]
        assert len(kept) < len(lines)
        (folder / "case.toml").write_text("".join(kept))

    return edit


def rows(file: str, change: Callable[[list[str]], list[str]]) -> Edit:
    """Change the lines of a table below its header."""

    def edit(folder: Path) -> None:
        head, *lines = (folder / file).read_text().splitlines()
        (folder / file).write_text("\n".join([head, *change(lines)]) + "\n")

    return edit


def column(name: str, change: Callable[[int, str], str], file: str = "cabinet.csv") -> Edit:
    """Change the cells of a column: (number of the row, cell) -> cell."""

    def edit(folder: Path) -> None:
        head, *lines = (folder / file).read_text().splitlines()
        place = head.split(",").index(name)
        cells = [line.split(",") for line in lines]
        for number, row in enumerate(cells):
            row[place] = change(number, row[place])
        (folder / file).write_text("\n".join([head, *(",".join(row) for row in cells)]) + "\n")

    return edit


def holds(file: str, found: bytes) -> Edit:
    """Write other bytes into a file."""
    return lambda folder: (folder / file).write_bytes(found)


def result(change: Callable[[dict], object]) -> Edit:
    """Change what fit.json holds."""

    def edit(folder: Path) -> None:
        file = folder / "result" / "fit.json"
        data = json.loads(file.read_text())
        change(data)
        file.write_text(json.dumps(data))

    return edit


def gone(name: str) -> Edit:
    return lambda folder: (folder / name).unlink()


def nothing(folder: Path) -> None:
    """The mistake is on the command line."""


# --- every command ---------------------------------------------------------------------------


def test_help_names_every_command_and_starts_without_a_traceback():
    done = subprocess.run(
        [sys.executable, "-m", "hygrokf", "--help"], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
    for name in COMMANDS:
        assert re.search(rf"^    {name} +\w", done.stdout, re.MULTILINE)


def test_version_and_no_command_at_all(told):
    assert told("--version") == Said(0, f"hygrokf {__version__}\n", "")
    said = told("")
    assert (said.status, said.err) == (0, "")
    assert said.out.startswith("usage: hygrokf")


def test_demo_makes_fits_and_reports(tmp_path, told):
    """The whole demo, as in the README; its truth is a time constant of 1.5 h and one of 0.30 h."""
    said = told(f"demo --out {tmp_path}/demo --json")
    assert said.status == 0
    written = {"cabinet.csv", "ambient.csv", "scada.csv", "case.toml", "fit.json", "series.npz", "report.html"}
    assert set(content(tmp_path / "demo")) == written
    first, last = said.err.splitlines()
    assert first == f"synthetic turbine written: {tmp_path}/demo/case.toml"
    assert last == f"report: {tmp_path}/demo/report.html"
    found = json.loads(said.out)
    assert found["synthetic"] is True
    assert found["converged"] is True
    for name, truth in (("thermal", 1.5), ("hygric", 0.30)):
        entry = found["time_constants"][name]
        assert entry["lower_h"] / 1.05 < truth < entry["upper_h"] * 1.05


def test_demo_of_another_seed_is_another_turbine(tmp_path, told, monkeypatch):
    """The seed reaches the turbine; what follows is broken off."""
    monkeypatch.setattr("hygrokf.identification.identify", interrupted)
    assert told(f"demo --out {tmp_path}/demo --seed 7").status == 130
    assert 'name = "synthetic-turbine-7"' in (tmp_path / "demo" / "case.toml").read_text()
    assert len(content(tmp_path / "demo")) == 4


def interrupted(*_, **__):
    raise KeyboardInterrupt


def test_check_says_what_was_read(folder, told):
    said = told("check case.toml")
    assert (said.status, said.err) == (0, "")
    assert said.out.startswith("synthetic-turbine-3: 2020-07-15T00:00Z to 2020-08-04T00:00Z, 20.0 d")
    for words in ("cabinet_relative_humidity", 'scada.csv, column "P_kW"', "warnings: none", "doubts: 1"):
        assert words in said.out
    found = json.loads(told("check case.toml --json").out)
    assert found["rated_power_kW"] == 2050.0
    assert found["validation"]["days"] == 3.0
    assert [one["file"] for one in found["files"]] == ["cabinet.csv", "ambient.csv", "scada.csv"]


def test_fit_prints_the_tables_and_writes_three_files(fitted):
    folder, said = fitted
    assert set(content(folder / "result")) == {"fit.json", "series.npz", "report.html"}
    assert said.err == f"report: {folder}/result/report.html\n"
    for words in (
        "synthetic-turbine-3 (SYNTHETIC: nothing measured)",
        "Time constants",
        "thermal (R_AT+R_IC)·C",
        "hygric R_D*·V*",
        "Root mean squared error, identification",
        "Root mean squared error, validation",
        "Readings inside the 95 % bands",
        "Parameters",
        "thermal_time_constant",
        "What to believe (+)",
    ):
        assert words in said.out
    page = (folder / "result" / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert "synthetic-turbine-3" in page
    entry = json.loads((folder / "result" / "fit.json").read_text())["time_constants"]["thermal"]
    assert f"thermal {entry['value_h']:.3g} h" in said.out


def test_fit_json_has_the_keys_that_others_rely_on(fitted):
    found = json.loads((fitted[0] / "result" / "fit.json").read_text())
    for name in ("thermal", "hygric"):
        entry = found["time_constants"][name]
        assert {"value_h", "lower_h", "upper_h", "level", "method", "reference", "modes"} <= set(entry)
        assert 0 < entry["lower_h"] < entry["value_h"] < entry["upper_h"]
        assert entry["level"] == 0.95
        assert entry["modes"][0] == pytest.approx(entry["value_h"])
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
    assert found["n_obs"] > 2500
    assert found["converged"] is True
    assert found["message"]
    assert found["version"] == __version__


def test_fit_as_json_is_what_it_writes(folder, told):
    """Options reach the fit: the free run's criterion gives other numbers than the innovations'."""
    said = told("fit case.toml --out made/here --criterion simulation --starts 1 --json")
    assert said.status == 0
    assert said.out == (folder / "made/here/fit.json").read_text()
    found = json.loads(said.out)
    assert found["criterion"] == "simulation"
    assert found["time_constants"]["thermal"]["method"].startswith("output error")
    assert set(content(folder / "made/here")) == {"fit.json", "series.npz", "report.html"}


def test_options_of_fit_reach_the_identification(folder, told, monkeypatch):
    seen = {}

    def identify(record, *, progress, **options):
        seen.update(options, name=record.name)
        raise KeyboardInterrupt

    monkeypatch.setattr("hygrokf.identification.identify", identify)
    told("fit case.toml --out made")
    assert seen == {"name": "synthetic-turbine-3", "criterion": "likelihood", "starts": 4}
    told("fit case.toml --out made --kind joint --criterion simulation --starts 7")
    assert seen == {
        "name": "synthetic-turbine-3",
        "criterion": "simulation",
        "starts": 7,
        "kind": "joint",
    }


def test_simulate_writes_the_free_run(folder, told):
    said = told(SIMULATE)
    head, *lines = (folder / "simulated.csv").read_text().splitlines()
    assert (said.status, said.err) == (0, "")
    assert said.out == f"{len(lines)} instants written: simulated.csv\n"
    names = ("temperature_degC", "relative_humidity_pct", "absolute_humidity_g_m3")
    columns = ["time", *(f"cabinet_{name}{end}" for name in names for end in ("", "_sd")), "inputs_known"]
    assert head.split(",") == columns
    cells = np.array([line.split(",")[1:] for line in lines], dtype=float)
    fit, record = read_fit(folder / "result"), read_case(folder / "case.toml")
    _, made, predicted = simulated(fit, record)
    seconds = [datetime.fromisoformat(line.split(",")[0]).timestamp() for line in lines]
    np.testing.assert_allclose(seconds, made.timeline.origin_s + 3600 * made.timeline.time, atol=1e-3)
    np.testing.assert_allclose(cells[:, 0], predicted.temperature[0] - 273.15, atol=6e-5)
    np.testing.assert_allclose(cells[:, 1], predicted.temperature[1], atol=6e-5)
    np.testing.assert_allclose(cells[:, 2], 100 * predicted.relative_humidity[0], atol=6e-5)
    np.testing.assert_allclose(cells[:, 4], predicted.absolute_humidity[0], atol=6e-5)
    np.testing.assert_array_equal(cells[:, 6], made.scored)
    again = told(f"{SIMULATE} --json")
    assert json.loads(again.out) == simulation_summary(fit, record)


def test_simulate_needs_no_cabinet(folder, told):
    case(("cabinet_temperature", "nacelle_temperature"), ("cabinet_relative", "nacelle_relative"))(folder)
    assert told(SIMULATE).status == 0
    assert (folder / "simulated.csv").read_text().count("\n") > 2000


def test_evaluate_prints_the_scores(folder, told):
    fit, record = read_fit(folder / "result"), read_case(folder / "case.toml")
    found = evaluation(fit, record)
    assert told(EVALUATE) == Said(0, evaluation_text(found) + "\n", "")
    shown = json.loads(told(f"{EVALUATE} --json").out)
    assert shown == json.loads(json.dumps(found))
    assert shown["rmse"] == pytest.approx_nested(json.loads((folder / "result/fit.json").read_text())["rmse"])


def test_report_is_written_again_from_the_two_files(folder, told):
    page = (folder / "result/report.html").read_bytes()
    (folder / "result/report.html").unlink()
    assert told("report result") == Said(0, "result/report.html\n", "")
    assert (folder / "result/report.html").read_bytes() == page
    assert json.loads(told("report result --json").out) == {"report": "result/report.html"}


# --- wrong inputs ----------------------------------------------------------------------------


def wrong(name: str, line: str, edit: Edit, *words: str):
    return pytest.param(line, edit, words, id=name)


def damaged(name: str, change: Callable[[dict], object], *words: str):
    """A fit.json that was changed by hand."""
    return wrong(name, EVALUATE, result(change), "hygrokf: result/fit.json: damaged", *words, "fit` again")


def option(name: str, line: str, *words: str):
    return wrong(name, line, nothing, *words)


ONE = "hygrokf: case.toml: 1 fault\n  1. "

WRONG = [
    # the case file
    wrong("no case file", "fit uk-01.toml --out made", nothing, "hygrokf: uk-01.toml", "no such case file"),
    wrong("misspelt case file", "check cse.toml", nothing, "no such case file", 'mean "case.toml"?'),
    wrong("a directory as case", "check result", nothing, "hygrokf: result: 1 fault", "Is a directory"),
    wrong("empty case file", FIT, holds("case.toml", b""), "3 faults", "names no source", "[[source]]"),
    wrong(
        "broken TOML",
        FIT,
        case(("[[source]]", "[[source")),
        ONE + "line 9, column 9: not valid TOML: Expected ']]'",
        "in: [[source",
    ),
    wrong("binary case file", FIT, holds("case.toml", b"\xff\x00"), ONE, "expected TOML text in UTF-8"),
    wrong(
        "unknown key",
        FIT,
        case(("rated_power_kW", "rated_power")),
        ONE + 'case.toml, line 3: unknown key "rated_power"; expected name, rated_power_kW',
    ),
    wrong(
        "unknown unit",
        FIT,
        case(('"degC"', '"grad"')),
        ONE + 'case.toml, line 12: unknown unit "grad" for cabinet_temperature; units that fit: K, degC, degF',
    ),
    wrong(
        "unit of another quantity",
        FIT,
        case(('"degC"', '"kW"')),
        ONE + 'case.toml, line 12: unit "kW" is one of power, but cabinet_temperature is a temperature',
    ),
    wrong(
        "unknown signal",
        FIT,
        case(("cabinet_temperature", "cabin_temperature")),
        ONE + 'case.toml, line 12: unknown signal "cabin_temperature"; did you mean "cabinet_temperature"',
    ),
    wrong(
        "bad stamp word",
        FIT,
        case(('stamp = "start"', 'stamp = "begin"')),
        ONE + 'case.toml, line 26: stamp must be one of instant, start, middle, end, found "begin"',
    ),
    wrong(
        "unknown timezone",
        FIT,
        case(('time = "time"', 'time = "time"\ntimezone = "Europe/Berln"')),
        ONE + 'cabinet.csv: unknown timezone "Europe/Berln": expected a fixed offset',
        'mean "Europe/Berlin"',
    ),
    wrong(
        "until outside the record",
        FIT,
        case(("2020-08-01T", "2030-08-01T")),
        ONE + "case.toml, line 32: until = 2030-08-01T00:00Z is outside of the record",
        "(2020-07-15T00:00Z to 2020-08-04T00:00Z)",
    ),
    wrong(
        "until without a zone",
        FIT,
        case(("2020-08-01T00:00:00Z", "2020-08-01T00:00:00")),
        ONE + 'case.toml, line 32: until: stamp "2020-08-01T00:00:00" has no offset: add Z',
    ),
    wrong(
        "no ambient temperature",
        FIT,
        leave_out("ambient_temperature"),
        ONE + "case.toml: no source names signals.ambient_temperature",
    ),
    wrong("no source file", FIT, gone("scada.csv"), ONE + "scada.csv: no such file"),
    # the tables
    wrong(
        "missing column",
        FIT,
        case(('"T_cab_degC"', '"T_cab"')),
        ONE + 'cabinet.csv: no column "T_cab" (line 1 has "time", "T_cab_degC", "RH_cab_pct"',
        'mean "T_cab_degC"?',
    ),
    wrong(
        "naive time",
        FIT,
        rows("cabinet.csv", lambda lines: [line.replace("Z,", ",") for line in lines]),
        ONE + 'cabinet.csv: column "time": 1847 of 1847 stamps have no offset (line 2 "2020-07-15T00:03:20")',
        'timezone = "UTC"',
    ),
    wrong(
        "text among numbers",
        FIT,
        column("T_cab_degC", lambda row, cell: "error" if row == 10 else cell),
        ONE + 'cabinet.csv: column "T_cab_degC": expected numbers, found text in 1 of 1847 rows: line 12 "error"',
        'missing = ["error"]',
    ),
    wrong(
        "text among stamps",
        FIT,
        rows("ambient.csv", lambda lines: [*lines[:7], "midnight" + lines[7][20:], *lines[8:]]),
        ONE + 'ambient.csv: column "time": expected ISO 8601 stamps, found 1 of 2854 rows otherwise: '
        'line 9 "midnight"',
    ),
    wrong(
        "fraction called %",
        FIT,
        column("RH_cab_pct", lambda row, cell: f"{float(cell) / 100:.3f}" if cell else cell),
        ONE + 'cabinet.csv: column "RH_cab_pct": cabinet_relative_humidity is called %, but its readings reach',
        'unit = "1"',
    ),
    wrong(
        "kelvin called degC",
        FIT,
        column("T_amb_degC", lambda row, cell: f"{float(cell) + 273.15:.1f}", "ambient.csv"),
        ONE + 'ambient.csv: column "T_amb_degC": ambient_temperature is called degC',
        "they would fit as K",
    ),
    wrong(
        "no overlap",
        FIT,
        rows("ambient.csv", lambda lines: [line.replace("2020-", "2019-") for line in lines]),
        ONE + "no overlap: ambient_temperature",
        "ambient.csv (2019-07-15T00:06:40Z to 2019-08-03T23:56:40Z)",
        "the cabinet's readings (2020-07-15T00:03:20Z to 2020-08-03T23:48:20Z)",
    ),
    wrong("empty file", FIT, holds("cabinet.csv", b""), ONE + "cabinet.csv: the file is empty"),
    wrong(
        "only a header",
        FIT,
        rows("cabinet.csv", lambda lines: []),
        ONE + "cabinet.csv: expected readings, found no row below the header",
    ),
    wrong(
        "binary file",
        FIT,
        holds("cabinet.csv", b"time,T_cab_degC\n\x00\x01\x02"),
        ONE + "cabinet.csv: line 2: is no text (a zero byte)",
    ),
    wrong("Excel file", FIT, holds("cabinet.csv", b"PK\x03\x04 and more"), ONE, "export it as CSV"),
    wrong(
        "a cell too many",
        FIT,
        rows("scada.csv", lambda lines: [*lines[:3], lines[3] + ",7", *lines[4:]]),
        ONE + "scada.csv: line 5: expected 5 cells as in the header (line 1), found more",
    ),
    wrong(
        "one mean alone",
        FIT,
        rows("scada.csv", lambda lines: lines[:1]),
        ONE + "scada.csv: the length of the interval averaged over is not to be seen",
        'interval = "10min"',
    ),
    wrong(
        "too few readings",
        FIT,
        rows("cabinet.csv", lambda lines: lines[:29]),
        "hygrokf: case.toml: cabinet_temperature: expected at least 50 readings in the identification period, "
        "found 29",
    ),
    # where to write
    option("out is a file", "fit case.toml --out scada.csv", "--out scada.csv: expected a directory", "a file"),
    option("out below a file", "fit case.toml --out scada.csv/a/b", "--out scada.csv/a/b", "scada.csv is a file"),
    option("demo out is a file", "demo --out scada.csv", "--out scada.csv: expected a directory", "is a file"),
    option("simulate to a directory", "simulate result case.toml --out result", "expected a file", "directory"),
    option("simulate to nowhere", "simulate result case.toml --out a/b.csv", "--out a/b.csv", "found no a;"),
    option("simulate below a file", "simulate result case.toml --out scada.csv/b.csv", "scada.csv is a file"),
    *(
        option(
            f"simulate onto {file}",
            f"simulate result case.toml --out {file}",
            f"hygrokf: --out {file}: expected a file of its own, found one that is read here",
        )
        for file in ("result/fit.json", "case.toml", "cabinet.csv")
    ),
    # the results of a fit
    wrong("no fit.json", EVALUATE, gone("result/fit.json"), "result/fit.json: expected a result", "no such file"),
    option("a directory without fit", "evaluate . case.toml", "hygrokf: fit.json: expected a result", "no such"),
    wrong(
        "half a fit.json",
        EVALUATE,
        lambda folder: os.truncate(folder / "result/fit.json", 2000),
        "hygrokf: result/fit.json: expected JSON written by `hygrokf fit`, found Unterminated string",
        "line ",
    ),
    wrong(
        "no fit at all",
        EVALUATE,
        holds("result/fit.json", b'{"a": 1}'),
        "result/fit.json: not a result of `hygrokf fit`: it lacks covariance, design",
    ),
    wrong(
        "newer version",
        EVALUATE,
        result(lambda fit: fit.update(version="99.0.1")),
        f"result/fit.json: written by hygrokf 99.0.1, this is {__version__}",
    ),
    damaged("a row of the covariance missing", lambda fit: fit["covariance"]["matrix"].pop(), "expected 19 × 19"),
    damaged(
        "no number in the covariance",
        lambda fit: fit["covariance"]["matrix"][0].__setitem__(0, None),
        "covariance: expected 19 × 19 finite numbers, found 360",
    ),
    damaged(
        "covariance of another model",
        lambda fit: fit["covariance"]["names"].__setitem__(0, "mass"),
        "covariance of unknown parameters mass",
    ),
    damaged(
        "a parameter twice",
        lambda fit: fit["covariance"]["names"].__setitem__(0, fit["covariance"]["names"][1]),
        "covariance: expected every parameter once",
    ),
    damaged(
        "parameter out of bounds",
        lambda fit: fit["parameters"]["hygric_k"].update(value=-1),
        "parameter hygric_k: expected 0.005 … 200 h, found -1",
    ),
    damaged(
        "parameter is text",
        lambda fit: fit["parameters"]["hygric_k"].update(value="0.3"),
        "parameter hygric_k: expected a number, found '0.3'",
    ),
    damaged(
        "unknown mechanism",
        lambda fit: fit["design"]["mechanisms"][0].__setitem__(0, "stove"),
        "KeyError 'stove'",
    ),
    damaged(
        "constants of the design",
        lambda fit: fit["design"].update(
            power_scale_W="much",
            power_order="two",
            averaged={"cabinet_temperature": 0},
            ambient_noise={"ambient_temperature": [1.0]},
        ),
        "power_scale_W: expected a number above 0 or null, found 'much'",
        "power_order: expected a whole number from 0 on, found 'two'",
        "averaged.cabinet_temperature: expected 1 number above 0, found 0",
        "ambient_noise.ambient_temperature: expected 2 numbers above 0, found (1.0,)",
    ),
    damaged(
        "means of the power",
        lambda fit: fit["design"].update(power_mean=[0.5]),
        "power_mean: expected 3 numbers or none, found [0.5]",
    ),
    # the case for a fit
    wrong(
        "simulate without ambient",
        SIMULATE,
        leave_out("ambient_temperature"),
        ONE + "case.toml: no source names signals.ambient_temperature, the input that no model goes without",
    ),
    wrong(
        "simulate without ambient humidity",
        SIMULATE,
        leave_out("ambient_relative_humidity"),
        "hygrokf: case.toml: the model reads an ambient humidity (relative, absolute or dew point)",
        "which the record does not have (it has cabinet_temperature,",
    ),
    wrong(
        "evaluate without cabinet",
        EVALUATE,
        case(("cabinet_temperature", "nacelle_temperature"), ("cabinet_relative", "nacelle_relative")),
        ONE + "case.toml: nothing in the cabinet to identify; expected one of signals.cabinet_temperature",
    ),
    wrong(
        "evaluate without readings",
        EVALUATE,
        rows("cabinet.csv", lambda lines: [re.sub("Z,.*", "Z,,,1", line) for line in lines]),
        ONE + "no reading of cabinet_temperature, cabinet_relative_humidity can be used",
        "the columns hold no number",
    ),
    # the report
    option("report on no directory", "report none", "hygrokf: none/fit.json: no such file", "none/series.npz: no"),
    wrong(
        "report on an empty directory",
        "report made",
        lambda folder: (folder / "made").mkdir(),
        "hygrokf: made/fit.json: no such file; run `hygrokf fit` with --out on this directory first",
        "\nmade/series.npz: no such file",
    ),
    wrong(
        "report on half a file",
        "report result",
        lambda folder: os.truncate(folder / "result/series.npz", 2000),
        "hygrokf: result/series.npz: expected arrays written by `hygrokf fit`, found: ",
    ),
    # options
    option("no start", f"{FIT} --starts 0", "--starts: expected a whole number from 1 on, found '0'"),
    option("starts in words", f"{FIT} --starts two", "--starts: expected a whole number from 1 on, found 'two'"),
    option("unknown criterion", f"{FIT} --criterion guess", "--criterion: ", "'guess'", "likelihood", "simulation"),
    option("unknown kind", f"{FIT} --kind both", "--kind: ", "'both'", "joint", "cascade"),
    option("negative seed", "demo --out made --seed -1", "--seed: expected a whole number from 0 on, found '-1'"),
    option("nowhere to write", "fit case.toml", "the following arguments are required: --out"),
    option("unknown command", "fot case.toml", "'fot'", "check", "simulate"),
    option("unknown option", "check case.toml --fast", "unrecognized arguments: --fast"),
]


def refused(said: Said, words: tuple[str, ...]) -> None:
    """Status 2 and one message on standard error that holds the words."""
    assert said.status == 2
    assert said.out == ""
    assert "Traceback" not in said.err
    assert said.err.startswith(("hygrokf: ", "usage: "))
    messages = re.findall(r"^hygrokf( \w+)?: ", said.err, re.MULTILINE)
    assert len(messages) == 1
    for part in words:
        assert part in said.err


@pytest.mark.parametrize(("line", "edit", "words"), WRONG)
def test_a_mistake_is_told_in_one_message_and_nothing_is_written(folder, told, line, edit, words):
    edit(folder)
    before = content(folder)
    refused(told(line), words)
    assert content(folder) == before


def test_every_fault_of_a_case_is_listed_at_once(folder, told):
    for edit in (
        case(
            ("rated_power_kW = 2050.0", "rated_power_kW = -3"),
            ("latitude_deg = 52.4", "latitude_deg = 152.4"),
            ('column = "T_cab_degC"', 'column = "T"'),
            ("signals.rain", "signals.rainfall"),
            ('stamp = "start"', 'stamp = "begin"'),
            ('unit = "kW"', 'unit = "kWh"'),
            ('until = "2020-08-01T00:00:00Z"', 'until = "soon"'),
        ),
        rows("cabinet.csv", lambda lines: [line.replace("Z,", ",") for line in lines]),
        column("RH_amb_pct", lambda row, cell: "wet" if row in (3, 5) else cell, "ambient.csv"),
        gone("scada.csv"),
    ):
        edit(folder)
    before = content(folder)
    said = told(FIT)
    expected = [
        "case.toml, line 3: rated_power_kW must be a number above 0, found -3",
        "case.toml, line 6: site: latitude_deg must lie within -90 … 90, found 152.4",
        'case.toml, line 32: until: expected an ISO 8601 stamp such as "2020-12-01T00:00:00Z", found "soon"',
        'case.toml, line 21: unknown signal "rainfall"',
        'case.toml, line 27: unknown unit "kWh" for active_power',
        'case.toml, line 26: stamp must be one of instant, start, middle, end, found "begin"',
        'cabinet.csv: no column "T"',
        'cabinet.csv: column "time": 1847 of 1847 stamps have no offset',
        'ambient.csv: column "RH_amb_pct": expected numbers, found text in 2 of 2854 rows: '
        'line 5 "wet", line 7 "wet"',
        "scada.csv: no such file",
    ]
    refused(said, (f"hygrokf: case.toml: {len(expected)} faults\n", *expected))
    assert [line[:5] for line in said.err.splitlines()[1:]] == [f"{n:3}. " for n in range(1, 11)]
    assert content(folder) == before


@pytest.mark.parametrize("line", ["fit case.toml --out locked/made", "simulate result case.toml --out locked/a"])
def test_a_write_protected_directory_is_told_before_the_work(folder, told, monkeypatch, line):
    (folder / "locked").mkdir()
    (folder / "locked").chmod(0o555)
    allowed = os.access  # root may write everywhere: the answer of an ordinary user is given to it
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked" and allowed(path, mode))
    monkeypatch.setattr("hygrokf.case.read_case", interrupted)
    refused(told(line), ("locked is write-protected", "name another"))
    assert content(folder / "locked") == {}


def test_what_the_system_refuses_is_told_without_a_traceback(folder, told, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "made/fit.json")

    monkeypatch.setattr("hygrokf.files.write_text_whole", full)
    refused(told(SIMULATE), ("made/fit.json: cannot be read or written: No space left on device",))


def test_an_interrupted_fit_leaves_nothing(folder, told, monkeypatch):
    before = content(folder)
    monkeypatch.setattr("hygrokf.identification.identify", interrupted)
    assert told(FIT) == Said(130, "", "interrupted; nothing half-written is left\n")
    assert content(folder) == before


def test_faults_of_the_package_itself_are_not_hidden(folder, told, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a defect")

    monkeypatch.setattr("hygrokf.identification.identify", broken)
    with pytest.raises(RuntimeError, match="a defect"):
        told(FIT)


def test_output_that_nobody_reads_and_a_terminal_without_degrees(folder):
    """A pipe that is closed, a closed stream, and an encoding without "°": no traceback, no other status."""
    command = f'"{sys.executable}" -m hygrokf check case.toml'
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command} | head -c 40; echo; {command} >&-; echo $?"],
        capture_output=True, text=True, timeout=120, env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    assert done.stderr == ""
    assert done.stdout.splitlines() == ["synthetic-turbine-3: 2020-07-15T00:00Z t", "0"]


# --- what is masked, and said ----------------------------------------------------------------


def doubled(lines: list[str]) -> list[str]:
    """A stamp twice with equal readings, and one with others."""
    return [*lines[:50], lines[49], *lines[50:90], re.sub(r"Z,[^,]*", "Z,99.9", lines[89]), *lines[90:]]


def swapped(lines: list[str]) -> list[str]:
    return [*lines[:50], lines[51], lines[50], *lines[52:]]


MASKED = [
    pytest.param(rows("cabinet.csv", doubled), ("duplicate stamps: 2", "contradicting ones masked"), 1, id="twice"),
    pytest.param(rows("cabinet.csv", swapped), ("unsorted stamps: 1 of 1847", "sorted"), 0, id="unsorted"),
    pytest.param(
        rows("cabinet.csv", lambda lines: lines[::-1]), ("the newest come first; turned round",), 0, id="reversed"
    ),
    pytest.param(
        column("T_cab_degC", lambda row, cell: "-273.0" if row in (7, 70) else cell),
        ("2 readings outside of -60 degC … 120 degC masked", "-273 degC"),
        2,
        id="absolute zero",
    ),
    pytest.param(
        column("T_cab_degC", lambda row, cell: "21.4" if 300 <= row < 700 else cell),
        ("frozen sensor, 1 run of identical readings", "at 21.4 degC", "399 readings masked"),
        399,
        id="frozen",
    ),
    pytest.param(
        column("RH_cab_pct", lambda row, cell: "100.0" if 300 <= row < 340 else cell),
        ("saturated humidity, 40 readings of at least 99.5 % masked", "stay out of the likelihood"),
        40,
        id="saturated",
    ),
]


@pytest.mark.parametrize(("edit", "words", "lost"), MASKED)
def test_what_can_be_masked_is_masked_and_said(folder, told, edit, words, lost):
    """Warnings of `check`, and the number of readings that the cabinet has less."""

    def counted() -> tuple[int, list[str]]:
        said = told("check case.toml --json")
        assert (said.status, said.err) == (0, "")
        found = json.loads(said.out)
        return sum(one["readings"] for one in found["signals"][:2]), found["warnings"]

    count, warnings = counted()
    assert warnings == []
    edit(folder)
    left, warnings = counted()
    (sentence,) = warnings
    assert "cabinet.csv" in sentence
    for part in words:
        assert part in sentence
    assert left == count - lost
    text = told("check case.toml").out
    assert f"warnings: 1\n  - {sentence}\n" in text


@pytest.mark.parametrize(
    ("start", "clock", "words"),
    [
        ("2020-10-15T00:00:00", "Europe/Berlin", "2020-10-25"),
        ("2020-03-20T00:00:00", "Etc/GMT-1", "2020-03-29"),
    ],
    ids=["autumn", "spring"],
)
def test_summer_time_holes_are_said(tmp_path, told, start, clock, words):
    """A logger that follows Berlin's clock through the doubled hour, and one that does not skip the missing one."""
    write_case(synthetic_turbine(seed=3, days=15, start=start), tmp_path)
    case(('time = "time"', 'time = "time"\ntimezone = "Europe/Berlin"'))(tmp_path)

    def local(lines: list[str]) -> list[str]:
        moments = [datetime.fromisoformat(line.split("Z,")[0]).replace(tzinfo=UTC) for line in lines]
        shown = [one.astimezone(ZoneInfo(clock)).strftime("%Y-%m-%d %H:%M:%S,") for one in moments]
        return [stamp + line.split("Z,")[1] for stamp, line in zip(shown, lines, strict=True)]

    rows("cabinet.csv", local)(tmp_path)
    said = told(f"check {tmp_path}/case.toml --json")
    assert said.status == 0
    (sentence,) = json.loads(said.out)["warnings"]
    assert sentence.startswith("cabinet.csv: summer-time hole")
    assert words in sentence


def test_warnings_do_not_stop_the_other_commands(folder, told):
    column("T_cab_degC", lambda row, cell: "-273.0" if row == 7 else cell)(folder)
    for line in (EVALUATE, SIMULATE):
        said = told(line)
        assert said.status == 0
        (warning,) = said.err.splitlines()
        assert warning.startswith('warning: cabinet_temperature (cabinet.csv, column "T_cab_degC"): 1 reading')
        assert "-273" not in said.out
