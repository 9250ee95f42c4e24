"""Pictures of a linear system's answers: Bode diagram and step responses, with their bands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hygrokf.evaluation.responses import Answer, FrequencyResponse, Response, StepResponse
from hygrokf.report.figures.drawing import MEASURED
from hygrokf.report.figures.panels import Axis, Band, Curve, Mark, Panel, Picture
from hygrokf.report.quantities import spoken

QUARTERS = (1.0, 1.5, 3.0, 4.5, 9.0, 10.0)
"""Steps between the marks of a phase axis, times a power of ten: 15°, 30°, 45°, 90°."""


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
