"""`hygrokf doctor`: checks everything that a tracker needs."""

from __future__ import annotations

import argparse

from hygrokf.commands.console import FOUND, show
from hygrokf.commands.inputs import load_causes
from hygrokf.commands.track import add_tracked, tracked_config
from hygrokf.commands.verb import Verb, add_json, add_library


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_tracked(parser)
    parser.add_argument(
        "--wait",
        type=_duration,
        default=10.0,
        metavar="TIME",
        help="time to listen to the sources (default 10s)",
    )
    parser.add_argument(
        "--try",
        dest="tried",
        metavar="FILE|TOPIC",
        help="print what the payloads of a file or topic give by [mapping], and check nothing else",
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
    """Check, or try payloads; the exit status is 1 where there is a fault, or where no payload gave a
    reading."""
    load_causes(options.library)
    config = tracked_config(options)
    if options.tried is not None:
        from hygrokf.live.doctor import payloads

        tried = payloads.try_payloads(config.streams, options.tried, options.wait)
        show(payloads.as_data(tried), payloads.as_text(tried), options.json)
        return 0 if any(one.used for one in tried) else FOUND
    from hygrokf.live.doctor.examination import as_data, as_text, examine

    file = next((path for path in options.what if path.suffix == ".toml"), None)
    found = examine(config, file, options.wait, not options.no_page, options.notify)
    show(as_data(found), as_text(found), options.json)
    return FOUND if any(one.level == "fault" for one in found) else 0


VERB = Verb(
    "doctor", "check everything that a tracker needs, change nothing, report what to fix", _arguments, _run
)
