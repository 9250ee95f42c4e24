"""The command line of `scripts/pictures`."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from illustrations.drafts import drafts
from illustrations.house_plan import house_plan
from illustrations.live_page import live_page
from illustrations.measured import attic, climate, uk
from illustrations.synthetic import compare, demo, fleet, transfer
from illustrations.theory import clock, noise

SYNTHETIC = {
    "fleet": fleet,
    "demo": demo,
    "noise": noise,
    "clock": clock,
    "compare": compare,
    "transfer": transfer,
    "live_page": live_page,
    "house_plan": house_plan,
}


WITH_DATA = {"attic": attic, "uk": uk, "climate": climate, "drafts": drafts}


def main(description: str | None) -> None:
    """Draw the wanted pictures and fill the tables; `description` stands in the help."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "data", nargs="?", type=Path, help="directory with the measured data; they are not shipped"
    )
    parser.add_argument(
        "--only", nargs="+", choices=(*SYNTHETIC, *WITH_DATA), help="some parts instead of all"
    )
    options = parser.parse_args()
    wanted = options.only or [*SYNTHETIC, *(WITH_DATA if options.data else ())]
    if set(wanted) & set(WITH_DATA) and options.data is None:
        parser.error("attic, uk, climate and drafts need the data directory")
    with tempfile.TemporaryDirectory() as directory:
        for name in wanted:
            if name in SYNTHETIC:
                SYNTHETIC[name](Path(directory))
            else:
                WITH_DATA[name](Path(directory), options.data)
