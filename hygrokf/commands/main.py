"""The command line: its parser, the exit status of a command, and the commands `help` and `completion`."""

from __future__ import annotations

import argparse
import atexit
import gc
import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from hygrokf.commands.case_commands import CHECK, DEMO, INIT
from hygrokf.commands.climate_commands import CLIMATE_VERB
from hygrokf.commands.compare_commands import COMPARE, TRANSFER_VERB
from hygrokf.commands.console import (
    INTERRUPTED,
    USER_FAULT,
    Activity,
    UserFault,
    printable,
    running,
    system_message,
)
from hygrokf.commands.fit_commands import DISCOVER, EVALUATE, FIT_VERB, SIMULATE
from hygrokf.commands.fleet_command import FLEET_VERB
from hygrokf.commands.report_commands import REPORT_VERB, SUMMARY_VERB
from hygrokf.commands.store_commands import EXPORT, RESTORE, STORE
from hygrokf.commands.track_command import DOCTOR, TRACK
from hygrokf.commands.verb import Verb, add_loudness, parsers_of
from hygrokf.errors import HygrokfError, suggestion
from hygrokf.version import __version__


def _help_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("name", nargs="?", metavar="COMMAND", help="the command (default: list all of them)")


def _help(options: Namespace) -> int:
    """Print the help of a command, or of all commands. Raises UserFault for an unknown command."""
    parsers = parsers_of(options.parser)
    if options.name is None:
        options.parser.print_help()
        return 0
    if options.name not in parsers:
        raise UserFault(
            f'there is no command "{options.name}"{suggestion(options.name, parsers)}; expected one of '
            f"{', '.join(parsers)}"
        )
    parsers[options.name].print_help()
    return 0


HELP = Verb("help", "show the arguments of a command", _help_arguments, _help)

SHELLS = ("bash", "zsh", "fish", "tcsh", "powershell")


def _shell(parser: ArgumentParser) -> None:
    """Add the argument of `hygrokf completion`."""
    parser.add_argument("shell", choices=SHELLS, help="the shell that is to read the script")


def _complete(options: Namespace) -> int:
    """Print a script with which a shell completes commands, options and files."""
    import shtab  # imported here only, because every command imports this module

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


VERBS = (
    DEMO, INIT, CHECK, FIT_VERB, DISCOVER, SIMULATE, EVALUATE, FLEET_VERB, CLIMATE_VERB, COMPARE,
    TRANSFER_VERB, EXPORT, TRACK, DOCTOR, RESTORE, STORE, REPORT_VERB, SUMMARY_VERB, HELP, COMPLETION,
)  # fmt: skip
"""The commands in the order of the help."""

MAIN_VERBS = (INIT, CHECK, FIT_VERB, DISCOVER, CLIMATE_VERB)
"""The commands that `hygrokf` without arguments lists."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status, see docs/reference/command_line.md.

    arguments: of the command line; None: those of this process.
    """
    # the filter's matrices are small: more BLAS threads would only wait for each other
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    for stream in (sys.stdout, sys.stderr):
        # a terminal that cannot show ≤ or τ gets a question mark instead of a traceback
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    if arguments is None:
        # without this, the collection of the libraries' objects at exit takes longer than some commands
        atexit.register(gc.freeze)
    options = _parser().parse_args(arguments)
    try:
        status = _run(options) if hasattr(options, "verb") else _overview()
        if sys.stdout is not None:  # None where the shell has closed it
            sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("interrupted; no incomplete file is left", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of the output has gone; the remaining output must not raise at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as fault:
        print(f"hygrokf: {system_message(fault)}", file=sys.stderr)
        return USER_FAULT
    except HygrokfError as fault:
        print(f"hygrokf: {printable(str(fault))}", file=sys.stderr)
        return USER_FAULT


def _parser() -> argparse.ArgumentParser:
    """Return the parser of the command line, with one subparser for each command."""
    parser = argparse.ArgumentParser(
        prog="hygrokf",
        description="Hygrothermal models of converter cabinets in wind turbines by Kalman filtering.",
    )
    parser.add_argument("--version", action="version", version=f"hygrokf {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for verb in VERBS:
        command = commands.add_parser(verb.name, help=verb.help, description=verb.help)
        command.set_defaults(verb=verb, parser=parser)
        verb.arguments(command)
        add_loudness(command)
    return parser


def _run(options: argparse.Namespace) -> int:
    """Run the chosen command; returns its exit status."""
    verb: Verb = options.verb
    command = Activity(f"hygrokf {verb.name}", options.loudness, beats=not verb.service)
    with running(command):
        status = verb.run(options)
        if not verb.service:
            command.end()
    return status


def _overview() -> int:
    """Print the main commands, and how to list all of them; returns the exit status 0."""
    print("usage: hygrokf COMMAND …\n")
    for verb in MAIN_VERBS:
        print(f"  {verb.name:<10}{verb.help}")
    print(
        "\nhygrokf help: all commands\nhygrokf help COMMAND: the arguments of one\n"
        "hygrokf demo --out demo: try it on a synthetic turbine"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
