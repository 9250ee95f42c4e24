"""The commands of the command line, and the arguments that several of them have."""

from __future__ import annotations

import math
from argparse import ArgumentParser, ArgumentTypeError, Namespace, _SubParsersAction
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from hygrokf.commands.console import Loudness

T = TypeVar("T")
N = TypeVar("N", int, float)


@dataclass(frozen=True)
class Verb:
    """A command: its name, its help, the function that adds its arguments, and the function that runs it.

    `run` returns the exit status. A `service` runs until a signal ends it, and writes its own log.
    """

    name: str
    help: str
    arguments: Callable[[ArgumentParser], None]
    run: Callable[[Namespace], int]
    service: bool = False


def parsers_of(parser: ArgumentParser) -> dict[str, ArgumentParser]:
    """Return the parser of each command by its name, from the parser of the command line."""
    (commands,) = (action for action in parser._actions if isinstance(action, _SubParsersAction))
    return dict(commands.choices)


def reader(expected: str, convert: Callable[[str], T]) -> Callable[[str], T]:
    """Return a type for `argparse`: `convert`, with a message that states what was expected if it raises
    ValueError."""

    def read(text: str) -> T:
        try:
            return convert(text)
        except (ValueError, OverflowError):
            raise ArgumentTypeError(f"expected {expected}, found {text!r}") from None

    return read


def within(low: float, value: N, high: float = math.inf) -> N:
    """Return a value that lies within `low` … `high`. Raises ValueError for any other."""
    if not low <= value <= high:
        raise ValueError
    return value


def whole_number(least: int) -> Callable[[str], int]:
    """Return the type of an argument that is a whole number of at least `least`."""
    return reader(f"a whole number from {least} on", lambda text: within(least, int(text)))


def add_out(parser: ArgumentParser, help: str) -> None:
    """Add --out, the output directory or file."""
    parser.add_argument("--out", type=Path, required=True, help=help)


def add_json(parser: ArgumentParser) -> None:
    """Add --json."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_loudness(parser: ArgumentParser) -> None:
    """Add --quiet and --verbose."""
    group = parser.add_argument_group("messages").add_mutually_exclusive_group()
    for short, long, loudness, help in (
        ("-q", "--quiet", Loudness.QUIET, "print the result and errors only: no progress, notes, warnings"),
        ("-v", "--verbose", Loudness.VERBOSE, "print each step on a line of its own, with the time taken"),
    ):
        group.add_argument(
            short, long, dest="loudness", action="store_const", const=loudness, default=Loudness.NORMAL,
            help=help,
        )  # fmt: skip


def add_library(parser: ArgumentParser) -> None:
    """Add --library, the user's files with causes."""
    parser.add_argument(
        "--library",
        type=Path,
        action="append",
        default=[],
        metavar="FILE.py",
        help="Python file with causes of your own (it is executed); may be given several times",
    )


def add_fit_and_case(parser: ArgumentParser) -> None:
    """Add the arguments FIT.json and CASE.toml."""
    parser.add_argument("fit", type=Path, metavar="FIT.json", help="the fitted model, or its directory")
    parser.add_argument("case", type=Path, metavar="CASE.toml", help="the case file")
