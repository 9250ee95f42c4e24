"""Places of a case in messages: the lines of its file, or the arguments of a call."""

from __future__ import annotations

import re
from typing import Protocol


class Statement(Protocol):
    """Names the places of a case in messages: lines of a file, or arguments of a call."""

    name: str
    """Of the file or function."""

    def at(self, block: int | None, *keys: str) -> str:
        """The place of a key in the source with this number, or outside the sources."""

    def table(self, name: str) -> str:
        """The name of a table of keys, such as `site`."""

    def signal(self, name: str) -> str:
        """The name of a signal's entry."""


class CaseLines:
    """Finds the line of the case file on which a key stands, so that faults can name it."""

    def __init__(self, name: str, text: str) -> None:
        self.name = name
        self.lines = [line.split("#")[0] for line in text.splitlines()]
        heads = [
            number for number, line in enumerate(self.lines) if re.match(r"\s*\[\[\s*source\s*\]\]", line)
        ]
        ends = [
            next(
                (
                    other
                    for other in range(head + 1, len(self.lines))
                    if re.match(r"\s*\[(?!\s*source\s*\.)", self.lines[other])
                ),
                len(self.lines),
            )
            for head in heads
        ]
        self.blocks = list(zip(heads, ends, strict=True))

    def table(self, name: str) -> str:
        """The head of a table."""
        return f"[{name}]"

    def signal(self, name: str) -> str:
        """The key of a signal."""
        return f"signals.{name}"

    def at(self, block: int | None, *keys: str) -> str:
        """The place as "case.toml, line 7", or the file's name alone where the line is not found.

        block: number of the [[source]], or None for the rest of the file.
        keys: the first of these found on a line gives the line.
        """
        inside = [number for first, last in self.blocks for number in range(first, last)]
        if block is None:
            numbers = [number for number in range(len(self.lines)) if number not in set(inside)]
        elif block < len(self.blocks):
            numbers = list(range(*self.blocks[block]))
        else:
            numbers = list(range(len(self.lines)))
        for key in keys:
            pattern = re.compile(rf"(?<![\w.-])(?:signals\.)?[\"']?{re.escape(key)}[\"']?\s*[.=\]]")
            for number in numbers:
                if pattern.search(self.lines[number]):
                    return f"{self.name}, line {number + 1}"
        if block is not None and block < len(self.blocks):
            return f"{self.name}, line {self.blocks[block][0] + 1}"
        return self.name
