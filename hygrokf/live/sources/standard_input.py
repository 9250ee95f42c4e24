"""Standard input as a source."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from io import UnsupportedOperation
from os import read
from pathlib import Path
from threading import Event
from typing import IO, Any

from hygrokf.data.toml_form import Place, setting
from hygrokf.live.sources.local import LONGEST_LINE, Lines, next_line
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.stream import PAUSE_S, Delivery, SourceKeys, Stream

PIECE = 65_536
"""[bytes] read at once."""


class StandardInput(Stream):
    """Lines of standard input until it ends; lines cannot be read again after a restart."""

    url = "stdin"

    def __init__(
        self,
        mapping: PayloadMapping,
        file: IO[Any] | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        super().__init__(mapping, clock)
        self._file = file
        self._lines = Lines(mapping.form)
        self._pipe: _Pipe | None = None

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        file: IO[Any] = getattr(sys.stdin, "buffer", sys.stdin) if self._file is None else self._file
        descriptor = _descriptor(file)
        if descriptor is not None and self._pipe is None:
            self._pipe = _Pipe(descriptor, self._ended)
        while line := next_line(file) if self._pipe is None else self._pipe.next_line():
            if self._ended.is_set():
                return
            content = self._lines.content(line)
            if content is not None:
                put(Delivery(content, self.clock()))


def _descriptor(file: IO[Any]) -> int | None:
    """The descriptor of a file that can be waited for; None where it has none, or the system cannot."""
    try:
        descriptor = file.fileno()
        select.select([descriptor], [], [], 0.0)
    except (OSError, UnsupportedOperation, ValueError):
        return None
    return descriptor


class _Pipe:
    """Lines of a descriptor.  Waiting for more ends with an event: a thread that blocks in a buffered read
    would keep the process from ending."""

    def __init__(self, descriptor: int, ended: Event) -> None:
        self._descriptor, self._ended = descriptor, ended
        self._held = bytearray()

    def next_line(self) -> bytes:
        """The next line, or a piece of one that is too long; empty at the end, and once the event is set."""
        searched = 0
        while (end := self._held.find(b"\n", searched) + 1) == 0 and len(self._held) <= LONGEST_LINE:
            searched = len(self._held)
            more = self._read()
            if not more:
                end = len(self._held)
                break
            self._held += more
        count = min(end or LONGEST_LINE + 1, LONGEST_LINE + 1)
        line = bytes(self._held[:count])
        del self._held[:count]
        return line

    def _read(self) -> bytes:
        while not self._ended.is_set():
            if select.select([self._descriptor], [], [], PAUSE_S)[0]:
                return read(self._descriptor, PIECE)
        return b""


@dataclass(frozen=True)
class InputForm(SourceKeys):
    """A [[source]] of `stdin`."""

    url: str = setting(help="stdin")

    def stream(self, folder: Path, mapping: PayloadMapping, place: Place) -> Stream:
        """The stream."""
        return StandardInput(mapping)
