"""The command line run inside the test."""

from __future__ import annotations

import contextlib
import io
import os
from dataclasses import dataclass
from pathlib import Path

from hygrokf.commands import console
from hygrokf.commands.main import main

# on a slow machine signs of life would stand between the lines that tests compare
console.LONGEST_SILENCE_S = 1e6

ROOT = Path(__file__).resolve().parents[2]
FIT = "fit case.toml --out made"
SIMULATE = "simulate result case.toml --out simulated.csv"
EVALUATE = "evaluate result/fit.json case.toml"
"""Lines that do their work in the `folder` of the commands' tests."""


@dataclass(frozen=True)
class Said:
    """Exit status of a command and its two streams."""

    status: int
    out: str
    err: str


def run(line: str) -> Said:
    """A command line without quotes, in this process; also one that the parser refuses."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(line.split())
        except SystemExit as stop:
            status = stop.code
    return Said(status, out.getvalue(), err.getvalue())


def environment(**more: str) -> dict[str, str]:
    """For a process of its own, wherever it starts."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **more}


def interrupted(*_: object, **__: object) -> None:
    """Work that the user stops at once."""
    raise KeyboardInterrupt
