"""Keys of a case: their values checked, every fault with the place where it is stated."""

from __future__ import annotations

import math
import numbers
import re
from typing import Any, Protocol

from hygrokf.errors import suggestion


class Statement(Protocol):
    """Where a case is stated, for messages: a file with its lines, or the arguments of a call.

    name: of the whole.
    """

    name: str

    def at(self, block: int | None, *keys: str) -> str:
        """Where a key is stated: in the source of that number, or outside of the sources."""

    def table(self, name: str) -> str:
        """What a table of keys, such as `site`, is called."""

    def signal(self, name: str) -> str:
        """What the entry of a signal is called."""


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
        """ "case.toml, line 7", or the file's name alone where the line is not found.

        block: number of the [[source]], or None for the rest of the file.
        keys: the first of these that stands on a line gives the line.
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


def expect_known_keys(
    table: dict[str, Any],
    known: tuple[str, ...],
    of: str,
    lines: Statement,
    block: int | None,
    faults: list[str],
) -> None:
    """Every key of a table that is not among the known ones becomes a fault.

    of: the table in words, such as " in [[source]]". block: number of the [[source]], or None.
    """
    for key in table:
        if key not in known:
            faults.append(
                f'{lines.at(block, key)}: unknown key "{key}"{of}; expected '
                f"{', '.join(known)}{suggestion(key, known)}"
            )


def stated_text(
    table: dict[str, Any], key: str, lines: Statement, block: int | None, faults: list[str]
) -> str | None:
    """A text that may be absent."""
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, str) and value:
        return value
    faults.append(f"{lines.at(block, key)}: {key} must be text in quotes, found {value!r}")
    return None


def stated_number(value: Any) -> float | None:
    """A finite number, or None for anything else."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value):
        return None
    return float(value)


def stated_positive(
    table: dict[str, Any], key: str, lines: Statement, block: int | None, faults: list[str]
) -> float | None:
    """A number above 0 that may be absent."""
    if key not in table:
        return None
    number = stated_number(table[key])
    if number is None or number <= 0.0:
        faults.append(f"{lines.at(block, key)}: {key} must be a number above 0, found {table[key]!r}")
        return None
    return number
