"""All numbers of the experiments beside the paper's, drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.report.figures.drawing import INK, MEASURED, RULE, SIMULATED_COLOUR, new_figure, styled
from hygrokf.texts.parts import SCORED
from validation.paper.models import CRITERIA, FREE_RUN, LIKELIHOOD
from validation.paper.tables import SPREAD, UNITS, WORDS, published_total, totals

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {LIKELIHOOD: MEASURED, FREE_RUN: "#c98a00"}


def figure_errors(seeds: Sequence[Mapping]) -> Figure:
    """Errors of every experiment and seed by both criteria, the paper's as diamonds."""
    from matplotlib.lines import Line2D

    with styled():
        figure = new_figure(2.75)
        rows = len(SPREAD)
        for column, quantity in enumerate(SCORED):
            axes = figure.add_subplot(1, 2, column + 1)
            for place, (run, period, _, path) in enumerate(SPREAD):
                axes.axhline(place, color=RULE, linewidth=0.5, zorder=0)
                for shift, criterion in zip((-0.17, 0.17), CRITERIA, strict=True):
                    values = totals(seeds, run, period, quantity, criterion)
                    axes.plot(values[1:], np.full(len(values) - 1, place + shift), "o",
                        color=COLOURS[criterion],
                              markersize=2.6, alpha=0.45, markeredgewidth=0)  # fmt: skip
                    axes.plot(values[0], place + shift, "o", color=COLOURS[criterion], markersize=5.5)
                axes.plot(published_total(path, quantity), place, "D", color=SIMULATED_COLOUR, markersize=5.5,
                          markeredgecolor="white", markeredgewidth=0.7, zorder=4)  # fmt: skip
            axes.set_ylim(rows - 0.5, -0.5)
            axes.set_yticks(range(rows), [words for _, _, words, _ in SPREAD] if column == 0 else [""] * rows)
            axes.tick_params(axis="y", length=0)
            axes.grid(False, axis="y")
            axes.set_xlim(left=0.0)
            axes.set_xlabel(f"RMSE of the {('temperature', 'absolute humidity')[column]} [{UNITS[quantity]}]")
        handles = [
            Line2D([], [], marker="D", color=SIMULATED_COLOUR, linestyle="", markersize=5.0,
                label="paper, measured cabinet"),
            *(Line2D([], [], marker="o", color=COLOURS[c], linestyle="", markersize=5.0,
                label=f"here, {WORDS[c]}")
              for c in CRITERIA),
        ]  # fmt: skip
        figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.005, 0.935), ncols=3)
        figure.subplots_adjust(left=0.205, right=0.985, top=0.87, bottom=0.155, wspace=0.1)
    return figure


def figure_constants(seeds: Sequence[Mapping]) -> Figure:
    """Both time constants of every seed, by the air of the identification and by criterion."""
    airs = (("local", "local air"), ("era5", "ERA5's air"))
    with styled():
        figure = new_figure(2.6)
        for column, part in enumerate(("thermal", "hygric")):
            axes = figure.add_subplot(1, 2, column + 1)
            labels = []
            for place, (air, words, criterion) in enumerate((a, w, c) for a, w in airs for c in CRITERIA):
                labels.append(f"{words}\n{WORDS[criterion]}")
                for i, one in enumerate(seeds):
                    entry = one["time_constants"][air][part][criterion]
                    y = place + (0.0 if len(seeds) == 1 else 0.64 * (i / (len(seeds) - 1) - 0.5))
                    upper = entry["upper_h"] or 1e3 * entry["value_h"]
                    axes.plot(
                        [entry["lower_h"], upper], [y, y], color=COLOURS[criterion], linewidth=0.8, alpha=0.75
                    )
                    axes.plot(entry["value_h"], y, "o", color=COLOURS[criterion],
                        markersize=4.5 if i == 0 else 2.6,
                              markeredgewidth=0)  # fmt: skip
            axes.axvline(
                np.mean([one["truth"][f"{part}_h"] for one in seeds]), color=INK, linewidth=0.8, zorder=0
            )
            axes.set_ylim(len(labels) - 0.5, -0.5)
            axes.set_yticks(range(len(labels)), labels if column == 0 else [""] * len(labels))
            axes.tick_params(axis="y", length=0)
            axes.grid(False, axis="y")
            truth = seeds[0]["truth"][f"{part}_h"]
            axes.set_xlim(0.0, 2.2 * truth)
            axes.set_xlabel(f"{part} time constant [h]")
        figure.subplots_adjust(left=0.17, right=0.985, top=0.985, bottom=0.165, wspace=0.1)
    return figure
