"""What commands tell the one at the terminal, and what they refuse before any work is done."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from hygrokf.data.files import DISCOVERY, FIT, RESULTS, is_stream
from hygrokf.errors import HygrokfError


class UserFault(HygrokfError):
    """A mistake of the user's, told without a traceback."""


class Progress:
    """A progress bar on standard error; silent where there is no terminal to look at it."""

    def __init__(self, total: int) -> None:
        from tqdm import tqdm

        self._bar = tqdm(
            total=total, file=sys.stderr, disable=None, bar_format="{l_bar}{bar}| {elapsed} {postfix}"
        )

    def __call__(self, text: str) -> None:
        self._bar.set_postfix_str(text, refresh=False)
        if self._bar.n < self._bar.total - 1:
            self._bar.update()

    def tell(self, text: str) -> None:
        """A line that stays, above the bar."""
        from tqdm import tqdm

        tqdm.write(printable(text), file=sys.stderr)

    def abandon(self) -> None:
        """End where it is: the work was broken off."""
        self._bar.close()

    def close(self) -> None:
        self._bar.n = self._bar.total
        self._bar.set_postfix_str("done")
        self._bar.close()


def printable(text: str) -> str:
    """Text without control characters: what a binary file holds must not reach the terminal."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


def system_words(fault: OSError) -> str:
    """What the system refused, and what to do."""
    where = fault.filename2 or fault.filename
    return (
        f"{f'{where}: ' if where else ''}cannot be read or written: {fault.strerror or fault}; "
        "check the path, its permissions and the space on the disk"
    )


def expect_directory(path: Path) -> None:
    """Refuse before the work what could not be written after it; nothing is made yet."""
    there = next(one for one in (path, *path.absolute().parents) if os.path.lexists(one))
    if not there.is_dir():
        found = f"{there} is a file" if there.exists() else f"{there} is a link to nothing"
    elif not os.access(there, os.W_OK | os.X_OK):
        found = f"{there} is write-protected"
    else:
        return
    raise UserFault(
        f"--out {path}: expected a directory that can be written, found: {found}; name another one"
    )


def expect_own_directory(out: Path, own: str) -> None:
    """The same for results, told by the name of their file: a directory that holds others is refused as well.

    Its report.html is made from them.  A discovery's directory holds the fit of its extended model too.
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
    """The same for a file: its directory must be there.  A pipe or device needs to be writable."""
    if is_stream(path):
        if not os.access(path, os.W_OK):
            raise UserFault(
                f"--out {path}: expected a pipe or device that can be written, found it write-protected"
            )
        return
    if path.is_dir():
        raise UserFault(f"--out {path}: expected a file to write, found a directory; name a file in it")
    if not path.parent.is_dir():
        found = f"no {path.parent}; make it first"
        if path.parent.exists():
            found = f"that {path.parent} is a file"
        raise UserFault(f"--out {path}: expected a file in an existing directory, found {found}")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise UserFault(f"--out {path}: {path.parent} is write-protected; name another directory")


def expect_other(path: Path, *read: Path) -> None:
    """Refuse to write over what the command reads."""
    for one in read:
        if path.exists() and one.exists() and path.samefile(one):
            raise UserFault(
                f"--out {path}: expected a file of its own, found one that is read here; name another one"
            )
