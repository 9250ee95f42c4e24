"""A command of the command line, and the arguments that several commands have."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace, _SubParsersAction
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hygrokf.commands.console import Loudness


@dataclass(frozen=True)
class Verb:
    """A command: its name and help, the function that adds its arguments, and the one that runs it.

    `run` returns the exit status.  A `service` runs until it is told to end, and writes a log of its own.
    """

    name: str
    help: str
    arguments: Callable[[ArgumentParser], None]
    run: Callable[[Namespace], int]
    service: bool = False


def parsers_of(parser: ArgumentParser) -> dict[str, ArgumentParser]:
    """The parsers of the commands of the command line's parser, by name."""
    (commands,) = (one for one in parser._actions if isinstance(one, _SubParsersAction))
    return dict(commands.choices)


def whole(least: int) -> Callable[[str], int]:
    """A reader of whole numbers not below `least`."""

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise ArgumentTypeError(f"expected a whole number from {least} on, found {text!r}")
        return value

    return number


def add_out(parser: ArgumentParser, help: str) -> None:
    parser.add_argument("--out", type=Path, required=True, help=help)


def add_json(parser: ArgumentParser) -> None:
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
    parser.add_argument(
        "--library",
        type=Path,
        action="append",
        default=[],
        metavar="FILE.py",
        help="Python file with causes of your own (it is executed); may be given several times",
    )


def add_fit_and_case(parser: ArgumentParser) -> None:
    parser.add_argument("fit", type=Path, metavar="FIT.json", help="the fitted model, or its directory")
    parser.add_argument("case", type=Path, metavar="CASE.toml", help="the case file")
