"""`hygrokf track`: follow cabinets live; `hygrokf doctor`: check everything that a tracker needs."""

from __future__ import annotations

import argparse
import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.commands.console import (
    FOUND,
    INTERRUPTED,
    USER_FAULT,
    Loudness,
    Progress,
    UserFault,
    activity,
    expect_directory,
    show,
    system_message,
)
from hygrokf.commands.opening import library_of
from hygrokf.commands.verb import Verb, add_json, add_library, reader, within
from hygrokf.errors import HygrokfError

if TYPE_CHECKING:
    from hygrokf.live.config import Config
    from hygrokf.live.service import Service

LOG = logging.getLogger("hygrokf.track")
_LEVELS = {Loudness.QUIET: logging.WARNING, Loudness.NORMAL: logging.INFO, Loudness.VERBOSE: logging.DEBUG}
"""Loudness → lowest level of the messages in the log."""


def add_tracker_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for turbines, sources, store and page, which both commands have."""
    parser.add_argument(
        "what",
        nargs="*",
        type=Path,
        metavar="TRACK.toml|FIT.json",
        help="the tracker's file, or fitted models",
    )
    parser.add_argument(
        "--source",
        action="append",
        default=[],
        metavar="URL",
        help="source without a TRACK.toml: file:PATH or stdin",
    )
    parser.add_argument(
        "--store", metavar="URL", help="sqlite:PATH (default sqlite:live.db) or postgresql://…"
    )
    parser.add_argument("--page", metavar="HOST:PORT", help="address of the page (default 127.0.0.1:8080)")
    parser.add_argument("--no-page", action="store_true", help="no page, only store and alarms")


def tracker_config(options: argparse.Namespace) -> Config:
    """Return the configuration in TRACK.toml, or a default one for fitted models and --source; --store and
    --page override it. Raises UserFault."""
    from hygrokf.live.config import read_config
    from hygrokf.live.defaults import default_config, page_at, store_at

    files = [path for path in options.what if path.suffix == ".toml"]
    if not options.what:
        raise UserFault("expected a TRACK.toml or FIT.json files (or track --demo); found none of them")
    if files and (len(options.what) > 1 or options.source):
        raise UserFault("a TRACK.toml names turbines and sources itself; give it alone")
    store, library = store_at(options.store or "sqlite:live.db"), library_of(options.library)
    if not files:
        return default_config(options.what, options.source, store, page_at(options.page), library)
    config = read_config(files[0], library)
    config = config if options.store is None else replace(config, store=store)
    return config if options.page is None else replace(config, page=page_at(options.page))


def _track_arguments(parser: argparse.ArgumentParser) -> None:
    add_tracker_arguments(parser)
    parser.add_argument("--demo", action="store_true", help="play back synthetic data; needs no files")
    parser.add_argument("--until-ended", action="store_true", help="end when all sources have ended")
    parser.add_argument(
        "--log", choices=("text", "json"), default="text", help="format of the log on standard error"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("live-demo"), help="directory of the demo (default live-demo)"
    )
    parser.add_argument(
        "--speed",
        type=reader("a number above 0, up to 1e6", lambda text: within(math.ulp(0.0), float(text), 1e6)),
        default=1800.0,
        help="speed of the demo, relative to real time (default 1800)",
    )
    add_library(parser)


def _track_with_log(options: argparse.Namespace) -> int:
    """Run `_track` with the log on standard error; with a JSON log, also log the exception that ends it."""
    from hygrokf.live.tracking import log_to_stderr

    with log_to_stderr(options.log, _LEVELS[activity().loudness]):
        if options.log != "json":
            return _track(options)
        try:
            return _track(options)
        except KeyboardInterrupt:
            LOG.error("interrupted")
            return INTERRUPTED
        except (OSError, HygrokfError) as fault:
            message = system_message(fault) if isinstance(fault, OSError) else str(fault)
            LOG.error("ended by a fault", extra={"fault": message})
            return USER_FAULT
        except Exception as fault:
            LOG.error("ended by an exception", exc_info=True, extra={"fault": str(fault)})
            return 1


def _track(options: argparse.Namespace) -> int:
    """Track until a signal ends the tracker, or with --until-ended until all sources have ended; returns the
    exit status."""
    from hygrokf.live.tracking import track

    config = _demo_config(options) if options.demo else tracker_config(options)

    def tell(event: str, text: str, **fields: object) -> None:
        """Print a message for the user; with a JSON log, write an entry with `fields` instead of the text."""
        if options.log == "json":
            LOG.info(event, extra=fields)
        else:
            activity().note(f"{event}: {text}")

    def on_begin(service: Service, page: str | None) -> None:
        names = ", ".join(list(config.turbines)[:5]) + (" …" if len(config.turbines) > 5 else "")
        count, store = len(config.turbines), config.store
        tell("tracking", f"{names} ({count}); store {store}", turbines=count, store=store)
        if page is not None:
            tell("page", page, url=page)

    service = track(config, with_page=not options.no_page, until_ended=options.until_ended, begun=on_begin)
    count = service.health.deliveries
    tell("done", f"{count} deliveries, all committed", deliveries=count)
    return 0


def _demo_config(options: argparse.Namespace) -> Config:
    """Return a configuration that plays back a synthetic turbine. Raises UserFault beside other turbines or
    sources."""
    from hygrokf.live.config import Config
    from hygrokf.live.defaults import demo_stream, demo_turbines, page_at, store_at

    if options.what or options.source:
        raise UserFault("track --demo brings its own turbine and source; leave the others out")
    expect_directory(options.out)
    store, page = store_at(options.store or f"sqlite:{options.out / 'live.db'}"), page_at(options.page)
    with Progress(16) as progress:
        turbines, record, live_s = demo_turbines(options.out, progress=progress)
    return Config(turbines, (demo_stream(record, live_s, options.speed),), store, page)


TRACK = Verb(
    "track",
    "follow cabinets live: condition, forecast, alarms, on a page",
    _track_arguments,
    _track_with_log,
    service=True,
)


def _doctor_arguments(parser: argparse.ArgumentParser) -> None:
    add_tracker_arguments(parser)
    parser.add_argument(
        "--wait",
        type=reader("a duration such as 10s", _duration),
        default=10.0,
        metavar="TIME",
        help="time to listen to the sources (default 10s)",
    )
    parser.add_argument(
        "--try",
        dest="tried",
        metavar="FILE|TOPIC",
        help="print the readings that [mapping] gives for payloads of a file or topic; check nothing else",
    )
    parser.add_argument("--notify", action="store_true", help="send a test message to every [[notify]]")
    add_library(parser)
    add_json(parser)


def _duration(text: str) -> float:
    """Read a duration such as "10s" in seconds. Raises ValueError."""
    from hygrokf.data.timestamps import duration

    return duration(text)


def _doctor(options: argparse.Namespace) -> int:
    """Check the tracker, or with --try read payloads; the exit status is 1 if there is a fault, or if no
    payload gave a reading."""
    config = tracker_config(options)
    if options.tried is not None:
        from hygrokf.live.doctor import payloads

        trials = payloads.try_payloads(config.streams, options.tried, options.wait)
        show(payloads.trials_data(trials), payloads.trials_text(trials), options.json)
        return 0 if any(trial.used for trial in trials) else FOUND
    from hygrokf.live.doctor.examination import checks_data, checks_text, examine

    tracker_file = next((path for path in options.what if path.suffix == ".toml"), None)
    checks = examine(config, tracker_file, options.wait, not options.no_page, options.notify)
    show(checks_data(checks), checks_text(checks), options.json)
    return FOUND if any(check.level == "fault" for check in checks) else 0


DOCTOR = Verb(
    "doctor",
    "check everything that a tracker needs, change nothing, report what to fix",
    _doctor_arguments,
    _doctor,
)
