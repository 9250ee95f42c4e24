"""`hygrokf doctor`: checks everything that a tracker needs."""

from __future__ import annotations

import argparse

from hygrokf.commands.console import show
from hygrokf.commands.inputs import load_causes
from hygrokf.commands.track import add_tracked, tracked_config
from hygrokf.commands.verb import Verb, add_json, add_library


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_tracked(parser)
    parser.add_argument(
        "--wait", type=_duration, default=10.0, metavar="TIME", help="listen to sources so long (default 10s)"
    )
    parser.add_argument("--notify", action="store_true", help="send a test message to every [[notify]]")
    add_library(parser)
    add_json(parser)


def _duration(text: str) -> float:
    """The seconds of a duration such as 10s."""
    from hygrokf.data.timestamps import duration

    try:
        return duration(text)
    except ValueError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


def _run(options: argparse.Namespace) -> int:
    """Check; the exit status is 1 where there is a fault."""
    from hygrokf.live.doctor.examination import as_data, as_text, examine

    load_causes(options.library)
    config = tracked_config(options)
    file = next((path for path in options.what if path.suffix == ".toml"), None)
    found = examine(config, file, options.wait, not options.no_page, options.notify)
    show(as_data(found), as_text(found), options.json)
    return int(any(one.level == "fault" for one in found))


VERB = Verb("doctor", "look at all that a tracker needs, change nothing, say what to mend", _arguments, _run)
