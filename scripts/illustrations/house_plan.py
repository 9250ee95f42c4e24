"""The floor plan of docs/project/house.md."""

from __future__ import annotations

from pathlib import Path

from illustrations.pages import save, write_table


def house_plan(directory: Path) -> None:
    """The folders of the package on their floors, and what imports what, as it is written in the code."""
    from builders import house

    from hygrokf.report.figures.drawing import (
        INK,
        MEASURED,
        QUIET,
        SHADE,
        SIMULATED_COLOUR,
        new_figure,
        styled,
    )

    write_table("house.md", "house plan", house.table())
    wings = house.FLOORS.index(next(row for row in house.FLOORS if "discovery" in row))
    with styled():
        figure = new_figure(4.6)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(0.0, 1.0), ylim=(-0.15, len(house.FLOORS) + 0.1))
        axes.axis("off")
        place = {}
        for floor, row in enumerate(house.FLOORS):
            names = row.split()
            for number, name in enumerate(names):
                place[name] = ((number + 0.5) / len(names) * 0.92 + 0.04, floor + 0.5)
        for name, (x, y) in place.items():
            for other in house.neighbours(name):
                to_x, to_y = place[other]
                near = y - to_y < 1.5
                axes.plot(
                    (x, to_x),
                    (y - 0.26, to_y + 0.26),
                    color=MEASURED if near else QUIET,
                    alpha=0.9 if near else 0.22,
                    lw=0.9 if near else 0.6,
                    zorder=1,
                )
        for name, (x, y) in place.items():
            count = sum(house.folder(module) == name for module in house.MODULES)
            box = {
                "boxstyle": "round,pad=0.45",
                "facecolor": SHADE,
                "edgecolor": SIMULATED_COLOUR if y - 0.5 == wings else INK,
                "linewidth": 0.8,
            }
            axes.text(
                x,
                y,
                f"{name}  {count}",
                ha="center",
                va="center",
                fontsize=8.0,
                color=INK,
                bbox=box,
                zorder=2,
            )
    save(figure, "house")
