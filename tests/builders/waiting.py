"""Waiting for what other threads and processes do."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 60.0


def eventually(
    found: Callable[[], object], said: Callable[[], object] = lambda: "", patience_s: float = PATIENCE_S
) -> object:
    """The result of a function once it is true; fails with `said` if it is not true in time."""
    end = time.monotonic() + patience_s
    while not (got := found()):
        assert time.monotonic() < end, said() or f"nothing within {patience_s:g} s"
        time.sleep(0.01)
    return got
