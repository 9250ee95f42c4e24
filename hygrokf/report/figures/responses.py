"""Pictures of a linear system's answers: Bode diagram and step responses, with their bands."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.evaluation.responses import Answer, FrequencyResponse, Response, StepResponse
from hygrokf.report.blocks import Figure
from hygrokf.report.figures.drawing import MEASURED, area_handle, line_handle, logarithmic
from hygrokf.report.figures.panels import Panels

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

BAND = 0.22
"""[1] opacity of a band."""
TURN_DEG = 45.0
"""[°] smallest step between two marks of a phase axis."""


def bode_figure(found: FrequencyResponse) -> Figure:
    """Magnitude over phase, a column for each input and two rows for each output."""
    return Figure("bode", "Frequency response", "", partial(_bode, found))


def step_figure(found: StepResponse) -> Figure:
    """A panel for each output and input."""
    return Figure("step-response", "Step response", "", partial(_step, found))


def _bode(found: FrequencyResponse) -> Panels:
    draw: list[Callable[[Axes], None]] = []
    for output in found.system.outputs:
        draw += [partial(_magnitude, found, (output, name)) for name in found.system.inputs]
        draw += [partial(_phase, found, (output, name)) for name in found.system.inputs]
    rows = 2 * len(found.system.outputs)
    return _panels(found, draw, 0.4 + 1.7 * rows)


def _step(found: StepResponse) -> Panels:
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
    low, high = axes.get_ylim()
    if high - low > 2.0 * TURN_DEG:
        step = TURN_DEG * max(np.ceil((high - low) / (5.0 * TURN_DEG)), 1.0)
        axes.set_yticks(np.arange(np.ceil(low / step), np.floor(high / step) + 1.0) * step)
    else:
        axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel("phase [°]")
    axes.set_xlabel("angular frequency [rad/h]")


def _course(found: StepResponse, pair: tuple[str, str], axes: Axes) -> None:
    _drawn(axes, found.time_h, found.value[pair])
    axes.set_title(f"{_words(pair[1])} + 1 → {_words(pair[0])}")
    axes.set_xlim(0.0, found.time_h[-1])
    axes.set_ylabel("answer [output/input]")
    axes.set_xlabel("time after the step [h]")
