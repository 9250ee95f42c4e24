"""Waiting for what other threads and processes do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

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


@contextmanager
def repeating(act: Callable[[], object]) -> Iterator[None]:
    """Repeat an act every tenth of a second, in a thread of its own, as long as the block lasts."""
    ended = threading.Event()

    def go_on() -> None:
        while not ended.wait(0.1):
            act()

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(PATIENCE_S)
