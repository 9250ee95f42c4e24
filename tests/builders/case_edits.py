"""What is done to the files of a case, to its fit, or to nothing, before a command reads them."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

Edit = Callable[[Path], object]


def content(folder: Path) -> dict[str, bytes | None]:
    """Everything in a directory: files with their bytes, directories with None."""
    return {
        str(one.relative_to(folder)): one.read_bytes() if one.is_file() else None for one in folder.rglob("*")
    }


def exchange(file: str, *changes: tuple[str, str]) -> Edit:
    """Exchange texts of a file, each where it stands first."""

    def edit(folder: Path) -> None:
        text = (folder / file).read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        (folder / file).write_text(text)

    return edit


case = partial(exchange, "case.toml")


def leave_out(*words: str) -> Edit:
    """Leave out the lines of the case file that hold one of the words."""

    def edit(folder: Path) -> None:
        lines = (folder / "case.toml").read_text().splitlines(keepends=True)
        kept = [line for line in lines if not any(word in line for word in words)]
        assert len(kept) < len(lines)
        (folder / "case.toml").write_text("".join(kept))

    return edit


def rows(file: str, change: Callable[[list[str]], list[str]]) -> Edit:
    """Change the lines of a table below its header."""

    def edit(folder: Path) -> None:
        head, *lines = (folder / file).read_text().splitlines()
        (folder / file).write_text("\n".join([head, *change(lines)]) + "\n")

    return edit


def column(name: str, change: Callable[[int, str], str], file: str = "cabinet.csv") -> Edit:
    """Change the cells of a column: (number of the row, cell) -> cell."""

    def edit(folder: Path) -> None:
        head, *lines = (folder / file).read_text().splitlines()
        place = head.split(",").index(name)
        cells = [line.split(",") for line in lines]
        for number, row in enumerate(cells):
            row[place] = change(number, row[place])
        (folder / file).write_text("\n".join([head, *(",".join(row) for row in cells)]) + "\n")

    return edit


def holds(file: str, found: bytes) -> Edit:
    """Write other bytes into a file."""
    return lambda folder: (folder / file).write_bytes(found)


def result(change: Callable[[dict], object]) -> Edit:
    """Change what fit.json holds."""

    def edit(folder: Path) -> None:
        file = folder / "result" / "fit.json"
        data = json.loads(file.read_text())
        change(data)
        file.write_text(json.dumps(data))

    return edit


def put(*path: str | int, value: object) -> Edit:
    """Put a value at a place of fit.json."""

    def change(data: dict) -> None:
        *way, last = path
        for key in way:
            data = data[key]
        data[last] = value

    return result(change)


def gone(name: str) -> Edit:
    return lambda folder: (folder / name).unlink()


def nothing(folder: Path) -> None:
    """The mistake is on the command line."""


NO_CABINET = case(("cabinet_temperature", "nacelle_temperature"), ("cabinet_relative", "nacelle_relative"))
