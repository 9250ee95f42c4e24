"""Two revisions compared: runs take turns, the interval holds the median, nothing temporary stays."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from benchmarks import against, command, revision_worker
from benchmarks.measure import Figure
from scipy.stats import binom

REPOSITORY = Path(__file__).resolve().parents[2]
CLONED = shutil.which("git") is not None and (REPOSITORY / ".git").exists()


class Told:
    """A contender with seconds that are told, which writes down its turns."""

    def __init__(self, name: str, seconds: list[float], log: list[str]) -> None:
        self.name, self.seconds, self.log = name, iter(seconds), log

    def prepare(self, measurement: str) -> None:
        self.log.append(f"{self.name} ready")

    def run(self, measurement: str) -> float:
        self.log.append(self.name)
        return next(self.seconds)


def test_whoever_ends_a_pair_begins_the_next_one() -> None:
    log: list[str] = []
    own, other = (Told(name, [1.0] * 4, log) for name in "AB")
    against.turns(own, other, "value 3-box", 4)
    assert "".join(log) == "ABBAABBA"


def test_ratios_are_those_of_pairs() -> None:
    """A machine that becomes ten times slower changes no ratio."""
    pace = np.linspace(1.0, 10.0, 11)
    log: list[str] = []
    own, other = Told("own", list(2.0 * pace), log), Told("other", list(pace), log)
    (figure,) = against.compare(own, other, ["value 3-box"], lambda name: 11, "main")
    assert (figure.reached, figure.low, figure.high) == (2.0, 2.0, 2.0)
    assert log[:2] == ["own ready", "other ready"]


def test_what_a_revision_lacks_is_said_and_the_others_are_measured() -> None:
    class Older(Told):
        def prepare(self, measurement: str) -> None:
            if measurement == "score 3-box":
                raise against.NotMeasured("no such verb")

    own, other = Told("own", [1.0] * 9, []), Older("other", [1.0] * 9, [])
    names = ["score 3-box", "value 3-box"]
    lacking, found = against.compare(own, other, names, lambda name: 3, "main")
    assert np.isnan(lacking.reached) and "no such verb" in lacking.note
    assert found.reached == 1.0


@pytest.mark.parametrize("count", [6, 9, 11, 15, 30])
def test_the_interval_is_the_shortest_with_the_coverage(count: int) -> None:
    """Against the binomial distribution: between the order statistics k and n + 1 − k lies the median with
    P(k ≤ B ≤ n − k)."""
    low, high, coverage = against.median_interval(np.arange(1.0, count + 1.0))
    k = int(low)
    assert high == count + 1 - k

    def inside(k: int) -> float:
        return float(binom.cdf(count - k, count, 0.5) - binom.cdf(k - 1, count, 0.5))

    assert coverage == pytest.approx(inside(k), abs=1e-12) and coverage >= against.COVERAGE
    assert inside(k + 1) < against.COVERAGE


def test_few_pairs_have_their_range_and_its_coverage() -> None:
    assert against.median_interval(np.array([3.0, 1.0, 2.0])) == (1.0, 3.0, 0.75)
    assert against.median_interval(np.array([3.0])) == (3.0, 3.0, 0.0)


def test_the_interval_holds_the_median_of_skewed_ratios() -> None:
    """Of 2,000 sets of 11 log-normal ratios with median 1; 3.1 standard errors of 98.8 % are 0.8 %."""
    random = np.random.default_rng(11)
    held = 0
    for values in np.exp(random.normal(size=(2000, against.PAIRS))):
        low, high, _ = against.median_interval(values)
        held += low <= 1.0 <= high
    assert abs(held / 2000.0 - (1.0 - 2.0 * 12.0 / 2048.0)) < 0.008


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


def _worktrees(root: Path) -> list[str]:
    return [line for line in _git(root, "worktree", "list", "--porcelain").splitlines() if "worktree" in line]


def test_the_other_revision_is_checked_out_and_removed(repository: Path) -> None:
    with against.checked_out(repository, "HEAD~1") as root:
        assert (root / "file.txt").read_text() == "first"
        assert len(_worktrees(repository)) == 2
    assert not root.parent.exists() and len(_worktrees(repository)) == 1


def test_a_fault_removes_it_too(repository: Path) -> None:
    with pytest.raises(KeyboardInterrupt), against.checked_out(repository, "HEAD~1") as root:
        raise KeyboardInterrupt
    assert not root.parent.exists() and len(_worktrees(repository)) == 1


def test_a_revision_that_does_not_exist_is_refused(repository: Path) -> None:
    with (
        pytest.raises(against.NotMeasured, match="nothing-such"),
        against.checked_out(repository, "nothing-such"),
    ):
        pass


def test_a_signal_removes_it_too(repository: Path, tmp_path: Path) -> None:
    """SIGTERM while the other revision is checked out."""
    told = tmp_path / "told"
    program = (
        "import sys, time; from pathlib import Path; from benchmarks import against\n"
        f"with against.ended_by_signals(), against.checked_out(Path({str(repository)!r}), 'HEAD~1') as one:\n"
        f"    Path({str(told)!r}).write_text(str(one)); time.sleep(60)\n"
    )
    path = os.pathsep.join([str(REPOSITORY / "scripts"), str(REPOSITORY)])
    process = subprocess.Popen([sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": path})
    try:
        end = time.monotonic() + 50.0
        while not (told.exists() and told.read_text()) and time.monotonic() < end:
            time.sleep(0.02)
        root = Path(told.read_text())
        assert root.exists()
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=50.0) == 128 + signal.SIGTERM
    finally:
        process.kill()
        process.wait()
    assert not root.parent.exists() and len(_worktrees(repository)) == 1


# -- workers and command -------------------------------------------------------------------------------------
def test_three_boxes_are_what_the_figures_say() -> None:
    likelihood, values = revision_worker.three_boxes(200)
    model = likelihood.model
    assert (len(model.states), len(model.outputs), len(model.parameters), len(values)) == (4, 2, 11, 11)
    assert len(likelihood.timeline) == 200 and likelihood.timeline.n_readings == 400
    assert likelihood.steps_per_instant(values) == pytest.approx(4.0, abs=0.05)
    assert np.isfinite(likelihood.value(values))


def test_a_worker_measures_its_own_package_and_says_what_it_cannot(tmp_path: Path) -> None:
    """In a process of its own, on the package beside these tests; then under a root without one."""
    with against.Worker(REPOSITORY, tmp_path / "own") as worker:
        worker.prepare("fixed 3-box")
        assert 0.0 < worker.run("fixed 3-box") < 60.0
        with pytest.raises(against.NotMeasured, match="KeyError"):
            worker.prepare("value nothing")
    empty = tmp_path / "empty"
    empty.mkdir()
    with (
        against.Worker(empty, tmp_path / "other") as worker,
        pytest.raises(against.NotMeasured, match=r"expected the package under|No module named"),
    ):
        worker.prepare("value 3-box")


def test_a_worker_that_ends_is_said(tmp_path: Path) -> None:
    with against.Worker(REPOSITORY, tmp_path) as worker:
        os.killpg(worker._process.pid, signal.SIGKILL)
        worker._process.wait()
        with pytest.raises(against.NotMeasured, match="ended"):
            worker.prepare("value 3-box")


def test_the_command_compares(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    asked: list[tuple] = []

    def figures(root: Path, revision: str, kinds: list[str], pairs: int, fit_pairs: int) -> list[Figure]:
        asked.append((root, revision, kinds, pairs, fit_pairs))
        return [Figure("this / main", "value 3-box", "×", 1.01, 0.99, 1.03)]

    monkeypatch.setattr(against, "figures", figures)
    assert command.main(["--against", "main", "--only", "value", "fit", "--fit-pairs", "3"]) == 0
    assert asked == [(REPOSITORY, "main", ["value", "fit"], against.PAIRS, 3)]
    printed = capsys.readouterr().out
    assert "0.99 … 1.03" in printed and "interval" in printed


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--only", "memory"], "information"),
        (["--pairs", "10"], "--pairs"),
        (["--fit-pairs", "-1"], "--fit-pairs"),
        (["track"], "topic"),
    ],
)
def test_what_cannot_be_compared_ends_with_status_2(
    arguments: list[str], word: str, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as ended:
        command.main([*arguments, "--against", "main"])
    assert ended.value.code == 2 and word in capsys.readouterr().err


@pytest.mark.skipif(not CLONED, reason="needs a clone of the repository")
@pytest.mark.slow
def test_a_revision_compared_with_itself(capsys: pytest.CaptureFixture) -> None:
    assert command.main(["--against", "HEAD", "--quick", "--only", "value", "fixed"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("this / HEAD") >= 8 and "not measured" not in printed
