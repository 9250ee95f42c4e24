"""The reliability diagram: how often what was forecast with some probability came true."""

from __future__ import annotations

from hygrokf.report.figures.drawing import INK, MEASURED, QUIET, new_figure, png, styled
from trials.forecast import EVENTS, Forecasts, reliability

SHOWN = ("RH > 50 %", "RH > 60 %", "RH > 70 %", "RH > 80 %")
FEWEST = 20
"""Forecasts below which a share is not drawn."""


def reliability_png(f: Forecasts) -> bytes:
    """The picture as PNG: a panel an event, with the numbers of forecasts below."""
    with styled():
        figure = new_figure(3.1)
        figure.subplots_adjust(left=0.085, right=0.98, top=0.92, bottom=0.15, wspace=0.16, hspace=0.1)
        panels = figure.subplots(2, len(SHOWN), sharex=True, sharey="row", height_ratios=(3.0, 1.0))
        for name, top, below in zip(SHOWN, *panels, strict=True):
            column = EVENTS[name]
            rows = reliability(f.columns[column], f.happened(column), f.seed)
            below.bar([r["from"] + 0.05 for r in rows], [r["rate"].n for r in rows], width=0.08, color=QUIET)
            rows = [r for r in rows if r["rate"].n >= FEWEST]
            said = [r["said"] for r in rows]
            came = [r["rate"].share for r in rows]
            beyond = [[c - r["low"] for c, r in zip(came, rows, strict=True)],
                      [r["high"] - c for c, r in zip(came, rows, strict=True)]]  # fmt: skip
            top.plot([0, 1], [0, 1], color=INK, linewidth=0.6)
            top.errorbar(said, came, yerr=beyond, color=MEASURED, marker="o", markersize=3.2,
                         linestyle="none", elinewidth=1.0)  # fmt: skip
            top.set(title=name, xlim=(0, 1), ylim=(0, 1))
            top.set_yticks((0, 0.25, 0.5, 0.75, 1), ("0", "25", "50", "75", "100"))
            below.set_yscale("log")
            below.set_yticks((1, 100, 10000), ("1", "100", "10 000"))
            below.minorticks_off()
            below.set_ylim(1, 3e4)
            below.set_xticks((0, 0.5, 1), ("0", "50", "100"))
        panels[0, 0].set_ylabel("came true [%]")
        panels[1, 0].set_ylabel("number")
        figure.supxlabel("stated probability [%]", x=0.53, y=0.01, fontsize=7.5)
        figure.align_ylabels(panels[:, 0])
        return png(figure, dpi=170)
