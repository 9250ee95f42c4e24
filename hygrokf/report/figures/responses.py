"""Pictures of a linear system's answers: Bode diagram and step responses, with their bands."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.evaluation.responses import Answer, FrequencyResponse, Response, StepResponse
from hygrokf.report.figures.drawing import MEASURED, Panels, area_handle, line_handle, logarithmic

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

BAND = 0.22
"""[1] opacity of a band."""
QUARTERS = (1.0, 1.5, 3.0, 4.5, 9.0, 10.0)
"""Steps between the marks of a phase axis, times a power of ten: 15°, 30°, 45°, 90°."""


def bode(found: FrequencyResponse) -> Panels:
    """Magnitude over phase, a column for each input and two rows for each output."""
    draw: list[Callable[[Axes], None]] = []
    for output in found.system.outputs:
        for kind in (_magnitude, _phase):
            draw += [partial(kind, found, (output, name)) for name in found.system.inputs]
    return _panels(found, draw, 0.4 + 3.4 * len(found.system.outputs))


def step_response(found: StepResponse) -> Panels:
    """A panel for each output and input."""
    draw: list[Callable[[Axes], None]] = [partial(_course, found, pair) for pair in found.pairs]
    return _panels(found, draw, 0.5 + 2.1 * len(found.system.outputs))


def _panels(found: Response, draw: list[Callable[[Axes], None]], height_in: float) -> Panels:
    return Panels(
        tuple(draw), height_in, columns=max(len(found.system.inputs), 1), handles=partial(_key, found)
    )


def _key(found: Response) -> list[Artist]:
    percent = f"{100.0 * found.level:g} % band from the parameters' uncertainty"
    return [line_handle(MEASURED, "at the estimate"), area_handle(MEASURED, percent, BAND)]


def _drawn(axes: Axes, x: np.ndarray, answer: Answer) -> None:
    value, lower, upper = answer
    if np.isfinite(lower).any():
        axes.fill_between(x, lower, upper, color=MEASURED, alpha=BAND, linewidth=0)
    axes.plot(x, value, color=MEASURED, linewidth=1.1)


def _words(name: str) -> str:
    return name.replace("_", " ")


def _magnitude(found: FrequencyResponse, pair: tuple[str, str], axes: Axes) -> None:
    _drawn(axes, found.omega, found.magnitude[pair])
    axes.set_title(f"{_words(pair[1])} → {_words(pair[0])}")
    axes.set_xlim(found.omega[0], found.omega[-1])
    logarithmic(axes, "x")
    logarithmic(axes, "y")
    axes.set_ylabel("magnitude [output/input]")


def _phase(found: FrequencyResponse, pair: tuple[str, str], axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    _drawn(axes, found.omega, found.phase_deg[pair])
    axes.set_xlim(found.omega[0], found.omega[-1])
    logarithmic(axes, "x")
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=QUARTERS))
    axes.set_ylabel("phase [°]")
    axes.set_xlabel("angular frequency [rad/h]")


def _course(found: StepResponse, pair: tuple[str, str], axes: Axes) -> None:
    _drawn(axes, found.time_h, found.value[pair])
    axes.set_title(f"{_words(pair[1])} + 1 → {_words(pair[0])}")
    axes.set_xlim(0.0, found.time_h[-1])
    axes.set_ylabel("answer [output/input]")
    axes.set_xlabel("time after the step [h]")
