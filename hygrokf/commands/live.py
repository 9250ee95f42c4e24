"""`hygrokf track`, `doctor` and `export` at the terminal: their arguments, and what they tell while they run."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import Any

from hygrokf.commands.console import Progress, UserFault, expect_directory


def track_arguments(parser: argparse.ArgumentParser) -> None:
    """What is tracked, for how long, and the demo."""
    _tracked(parser)
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


def doctor_arguments(parser: argparse.ArgumentParser) -> None:
    """What would be tracked, and how long its sources are listened to."""
    _tracked(parser)
    parser.add_argument(
        "--wait", type=_duration, default=10.0, metavar="TIME", help="listen to sources so long (default 10s)"
    )


def export_arguments(parser: argparse.ArgumentParser) -> None:
    """The store, and what of it is written where."""
    parser.add_argument(
        "--store", required=True, metavar="URL", help="sqlite:PATH or postgresql://USER@HOST/NAME"
    )
    parser.add_argument("--out", type=Path, required=True, help="directory for the files, one a table")
    parser.add_argument(
        "--format", choices=("csv", "parquet"), default="csv", help="of the files (default csv)"
    )
    parser.add_argument("--turbine", metavar="NAME", help="one turbine alone (default all)")
    parser.add_argument(
        "--since",
        type=_moment,
        default=None,
        metavar="ISO",
        help="from this time on, in UTC where it has no zone",
    )
    parser.add_argument("--until", type=_moment, default=None, metavar="ISO", help="before this time")


def _tracked(parser: argparse.ArgumentParser) -> None:
    """What is tracked, from where, into which store and on which page."""
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
        help="file:PATH or stdin, where no file says so",
    )
    parser.add_argument(
        "--store", metavar="URL", help="sqlite:PATH (default sqlite:live.db) or postgresql://…"
    )
    parser.add_argument("--page", metavar="HOST:PORT", help="address of the page (default 127.0.0.1:8080)")
    parser.add_argument("--no-page", action="store_true", help="no page: the store and alarms alone")


def _duration(text: str) -> float:
    """A duration such as 10s [s]."""
    from hygrokf.data.timestamps import duration

    try:
        return duration(text)
    except ValueError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


def _factor(text: str) -> float:
    """A number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"expected a number above 0 and below 1e6, found {text!r}")
    return value


def _moment(text: str) -> float:
    """An ISO 8601 time as seconds since 1970; UTC where it names no zone."""
    from datetime import UTC, datetime

    try:
        found = datetime.fromisoformat(text)
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(
            f"expected a time such as 2026-01-31 or 2026-01-31T12:00:00Z, found {text!r}"
        ) from None


def run_track(options: argparse.Namespace) -> None:
    """Track until it is told to end.  Raises UserFault and what the parts of a tracker raise."""
    from hygrokf.live.logs import log_to_stderr
    from hygrokf.live.tracking import track

    config = _demo_config(options) if options.demo else _track_config(options)
    log_to_stderr(options.log)

    def tell(text: str, **beside: object) -> None:
        """To the one who started it; among logs as JSON as one of them."""
        if options.log == "json":
            logging.getLogger("hygrokf.track").info(text.partition(":")[0], extra=beside)
        else:
            print(text, file=sys.stderr, flush=True)

    def begun(service: Any, page: str | None) -> None:
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


def _track_config(options: argparse.Namespace) -> Any:
    """What the file or the arguments say; arguments win over the file."""
    from dataclasses import replace

    from hygrokf.live.config import read_config
    from hygrokf.live.defaults import page_at, store_at, usual_config

    files = [path for path in options.what if path.suffix == ".toml"]
    if not options.what:
        raise UserFault("expected a TRACK.toml or FIT.json files (or track --demo); found none of them")
    if files and (len(options.what) > 1 or options.source):
        raise UserFault("a TRACK.toml names turbines and sources itself; give it alone")
    store = store_at(options.store or "sqlite:live.db")
    if not files:
        return usual_config(options.what, options.source, store, page_at(options.page))
    config = read_config(files[0])
    config = config if options.store is None else replace(config, store=store)
    return config if options.page is None else replace(config, page=page_at(options.page))


def _demo_config(options: argparse.Namespace) -> Any:
    from hygrokf.live.config import Config
    from hygrokf.live.defaults import page_at, store_at
    from hygrokf.live.demo import demo_stream, demo_turbines

    if options.what or options.source:
        raise UserFault("track --demo brings its own turbine and source; leave the others out")
    expect_directory(options.out)
    store, page = store_at(options.store or f"sqlite:{options.out / 'live.db'}"), page_at(options.page)
    progress = Progress(16)
    try:
        turbines, record, live_s = demo_turbines(options.out, progress=progress)
    except BaseException:
        progress.abandon()
        raise
    progress.close()
    return Config(turbines, (demo_stream(record, live_s, options.speed),), store, page)


def run_doctor(options: argparse.Namespace) -> tuple[Any, str, int]:
    """What was found, as data and as text, and the exit status: 1 where something is at fault.  Raises as `run_track`."""
    from hygrokf.live.doctor.examination import as_data, as_text, examine

    config = _track_config(options)
    file = next((path for path in options.what if path.suffix == ".toml"), None)
    found = examine(config, file, options.wait, with_page=not options.no_page)
    return as_data(found), as_text(found), int(any(one.level == "fault" for one in found))


def run_export(options: argparse.Namespace) -> tuple[Any, str]:
    """Write the files; the rows of each, as data and as text.  Raises UserFault, StoreFault, ExportFault."""
    from hygrokf.live.storage.export import export
    from hygrokf.live.storage.store import open_store

    expect_directory(options.out)
    times = {name: at for name in ("since", "until") if (at := getattr(options, name)) is not None}
    store = open_store(options.store, read_only=True)
    try:
        counts = export(store, options.out, options.format, options.turbine, **times)
    finally:
        store.close()
    said = "\n".join(f"{n} rows written: {options.out / name}.{options.format}" for name, n in counts.items())
    return {"rows": counts}, said
