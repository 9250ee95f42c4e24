"""Progress of a long computation: each step is passed to a caller's function or shown on one line."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TypeAlias

Progress: TypeAlias = Callable[[str], None]
"""Receives each step in words."""


@contextmanager
def reporting(progress: Progress | bool | None, name: str) -> Iterator[Progress]:
    """Open a context with a function that reports the steps of the computation `name`.

    progress: a function: it receives the steps.  True: one line with the current step and the elapsed time,
        in a notebook by IPython's display, else on standard error.  None, False: nothing is reported.
    """
    if callable(progress) or not progress:
        yield progress if callable(progress) else lambda text: None
        return
    show, start_s = _notebook() or _on_stderr, time.monotonic()

    def say(text: str, last: bool = False) -> None:
        """Show a step with the elapsed time."""
        show(f"{name}: {text} ({time.monotonic() - start_s:.0f} s)", last)

    say("begins")
    try:
        yield say
    except BaseException as error:
        say(f"stopped by {type(error).__name__}", last=True)
        raise
    say("done", last=True)


Line: TypeAlias = Callable[[str, bool], None]
"""Shows a text in place of the previous one; the second argument: whether the text is the last."""


def _notebook() -> Line | None:
    """Return a function that shows a line in the output of a notebook's cell; None outside of a notebook."""
    ipython = sys.modules.get("IPython")  # a notebook has loaded it; nothing else needs it
    shell = None if ipython is None else ipython.get_ipython()
    if shell is None or not hasattr(shell, "kernel"):
        return None
    handle = import_module("IPython.display").display({"text/plain": ""}, raw=True, display_id=True)
    return lambda text, last: handle.update({"text/plain": text}, raw=True)


def _on_stderr(text: str, last: bool) -> None:
    """Print a line on standard error; on a terminal it overwrites the previous one."""
    if sys.stderr is None:
        return
    if sys.stderr.isatty():
        print(f"\r{text}\x1b[K", end="\n" if last else "", file=sys.stderr, flush=True)
    else:
        print(text, file=sys.stderr, flush=True)
