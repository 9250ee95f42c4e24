"""`hygrokf help`: the arguments of a command; `hygrokf completion`: commands and options at the shell's tab
key, made from the parser by shtab."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

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


HELP = Verb("help", "show the arguments of a command", _arguments, _run)

SHELLS = ("bash", "zsh", "fish", "tcsh", "powershell")


def _shell(parser: ArgumentParser) -> None:
    parser.add_argument("shell", choices=SHELLS, help="the shell that is to read the script")


def _complete(options: Namespace) -> int:
    import shtab  # here, because every command imports this module when it starts

    commands = parsers_of(options.parser)
    for command in commands.values():
        for action in command._actions:
            if action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
            elif action.metavar == "COMMAND":
                action.choices = list(commands)
    print(shtab.complete(options.parser, options.shell))
    return 0


COMPLETION = Verb("completion", "print the completion script of a shell", _shell, _complete)
