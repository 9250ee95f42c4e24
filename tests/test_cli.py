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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.commands.main import main
from hygrokf.data.files import RESULTS
from hygrokf.identification.results import read_fit
from hygrokf.identification.tables import evaluate, evaluation_text, simulated, simulation_summary
from hygrokf.version import __version__

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ("demo", "check", "fit", "simulate", "evaluate", "export", "track", "doctor", "report")
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
        str(one.relative_to(folder)): one.read_bytes() if one.is_file() else None for one in folder.rglob("*")
    }


def environment(**more: str) -> dict[str, str]:
    """For a process of its own, wherever it starts."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **more}


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
    command = [sys.executable, "-m", "hygrokf", "--help"]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60)
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
    written = {
        "cabinet.csv",
        "ambient.csv",
        "scada.csv",
        "case.toml",
        "fit.json",
        "series.npz",
        "report.html",
    }
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
    monkeypatch.setattr("hygrokf.identification.procedure.identify", interrupted)
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


def test_check_takes_a_case_without_cabinet(folder, told):
    NO_CABINET(folder)
    said = told("check case.toml")
    assert said.status == 0
    assert "no cabinet signal: nothing can be identified or scored" in said.out


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
    assert found["doubts"] == ["short validation period: 3.0 days"]
    for period in ("identification", "validation"):
        assert found["readings_sd"][period]["temperature_K"] > found["rmse"][period]["temperature_K"]["total"]
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

    monkeypatch.setattr("hygrokf.identification.procedure.identify", identify)
    told("fit case.toml --out made")
    assert seen == {"name": "synthetic-turbine-3", "criterion": "likelihood", "starts": 5}
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
    assert said.out.startswith(f"{len(lines)} instants written: simulated.csv\n")
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


def test_simulate_without_power_says_that_no_row_counts(folder, told):
    leave_out("active_power")(folder)
    said = told(SIMULATE)
    assert said.status == 0
    assert (
        "note: no row has all inputs known (inputs_known is 0 throughout): the fit knows the power, "
        in said.err
    )
    lines = (folder / "simulated.csv").read_text().splitlines()[1:]
    assert {line[-1] for line in lines} == {"0"}


def test_evaluate_notes_another_rated_power(folder, told):
    assert "rated power" not in told(EVALUATE).out
    case(("rated_power_kW = 2050", "rated_power_kW = 3075"))(folder)
    assert (
        "note: this turbine's rated power is 1.50 times that of the fit: another type?" in told(EVALUATE).out
    )


def test_fit_says_whose_fit_it_replaces(folder, told, monkeypatch):
    monkeypatch.setattr("hygrokf.commands.main._identify", lambda *_: read_fit(folder / "result"))
    monkeypatch.setattr("hygrokf.commands.main._write", lambda fit, out: out / "report.html")
    assert "replaces" not in told("fit case.toml --out result").err
    case(("synthetic-turbine-3", "uk-01"))(folder)
    assert (
        "note: --out result: replaces the fit of synthetic-turbine-3\n"
        in told("fit case.toml --out result").err
    )


def test_evaluate_prints_the_scores(folder, told):
    fit, record = read_fit(folder / "result"), read_case(folder / "case.toml")
    found = evaluate(fit, record)
    assert told(EVALUATE) == Said(0, evaluation_text(found) + "\n", "")
    shown = json.loads(told(f"{EVALUATE} --json").out)
    assert shown == json.loads(json.dumps(found))
    assert shown["rmse"] == json.loads((folder / "result/fit.json").read_text())["rmse"]


def test_report_is_written_again_from_the_two_files(folder, told):
    page = (folder / "result/report.html").read_bytes()
    (folder / "result/report.html").unlink()
    assert told("report result") == Said(0, "result/report.html\n", "")
    assert (folder / "result/report.html").read_bytes() == page


def test_report_as_json_names_the_page(folder, told, monkeypatch):
    monkeypatch.setattr("hygrokf.report.fit_page.report_page", lambda fit, series: fit["name"])
    assert json.loads(told("report result --json").out) == {"report": "result/report.html"}
    assert (folder / "result/report.html").read_text() == "synthetic-turbine-3"


# --- wrong inputs ----------------------------------------------------------------------------


def put(*path: str | int, value: object) -> Edit:
    """Put a value at a place of fit.json."""

    def change(data: dict) -> None:
        *way, last = path
        for key in way:
            data = data[key]
        data[last] = value

    return result(change)


def onto(file: str) -> tuple:
    words = f"hygrokf: --out {file}: expected a file of its own, found one that is read here; name another"
    return f"simulate result case.toml --out {file}", nothing, words


NO_CABINET = case(("cabinet_temperature", "nacelle_temperature"), ("cabinet_relative", "nacelle_relative"))
NO_READING = rows("cabinet.csv", lambda lines: [re.sub("Z,.*", "Z,,,1", line) for line in lines])
FRACTION = column("RH_cab_pct", lambda row, cell: f"{float(cell) / 100:.3f}" if cell else cell)
KELVIN = column("T_amb_degC", lambda row, cell: f"{float(cell) + 273.15:.1f}", "ambient.csv")
ERROR = column("T_cab_degC", lambda row, cell: "error" if row == 10 else cell)
MIDNIGHT = rows("ambient.csv", lambda lines: [*lines[:7], "midnight" + lines[7][20:], *lines[8:]])
NAIVE = rows("cabinet.csv", lambda lines: [line.replace("Z,", ",") for line in lines])
YEAR_BEFORE = rows("ambient.csv", lambda lines: [line.replace("2020-", "2019-") for line in lines])
ONE = "hygrokf: case.toml: 1 fault\n  1. "
ZONE = 'time = "time"\ntimezone = "Europe/Berln"'
DAMAGED = "hygrokf: result/fit.json: damaged, or written by another version of hygrokf than"
MATRIX = ("covariance", "matrix")
# what is wrong: command, what was done before it, what must be said
# fmt: off
WRONG: dict[str, tuple] = {
    # the case file
    "no case file": ("fit uk-01.toml --out made", nothing, "hygrokf: uk-01.toml: 1 fault", "no such case"),
    "misspelt case file": ("check cse.toml", nothing, "no such case file", 'mean "case.toml"?'),
    "a directory as case": ("check result", nothing, "hygrokf: result: 1 fault", "Is a directory"),
    "empty case file": (FIT, holds("case.toml", b""), "3 faults", "names no source; expected one [[source]]"),
    "broken TOML": (FIT, case(("[[source]]", "[[source")),
        ONE + "line 9, column 9: not valid TOML: ", "in: [[source"),
    "binary case file": (FIT, holds("case.toml", b"\xff\x00"), ONE + "expected TOML text in UTF-8"),
    "unknown key": (FIT, case(("rated_power_kW", "rated")),
        ONE + 'case.toml, line 3: unknown key "rated"; expected name, rated_power_kW'),
    "unknown unit": (FIT, case(('"degC"', '"grad"')),
        ONE + 'case.toml, line 12: unknown unit "grad" for cabinet_temperature; units that fit: K, degC'),
    "unknown signal": (FIT, case(("cabinet_temperature", "cabin_temperature")),
        ONE + 'case.toml, line 12: unknown signal "cabin_temperature"; did you mean "cabinet_temperature"'),
    "bad stamp word": (FIT, case(('"start"', '"begin"')),
        ONE + 'case.toml, line 26: stamp must be one of instant, start, middle, end, found "begin"'),
    "unknown timezone": (FIT, case(('time = "time"', ZONE)),
        ONE + 'cabinet.csv: unknown timezone "Europe/Berln": expected a fixed', 'mean "Europe/Berlin"'),
    "until outside": (FIT, case(("2020-08-01T", "2030-08-01T")),
        ONE + "case.toml, line 32: until = 2030-08-01T00:00Z is outside of the record (2020-07-15T00:00Z to"),
    "no ambient": (FIT, leave_out("ambient_temp"), ONE + "case.toml: no source names signals.ambient_temp"),
    "no source file": (FIT, gone("scada.csv"), ONE + "scada.csv: no such file"),
    # the tables
    "missing column": (FIT, case(('"T_cab_degC"', '"T_cab"')),
        ONE + 'cabinet.csv: no column "T_cab" (line 1 has "time", "T_cab_degC"', 'mean "T_cab_degC"?'),
    "naive time": (FIT, NAIVE,
        ONE + 'cabinet.csv: column "time": 1847 of 1847 stamps have no offset (line 2 "2020-07-15T00:03:20")',
        'state their zone in this source: timezone = "UTC"'),
    "text among numbers": (FIT, ERROR,
        ONE + 'cabinet.csv: column "T_cab_degC": expected numbers, found text in 1 of 1847 rows:',
        'line 12 "error"'),
    "text among stamps": (FIT, MIDNIGHT,
        ONE + 'ambient.csv: column "time": expected ISO 8601 stamps, found 1 of 2854 rows otherwise: '
        'line 9 "midnight"'),
    "fraction called %": (FIT, FRACTION,
        ONE + 'cabinet.csv: column "RH_cab_pct": cabinet_relative_humidity is called %, but its readings',
        'state unit = "1"'),
    "kelvin called degC": (FIT, KELVIN,
        ONE + 'ambient.csv: column "T_amb_degC": ambient_temperature is called degC', "they would fit as K"),
    "no overlap": (FIT, YEAR_BEFORE, ONE + "no overlap: ambient_temperature",
        "in ambient.csv (2019-07-15T00:06:40Z to 2019-08-03T23:56:40Z)",
        "the cabinet's readings (2020-07-15T00:03:20Z to 2020-08-03T23:48:20Z) share no time"),
    "empty file": (FIT, holds("cabinet.csv", b""), ONE + "cabinet.csv: the file is empty"),
    "only a header": (FIT, rows("cabinet.csv", lambda lines: []),
        ONE + "cabinet.csv: expected readings, found no row below the header"),
    "binary file": (FIT, holds("cabinet.csv", b"time,T\n\x00\x01"), ONE + "cabinet.csv: line 2: is no text"),
    "a cell too many": (FIT, rows("scada.csv", lambda lines: [*lines[:3], lines[3] + ",7", *lines[4:]]),
        ONE + "scada.csv: line 5: expected 5 cells as in the header (line 1), found more"),
    "one mean alone": (FIT, rows("scada.csv", lambda lines: lines[:1]),
        ONE + "scada.csv: the length of the interval averaged over is not to be seen", 'interval = "10min"'),
    "too few readings": (FIT, rows("cabinet.csv", lambda lines: lines[:29]),
        "hygrokf: case.toml: cabinet_temperature: expected at least 50 readings in the", "period, found 29"),
    # where to write
    "out is a file": ("fit case.toml --out scada.csv", nothing,
        "hygrokf: --out scada.csv: expected a directory that can be written, found: scada.csv is a file"),
    "out below a file": ("fit case.toml --out scada.csv/a/b", nothing,
        "hygrokf: --out scada.csv/a/b: expected a directory that can be written, found: ", "scada.csv is a file"),
    "demo out is a file": ("demo --out scada.csv", nothing, "--out scada.csv: expected a directory that"),
    "simulate to a directory": ("simulate result case.toml --out result", nothing,
        "hygrokf: --out result: expected a file to write, found a directory"),
    "simulate to nowhere": ("simulate result case.toml --out a/b.csv", nothing,
        "hygrokf: --out a/b.csv: expected a file in an existing directory, found no a; make it first"),
    "simulate below a file": ("simulate result case.toml --out scada.csv/b.csv", nothing,
        "expected a file in an existing directory, found that scada.csv is a file"),
    "simulate onto the fit": onto("result/fit.json"),
    "simulate onto the case": onto("case.toml"),
    "simulate onto a table": onto("cabinet.csv"),
    # the results of a fit
    "no fit.json": (EVALUATE, gone("result/fit.json"), "result/fit.json: expected a result", "no such file"),
    "a directory without fit": ("evaluate . case.toml", nothing, "hygrokf: fit.json: expected a result of"),
    "half a fit.json": (EVALUATE, lambda folder: os.truncate(folder / "result/fit.json", 2000),
        "hygrokf: result/fit.json: expected JSON written by `hygrokf fit`, found "),
    "other JSON": (EVALUATE, holds("result/fit.json", b'{"a": 1}'),
        "result/fit.json: not a result of `hygrokf fit`: it lacks covariance, design"),
    "newer version": (EVALUATE, put("version", value="99.0.1"),
        f"result/fit.json: written by hygrokf 99.0.1, this is {__version__}; install that version"),
    "covariance without a row": (EVALUATE, result(lambda fit: fit["covariance"]["matrix"].pop()),
        DAMAGED, "covariance: expected", "finite numbers, found "),
    "covariance without a number": (EVALUATE, put(*MATRIX, 0, 0, value=None),
        DAMAGED, "covariance: expected", "finite numbers, found "),
    "covariance of another model": (EVALUATE, put("covariance", "names", 0, value="mass"),
        DAMAGED, "covariance of unknown parameters mass"),
    "covariance twice": (EVALUATE, put("covariance", "names", 0, value="hygric_k"),
        DAMAGED, "covariance: expected every parameter once"),
    "parameter out of bounds": (EVALUATE, put("parameters", "hygric_k", "value", value=-1),
        DAMAGED, "parameter hygric_k: expected 0.005 … 200 h, found -1; run `hygrokf fit` again"),
    "parameter is text": (EVALUATE, put("parameters", "hygric_k", "value", value="0.3"),
        DAMAGED, "parameter hygric_k: expected a number, found '0.3'"),
    "unknown mechanism": (EVALUATE, put("design", "mechanisms", 0, 0, value="stove"), DAMAGED, "'stove'"),
    "scale of the power": (SIMULATE, put("design", "power_scale_W", value="much"),
        DAMAGED, "power_scale_W: expected a number above 0 or null, found 'much'"),
    "order of the power": (SIMULATE, put("design", "power_order", value="two"),
        DAMAGED, "power_order: expected a whole number from 0 on, found 'two'"),
    "means of the power": (SIMULATE, put("design", "power_mean", value=[0.5]),
        DAMAGED, "power_mean: expected 3 numbers or none, found [0.5]"),
    "length of the means": (SIMULATE, put("design", "averaged", value={"cabinet_temperature": 0}),
        DAMAGED, "averaged.cabinet_temperature: expected 1 number above 0, found 0"),
    "noise of the ambient": (SIMULATE, put("design", "ambient_noise", value={"ambient_temperature": [1.0]}),
        DAMAGED, "ambient_noise.ambient_temperature: expected 2 numbers above 0, found (1.0,)"),
    "a case as fit": ("evaluate case.toml result/fit.json", nothing,
        "hygrokf: case.toml is a case file, expected a result", "the fit comes first, as in `hygrokf evaluate FIT CASE`"),
    "a case as fit to simulate": ("simulate case.toml result --out a.csv", nothing, "case.toml is a case file"),
    "a fit as case": ("fit result/fit.json --out made", nothing,
        "hygrokf: result/fit.json: 1 fault\n  1. is a result of `hygrokf fit`, expected a case file (docs/case_file.md)"),
    "a table as case": ("fit cabinet.csv --out made", nothing,
        "hygrokf: cabinet.csv: 1 fault\n  1. is a table, expected a case file that names it (docs/case_file.md)"),
    "out with another program's fit.json": ("fit case.toml --out result", holds("result/fit.json", b'{"a": 1}'),
        "hygrokf: --out result: expected a new directory or one with an earlier fit, found a fit.json in it that is no"),
    # the case for a fit
    "simulate without ambient": (SIMULATE, leave_out("ambient_temperature"),
        ONE + "case.toml: no source names signals.ambient_temperature, the input that no model goes without"),
    "simulate without ambient humidity": (SIMULATE, leave_out("ambient_relative_humidity"),
        "hygrokf: case.toml: the model reads an ambient humidity (relative, absolute or dew point)",
        "which the record does not have (it has cabinet_temperature,"),
    "evaluate without cabinet": (EVALUATE, NO_CABINET,
        ONE + "case.toml: nothing in the cabinet to identify; expected one of signals.cabinet_temperature"),
    "evaluate without readings": (EVALUATE, NO_READING,
        ONE + "no reading of cabinet_temperature, cabinet_relative_humidity can be used; the columns hold"),
    # the report
    "report on no directory": ("report none", nothing, "hygrokf: none/fit.json: no such file; run"),
    "report on an empty directory": ("report made", lambda folder: (folder / "made").mkdir(),
        "hygrokf: made/fit.json: no such file; run `hygrokf fit` with --out on this directory first\n",
        "\nmade/series.npz: no such file"),
    "report on half a file": ("report result", lambda folder: os.truncate(folder / "result/series.npz", 2000),
        "hygrokf: result/series.npz: expected arrays written by `hygrokf fit`, found: "),
    "report on other JSON": ("report result", holds("result/fit.json", b'{"a": 1}'),
        "hygrokf: result/fit.json: not a result of `hygrokf fit`: it lacks name, version, parameters"),
    "demo over another turbine": ("demo --out .", case(("synthetic", "measured")),
        "hygrokf: --out .: it holds a case.toml of another turbine; name another directory"),
    # options
    "no start": (f"{FIT} --starts 0", nothing, "--starts: expected a whole number from 1 on, found '0'"),
    "starts in words": (f"{FIT} --starts two", nothing, "expected a whole number from 1 on, found 'two'"),
    "unknown criterion": (f"{FIT} --criterion guess", nothing, "--criterion: ", "'guess'", "likelihood"),
    "unknown kind": (f"{FIT} --kind both", nothing, "--kind: ", "'both'", "joint", "cascade"),
    "negative seed": ("demo --out made --seed -1", nothing, "--seed: expected a whole number from 0 on"),
    "nowhere to write": ("fit case.toml", nothing, "the following arguments are required: --out"),
    "unknown command": ("fot case.toml", nothing, "'fot'", "check", "simulate"),
    "unknown option": ("check case.toml --fast", nothing, "unrecognized arguments: --fast"),
}
# fmt: on


def refused(said: Said, words: Sequence[str]) -> None:
    """Status 2 and one message on standard error that holds the words."""
    assert said.status == 2
    assert said.out == ""
    assert "Traceback" not in said.err
    assert said.err.startswith(("hygrokf: ", "usage: "))
    assert len(re.findall(r"^hygrokf( \w+)?: ", said.err, re.MULTILINE)) == 1
    for part in words:
        assert part in said.err


@pytest.mark.parametrize("name", WRONG)
def test_a_mistake_is_told_in_one_message_and_nothing_is_written(folder, told, name):
    line, edit, *words = WRONG[name]
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
        NAIVE,
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
    assert re.findall(r"^  (\d+)\. ", said.err, re.MULTILINE) == [str(n + 1) for n in range(len(expected))]
    assert content(folder) == before


@pytest.mark.parametrize(
    "line", ["fit case.toml --out locked/made", "simulate result case.toml --out locked/a"]
)
def test_a_write_protected_directory_is_told_before_the_work(folder, told, monkeypatch, line):
    (folder / "locked").mkdir()
    (folder / "locked").chmod(0o555)
    allowed = os.access  # root may write everywhere: the answer of an ordinary user is given to it
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked" and allowed(path, mode))
    monkeypatch.setattr("hygrokf.cases.case_file.read_case", interrupted)
    refused(told(line), ("locked is write-protected", "name another"))
    assert content(folder / "locked") == {}


def test_what_the_system_refuses_is_told_without_a_traceback(folder, told, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "made/fit.json")

    monkeypatch.setattr("hygrokf.data.files.write_text_whole", full)
    refused(told(SIMULATE), ("made/fit.json: cannot be read or written: No space left on device",))


def test_an_interrupted_fit_leaves_nothing(folder, told, monkeypatch):
    before = content(folder)
    monkeypatch.setattr("hygrokf.identification.procedure.identify", interrupted)
    assert told(FIT) == Said(130, "", "interrupted; nothing half-written is left\n")
    assert content(folder) == before


def test_faults_of_the_package_itself_are_not_hidden(folder, told, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a defect")

    monkeypatch.setattr("hygrokf.identification.procedure.identify", broken)
    with pytest.raises(RuntimeError, match="a defect"):
        told(FIT)


def test_odd_terminals_change_neither_status_nor_words(folder):
    """An encoding without "°", a pipe that nobody reads, a closed stream."""
    command = f'"{sys.executable}" -m hygrokf check case.toml'
    script = f'{command} | head -n 1; {command} | true; echo "${{PIPESTATUS[0]}}"; {command} >&-; echo $?'
    done = subprocess.run(
        ["bash", "-c", script],
        env=environment(PYTHONIOENCODING="ascii"),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stderr == ""
    first, *statuses = done.stdout.splitlines()
    assert first.endswith("20.0 d, rated 2050 kW, 52.4?N 0.95?W")
    assert statuses == ["0", "0"]


# --- what is masked, and said ----------------------------------------------------------------


def doubled(lines: list[str]) -> list[str]:
    """A stamp twice with equal readings, and one with others."""
    return [*lines[:50], lines[49], *lines[50:90], re.sub(r"Z,[^,]*", "Z,99.9", lines[89]), *lines[90:]]


def swapped(lines: list[str]) -> list[str]:
    return [*lines[:50], lines[51], lines[50], *lines[52:]]


MASKED = [
    pytest.param(
        rows("cabinet.csv", doubled), ("duplicate stamps: 2", "contradicting ones masked"), 1, id="twice"
    ),
    pytest.param(rows("cabinet.csv", swapped), ("unsorted stamps: 1 of 1847", "sorted"), 0, id="unsorted"),
    pytest.param(
        rows("cabinet.csv", lambda lines: lines[::-1]),
        ("the newest come first; turned round",),
        0,
        id="reversed",
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
    """A logger that follows the doubled hour, and one that does not skip the missing one."""
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
        assert warning.startswith(
            'warning: cabinet_temperature (cabinet.csv, column "T_cab_degC"): 1 reading'
        )
        assert "-273" not in said.out


@pytest.mark.parametrize(
    ("command", "own"),
    [
        (["fit", "case.toml"], "fit.json"),
        (["discover", "case.toml"], "discovery.json"),
        (["compare", "case.toml", "case.toml"], "compare.json"),
        (["transfer", "fit", "case.toml"], "transfer.json"),
        (["climate", "fit.json", "--weather", "w.epw", "--standstill"], "climate.json"),
        (["fleet", "fleet.toml"], "fleet.json"),
    ],
)
def test_results_are_not_written_over_results_of_another_kind(
    command: list[str], own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Told before anything is read; a directory with results of the same kind is taken, a discovery's with its fit too."""
    for name in RESULTS:
        out = tmp_path / name.partition(".")[0]
        out.mkdir()
        (out / name).write_text("{}")
        assert main([*command, "--out", str(out)]) == 2
        said = capsys.readouterr().err
        assert ("a directory of its own" in said) == (name != own), said
    if own == "discovery.json":
        (tmp_path / "discovery" / "fit.json").write_text("{}")
        assert main([*command, "--out", str(tmp_path / "discovery")]) == 2
        assert "a directory of its own" not in capsys.readouterr().err
