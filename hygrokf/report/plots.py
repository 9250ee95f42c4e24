"""Results on matplotlib's axes: the picture of a result's first screen.

The methods `plot` of results end here (`hygrokf.data.result_file`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hygrokf.climate.study import Study
from hygrokf.discovery.discovery_results import Discovered
from hygrokf.errors import HygrokfError
from hygrokf.evaluation.responses import Answer, FrequencyResponse, Response, StepResponse
from hygrokf.identification.fit import Fit
from hygrokf.report.figures.drawing import MEASURED, WIDTH_IN, NothingToShow, expect_matplotlib, styled
from hygrokf.report.figures.lead import lead_of_climate, lead_of_discovery, lead_of_fit
from hygrokf.report.figures.panels import Axis, Band, Curve, Mark, Panel, Picture
from hygrokf.report.quantities import spoken

if TYPE_CHECKING:
    from matplotlib.axes import Axes


QUARTERS = (1.0, 1.5, 3.0, 4.5, 9.0, 10.0)
"""Steps between the marks of a phase axis, times a power of ten: 15°, 30°, 45°, 90°."""


# -- answers of a linear system ------------------------------------------------------------------------------
def bode(found: FrequencyResponse) -> Picture:
    """Magnitude over phase, a column for each input and two rows for each output."""
    limits = (float(found.omega[0]), float(found.omega[-1]))
    magnitude = Axis("magnitude [output/input]", kind="logarithmic")
    phase = Axis("phase [°]", most=6, steps=QUARTERS)
    panels = []
    for output in found.system.outputs:
        pairs = [(output, name) for name in found.system.inputs]
        for pair in pairs:
            marks = _marks(found, found.omega, found.magnitude[pair])
            title = f"{spoken(pair[1])} → {spoken(pair[0])}"
            panels.append(Panel(marks, Axis("", limits, "logarithmic"), magnitude, title))
        for pair in pairs:
            marks = _marks(found, found.omega, found.phase_deg[pair])
            x = Axis("angular frequency [rad/h]", limits, "logarithmic")
            panels.append(Panel(marks, x, phase))
    return _picture(found, panels, 0.4 + 3.4 * len(found.system.outputs))


def step_response(found: StepResponse) -> Picture:
    """A panel for each output and input."""
    x = Axis("time after the step [h]", (0.0, float(found.time_h[-1])))
    panels = [
        Panel(
            _marks(found, found.time_h, found.value[pair]),
            x,
            Axis("answer [output/input]"),
            f"{spoken(pair[1])} + 1 → {spoken(pair[0])}",
        )
        for pair in found.pairs
    ]
    return _picture(found, panels, 0.5 + 2.1 * len(found.system.outputs))


def _picture(found: Response, panels: Sequence[Panel], height_in: float) -> Picture:
    return Picture(tuple(panels), height_in, columns=max(len(found.system.inputs), 1))


def _marks(found: Response, x: np.ndarray, answer: Answer) -> tuple[Mark, ...]:
    value, lower, upper = answer
    band = f"{100.0 * found.level:g} % band from the parameters' uncertainty"
    shown = (Curve(x, value, MEASURED, 1.1, "at the estimate"),)
    return (*shown, Band(x, lower, upper, MEASURED, 0.22, band)) if np.isfinite(lower).any() else shown


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
