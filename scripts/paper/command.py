"""The command `scripts/reproduce_paper`: run the experiments, write tables, figures and the page."""

from __future__ import annotations

import argparse
import io
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from hygrokf.commands.console import UserFault, expect_directory, system_words
from hygrokf.data.files import write_bytes_whole
from hygrokf.data.result_file import result_text
from hygrokf.report.figures.drawing import png, svg
from paper import published
from paper.experiments import Outcome, Plan, experiments, plain
from paper.figures import Drawn, all_figures
from paper.models import Say
from paper.page import page
from paper.sites import DataFault, eave_deviations, expect_files, nacelle_deviation
from paper.tables import SIMULATED_NOTE, all_tables, csv_text, markdown

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
DOCS = ROOT / "docs"
PICTURES = {"errors": "paper_errors", "time_constants": "paper_time_constants"}
"""Figures that the page in docs shows, and the names of their files."""


def reproduce(plan: Plan, folder: Path, say: Say = lambda text: None) -> tuple[dict, Outcome]:
    """All numbers as plain data, and the outcome of the shown seed.  Raises DataFault."""
    expect_files(folder)
    deviation = {
        "nacelle": nacelle_deviation(folder),
        "eaves": eave_deviations(folder),
        "used": asdict(plan.air),
    }
    shown = experiments(plan, folder, plan.seed, say)
    seeds = [plain(shown)]
    once = replace(plan, starts=1)  # the spread needs no search for other optima
    seeds += [plain(experiments(once, folder, seed, say)) for seed in plan.others]
    found = {
        "simulated": SIMULATED_NOTE,
        "plan": asdict(plan),
        "published": {
            "time_constants_h": published.TIME_CONSTANTS_H,
            "periods": published.PERIODS,
            "whole": published.WHOLE,
            "sister": published.SISTER,
        },
        "deviation": deviation,
        "shown": seeds[0],
        "seeds": seeds,
    }
    return found, shown


def files(found: Mapping, figures: Sequence[Drawn]) -> dict[str, bytes]:
    """Everything that is written: path below the folder -> content."""
    made = {"paper.json": result_text(found).encode()}
    made |= {f"{name}.csv": csv_text(table).encode() for name, table in all_tables(found).items()}
    for one in figures:
        made[f"{one.name}.png"] = png(one.draw())
        made[f"{one.name}.svg"] = svg(one.draw(), one.name.replace("_", "-")).encode()
    made["report.html"] = page(found, figures).encode()
    return made


# -- docs ----------------------------------------------------------------------------------------------------
def filled(text: str, found: Mapping) -> str:
    """A page of docs with the tables between its marks made again."""
    for name, table in all_tables(found).items():
        begin, end = f"<!-- made by scripts/reproduce_paper: {name} -->", "<!-- end -->"
        head, there, rest = text.partition(begin)
        if not there:
            continue
        if end not in rest:
            raise UserFault(
                f"docs/validation/reproduce_paper.md: expected {end} after {begin}, found none; put it there"
            )
        text = f"{head}{begin}\n\n{markdown(table)}\n\n{rest[rest.index(end) :]}"
    return text


def write_docs(found: Mapping, figures: Sequence[Drawn]) -> None:
    """The tables and the pictures of docs/validation/reproduce_paper.md."""
    from PIL import Image

    path = DOCS / "validation" / "reproduce_paper.md"
    write_bytes_whole(path, filled(path.read_text(encoding="utf-8"), found).encode())
    for one in figures:
        if one.name not in PICTURES:
            continue
        small, image = io.BytesIO(), Image.open(io.BytesIO(png(one.draw(), dpi=110)))
        image.convert("RGB").quantize(64).save(small, "PNG", optimize=True)
        write_bytes_whole(DOCS / "pictures" / f"{PICTURES[one.name]}.png", small.getvalue())


# -- the command ---------------------------------------------------------------------------------------------
def parser() -> argparse.ArgumentParser:
    default = Plan()
    made = argparse.ArgumentParser(
        prog="scripts/reproduce_paper",
        description="The paper's three experiments on a simulated cabinet under measured drivers, beside the "
        "paper's numbers.",
    )
    made.add_argument("data", nargs="?", type=Path, default=DATA,
        help="folder with the measured drivers (default: ../shared/data)")  # fmt: skip
    made.add_argument("--out", type=Path, default=ROOT / "build" / "paper", metavar="DIR",
                      help="folder for paper.json, CSV, PNG, SVG and report.html (default: "
                           "build/paper)")  # fmt: skip
    made.add_argument(
        "--seed", type=_seed, default=default.seed, help=f"of what is shown (default: {default.seed})"
    )
    made.add_argument("--others", type=_seeds, default=default.others, metavar="FIRST:LAST",
                      help="seeds of the spread, LAST excluded; 0:0 for none (default: "
                           f"{default.others[0]}:{default.others[-1] + 1})")  # fmt: skip
    made.add_argument("--days", type=_days, default=default.days, metavar="N",
                      help=f"length of the records (default: {default.days:g}); the last 15 %% "
                           "validate")  # fmt: skip
    made.add_argument("--quick", action="store_true", help="one start a fit: a smoke test")
    made.add_argument(
        "--docs", action="store_true", help="also make the tables of docs/validation/reproduce_paper.md again"
    )
    return made


def _seed(text: str) -> int:
    if not re.fullmatch(r"\d{1,9}", text):
        raise argparse.ArgumentTypeError(f"expected a whole number from 0 on, found {text!r}")
    return int(text)


def _seeds(text: str) -> tuple[int, ...]:
    found = re.fullmatch(r"(\d{1,9}):(\d{1,9})", text)
    if not found:
        raise argparse.ArgumentTypeError(f"expected FIRST:LAST, such as 2024:2034, found {text!r}")
    return tuple(range(int(found[1]), int(found[2])))


def _days(text: str) -> float:
    try:
        days = float(text)
    except ValueError:
        days = 0.0
    if not 20.0 <= days <= 500.0:
        raise argparse.ArgumentTypeError(f"expected a number of days from 20 to 500, found {text!r}")
    return days


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, write, and say where; 2 for a user's mistake."""
    options = parser().parse_args(arguments)
    plan = Plan(seed=options.seed, others=options.others, days=options.days, until_day=0.85 * options.days,
                starts=1 if options.quick else Plan().starts)  # fmt: skip
    try:
        expect_directory(options.out)
        found, shown = reproduce(plan, options.data, lambda text: print(text, file=sys.stderr, flush=True))
        figures = all_figures(found, shown)
        made = files(found, figures)
        options.out.mkdir(parents=True, exist_ok=True)
        for name, content in made.items():
            write_bytes_whole(options.out / name, content)
        if options.docs:
            write_docs(found, figures)
    except (DataFault, UserFault) as fault:
        print(f"scripts/reproduce_paper: {fault}", file=sys.stderr)
        return 2
    except OSError as fault:
        print(f"scripts/reproduce_paper: {system_words(fault)}", file=sys.stderr)
        return 2
    print("\n\n".join(f"## {table.heading}\n\n{markdown(table)}" for table in all_tables(found).values()))
    print(f"\n{options.out / 'report.html'}")
    return 0
