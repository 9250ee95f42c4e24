"""Places of a case in messages: the lines of its file, or the arguments of a call."""

from __future__ import annotations

from typing import Protocol

from hygrokf.data.toml_lines import Path, lines_of


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
    """The lines of a case file, so that faults can name those of their keys."""

    def __init__(self, name: str, text: str) -> None:
        self.name = name
        self.lines = lines_of(text)

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
        source: Path = ("source", -1 if block is None else block)
        numbered = source in self.lines
        inside = {
            path: line
            for path, line in self.lines.items()
            if (path[:2] == source if numbered else block is not None or path[:1] != ("source",))
        }
        for key in keys:
            found = next((line for path, line in inside.items() if path[-1] == key), None)
            if found is not None:
                return f"{self.name}, line {found}"
        return f"{self.name}, line {self.lines[source]}" if numbered else self.name
