"""Results draw themselves, and do not know how: the report's drawing is looked up by name at its first use.

The report stands on a higher floor than all results; none of them imports it, colours or matplotlib.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PLOTS = "hygrokf.report.plots"
T = TypeVar("T")


def drawn(by: str, result: T, axes: Axes | Sequence[Axes] | None) -> tuple[Axes, ...]:
    """A result drawn on axes by the function `by` of `hygrokf.report.plots`."""
    draw: Callable[[T, Axes | Sequence[Axes] | None], tuple[Axes, ...]] = getattr(import_module(PLOTS), by)
    return draw(result, axes)
