"""`hygrokf completion`: commands and options at the shell's tab key, made from the parser."""

from __future__ import annotations

from argparse import SUPPRESS, Action, ArgumentParser, Namespace
from collections.abc import Mapping
from dataclasses import dataclass

from hygrokf.commands.verb import Verb, parsers_of

SHELLS = ("bash", "zsh", "fish")


@dataclass(frozen=True)
class Option:
    """An option of a command: its names, its help, its choices, and whether it takes a value."""

    names: tuple[str, ...]
    help: str
    choices: tuple[str, ...]
    takes_value: bool


@dataclass(frozen=True)
class Command:
    """A command: its help, its options, and the choices of its positional arguments."""

    help: str
    options: tuple[Option, ...]
    words: tuple[str, ...]


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("shell", choices=SHELLS, help="the shell that is to read the script")


def _run(options: Namespace) -> int:
    made = {"bash": bash_script, "zsh": zsh_script, "fish": fish_script}[options.shell]
    print(made(commands_of(options.parser)), end="")
    return 0


def commands_of(parser: ArgumentParser) -> dict[str, Command]:
    """The commands of a parser by name, with what may follow them."""
    parsers = parsers_of(parser)
    found = {}
    for name, command in parsers.items():
        actions = [one for one in command._actions if one.help != SUPPRESS]
        words = [str(word) for one in actions if not one.option_strings for word in one.choices or ()]
        if name == "help":
            words = list(parsers)
        made = tuple(_option(one) for one in actions if one.option_strings)
        found[name] = Command(command.description or "", made, tuple(words))
    return found


def _option(action: Action) -> Option:
    choices = tuple(str(one) for one in action.choices or ())
    text = (action.help or "").replace("%(default)g", str(action.default)).replace("%%", "%")
    return Option(tuple(action.option_strings), text, choices, action.nargs != 0)


# --- the scripts -----------------------------------------------------------------------------


def bash_script(commands: Mapping[str, Command]) -> str:
    """The script for bash: commands, then options and choices, else files."""
    cases = []
    for name, command in commands.items():
        chosen = [
            f"                {'|'.join(one.names)}) words={_quoted(' '.join(one.choices))} ;;"
            for one in command.options
            if one.choices
        ]
        # the values of the other options are files, numbers or names: the shell completes files
        free = [one for one in command.options if one.takes_value and not one.choices]
        others = [name for one in free for name in one.names]
        chosen += [f"                {'|'.join(others)}) words= ;;"] if others else []
        every = [name for one in command.options for name in one.names]
        cases += [
            f"        {name})",
            '            case "$before" in',
            *chosen,
            f"                *) words={_quoted(' '.join(command.words))}",
            f'                   [[ "$word" == -* ]] && words={_quoted(" ".join(every))} ;;',
            "            esac ;;",
        ]
    return "\n".join(
        [
            "# for bash: put  source <(hygrokf completion bash)  into ~/.bashrc",
            "_hygrokf() {",
            '    local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" words=',
            "    if [[ $COMP_CWORD -eq 1 ]]; then",
            f"        words={_quoted(' '.join([*commands, '--help', '--version']))}",
            '        COMPREPLY=($(compgen -W "$words" -- "$word"))',
            "        return",
            "    fi",
            '    case "${COMP_WORDS[1]}" in',
            *cases,
            "    esac",
            '    COMPREPLY=($(compgen -W "$words" -- "$word"))',
            "}",
            "complete -o default -F _hygrokf hygrokf",
            "",
        ]
    )


def zsh_script(commands: Mapping[str, Command]) -> str:
    """The script for zsh: commands with their help, then options with theirs, choices, else files."""
    cases = []
    for name, command in commands.items():
        cases += [f"        {name})", "            _arguments \\"]
        for one in command.options:
            value = f":value:({' '.join(one.choices)})" if one.choices else ":value:_files"
            after = f"[{_bare(one.help)}]{value if one.takes_value else ''}"
            cases += [f"                {_quoted(option + after)} \\" for option in one.names]
        rest = f"*:argument:({' '.join(command.words)})" if command.words else "*:file:_files"
        cases += [f"                {_quoted(rest)} ;;"]
    listed = [f"            {_quoted(f'{name}:{_bare(one.help)}')}" for name, one in commands.items()]
    return "\n".join(
        [
            "#compdef hygrokf",
            "# for zsh: put  source <(hygrokf completion zsh)  into ~/.zshrc, below compinit",
            "_hygrokf() {",
            "    if (( CURRENT == 2 )); then",
            "        local -a commands=(",
            *listed,
            "        )",
            "        _describe command commands",
            "        return",
            "    fi",
            "    local command=$words[2]",
            "    shift words",
            "    (( CURRENT-- ))",
            "    case $command in",
            *cases,
            "    esac",
            "}",
            "compdef _hygrokf hygrokf",
            "",
        ]
    )


def fish_script(commands: Mapping[str, Command]) -> str:
    """The script for fish: commands with their help, then options with theirs, choices, else files."""
    lines = ["# for fish: hygrokf completion fish > ~/.config/fish/completions/hygrokf.fish"]
    for name, command in commands.items():
        lines.append(f"complete -c hygrokf -f -n __fish_use_subcommand -a {name} -d {_quoted(command.help)}")
        within = f"-n {_quoted(f'__fish_seen_subcommand_from {name}')}"
        if command.words:
            lines.append(f"complete -c hygrokf -f {within} -a {_quoted(' '.join(command.words))}")
        for one in command.options:
            names = " ".join(f"-l {n[2:]}" if n.startswith("--") else f"-s {n[1:]}" for n in one.names)
            value = " -r" if one.takes_value else ""
            if one.choices:
                value = f" -x -a {_quoted(' '.join(one.choices))}"
            lines.append(f"complete -c hygrokf {within} {names}{value} -d {_quoted(one.help)}")
    return "\n".join([*lines, ""])


def _quoted(text: str) -> str:
    """Text as one word of a shell."""
    return "'" + text.replace("'", "'\\''") + "'"


def _bare(text: str) -> str:
    """Text without the characters that stand for structure in a completion of zsh."""
    return text.replace("[", "(").replace("]", ")").replace(":", ",")


VERB = Verb("completion", "print the completion script of a shell", _arguments, _run)
