"""Results on matplotlib's axes: the picture of a result's first screen.

The methods `plot` of results end here (`hygrokf.data.drawn`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

from hygrokf.climate.study import Study
from hygrokf.discovery.results import Discovered
from hygrokf.errors import HygrokfError
from hygrokf.evaluation.responses import FrequencyResponse, StepResponse
from hygrokf.identification.fit import Fit
from hygrokf.report.blocks import Figure
from hygrokf.report.figures.drawing import WIDTH_IN, NothingToShow, expect_matplotlib, styled
from hygrokf.report.figures.lead import lead_of_climate, lead_of_discovery, lead_of_fit
from hygrokf.report.figures.responses import bode, step_response

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_fit(fit: Fit, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """The readings [°C], [g/m³] and the free run of a fit, see `Fit.plot`."""
    expect_matplotlib()
    if not fit.series:
        raise HygrokfError(
            f"{fit.name}: expected the course of readings and free run, found a fit without series; read it "
            "with read_fit(…, series=True), or call `plot` on what `identify` returns"
        )
    return _plotted(lambda: lead_of_fit(fit.series), fit.name, axes)


def plot_discovery(found: Discovered, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """Readings and simulations where a discovery found errors, see `Discovery.plot`."""
    expect_matplotlib()
    results = found.results
    return _plotted(lambda: lead_of_discovery(results, found.before, found.after), results.name, axes)


def plot_climate(study: Study, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """The year in the cabinet, or regions side by side, see `Study.plot`."""
    expect_matplotlib()
    return _plotted(lambda: lead_of_climate(study), study.name, axes)


def plot_bode(found: FrequencyResponse, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """Magnitude and phase over frequency, see `FrequencyResponse.plot`."""
    expect_matplotlib()
    return _plotted(lambda: Figure("bode", "", "", lambda: bode(found)), "bode", axes)


def plot_step_response(found: StepResponse, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """The answers to steps of the inputs, see `StepResponse.plot`."""
    expect_matplotlib()
    return _plotted(lambda: Figure("step", "", "", lambda: step_response(found)), "step_response", axes)


def _plotted(made: Callable[[], Figure], name: str, axes: Axes | Sequence[Axes] | None) -> tuple[Axes, ...]:
    """Draw on the axes given, in the user's style, or on a new figure of pyplot in that of the reports."""
    try:
        picture = made().draw()
    except NothingToShow as why:
        raise HygrokfError(f"{name}: nothing to plot. {why}") from None
    if axes is None:
        from matplotlib import pyplot

        with styled():
            figure = pyplot.figure(figsize=(WIDTH_IN, picture.height_in))
            return tuple(picture.on_figure(figure))
    given = tuple(axes) if isinstance(axes, Iterable) else (axes,)
    if not 1 <= len(given) <= len(picture.panels):
        raise ValueError(
            f"axes: expected 1 … {len(picture.panels)} axes, one for each panel of the picture, found "
            f"{len(given)}"
        )
    picture.on(given)
    return given
