"""What commands print on the terminal and in logs, and checks of their output paths before the work."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.data.files import DISCOVERY, FIT, RESULTS, is_stream
from hygrokf.errors import HygrokfError

if TYPE_CHECKING:
    from hygrokf.report.blocks import Page

LONGEST_SILENCE_S = 30.0
"""[s] a command whose standard error is not a terminal prints a line at least this often."""


class Loudness(IntEnum):
    """How much a command prints on standard error besides its result."""

    QUIET = 0
    NORMAL = 1
    VERBOSE = 2


class Activity:
    """A running command: its present step, and its lines on standard error.

    name: of the command. beats: print heartbeat lines if standard error is not a terminal.
    every_s: [s] between heartbeat lines; None: `LONGEST_SILENCE_S`. clock: monotonic clock [s].
    """

    def __init__(
        self,
        name: str,
        loudness: Loudness = Loudness.NORMAL,
        *,
        beats: bool = False,
        every_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name, self.loudness = name, loudness
        self._beats, self._clock = beats, clock
        self._every_s = LONGEST_SILENCE_S if every_s is None else every_s
        self._begin = self._last_line = clock()
        self._step = "at work"

    @property
    def on_terminal(self) -> bool:
        """Whether standard error is a terminal."""
        return sys.stderr is not None and sys.stderr.isatty()

    def step(self, text: str) -> None:
        """Begin a step, which is printed with --verbose and named in later heartbeat lines."""
        self._step = text
        if self.loudness is Loudness.VERBOSE:
            self.line(f"{self.name}: {self._elapsed()}: {text}")

    def note(self, text: str) -> None:
        """Print a note or a warning unless --quiet is given."""
        if self.loudness is not Loudness.QUIET:
            self.line(text)

    def line(self, text: str) -> None:
        """Print a line on standard error, at once."""
        self._last_line = self._clock()
        if sys.stderr is not None:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def heartbeat(self) -> Iterator[None]:
        """Print a heartbeat line, in this context, whenever `every_s` has passed without another line."""
        if not self._beats or self.loudness is Loudness.QUIET or self.on_terminal:
            yield
            return
        ended = threading.Event()

        def print_heartbeats() -> None:
            wait_s = self._every_s
            while not ended.wait(wait_s):
                wait_s = self._last_line + self._every_s - self._clock()
                if wait_s <= 0.0:
                    self.line(f"{self.name}: {self._elapsed()}: {self._step}")
                    wait_s = self._every_s

        thread = threading.Thread(target=print_heartbeats, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def end(self) -> None:
        """With --verbose, print how long the command took."""
        if self.loudness is Loudness.VERBOSE:
            self.line(f"{self.name}: {self._elapsed()}: end")

    def _elapsed(self) -> str:
        """Return the time since the command began, as text."""
        return f"{self._clock() - self._begin:.0f} s"


_ACTIVITY: ContextVar[Activity | None] = ContextVar("activity", default=None)


def activity() -> Activity:
    """Return the running command; outside any command, an activity of normal loudness."""
    return _ACTIVITY.get() or Activity("hygrokf")


@contextmanager
def running(command: Activity) -> Iterator[Activity]:
    """Make `activity()` return this command within this context, and print its heartbeat lines."""
    previous = _ACTIVITY.set(command)
    try:
        with command.heartbeat():
            yield command
    finally:
        _ACTIVITY.reset(previous)


FOUND, USER_FAULT, INTERRUPTED = 1, 2, 130
"""Exit status of a command that found faults (`doctor`), of an input error, and of an interruption."""


class UserFault(HygrokfError):
    """An input error, reported without a traceback."""


class Progress:
    """The steps of a command as a progress bar if standard error is a terminal; a context manager.

    With --verbose each step is a line instead; with --quiet no step is shown.
    """

    def __init__(self, total: int) -> None:
        from tqdm import tqdm

        shown = activity().loudness is Loudness.NORMAL and activity().on_terminal
        self._bar = tqdm(
            total=total, file=sys.stderr, disable=not shown, bar_format="{l_bar}{bar}| {elapsed} {postfix}"
        )

    def __call__(self, text: str) -> None:
        activity().step(text)
        self._bar.set_postfix_str(text, refresh=False)
        if self._bar.n < self._bar.total - 1:
            self._bar.update()

    def tell(self, text: str) -> None:
        """Print a line above the bar, unless --quiet is given."""
        from tqdm import tqdm

        with tqdm.external_write_mode(file=sys.stderr):
            activity().note(printable(text))

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the bar: full if the work is done, unchanged if the work was interrupted."""
        if kind is None:
            self._bar.n = self._bar.total
            self._bar.set_postfix_str("done")
        self._bar.close()


