"""`hygrokf track`: cabinets followed live."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.commands.console import Progress, UserFault, expect_directory
from hygrokf.commands.inputs import load_causes
from hygrokf.commands.tracked import add_tracked, tracked_config
from hygrokf.commands.verb import Verb, add_library

if TYPE_CHECKING:
    from hygrokf.live.config import Config
    from hygrokf.live.service import Service


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_tracked(parser)
    parser.add_argument(
        "--demo", action="store_true", help="a synthetic turbine, played back; needs nothing else"
    )
    parser.add_argument("--until-ended", action="store_true", help="end when all sources have ended")
    parser.add_argument(
        "--log", choices=("text", "json"), default="text", help="form of the log on standard error"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("live-demo"), help="directory of the demo (default live-demo)"
    )
    parser.add_argument(
        "--speed", type=_factor, default=1800.0, help="of the demo: times faster than real (default 1800)"
    )
    add_library(parser)


def _factor(text: str) -> float:
    """A number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"expected a number above 0 and below 1e6, found {text!r}")
    return value


def _run(options: argparse.Namespace) -> int:
    """Track until a signal ends it."""
    from hygrokf.live.tracking import log_to_stderr, track

    load_causes(options.library)
    config = _demo_config(options) if options.demo else tracked_config(options)
    log_to_stderr(options.log)

    def tell(text: str, **beside: object) -> None:
        """Print a message for the user; with a JSON log, write it as a log entry."""
        if options.log == "json":
            logging.getLogger("hygrokf.track").info(text.partition(":")[0], extra=beside)
        else:
            print(text, file=sys.stderr, flush=True)

    def begun(service: Service, page: str | None) -> None:
        names = ", ".join(list(config.turbines)[:5]) + (" …" if len(config.turbines) > 5 else "")
        tell(
            f"tracking: {names} ({len(config.turbines)}); store {config.store}",
            turbines=len(config.turbines),
            store=config.store,
        )
        if page is not None:
            tell(f"page: {page}", url=page)

    service = track(config, with_page=not options.no_page, until_ended=options.until_ended, begun=begun)
    counted = service.health.deliveries
    tell(f"done: {counted} deliveries, all committed", deliveries=counted)
    return 0


def _demo_config(options: argparse.Namespace) -> Config:
    from hygrokf.live.config import Config
    from hygrokf.live.defaults import demo_stream, demo_turbines, page_at, store_at

    if options.what or options.source:
        raise UserFault("track --demo brings its own turbine and source; leave the others out")
    expect_directory(options.out)
    store, page = store_at(options.store or f"sqlite:{options.out / 'live.db'}"), page_at(options.page)
    with Progress(16) as progress:
        turbines, record, live_s = demo_turbines(options.out, progress=progress)
    return Config(turbines, (demo_stream(record, live_s, options.speed),), store, page)


VERB = Verb("track", "follow cabinets live: condition, forecast, alarms, on a page", _arguments, _run)
