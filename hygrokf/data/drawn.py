"""Results draw themselves, and do not know how: the report's drawing is imported at its first use.

The report stands on a higher floor than all results; none of them imports it, colours or matplotlib.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PLOTS = "hygrokf.report.plots"


def drawn(result: object, axes: Axes | Sequence[Axes] | None) -> tuple[Axes, ...]:
    """A result drawn on axes by `hygrokf.report.plots`."""
    done: tuple[Axes, ...] = import_module(PLOTS).plotted(result, axes)
    return done
