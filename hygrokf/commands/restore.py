"""`hygrokf restore`: a copy in the place of a live tracker's store."""

from __future__ import annotations

import argparse
from pathlib import Path

from hygrokf.commands.console import UserFault, show
from hygrokf.commands.verb import Verb, add_json


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("copy", type=Path, metavar="COPY", help="the copy: of VACUUM INTO, or of pg_dump")
    parser.add_argument(
        "--store",
        required=True,
        metavar="URL",
        help="sqlite:PATH, which is replaced; postgresql://USER@HOST/NAME, of which the commands are shown",
    )
    add_json(parser)


def _run(options: argparse.Namespace) -> int:
    from hygrokf.data.timestamps import stamp_text
    from hygrokf.live.defaults import store_at
    from hygrokf.live.storage.restore import postgres_commands, restore_sqlite
    from hygrokf.live.storage.schema import VERSION
    from hygrokf.live.storage.sqlite import path_of

    url = store_at(options.store)
    if not url.startswith("sqlite:"):
        if not options.copy.is_file():
            raise UserFault(f"{options.copy}: there is no such file; name the copy of a store")
        commands = postgres_commands(options.copy, url)
        head = "# end every tracker of this database, then run as a role that may create databases:"
        show({"commands": commands}, "\n".join([head, *commands]), options.json)
        return 0
    found = restore_sqlite(options.copy, path_of(url))
    newest = "none" if found.newest_s is None else stamp_text(found.newest_s)
    lines = [
        f"restored: {found.store} from {options.copy} ({found.turbines} turbines, "
        f"newest reading {newest})",
        *(f"kept: {path}" for path in found.kept),
        "start the tracker: its sources go on from the places that the copy holds",
    ]
    data = {
        "store": str(found.store),
        "version": VERSION,
        "turbines": found.turbines,
        "newest": found.newest_s,
        "kept": [str(path) for path in found.kept],
    }
    show(data, "\n".join(lines), options.json)
    return 0


VERB = Verb("restore", "put a copy in the place of a live tracker's store", _arguments, _run)
