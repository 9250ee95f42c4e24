"""The method `plot` of results: it draws the lead figure of a result on axes of matplotlib.

`hygrokf.data.result_file.drawn` calls `plotted`.
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
def bode(response: FrequencyResponse) -> Picture:
    """Draw magnitude above phase over the frequency; a column for each input, two rows for each output."""
    limits = (float(response.omega[0]), float(response.omega[-1]))
    magnitude = Axis("magnitude [output/input]", kind="logarithmic")
    phase = Axis("phase [°]", most=6, steps=QUARTERS)
    panels = []
    for output in response.system.outputs:
        pairs = [(output, input_name) for input_name in response.system.inputs]
        for pair in pairs:
            marks = _marks(response, response.omega, response.magnitude[pair])
            title = f"{spoken(pair[1])} → {spoken(pair[0])}"
            panels.append(Panel(marks, Axis("", limits, "logarithmic"), magnitude, title))
        for pair in pairs:
            marks = _marks(response, response.omega, response.phase_deg[pair])
            x = Axis("angular frequency [rad/h]", limits, "logarithmic")
            panels.append(Panel(marks, x, phase))
    return _picture(response, panels, 0.4 + 3.4 * len(response.system.outputs))


def step_response(response: StepResponse) -> Picture:
    """Draw the response of each output to a unit step of each input."""
    x = Axis("time after the step [h]", (0.0, float(response.time_h[-1])))
    panels = [
        Panel(
            _marks(response, response.time_h, response.value[pair]),
            x,
            Axis("answer [output/input]"),
            f"{spoken(pair[1])} + 1 → {spoken(pair[0])}",
        )
        for pair in response.pairs
    ]
    return _picture(response, panels, 0.5 + 2.1 * len(response.system.outputs))


def _picture(response: Response, panels: Sequence[Panel], height_in: float) -> Picture:
    """Return the panels as a picture with one column for each input."""
    return Picture(tuple(panels), height_in, columns=max(len(response.system.inputs), 1))


def _marks(response: Response, x: np.ndarray, answer: Answer) -> tuple[Mark, ...]:
    """The curve of a response over x (n,), with the band of the parameters' uncertainty if there is one."""
    value, lower, upper = answer
    band_label = f"{100.0 * response.level:g} % band from the parameters' uncertainty"
    curve = (Curve(x, value, MEASURED, 1.1, "at the estimate"),)
    return (*curve, Band(x, lower, upper, MEASURED, 0.22, band_label)) if np.isfinite(lower).any() else curve


PICTURES: Mapping[type, Callable[[Any], Picture]] = {
    Fit: lambda fit: _fit(fit),
    Discovered: lambda found: lead_of_discovery(found.results, found.before, found.after).draw(),
    Study: lambda study: lead_of_climate(study).draw(),
    FrequencyResponse: bode,
    StepResponse: step_response,
}


def _fit(fit: Fit) -> Picture:
    """Return the lead figure of a fit. Raises NothingToShow for a fit that was read without its series."""
    if fit.series:
        return lead_of_fit(fit.series).draw()
    raise NothingToShow(
        "Expected the course of readings and free run, found a fit without series; read it with "
        "read_fit(…, series=True), or call `plot` on what `identify` returns."
    )


def plotted(result: object, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """Draw a result on axes of the user, in the user's style; None: on a new figure of pyplot, in the style
    of the reports. Returns the axes."""
    expect_matplotlib()
    try:
        picture = next(draw for kind, draw in PICTURES.items() if isinstance(result, kind))(result)
    except NothingToShow as reason:
        result_name = getattr(getattr(result, "results", result), "name", type(result).__name__)
        raise HygrokfError(f"{result_name}: nothing to plot. {reason}") from None
    if axes is None:
        from matplotlib import pyplot

        with styled():
            figure = pyplot.figure(figsize=(WIDTH_IN, picture.height_in))
            return tuple(picture.on_figure(figure))
    own_axes = tuple(axes) if isinstance(axes, Iterable) else (axes,)
    if not 1 <= len(own_axes) <= len(picture.panels):
        raise ValueError(
            f"axes: expected 1 … {len(picture.panels)} axes, one for each panel of the picture, found "
            f"{len(own_axes)}"
        )
    picture.on(own_axes)
    return own_axes
