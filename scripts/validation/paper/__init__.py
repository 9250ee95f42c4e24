"""The paper's three experiments on simulated cabinets under measured drivers, beside the paper's numbers:
docs/validation/reproduce_paper.md.  About two minutes on one core."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from validation.frame import DATA, Claim
from validation.paper.experiments import Plan, plain, repeated
from validation.paper.sites import eave_deviations, expect_files, nacelle_deviation
from validation.paper.tables import spread_note, spread_rows, table

SHOWN = 2023
"""Seed of the results that are shown; the spread of the others needs no search for other optima."""


def one(variant: str, seed: int, *, data: str = "", days: float = 200.0, starts: int = 0) -> dict:
    """The three experiments with one seed; `data`: folder of the measured drivers; `starts` of every fit, 0:
    four for the seed that is shown, else one."""
    folder = Path(data or DATA)
    expect_files(folder)
    deviation = {"nacelle": nacelle_deviation(folder), "eaves": eave_deviations(folder)}
    plan = Plan(days=days, until_day=0.85 * days, starts=starts or (4 if seed == SHOWN else 1))
    return {**plain(repeated(plan, folder, seed)), "deviation": deviation}


def docs(lines: Sequence[Mapping]) -> None:
    """The table and the pictures of docs/validation/reproduce_paper.md."""
    from illustrations.pages import save, write_table

    from validation.paper.figures import figure_constants, figure_errors

    seeds = sorted(lines, key=lambda line: line["seed"])
    note = f"*{spread_note(seeds)}*"
    write_table("reproduce_paper.md", "seeds", spread_rows(seeds), note, program="scripts/validate paper")
    simulated = "simulated cabinets under measured drivers"
    save(figure_errors(seeds), "paper_errors", f"here: {simulated}; paper: a measured one")
    save(figure_constants(seeds), "paper_time_constants", simulated)


CLAIM = Claim("paper", {"cabinets": range(2023, 2034)}, one, table, docs=docs)
