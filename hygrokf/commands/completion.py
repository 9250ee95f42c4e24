"""`hygrokf completion`: commands and options at the shell's tab key, made from the parser by shtab."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.verb import Verb, parsers_of

SHELLS = ("bash", "zsh", "fish", "tcsh", "powershell")


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("shell", choices=SHELLS, help="the shell that is to read the script")


def _run(options: Namespace) -> int:
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


VERB = Verb("completion", "print the completion script of a shell", _arguments, _run)
