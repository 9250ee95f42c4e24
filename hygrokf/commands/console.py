"""Messages of commands at the terminal: notes, steps, and signs of life in a log; and checks before any work
is done."""

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

HEARTBEAT_S = 30.0
"""[s] longest silence of a command whose output goes to a file or another program."""


class Loudness(IntEnum):
    """How much a command says on standard error beside its result."""

    QUIET = 0
    NORMAL = 1
    VERBOSE = 2


class Activity:
    """A running command: its present step, and its lines on standard error.

    name: of the command. beats: whether it gives signs of life where standard error is no terminal.
    every_s: [s] between these; None: `HEARTBEAT_S`. clock: [s] monotonic.
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
        self._every_s = HEARTBEAT_S if every_s is None else every_s
        self._begin = self._said = clock()
        self._step = "at work"

    @property
    def on_terminal(self) -> bool:
        """Whether a person watches: standard error is a terminal."""
        return sys.stderr is not None and sys.stderr.isatty()

    def step(self, text: str) -> None:
        """Begin a step; it is printed with --verbose, and named in later signs of life."""
        self._step = text
        if self.loudness is Loudness.VERBOSE:
            self.line(f"{self.name}: {self._elapsed()}: {text}")

    def note(self, text: str) -> None:
        """Print a note or a warning; not with --quiet."""
        if self.loudness is not Loudness.QUIET:
            self.line(text)

    def line(self, text: str) -> None:
        """Print a line on standard error, at once."""
        self._said = self._clock()
        if sys.stderr is not None:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def alive(self) -> Iterator[None]:
        """Give signs of life within this context: a line after every `every_s` without another line."""
        if not self._beats or self.loudness is Loudness.QUIET or self.on_terminal:
            yield
            return
        ended = threading.Event()

        def beat() -> None:
            wait = self._every_s
            while not ended.wait(wait):
                wait = self._said + self._every_s - self._clock()
                if wait <= 0.0:
                    self.line(f"{self.name}: {self._elapsed()}: {self._step}")
                    wait = self._every_s

        thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
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
        return f"{self._clock() - self._begin:.0f} s"


_ACTIVITY: ContextVar[Activity | None] = ContextVar("activity", default=None)


def activity() -> Activity:
    """The command that runs; outside of any command one with the usual loudness."""
    return _ACTIVITY.get() or Activity("hygrokf")


@contextmanager
def running(this: Activity) -> Iterator[Activity]:
    """Within this context `activity()` is this command, which gives signs of life."""
    before = _ACTIVITY.set(this)
    try:
        with this.alive():
            yield this
    finally:
        _ACTIVITY.reset(before)


FOUND, USER_FAULT, INTERRUPTED = 1, 2, 130
"""Exit status where the command ran and found a fault, after an input error, and after an interruption."""


class UserFault(HygrokfError):
    """An input error, reported without a traceback."""


class Progress:
    """The steps of a command, to be used in a `with`: a bar where standard error is a terminal.

    With --verbose the steps are lines instead; with --quiet they are not shown.
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
        """Print a line that stays above the bar; not with --quiet."""
        from tqdm import tqdm

        with tqdm.external_write_mode(file=sys.stderr):
            activity().note(printable(text))

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the bar: full after the work, as it stands where the work was interrupted."""
        if kind is None:
            self._bar.n = self._bar.total
            self._bar.set_postfix_str("done")
        self._bar.close()


@contextmanager
def faults_of(file: Path) -> Iterator[None]:
    """Report a ValueError raised inside as an input error that names the file."""
    try:
        yield
    except ValueError as fault:
        raise UserFault(f"{file}: {fault}") from fault


@contextmanager
def collected(faults: list[str]) -> Iterator[None]:
    """Add an input error raised inside to `faults`, so that the next input is read, too."""
    try:
        yield
    except HygrokfError as fault:
        faults.append(str(fault))


def show(found: object, text: str, as_json: bool) -> None:
    """Print a result as JSON or as text."""
    from hygrokf.data.result_file import result_text

    print(result_text(found) if as_json else text, end="" if as_json else "\n")


def show_reported(page: Path, found: object, blocks: Page, as_json: bool, more: str = "") -> int:
    """Print a result, as JSON or as the text of its page with what there is `more` to say, and on standard
    error the path of the page; returns the exit status 0."""
    from hygrokf.report.terminal import page_text

    show(found, page_text(blocks) + more, as_json)
    activity().note(f"report: {page}")
    return 0


def printable(text: str) -> str:
    """Text without control characters, so that the content of a binary file cannot affect the terminal."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


def system_words(fault: OSError) -> str:
    """The system's refusal and the remedy, in words."""
    where = fault.filename2 or fault.filename
    return (
        f"{f'{where}: ' if where else ''}cannot be read or written: {fault.strerror or fault}; "
        "check the path, its permissions and the space on the disk"
    )


def expect_directory(path: Path) -> None:
    """Raise UserFault where the output directory could not be written; nothing is created yet."""
    nearest = next(one for one in (path, *path.absolute().parents) if os.path.lexists(one))
    if not nearest.is_dir():
        found = f"{nearest} is a file" if nearest.exists() else f"{nearest} is a link to nothing"
    elif not os.access(nearest, os.W_OK | os.X_OK):
        found = f"{nearest} is write-protected"
    else:
        return
    raise UserFault(
        f"--out {path}: expected a directory that can be written, found: {found}; name another one"
    )


def expect_own_directory(out: Path, own: str) -> None:
    """`expect_directory`, and raise UserFault where the directory holds results of another kind than the file
    `own`.

    A directory's report.html is made from a single kind of results.  A discovery's directory also holds the
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
    """Raise UserFault where the output file could not be written: a pipe or device must be writable, a file's
    directory must exist."""
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
        found = f"that {path.parent} is a file" if is_file else f"no {path.parent}; make it first"
        raise UserFault(f"--out {path}: expected a file in an existing directory, found {found}")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise UserFault(f"--out {path}: {path.parent} is write-protected; name another directory")


def expect_other(path: Path, *read: Path) -> None:
    """Raise UserFault where the output would overwrite a file that the command reads."""
    for one in read:
        if path.exists() and one.exists() and path.samefile(one):
            raise UserFault(
                f"--out {path}: expected a file of its own, found one that is read here; name another one"
            )
