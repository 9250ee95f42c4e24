"""`hygrokf export`: the store of a live tracker as files."""

from __future__ import annotations

import argparse

from hygrokf.commands.console import expect_directory, show
from hygrokf.commands.verb import Verb, add_json, add_out


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--store", required=True, metavar="URL", help="sqlite:PATH or postgresql://USER@HOST/NAME"
    )
    add_out(parser, "directory for the files, one per table")
    parser.add_argument(
        "--format", choices=("csv", "parquet"), default="csv", help="format of the files (default csv)"
    )
    parser.add_argument("--turbine", metavar="NAME", help="only this turbine (default: all)")
    parser.add_argument(
        "--since",
        type=_moment,
        default=None,
        metavar="ISO",
        help="from this time on (UTC if it has no zone)",
    )
    parser.add_argument("--until", type=_moment, default=None, metavar="ISO", help="before this time")
    add_json(parser)


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


def _run(options: argparse.Namespace) -> int:
    from hygrokf.live.storage.export import export
    from hygrokf.live.storage.store import open_store

    expect_directory(options.out)
    times = {name: at for name in ("since", "until") if (at := getattr(options, name)) is not None}
    store = open_store(options.store, read_only=True)
    try:
        counts = export(store, options.out, options.format, options.turbine, **times)
    finally:
        store.close()
    text = "\n".join(f"{n} rows written: {options.out / name}.{options.format}" for name, n in counts.items())
    show({"rows": counts}, text, options.json)
    return 0


VERB = Verb("export", "export the data of a live tracker to CSV or Parquet files", _arguments, _run)
