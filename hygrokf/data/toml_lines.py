"""The lines of a TOML file on which tables and keys stand, so that faults can name them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from hygrokf.data.toml_form import Place

Path = tuple[str | int, ...]
"""Names of tables and keys from the outside in; a number counts the tables of one [[name]] from 0."""
_NAME = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_NAMES = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEAD = re.compile(rf"\s*(\[\[?)\s*({_NAMES})\s*\]")
_KEY = re.compile(rf"\s*({_NAMES})\s*=")


def lines_of(text: str) -> dict[Path, int]:
    """The line of each table and key of a TOML text, counted from 1; keys of inline tables are left out."""
    found: dict[Path, int] = {}
    counts: dict[Path, int] = {}
    table: Path = ()
    for number, line in enumerate(text.splitlines(), 1):
        head, key = _HEAD.match(line), _KEY.match(line)
        if head is not None:
            table = _numbered(_split(head[2]), counts, head[1] == "[[")
            found.setdefault(table, number)
        elif key is not None:
            names = _split(key[1])
            for length in range(len(names)):
                found.setdefault((*table, *names[: length + 1]), number)
    return found


def line_of(lines: Mapping[Path, int], table: Path, keys: Sequence[str]) -> int | None:
    """The line of the first of these keys of a table that is found, else of the table or of one around it."""
    around = (table[:length] for length in range(len(table), 0, -1))
    # a key of an inline table stands on the line of that table
    return next((lines[one] for one in (*((*table, key) for key in keys), *around) if one in lines), None)


def _split(names: str) -> list[str]:
    return [one.strip("\"'") for one in re.findall(_NAME, names)]


def _numbered(names: list[str], counts: dict[Path, int], begins: bool) -> Path:
    """The path of a table's head: of several [[name]] the newest is meant, or with `begins` a new one."""
    path: Path = ()
    for place, name in enumerate(names, 1):
        path = (*path, name)
        if begins and place == len(names):
            counts[path] = counts.get(path, -1) + 1
        if path in counts:
            path = (*path, counts[path])
    return path


@dataclass(frozen=True)
class LinedPlace(Place):
    """A table in messages with the line of the key at fault: "line 7, [[source]] 2".

    lines: of the file. path: of the table.
    """

    lines: dict[Path, int] = field(default_factory=dict, repr=False, compare=False)
    path: Path = ()

    def at(self, *keys: str) -> str:
        line = line_of(self.lines, self.path, keys)
        return ", ".join(([] if line is None else [f"line {line}"]) + ([self.name] if self.name else []))

    def inside(self, key: str, number: int | None = None, entry: str | None = None) -> Place:
        within = tuple(one for one in (number, entry) if one is not None)
        made = super().inside(key, number, entry)
        assert isinstance(made, LinedPlace)
        return replace(made, path=(*self.path, key, *within))
