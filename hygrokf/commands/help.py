"""`hygrokf help`: the arguments of a command."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from hygrokf.commands.console import UserFault
from hygrokf.commands.verb import Verb, parsers_of
from hygrokf.errors import suggestion


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("name", nargs="?", metavar="COMMAND", help="the command (default: list all of them)")


def _run(options: Namespace) -> int:
    known = parsers_of(options.parser)
    if options.name is None:
        options.parser.print_help()
        return 0
    if options.name not in known:
        raise UserFault(
            f'there is no command "{options.name}"{suggestion(options.name, known)}; expected one of '
            f"{', '.join(known)}"
        )
    known[options.name].print_help()
    return 0


VERB = Verb("help", "show the arguments of a command", _arguments, _run)
