"""`hygrokf store`: what is done with the store of a live tracker that does not run."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from hygrokf.commands.console import UserFault, show
from hygrokf.commands.verb import Verb, add_json, add_library


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "action",
        choices=("refilter",),
        help="refilter: filter the readings anew, with those that came too late or were corrected since",
    )
    parser.add_argument("file", type=Path, metavar="TRACK.toml", help="the tracker's file")
    parser.add_argument("--turbine", metavar="NAME", help="only this turbine (default: all)")
    add_json(parser)
    add_library(parser)


def _run(options: argparse.Namespace) -> int:
    from hygrokf.commands.inputs import load_causes
    from hygrokf.live.config import read_config
    from hygrokf.live.refilter import refilter
    from hygrokf.live.storage.store import open_store

    load_causes(options.library)
    config = read_config(options.file)
    turbines = {n: one for n, one in config.turbines.items() if options.turbine in (None, n)}
    if not turbines:
        names = ", ".join(config.turbines)
        raise UserFault(f"{options.file}: expected a turbine of {names}, found {options.turbine!r}")
    open_store(config.store, read_only=True).close()  # it must be there
    store = open_store(config.store)
    try:
        found = refilter(store, config.turbines, turbines)
    finally:
        store.close()
    lines = []
    for one in found:
        lines += [f"{one.turbine}: {one.late} readings that had come too late are used", *one.differences]
    show({"turbines": [asdict(one) for one in found]}, "\n".join(lines), options.json)
    return 0


VERB = Verb("store", "filter the stored readings of a live tracker anew", _arguments, _run)