@contextmanager
def faults_of(file: Path) -> Iterator[None]:
    """Turn a ValueError raised in this context into an input error that names the file."""
    try:
        yield
    except ValueError as fault:
        raise UserFault(f"{file}: {fault}") from fault


@contextmanager
def collect_faults(faults: list[str]) -> Iterator[None]:
    """Add an input error raised in this context to `faults`, so that the other inputs are still read."""
    try:
        yield
    except HygrokfError as fault:
        faults.append(str(fault))


def show(result: object, text: str, as_json: bool) -> None:
    """Print a result as JSON, or its text."""
    from hygrokf.data.result_file import result_text

    print(result_text(result) if as_json else text, end="" if as_json else "\n")


def show_reported(page: Path, result: object, blocks: Page, as_json: bool, more: str = "") -> int:
    """Print a result as JSON, or as the text of its page followed by `more`; and the path of the page on
    standard error. Returns the exit status 0."""
    from hygrokf.report.terminal import page_text

    show(result, page_text(blocks) + more, as_json)
    activity().note(f"report: {page}")
    return 0


def printable(text: str) -> str:
    """Replace the control characters of a text, so that the content of a binary file cannot affect the
    terminal."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


def system_message(fault: OSError) -> str:
    """Return the message of an error of the operating system, with the remedy."""
    where = fault.filename2 or fault.filename
    return (
        f"{f'{where}: ' if where else ''}cannot be read or written: {fault.strerror or fault}; "
        "check the path, its permissions and the space on the disk"
    )


def expect_directory(path: Path) -> None:
    """Raise UserFault if the output directory cannot be written; nothing is created."""
    candidates = (path, *path.absolute().parents)
    nearest = next(candidate for candidate in candidates if os.path.lexists(candidate))
    if not nearest.is_dir():
        reason = f"{nearest} is a file" if nearest.exists() else f"{nearest} is a link to nothing"
    elif not os.access(nearest, os.W_OK | os.X_OK):
        reason = f"{nearest} is write-protected"
    else:
        return
    raise UserFault(
        f"--out {path}: expected a directory that can be written, found: {reason}; name another one"
    )


def expect_own_directory(out: Path, own: str) -> None:
    """Raise UserFault if the output directory cannot be written, or holds results of another kind than the
    file `own`.

    The report.html of a directory belongs to one kind of results. The directory of a discovery also holds the
    fit of its extended model.
    """
    expect_directory(out)
    others = [name for name in RESULTS if name != own and (out / name).exists()]
    if own == DISCOVERY and (out / DISCOVERY).exists():
        others = [name for name in others if name != FIT]
    if others:
        raise UserFault(
            f"--out {out}: expected a directory of its own, found {others[-1]} in it; name another one"
        )


def expect_file(path: Path) -> None:
    """Raise UserFault if the output file cannot be written: a pipe or device must be writable; a file needs a
    directory that exists and is writable."""
    if is_stream(path):
        if not os.access(path, os.W_OK):
            raise UserFault(
                f"--out {path}: expected a pipe or device that can be written, found it write-protected"
            )
        return
    if path.is_dir():
        raise UserFault(f"--out {path}: expected a file to write, found a directory; name a file in it")
    if not path.parent.is_dir():
        is_file = path.parent.exists()
        reason = f"that {path.parent} is a file" if is_file else f"no {path.parent}; make it first"
        raise UserFault(f"--out {path}: expected a file in an existing directory, found {reason}")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise UserFault(f"--out {path}: {path.parent} is write-protected; name another directory")


def expect_other(path: Path, *inputs: Path) -> None:
    """Raise UserFault if the output file is one that the command reads."""
    for file in inputs:
        if path.exists() and file.exists() and path.samefile(file):
            raise UserFault(
                f"--out {path}: expected a file of its own, found one that is read here; name another one"
            )
