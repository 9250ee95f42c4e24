"""Atomic writing of files, and the names of result files."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

REPORT = "report.html"
"""The page of a directory of results: that of the fit, or of the discovery that contains the fit."""
BESIDE_DISCOVERY = "fit_report.html"
"""The fit's own page where report.html is that of a discovery."""
SUMMARY, BESIDE_SUMMARY = "summary", "fit_summary"
"""The files of a summary without their endings; the second is that of a discovery's own fit."""
SUMMARIES = tuple(f"{name}.{end}" for name in (SUMMARY, BESIDE_SUMMARY) for end in ("html", "pdf"))
FIT = "fit.json"
DISCOVERY = "discovery.json"
DISCOVERY_SERIES = "discovery.npz"
FLEET = "fleet.json"
CLIMATE = "climate.json"
COMPARISON = "compare.json"
COMPARISON_TABLE = "compare.csv"
COMPARISON_SERIES = "compare.npz"
TRANSFER = "transfer.json"
TRANSFER_SERIES = "transfer.npz"
TYPE = "type.json"
RESULTS = (FIT, DISCOVERY, FLEET, CLIMATE, COMPARISON, TRANSFER)
"""Result files that exclude each other in a directory, since its report.html is made from one of them."""

DRAFT_DOUBT = "# doubt: "
"""How a drafted case file begins a comment about what is doubted in the line below it."""


def write_bytes_whole(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a file atomically: a reader sees either the old or the new content.

    path, errors: as for `writing_whole`.
    content: all bytes of the file.

    Returns the path.
    """
    with writing_whole(path) as stream:
        stream.write(content)
    return Path(path)


@contextmanager
def writing_whole(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file for atomic binary writing: readers see its old content until the block ends.

    path: the file; its directory must exist.  A symbolic link is followed, and an existing file keeps its
        permissions.

    The bytes go to a temporary file in the same directory, are forced to the disk and renamed over the
    target.  If anything fails on the way, the temporary file is removed and the target stays as it was.  A
    pipe or device cannot be replaced: the bytes are streamed to it.  Raises OSError from the system.
    """
    if is_stream(path):
        with open(path, "ab") as stream:
            yield stream
        return
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(6)}.part")
    # O_EXCL with mode 0o666 leaves the permissions to the user's umask, as open() would.
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    descriptor = os.open(temporary, flags, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        with suppress(FileNotFoundError):
            os.chmod(temporary, target.stat().st_mode & 0o7777)
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    with suppress(OSError):  # the renaming survives a power cut, on systems that support it
        descriptor = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def is_stream(path: str | os.PathLike[str]) -> bool:
    """Whether a path is a pipe, a terminal or another device, such as /dev/stdout, instead of an ordinary
    file."""
    if os.path.abspath(path).startswith(("/dev/", "/proc/")):
        return os.path.exists(path)
    with suppress(OSError):
        mode = os.stat(path).st_mode
        return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))
    return False


def write_text_whole(path: str | os.PathLike[str], text: str) -> Path:
    """Write a text file (UTF-8, line ends as given) atomically.

    path, errors: as for `write_bytes_whole`.
    """
    return write_bytes_whole(path, text.encode("utf-8"))
