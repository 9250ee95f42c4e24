"""The turbines, sources, store and page that `hygrokf track` and `hygrokf doctor` name."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.commands.console import UserFault

if TYPE_CHECKING:
    from hygrokf.live.config import Config


def add_tracked(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for turbines, sources, store and page."""
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


def tracked_config(options: argparse.Namespace) -> Config:
    """The configuration from the file or the arguments; arguments override the file."""
    from dataclasses import replace

    from hygrokf.live.config import read_config
    from hygrokf.live.defaults import default_config, page_at, store_at

    files = [path for path in options.what if path.suffix == ".toml"]
    if not options.what:
        raise UserFault("expected a TRACK.toml or FIT.json files (or track --demo); found none of them")
    if files and (len(options.what) > 1 or options.source):
        raise UserFault("a TRACK.toml names turbines and sources itself; give it alone")
    store = store_at(options.store or "sqlite:live.db")
    if not files:
        return default_config(options.what, options.source, store, page_at(options.page))
    config = read_config(files[0])
    config = config if options.store is None else replace(config, store=store)
    return config if options.page is None else replace(config, page=page_at(options.page))
