"""Two revisions side by side: the same measurements in a process of each, which take turns.

The other revision is checked out into a temporary worktree.  A pair is one timed run of each revision, in the
order A B, B A, A B, …; the ratio of a pair has what both runs share of the machine's state divided out.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np

PAIRS = 11
"""Fewest pairs of a measurement."""
COVERAGE = 0.95
"""Least probability with which its interval holds a median."""
MEASUREMENTS = {
    **{f"{kind} {case}": kind for kind in ("value", "score", "information") for case in ("thermal", "joint")},
    "fixed thermal": "fixed",
    "fit demo": "fit",
    "track playback": "track",
}
"""What is compared, and the kind by which `--only` names it."""
LONG = ("fit", "track")
"""Kinds whose runs take seconds."""
WORKER = Path(__file__).with_name("revision_worker.py")


class NotMeasured(Exception):
    """A revision cannot be measured; the message says why."""


@dataclass(frozen=True)
class Ratio:
    """The `median` of this revision's CPU time over the other's, with the order statistics `low` and `high`
    that hold it with `COVERAGE`, whatever the distribution; NaN where pairs are too few, and where it was not
    measured, for the reason in the `note`."""

    name: str
    median: float = math.nan
    low: float = math.nan
    high: float = math.nan
    note: str = ""


class Contender(Protocol):
    """One revision: `prepare` readies a measurement, `run` times one run of it in CPU seconds."""

    def prepare(self, measurement: str) -> None: ...
    def run(self, measurement: str) -> float: ...


def compare(
    own: Contender, other: Contender, measurements: Sequence[str], pairs: Callable[[str], int]
) -> Iterator[Ratio]:
    """The ratio of every measurement."""
    from scipy.stats import quantile_test

    for name in measurements:
        try:
            for one in (own, other):
                one.prepare(name)
            seconds = turns(own, other, name, pairs(name))
        except NotMeasured as why:
            yield Ratio(name, note=f"not measured: {why}")
            continue
        ratios = seconds[:, 0] / seconds[:, 1]
        interval = quantile_test(ratios, p=0.5).confidence_interval(COVERAGE)
        this, that = np.median(seconds, axis=0)
        note = f"{this:.3g} s and {that:.3g} s of CPU time; {len(ratios)} pairs"
        yield Ratio(name, float(np.median(ratios)), float(interval.low), float(interval.high), note)


def turns(own: Contender, other: Contender, measurement: str, pairs: int) -> np.ndarray:
    """CPU seconds (pairs, 2) of own and other; whoever ends a pair begins the next one."""
    found = np.empty((pairs, 2))
    for pair in range(pairs):
        for place in (0, 1) if pair % 2 == 0 else (1, 0):
            found[pair, place] = (own, other)[place].run(measurement)
    return found


# -- the other revision's files ------------------------------------------------------------------------------
def end_by_signals() -> None:
    """Let the signals that end this process raise SystemExit, so that what is temporary is removed."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda received, frame: sys.exit(128 + received))


@contextmanager
def checked_out(repository: Path, revision: str) -> Iterator[Path]:
    """A temporary worktree of a revision, removed on every way out.  Raises NotMeasured without one."""
    found = _git(repository, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}")
    if found is None:
        raise NotMeasured(f"--against {revision}: expected a revision of {repository}, git finds none")
    with tempfile.TemporaryDirectory(prefix="benchmark-") as folder:
        root = Path(folder) / "other"
        try:
            if _git(repository, "worktree", "add", "--detach", "--force", str(root), found) is None:
                raise NotMeasured(f"--against {revision}: git could not check it out")
            yield root
        finally:
            _git(repository, "worktree", "remove", "--force", str(root))
            _git(repository, "worktree", "prune")


def _git(repository: Path, *arguments: str) -> str | None:
    """What git prints; None where it fails."""
    try:
        done = subprocess.run(
            ["git", "-C", str(repository), *arguments], capture_output=True, text=True, check=False
        )
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


# -- a process of each revision ------------------------------------------------------------------------------
class Worker:
    """A process that measures the package under `root`; its folder of temporary files is `scratch`."""

    def __init__(self, root: Path, scratch: Path) -> None:
        environment = {**os.environ, "PYTHONPATH": str(root), "HYGROKF_THREADS": "1"}
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            environment[name] = "1"
        scratch.mkdir(parents=True, exist_ok=True)
        self._process = subprocess.Popen(
            [sys.executable, str(WORKER), str(root), str(scratch)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
            start_new_session=True,  # so that it ends with the processes that it starts
        )  # fmt: skip

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()

    def prepare(self, measurement: str) -> None:
        self._ask("prepare", measurement)

    def run(self, measurement: str) -> float:
        return float(self._ask("run", measurement)["seconds"])

    def _ask(self, verb: str, measurement: str) -> Mapping[str, float | str]:
        """The answer to one line.  Raises NotMeasured with what the process says or how it ended."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(f"{verb} {measurement}\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise NotMeasured(f"its process ended with status {self._process.wait()}")
        answer: Mapping[str, float | str] = json.loads(line)
        if "fault" in answer:
            raise NotMeasured(str(answer["fault"]))
        return answer


def ratios(
    repository: Path, revision: str, kinds: Iterable[str], pairs: int, fit_pairs: int
) -> Iterator[Ratio]:
    """All ratios of the chosen kinds.  Raises NotMeasured for a revision that cannot be checked out."""
    wanted = [name for name, kind in MEASUREMENTS.items() if kind in set(kinds)]
    with ExitStack() as kept:
        other = kept.enter_context(checked_out(repository, revision))
        scratch = Path(kept.enter_context(tempfile.TemporaryDirectory(prefix="benchmark-")))
        workers = [
            kept.enter_context(Worker(root, scratch / name))
            for name, root in (("own", repository), ("other", other))
        ]
        yield from compare(*workers, wanted, lambda name: fit_pairs if MEASUREMENTS[name] in LONG else pairs)
