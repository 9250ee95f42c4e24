"""The command line as a whole: loudness, signs of life, help, completion, exit statuses."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import time

import pytest
from builders.command_line import FIT, SIMULATE, environment, interrupted, run

from hygrokf.commands.console import Activity, Loudness, Progress, activity, running
from hygrokf.commands.main import SHELLS, VERBS, _parser
from hygrokf.commands.verb import parsers_of

NO_JSON = {"track", "help", "completion"}
"""Commands without a result: the log of `track` has --log json."""


# --- loudness --------------------------------------------------------------------------------


def test_every_command_can_be_quiet_and_verbose_and_has_json_where_there_is_a_result():
    for name, command in parsers_of(_parser()).items():
        names = set(command._option_string_actions)
        assert {"--quiet", "--verbose", "-q", "-v", "--help"} <= names, name
        assert ("--json" in names) == (name not in NO_JSON), name


def test_quiet_leaves_the_result_alone(folder):
    (folder / "simulated.csv").unlink(missing_ok=True)
    text = (folder / "case.toml").read_text().replace('{ column = "P_kW"', '{ column = "P_kW_gone"')
    usual, quiet = run(f"{SIMULATE} --json"), run(f"{SIMULATE} --json --quiet")
    assert quiet.out == usual.out and quiet.status == 0 and quiet.err == ""
    (folder / "case.toml").write_text(text)
    assert "P_kW_gone" in run(f"{SIMULATE} -q").err  # errors are said all the same


def test_quiet_keeps_notes_and_the_path_of_the_report_back(folder, monkeypatch):
    monkeypatch.setattr("hygrokf.commands.fit_commands.case_fit", lambda *_: _stored(folder))
    monkeypatch.setattr("hygrokf.report.fit_page.write_report", lambda out: out / "report.html")
    assert "report: " in run("fit case.toml --out result").err
    assert run("fit case.toml --out result -q").err == ""
    said = run("fit case.toml --out result --verbose").err.splitlines()
    assert [line.partition(" s: ")[2] for line in said if line.startswith("hygrokf fit: ")] == [
        "write the fit", "draw the report", "end",
    ]  # fmt: skip


def _stored(folder):
    from hygrokf.identification.fit import read_fit

    return read_fit(folder / "result")


def test_quiet_and_verbose_exclude_each_other(folder):
    assert run("check case.toml -q -v").status == 2


# --- signs of life ---------------------------------------------------------------------------


def test_a_silent_command_gives_signs_of_life_in_a_log(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    with running(Activity("hygrokf fit", beats=True, every_s=0.05)), Progress(3) as progress:
        assert activity().name == "hygrokf fit"
        progress("start 1 of 5")
        _until(lambda: log.getvalue().count("start 1 of 5\n") >= 2)
    assert re.fullmatch(r"(hygrokf fit: \d+ s: (at work|start 1 of 5)\n)+", log.getvalue())
    before = log.getvalue()
    time.sleep(0.15)
    assert log.getvalue() == before  # nothing after the end


@pytest.mark.parametrize("loudness", [Loudness.QUIET, Loudness.NORMAL])
def test_no_sign_of_life_when_quiet_or_on_a_terminal(monkeypatch, loudness):
    log = io.StringIO()
    log.isatty = lambda: loudness is Loudness.NORMAL
    monkeypatch.setattr(sys, "stderr", log)
    with running(Activity("hygrokf fit", loudness, beats=True, every_s=0.02)):
        time.sleep(0.1)
    assert log.getvalue() == ""


def test_another_line_puts_the_sign_of_life_off():
    now = [0.0]
    this = Activity("hygrokf fit", beats=True, clock=lambda: now[0])
    now[0] = 29.0
    this.step("start 2 of 5")  # a step alone is silent, and no line
    assert this._last_line == 0.0
    this.note("a note")
    assert this._last_line == 29.0


def _until(done, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.01)


def test_a_process_ends_soon_after_its_last_line(folder):
    """The objects of the libraries are not collected one by one when the process ends."""
    script = (
        "import atexit, gc, sys\n"
        "from hygrokf.commands.main import main\n"
        "atexit.register(lambda: print(gc.get_freeze_count() > 10000, file=sys.stderr))\n"
        "sys.argv = ['hygrokf', 'check', 'case.toml', '-q']\n"
        "sys.exit(main())\n"
    )
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=folder, env=environment(), capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "True\n")


# --- help and completion ---------------------------------------------------------------------


def test_help_shows_a_command_or_all_of_them():
    said = run("help fit")
    assert said.status == 0 and said.out == run("fit --help").out and "--criterion" in said.out
    assert run("help").out == run("--help").out
    wrong = run("help fot")
    assert wrong.status == 2 and 'did you mean "fit"' in wrong.err


def test_completion_names_every_command_and_option():
    for shell in SHELLS:
        said = run(f"completion {shell}")
        assert said.status == 0
        for verb in VERBS:
            assert verb.name in said.out
        for name in ("criterion", "likelihood", "power-curve"):
            assert name in said.out
    assert run("completion sh").status == 2


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (("f",), {"fit", "fleet"}),
        (("fit", "--cri"), {"--criterion"}),
        (("fit", "--criterion", ""), {"likelihood", "simulation"}),
        (("help", "cl"), {"climate"}),
        (("completion", ""), set(SHELLS)),
        (("fit", "--out", ""), {"script"}),
    ],
)
def test_bash_completes(tmp_path, words, found):
    (tmp_path / "script").write_text(run("completion bash").out)
    line = " ".join(f"'{word}'" for word in words)
    asked = f"COMP_WORDS=(hygrokf {line}); COMP_CWORD={len(words)}"
    command = f'. ./script; {asked}; _shtab_hygrokf; echo "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (0, "")
    assert set(done.stdout.split()) == found


# --- exit statuses ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("", 0),
        ("check case.toml", 0),
        ("check no.toml", 2),
        ("check", 2),
        ("no-such-command", 2),
        ("fit case.toml --starts none --out made", 2),
        ("doctor result/fit.json --source file:gone.csv --store sqlite:gone/live.db --no-page --wait 1s", 1),
    ],
)
def test_exit_status(folder, line, status):
    assert run(line).status == status


def test_exit_status_of_an_interruption(folder, monkeypatch):
    monkeypatch.setattr("hygrokf.identification.identify.identify", interrupted)
    assert run(FIT).status == 130
