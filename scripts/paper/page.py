"""`report.html` of the experiments."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.wording import fixed
from hygrokf.report.blocks import Banner, Block, Figure, Heading, Items, Page, Prose, section
from hygrokf.report.page import page_html
from hygrokf.version import __version__
from paper.figures import Drawn
from paper.models import CRITERIA
from paper.tables import SIMULATED_NOTE, SPREAD, UNITS, WORDS, all_tables, published_total, totals

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

KIND = "Field-measurement based hygrothermal modelling of the converter-cabinet climate · reproduction"
TITLE = "The paper’s three experiments, with a simulated cabinet"


@dataclass(frozen=True)
class Picture:
    """A picture as the page's block expects it: drawn once, whenever it is asked for."""

    figure: Callable[[], Drawing]


def page(found: Mapping, figures: Sequence[Drawn]) -> str:
    """The whole page as HTML text."""
    return page_html(blocks(found, figures))


def blocks(found: Mapping, figures: Sequence[Drawn]) -> Page:
    """The experiments beside the paper's numbers: the errors first."""
    drawn = {
        one.name: Figure(one.name.replace("_", "-"), one.heading, one.caption, partial(Picture, one.draw))
        for one in figures
    }
    tables = all_tables(found)

    def pictures(start: str) -> list[Block]:
        return [picture for name, picture in drawn.items() if name.startswith(start)]

    plan = found["plan"]
    about = (
        f"Identified on {plan['until_day']:g} of {plan['days']:g} days from {plan['start'][0]} on (UK); the "
        f"sister from {plan['start'][1]} on (France). Seed {plan['seed']}, {len(found['seeds'])} in all."
    )
    body = (
        *section("Beside the paper", _verdicts(found), tables["seeds"]),
        *section("Experiment 1: identification and validation", tables["periods"], tables["time_constants"],
                 drawn["time_constants"], *pictures("local_")),
        *section("Experiment 2: ERA5’s air instead of the local air", tables["table_3"], *pictures("era5_")),
        *section("Experiment 3: the sister elsewhere", tables["sister"], *pictures("sister_")),
        Heading("What is measured and what is simulated"), *(Prose(text) for text in ORIGINS),
        tables["local_air"],
    )  # fmt: skip
    lead = (Banner("SIMULATED CABINET", SIMULATED_NOTE), drawn["errors"])
    return Page(KIND, TITLE, (about,), lead, body, (Prose(f"Page written by hygrokf {__version__}."),))


def _verdicts(found: Mapping) -> Items | None:
    """Where the paper's number lies among those of the seeds; nothing where there is one seed alone."""
    if len(found["seeds"]) == 1:
        return None
    items = []
    for quantity in SCORED:
        for run, period, words, path in SPREAD:
            stated = published_total(found, path, quantity)
            said = "; ".join(
                f"{_place(stated, totals(found, run, period, quantity, c))} with the {WORDS[c]}"
                for c in CRITERIA
            )
            items.append(f"{words}: the paper’s {fixed(stated)} {UNITS[quantity]} is {said}.")
    return Items(tuple(items))


def _place(stated: float, values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    span = f"({fixed(low)} … {fixed(high)})"
    if round(low, 2) <= stated <= round(high, 2):
        return f"among the {len(values)} seeds {span}"
    return f"{'below' if stated < low else 'above'} all {len(values)} seeds {span}"


ORIGINS = (
    "Measured: the power of both turbines (Kelmarsh: hourly means, with a made-up course within the hour; La "
    "Haute Borne: ten-minute means), and ERA5’s air at both sites, a reanalysis of measured weather.",
    "Simulated: both cabinets with their loggers, and the local air. Put in, so no evidence where they agree "
    "with the paper: the time constants, which are the paper’s; the coloured disturbances, sized to leave "
    "errors like the paper’s (1.2 to 1.75 K, 0.34 to 0.45 g/m³ of the free run); the deviation of the local "
    "air from ERA5’s, which makes most of what ERA5’s air adds. The size and time of that deviation come "
    "from two other measurements (table below) and were not fitted to the paper; that sisters differ by 10 % "
    "is assumed.",
    "No six-day standstill and no pre-heating: the power is as it was measured. The paper’s moisture peak "
    "after its standstill is not part of these experiments.",
    "The default seeds, 2023 for what is shown and 2024 to 2033 beside it, were fixed before they were run.",
    "The humidity of the French site is not in the files: ERA5’s dew-point depression at Kelmarsh, at the "
    "same hour of the same date four years later, is put on the French temperature.",
)
