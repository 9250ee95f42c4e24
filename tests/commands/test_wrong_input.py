"""Wrong input: every mistake is told in one message, and nothing is written."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from builders.case_edits import (
    NO_CABINET,
    case,
    column,
    content,
    gone,
    holds,
    leave_out,
    nothing,
    put,
    result,
    rows,
)
from builders.command_line import EVALUATE, FIT, SIMULATE, Said, environment, interrupted, run

from hygrokf.version import __version__


def onto(file: str) -> tuple:
    words = f"hygrokf: --out {file}: expected a file of its own, found one that is read here; name another"
    return f"simulate result case.toml --out {file}", nothing, words


NO_READING = rows("cabinet.csv", lambda lines: [re.sub("Z,.*", "Z,,,1", line) for line in lines])
NAIVE = rows("cabinet.csv", lambda lines: [line.replace("Z,", ",") for line in lines])
ONE = "hygrokf: case.toml: 1 fault\n  1. "
DAMAGED = "hygrokf: result/fit.json: damaged, or of another version than hygrokf"
# what is wrong: command, what was done before it, what must be said
# fmt: off
WRONG: dict[str, tuple] = {
    # the case file
    "no case file": ("fit uk-01.toml --out made", nothing, "hygrokf: uk-01.toml: 1 fault", "No such file"),
    "a directory as case": ("check result", nothing, "hygrokf: result: 1 fault", "Is a directory"),
    "broken TOML": (FIT, case(("[[source]]", "[[source")),
        ONE + "line 10, column 9: not valid TOML: ", "in: [[source"),
    "too few readings": (FIT, rows("cabinet.csv", lambda lines: lines[:29]),
        "hygrokf: case.toml: cabinet_temperature: expected at least 50 readings in the", "period, found 29"),
    # where to write
    "out is a file": ("fit case.toml --out scada.csv", nothing,
        "hygrokf: --out scada.csv: expected a directory that can be written, found: scada.csv is a file"),
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
    "no fit.json": (EVALUATE, gone("result/fit.json"), "result/fit.json: no such file; run `hygrokf fit`"),
    "half a fit.json": (EVALUATE, lambda folder: os.truncate(folder / "result/fit.json", 2000),
        "hygrokf: result/fit.json: expected the results of `hygrokf fit`, found: "),
    "other JSON": (EVALUATE, holds("result/fit.json", b'{"a": 1}'),
        "result/fit.json: not a result of `hygrokf fit`: it lacks covariance, design"),
    "newer version": (EVALUATE, put("version", value="99.0.1"),
        f"result/fit.json: written by hygrokf 99.0.1, this is {__version__}; install that version"),
    "covariance without a row": (EVALUATE, result(lambda fit: fit["covariance"]["matrix"].pop()),
        DAMAGED, "covariance: expected", "finite numbers, found "),
    "covariance of another model": (EVALUATE, put("covariance", "names", 0, value="mass"),
        DAMAGED, "covariance of unknown parameters mass"),
    "parameter out of bounds": (EVALUATE, put("parameters", "hygric_k", "value", value=-1),
        DAMAGED, "parameter hygric_k: expected 0.005 … 200 h, found -1; run `hygrokf fit` again"),
    "parameter is text": (EVALUATE, put("parameters", "hygric_k", "value", value="0.3"),
        DAMAGED, "parameters.hygric_k.value: expected a number, found '0.3'"),
    "unknown mechanism": (EVALUATE, put("design", "mechanisms", 0, 0, value="stove"), DAMAGED, "'stove'"),
    "scale of the power": (SIMULATE, put("design", "power_scale_W", value="much"),
        DAMAGED, "power_scale_W: expected a number above 0 or null, found 'much'"),
    "means of the power": (SIMULATE, put("design", "power_mean", value=[0.5]),
        DAMAGED, "power_mean: expected 3 numbers or none, found [0.5]"),
    "noise of the ambient": (SIMULATE, put("design", "ambient_noise", value={"ambient_temperature": [1.0]}),
        DAMAGED, "ambient_noise.ambient_temperature: expected 2 numbers above 0, found (1.0,)"),
    "a case as fit": ("evaluate case.toml result/fit.json", nothing,
        "hygrokf: case.toml is a case file, expected a result",
        "the fit comes first, as in `hygrokf evaluate FIT CASE`"),
    "a case as fit to simulate": ("simulate case.toml result --out a.csv", nothing,
        "case.toml is a case file"),
    "a fit as case": ("fit result/fit.json --out made", nothing,
        "hygrokf: result/fit.json: 1 fault\n  1. is a result of `hygrokf fit`, expected a case file "
        "(docs/reference/case_file.md)"),
    "a table as case": ("fit cabinet.csv --out made", nothing,
        "hygrokf: cabinet.csv: 1 fault\n  1. is a table, expected a case file that names it "
        "(docs/reference/case_file.md)"),
    "out with another program's fit.json": ("fit case.toml --out result",
        holds("result/fit.json", b'{"a": 1}'),
        "hygrokf: --out result: expected a new directory or one with an earlier fit, found a fit.json in it "
        "that is no"),
    # the case for a fit
    "simulate without ambient": (SIMULATE, leave_out("ambient_temperature"),
        ONE + "case.toml: no source names ambient_temperature, the input that every model needs"),
    "simulate without ambient humidity": (SIMULATE, leave_out("ambient_relative_humidity"),
        "hygrokf: case.toml: the model reads an ambient humidity (relative, absolute or dew point)",
        "which the record does not have (it has cabinet_temperature,"),
    "evaluate without cabinet": (EVALUATE, NO_CABINET,
        ONE + "case.toml: nothing in the cabinet to identify; expected one of cabinet_temperature"),
    "evaluate without readings": (EVALUATE, NO_READING,
        ONE + "no reading of cabinet_temperature, cabinet_relative_humidity can be used; the columns hold"),
    # the report
    "report on no directory": ("report none", nothing, "hygrokf: none/fit.json: no such file; run"),
    "report on an empty directory": ("report made", lambda folder: (folder / "made").mkdir(),
        "hygrokf: made/fit.json: no such file; run `hygrokf fit` with --out made first\n",
        "\nmade/series.npz: no such file"),
    "report on half a file": ("report result", lambda folder: os.truncate(folder / "result/series.npz", 2000),
        "hygrokf: result/series.npz: expected arrays written by `hygrokf fit`, found: "),
    "demo over another turbine": ("demo --out .", case(('= "synthetic"', '= "measured"')),
        "hygrokf: --out .: it holds a case.toml of another turbine; name another directory"),
    # options
    "no start": (f"{FIT} --starts 0", nothing, "--starts: expected a whole number from 1 on, found '0'"),
    "unknown criterion": (f"{FIT} --criterion guess", nothing, "--criterion: ", "'guess'", "likelihood"),
    "kind beside a model": (
        f"{FIT} --kind cascade --model result", nothing, "--kind cascade: ", "joint", "leave --kind out"
    ),
    "unknown kind": (f"{FIT} --kind both", nothing, "--kind: ", "'both'", "joint", "cascade"),
    "negative seed": ("demo --out made --seed -1", nothing, "--seed: expected a whole number from 0 on"),
    "nowhere to write": ("fit case.toml", nothing, "the following arguments are required: --out"),
    "unknown command": ("fot case.toml", nothing, "'fot'", "check", "simulate"),
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
def test_a_mistake_is_told_in_one_message_and_nothing_is_written(folder, name):
    line, edit, *words = WRONG[name]
    edit(folder)
    before = content(folder)
    refused(run(line), words)
    assert content(folder) == before


def test_every_fault_of_a_case_is_listed_at_once(folder):
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
    said = run(FIT)
    expected = [
        "case.toml, line 4: rated_power_kW",
        "case.toml, line 7, [site]: site: latitude_deg",
        "case.toml, line 33, [identification]: until: ",
        "case.toml, line 22, [[source]] 2 signals.rainfall: ",
        "case.toml, line 28, [[source]] 3 signals.active_power: ",
        "case.toml, line 27, [[source]] 3: stamp ",
        'cabinet.csv: no column "T"',
        'cabinet.csv: column "time": 1847 of 1847',
        'ambient.csv: column "RH_amb_pct": ',
        "scada.csv: no such file",
    ]
    refused(said, (f"hygrokf: case.toml: {len(expected)} faults\n", *expected))
    assert re.findall(r"^  (\d+)\. ", said.err, re.MULTILINE) == [str(n + 1) for n in range(len(expected))]
    assert content(folder) == before


@pytest.mark.parametrize(
    "line", ["fit case.toml --out locked/made", "simulate result case.toml --out locked/a"]
)
def test_a_write_protected_directory_is_told_before_the_work(folder, monkeypatch, line):
    (folder / "locked").mkdir()
    (folder / "locked").chmod(0o555)
    allowed = os.access  # root may write everywhere: the answer of an ordinary user is given to it
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked" and allowed(path, mode))
    monkeypatch.setattr("hygrokf.cases.case_file.read_case", interrupted)
    refused(run(line), ("locked is write-protected", "name another"))
    assert content(folder / "locked") == {}


def test_what_the_system_refuses_is_told_without_a_traceback(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "made/fit.json")

    monkeypatch.setattr("hygrokf.data.files.write_text_whole", full)
    refused(run(SIMULATE), ("made/fit.json: cannot be read or written: No space left on device",))


def test_an_interrupted_fit_leaves_nothing(folder, monkeypatch):
    before = content(folder)
    monkeypatch.setattr("hygrokf.identification.identify.identify", interrupted)
    assert run(FIT) == Said(130, "", "interrupted; no incomplete file is left\n")
    assert content(folder) == before


def test_faults_of_the_package_itself_are_not_hidden(folder, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a defect")

    monkeypatch.setattr("hygrokf.identification.identify.identify", broken)
    with pytest.raises(RuntimeError, match="a defect"):
        run(FIT)


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
    assert first.endswith("20.0 d, synthetic, rated 2050 kW, 52.4? N 0.95? W")
    assert statuses == ["0", "0"]
