"""Commands on the store of a live tracker: `hygrokf export` writes it to files, `hygrokf restore` replaces it
by a backup, `hygrokf store` filters its readings again while no tracker runs."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from hygrokf.commands.console import UserFault, expect_directory, show
from hygrokf.commands.verb import Verb, add_json, add_library, add_out, reader


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    moment = reader("a time such as 2026-01-31 or 2026-01-31T12:00:00Z", _moment)
    parser.add_argument(
        "--store", required=True, metavar="URL", help="sqlite:PATH or postgresql://USER@HOST/NAME"
    )
    add_out(parser, "directory for the files, one per table")
    parser.add_argument(
        "--format", choices=("csv", "parquet"), default="csv", help="format of the files (default csv)"
    )
    parser.add_argument("--turbine", metavar="NAME", help="only this turbine (default: all)")
    parser.add_argument(
        "--since", type=moment, default=None, metavar="ISO", help="from this time on (UTC if it has no zone)"
    )
    parser.add_argument("--until", type=moment, default=None, metavar="ISO", help="before this time")
    add_json(parser)


def _moment(text: str) -> float:
    """Read a time in ISO 8601 (UTC if it names no zone) as seconds since 1970. Raises ValueError."""
    from datetime import UTC, datetime

    moment = datetime.fromisoformat(text)
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return moment.timestamp()


def _export(options: argparse.Namespace) -> int:
    """Write the tables of a store to CSV or Parquet files, and show the numbers of rows."""
    from hygrokf.live.storage.export import export
    from hygrokf.live.storage.store import open_store

    expect_directory(options.out)
    period = {name: at for name in ("since", "until") if (at := getattr(options, name)) is not None}
    store = open_store(options.store, read_only=True)
    try:
        counts = export(store, options.out, options.format, options.turbine, **period)
    finally:
        store.close()
    text = "\n".join(
        f"{count} rows written: {options.out / name}.{options.format}" for name, count in counts.items()
    )
    show({"rows": counts}, text, options.json)
    return 0


EXPORT = Verb(
    "export", "export the data of a live tracker to CSV or Parquet files", _export_arguments, _export
)


def _restore_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "copy",
        type=Path,
        metavar="COPY",
        help="backup file made by VACUUM INTO (SQLite) or pg_dump (PostgreSQL)",
    )
    parser.add_argument(
        "--store",
        required=True,
        metavar="URL",
        help="sqlite:PATH to replace, or postgresql://USER@HOST/NAME, for which the commands are printed",
    )
    add_json(parser)


def _restore(options: argparse.Namespace) -> int:
    """Replace an SQLite store by a backup; for PostgreSQL, print the commands that do so."""
    from hygrokf.live.defaults import store_at
    from hygrokf.live.storage.postgres import postgres_commands
    from hygrokf.live.storage.schema import VERSION
    from hygrokf.live.storage.sqlite import path_of, restore_sqlite
    from hygrokf.texts.wording import stamp_text

    url = store_at(options.store)
    if not url.startswith("sqlite:"):
        if not options.copy.is_file():
            raise UserFault(f"{options.copy}: there is no such file; name the copy of a store")
        commands = postgres_commands(options.copy, url)
        comment = "# end every tracker of this database, then run as a role that may create databases:"
        show({"commands": commands}, "\n".join([comment, *commands]), options.json)
        return 0
    restored = restore_sqlite(options.copy, path_of(url))
    newest = "none" if restored.newest_s is None else stamp_text(restored.newest_s)
    lines = [
        f"restored: {restored.store} from {options.copy} ({restored.turbines} turbines, "
        f"newest reading {newest})",
        *(f"kept: {path}" for path in restored.kept),
        "start the tracker: its sources go on from the places that the copy holds",
    ]
    result = {
        "store": str(restored.store),
        "version": VERSION,
        "turbines": restored.turbines,
        "newest": restored.newest_s,
        "kept": [str(path) for path in restored.kept],
    }
    show(result, "\n".join(lines), options.json)
    return 0


RESTORE = Verb("restore", "put a copy in the place of a live tracker's store", _restore_arguments, _restore)


def _store_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "action",
        choices=("refilter",),
        help="refilter: filter the readings anew, with those that came too late or were corrected since",
    )
    parser.add_argument("file", type=Path, metavar="TRACK.toml", help="the tracker's file")
    parser.add_argument("--turbine", metavar="NAME", help="only this turbine (default: all)")
    add_json(parser)
    add_library(parser)


def _store(options: argparse.Namespace) -> int:
    """Filter the stored readings of a tracker again, and show what changed."""
    from hygrokf.commands.opening import library_of
    from hygrokf.live.config import read_config
    from hygrokf.live.refilter import refilter
    from hygrokf.live.storage.store import open_store

    config = read_config(options.file, library_of(options.library))
    turbines = {name: turbine for name, turbine in config.turbines.items() if options.turbine in (None, name)}
    if not turbines:
        names = ", ".join(config.turbines)
        raise UserFault(f"{options.file}: expected a turbine of {names}, found {options.turbine!r}")
    open_store(config.store, read_only=True).close()  # raises StoreFault if the store is missing
    store = open_store(config.store)
    try:
        results = refilter(store, config.turbines, turbines)
    finally:
        store.close()
    lines = []
    for result in results:
        lines.append(f"{result.turbine}: {result.late} readings that had come too late are used")
        lines += result.differences
    show({"turbines": [asdict(result) for result in results]}, "\n".join(lines), options.json)
    return 0


STORE = Verb("store", "filter the stored readings of a live tracker anew", _store_arguments, _store)
