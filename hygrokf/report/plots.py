"""Results on matplotlib's axes: the picture of a result's first screen.

The methods `plot` of results end here (`hygrokf.data.drawn`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hygrokf.climate.study import Study
from hygrokf.discovery.results import Discovered
from hygrokf.errors import HygrokfError
from hygrokf.evaluation.responses import FrequencyResponse, StepResponse
from hygrokf.identification.fit import Fit
from hygrokf.report.figures.drawing import WIDTH_IN, NothingToShow, expect_matplotlib, styled
from hygrokf.report.figures.lead import lead_of_climate, lead_of_discovery, lead_of_fit
from hygrokf.report.figures.panels import Picture
from hygrokf.report.figures.responses import bode, step_response

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PICTURES: Mapping[type, Callable[[Any], Picture]] = {
    Fit: lambda fit: _fit(fit),
    Discovered: lambda found: lead_of_discovery(found.results, found.before, found.after).draw(),
    Study: lambda study: lead_of_climate(study).draw(),
    FrequencyResponse: bode,
    StepResponse: step_response,
}


def _fit(fit: Fit) -> Picture:
    if fit.series:
        return lead_of_fit(fit.series).draw()
    raise NothingToShow(
        "Expected the course of readings and free run, found a fit without series; read it with "
        "read_fit(…, series=True), or call `plot` on what `identify` returns."
    )


def plotted(result: object, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """Draw a result on the axes given, in the user's style, or on a new figure of pyplot in that of the
    reports."""
    expect_matplotlib()
    try:
        picture = next(draw for kind, draw in PICTURES.items() if isinstance(result, kind))(result)
    except NothingToShow as why:
        name = getattr(getattr(result, "results", result), "name", type(result).__name__)
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
