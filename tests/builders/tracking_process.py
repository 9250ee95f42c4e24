"""A tracker in a process of its own, which may be killed: `tracking_process.py CASE.toml STORE-URL SPEED
HALT`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from builders.live_case import count_of
from hygrokf.data.record import Record

ROOT = Path(__file__).resolve().parents[2]


def started(
    case: Path, url: str, speed: float = 0.0, halt: float | None = None, **more: str
) -> subprocess.Popen[str]:
    """Play a case's record back into a store; speed 0 is as fast as it is taken.

    It stays at a share `halt` of the messages until it is killed.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}",
        "OMP_NUM_THREADS": "1",
        **more,
    }
    command = [
        sys.executable,
        str(Path(__file__)),
        str(case),
        url,
        str(speed),
        "" if halt is None else str(halt),
    ]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True
    )  # fmt: skip


def killed_at(
    mark: float, tracker: subprocess.Popen[str], count: Callable[[], int], random: np.random.Generator
) -> None:
    """Kill a tracker at a random moment after its store holds so many observations."""
    end = time.monotonic() + 120.0
    try:
        while count() <= mark:
            assert tracker.poll() is None and time.monotonic() < end, "the tracker did not come that far"
            time.sleep(0.005)
        time.sleep(float(random.uniform(0.0, 0.02)))
    finally:
        tracker.kill()
        said = tracker.communicate()
    assert tracker.returncode == -signal.SIGKILL, said


def halt_after(mark: float, record: Record) -> float:
    """A share of the messages beyond so many of them: one that halts there can neither finish nor be too
    slow."""
    return min(mark / count_of(record) + 0.08, 0.98)


def track(case: str, url: str, speed: str, halt: str) -> None:
    from builders.live_case import SIGNALS, Halting, live_turbine
    from hygrokf.cases.case_file import read_case
    from hygrokf.live import service
    from hygrokf.live.sources.local import record_mapping, record_messages

    made = read_case(case)
    record = replace(made, series=tuple(s for s in made.series if s.signal in SIGNALS))
    service.MOST_PER_ROUND = 20  # many small rounds: a kill hits each part of one
    messages, halts = record_messages(record, "T1"), [float(halt)] if halt else []
    stream = Halting("replay:", messages, record_mapping(record, "T1"), float(speed), halts=halts)
    service.Service({"T1": live_turbine(record)}, [stream], url).run(until_ended=True)


if __name__ == "__main__":
    track(*sys.argv[1:])
