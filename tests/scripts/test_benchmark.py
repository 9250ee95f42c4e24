"""Two revisions compared: runs take turns, the interval holds the median, nothing temporary stays."""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from benchmarks import against, command, revision_worker
from builders.documents import ROOT
from builders.waiting import eventually


class Told:
    """A contender with seconds that are told, which writes down its turns."""

    def __init__(self, name: str, seconds: list[float], log: list[str], lacks: str = "") -> None:
        self.name, self.seconds, self.log, self.lacks = name, iter(seconds), log, lacks

    def prepare(self, measurement: str) -> None:
        self.log.append(f"{self.name} ready")
        if measurement == self.lacks:
            raise against.NotMeasured("no such verb")

    def run(self, measurement: str) -> float:
        self.log.append(self.name)
        return next(self.seconds)


def test_pairs_take_turns_and_whoever_ends_one_begins_the_next() -> None:
    """A machine that becomes ten times slower changes no ratio."""
    pace = np.linspace(1.0, 10.0, 11)
    log: list[str] = []
    own, other = Told("A", list(2.0 * pace), log), Told("B", list(pace), log)
    (ratio,) = against.compare(own, other, ["value thermal"], lambda name: 11)
    assert (ratio.median, ratio.low, ratio.high) == (2.0, 2.0, 2.0)
    assert log[:2] == ["A ready", "B ready"] and "".join(log[2:]).startswith("ABBAABBA")


def test_what_a_revision_lacks_is_said_and_the_others_are_measured() -> None:
    own, other = Told("own", [1.0] * 9, []), Told("other", [1.0] * 9, [], lacks="score thermal")
    lacking, found = against.compare(own, other, ["score thermal", "value thermal"], lambda name: 3)
    assert math.isnan(lacking.median) and "no such verb" in lacking.note
    assert found.median == 1.0 and math.isnan(found.low)  # three pairs hold no median with 95 %


# -- worktrees -----------------------------------------------------------------------------------------------
@pytest.fixture
def repository(tmp_path: Path) -> Iterator[Path]:
    """A repository with two revisions of one file."""
    if shutil.which("git") is None:
        pytest.skip("needs git")
    root = tmp_path / "repository"
    root.mkdir()
    _git(root, "init", "--quiet")
    for text in ("first", "second"):
        (root / "file.txt").write_text(text)
        _git(root, "add", "file.txt")
        author = ("-c", "user.name=a", "-c", "user.email=a@b.example", "-c", "commit.gpgsign=false")
        _git(root, *author, "commit", "--quiet", "-m", text)
    yield root


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
    return done.stdout


def _worktrees(root: Path) -> int:
    return _git(root, "worktree", "list").count("\n")


def test_the_other_revision_is_checked_out_and_removed_also_after_a_fault(repository: Path) -> None:
    with pytest.raises(KeyboardInterrupt), against.checked_out(repository, "HEAD~1") as root:
        assert (root / "file.txt").read_text() == "first" and _worktrees(repository) == 2
        raise KeyboardInterrupt
    assert not root.parent.exists() and _worktrees(repository) == 1
    with pytest.raises(against.NotMeasured, match="nowhere"), against.checked_out(repository, "nowhere"):
        pass


def test_a_signal_removes_it_too(repository: Path, tmp_path: Path) -> None:
    """SIGTERM while the other revision is checked out."""
    told = tmp_path / "told"
    program = (
        "import sys, time; from pathlib import Path; from benchmarks import against\n"
        "against.end_by_signals()\n"
        f"with against.checked_out(Path({str(repository)!r}), 'HEAD~1') as one:\n"
        f"    Path({str(told)!r}).write_text(str(one)); time.sleep(60)\n"
    )
    path = os.pathsep.join([str(ROOT / "scripts"), str(ROOT)])
    process = subprocess.Popen([sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": path})
    try:
        eventually(lambda: told.exists() and told.read_text())
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=50.0) == 128 + signal.SIGTERM
    finally:
        process.kill()
        process.wait()
    assert not Path(told.read_text()).parent.exists() and _worktrees(repository) == 1


# -- workers and command -------------------------------------------------------------------------------------
@pytest.mark.parametrize(("kind", "readings"), [("thermal", 1), ("joint", 2)])
def test_cases_have_likelihoods_that_are_finite(kind: str, readings: int, tmp_path: Path) -> None:
    likelihood, values = revision_worker.likelihood_of(kind, tmp_path)
    assert len(likelihood.model.outputs) == readings and np.isfinite(likelihood.value(values))


def test_a_worker_measures_its_own_package_and_says_what_it_cannot(tmp_path: Path) -> None:
    """In a process of its own, on the package beside these tests, until it is killed; then under a root
    without one."""
    with against.Worker(ROOT, tmp_path / "own") as worker:
        worker.prepare("fixed thermal")
        assert 0.0 < worker.run("fixed thermal") < 60.0
        with pytest.raises(against.NotMeasured, match="KeyError"):
            worker.prepare("nothing thermal")
        os.killpg(worker._process.pid, signal.SIGKILL)
        worker._process.wait()
        with pytest.raises(against.NotMeasured, match="ended"):
            worker.prepare("fixed thermal")
    empty = tmp_path / "empty"
    empty.mkdir()
    with (
        against.Worker(empty, tmp_path / "other") as worker,
        pytest.raises(against.NotMeasured, match=r"expected the package under|No module named"),
    ):
        worker.prepare("value thermal")


def test_the_command_prints_what_was_compared(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    asked: list[tuple] = []
    ratio = against.Ratio("value thermal", 1.01, 0.99, 1.03, "0.2 s")
    monkeypatch.setattr(against, "ratios", lambda *how: asked.append(how) or [ratio])
    assert command.main(["--against", "main", "--only", "value", "fit", "--fit-pairs", "3"]) == 0
    assert asked == [(ROOT, "main", ["value", "fit"], against.PAIRS, 3)]
    assert "| value thermal | 1.01 | 0.99 … 1.03 | 0.2 s |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--only memory", "information"),
        ("--pairs 10", "--pairs"),
        ("--fit-pairs -1", "--fit-pairs"),
        ("track", "track"),
    ],
)
def test_what_cannot_be_compared_ends_with_status_2(
    words: str, said: str, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as ended:
        command.main([*words.split(), "--against", "main"])
    assert ended.value.code == 2 and said in capsys.readouterr().err


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs a clone of the repository")
@pytest.mark.slow
def test_a_revision_compared_with_itself(capsys: pytest.CaptureFixture) -> None:
    assert command.main(["--against", "HEAD", "--quick", "--only", "value", "fixed"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("2 pairs") == 3 and "not measured" not in printed
