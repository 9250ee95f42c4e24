"""Figures of a fit in the order of the report; here those of what was identified: heat release by operating
point, profile likelihood of the time constants, and how their intervals grow source by source.

Each function takes (fit, series), the content of `fit.json` and `series.npz`, and raises
`drawing.NothingToShow` where its data are missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Literal

import numpy as np

from hygrokf.identification.composition import CompositionStep
from hygrokf.identification.fit_results import FitResults, TimeConstant
from hygrokf.identification.steady_state import Regression
from hygrokf.identification.verdict_terms import Interval
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.blocks import Figure
from hygrokf.report.figures.course_panels import (
    figure_excerpts,
    figure_humidity,
    figure_residuals,
    figure_temperature,
    figure_validation,
)
from hygrokf.report.figures.drawing import (
    INK,
    MEASURED,
    QUIET,
    SIMULATED_COLOUR,
    WARM_TO_COLD,
    NothingToShow,
)
from hygrokf.report.figures.panels import (
    Axis,
    ColourScale,
    CrossLine,
    Curve,
    Mark,
    Note,
    Panel,
    Picture,
    Shade,
    bounds,
    point,
    rows,
)
from hygrokf.report.figures.residual_structure import figure_innovations

CHI_SQUARE_95 = 3.8415
"""95 % quantile of χ² with one degree of freedom."""
PRODUCT = {"thermal": "(R_AT+R_IC)·C", "hygric": "R_D*·V*"}
"""Time constant → its formula."""
CLOUD_POINTS = 500
"""Largest number of points of a regime that are drawn."""
LABELS = {
    "profile": "profile likelihood",
    "parts": "+ parts of the record",
    "forms": "+ other forms",
    "free run": "+ free run",
    "clocks": "+ clocks",
    "sampling": "+ ambient sampling",
}
SHOWN_SD = 1e-3
"""[1] a source with a smaller standard deviation of the logarithm has no bar."""
SHOWN_WEIGHT = 0.01
"""[1] share of the evidence above which another form is drawn."""


# --- heat release ----------------------------------------------------------------------------


def figure_heat_release(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Draw the quasi-stationary periods and the regression over them (Fig. 4 of the paper)."""
    heat_release = fit.heat_release
    shown_points: list[_Points] = []
    reasons = ""
    if heat_release is not None:
        kelvin = math.nan if heat_release.reference_K is None else heat_release.reference_K
        regimes = heat_release.regimes.items()
        all_points = [_Points(name, regime, kelvin - ZERO_CELSIUS_K) for name, regime in regimes]
        shown_points = [points for points in all_points if len(points.power)]
        reasons = "; ".join(map(str, heat_release.statements))
    if not shown_points:
        remark = f" ({reasons})" if reasons else ""
        raise NothingToShow(f"There are too few quasi-stationary periods for a regression{remark}.")
    all_ambient = np.concatenate([points.ambient for points in shown_points])
    edges = _round_edges(*np.quantile(all_ambient, [0.02, 0.98]))
    highest = max(float(np.nanmax(points.difference)) for points in shown_points)
    lowest = min(0.0, *(float(np.nanmin(points.difference)) for points in shown_points))
    limits = (lowest - 0.3, highest + 0.08 * (highest - lowest))
    panels = []
    for points in shown_points:
        is_operation = points.regime == "operation"
        count, episodes = points.data.n_points, points.data.n_episodes
        panels.append(
            Panel(
                (
                    *points.cloud(edges),
                    *(_operation(points, edges, fit) if is_operation else _standstill(points, fit)),
                ),
                Axis("power / rated [1]" if is_operation else "ambient temperature [°C]"),
                Axis("cabinet − ambient [K]" if points is shown_points[0] else "", limits),
                f"{points.regime}: {count} stationary periods, {episodes} episodes",
            )
        )
    key = [Curve((), (), INK, label="regression over the points")]
    if _likelihood(fit)[0]:
        key.append(Curve((), (), INK, 1.0, "final estimate, all data", dashed=True))
    scale = ColourScale(WARM_TO_COLD, "ambient [°C]", edges=tuple(edges))
    return Picture(tuple(panels), height_in=2.9, columns=len(shown_points), key=tuple(key), scale=scale)


class _Points:
    """The quasi-stationary periods of one regime: relative power [1], temperature difference [K], ambient
    temperature [°C] (n,), and the coefficients of the regression over them, relative to the temperature
    `reference` [°C]."""

    def __init__(self, regime: str, data: Regression, reference: float) -> None:
        self.regime, self.data, self.reference = regime, data, reference
        points = data.points
        ambient = points.ambient_K - ZERO_CELSIUS_K
        kept = np.isfinite(points.power) & np.isfinite(points.difference_K) & np.isfinite(ambient)
        self.power, self.difference = points.power[kept], points.difference_K[kept]
        self.ambient = ambient[kept]
        self.coefficients = data.coefficients

    def cloud(self, edges: np.ndarray) -> tuple[Curve, ...]:
        """Return the points, at most `CLOUD_POINTS`, in the colours of their classes of ambient
        temperature."""
        thinned = np.unique(
            np.linspace(0, len(self.power) - 1, min(CLOUD_POINTS, len(self.power))).astype(int)
        )
        x = (self.power if self.regime == "operation" else self.ambient)[thinned]
        y, class_of_point = self.difference[thinned], _classes(self.ambient[thinned], edges)
        is_in_class = [class_of_point == number for number in range(len(WARM_TO_COLD))]
        return tuple(
            Curve(x[chosen], y[chosen], colour, 0.0, marker=".", size=5.0, alpha=0.7)
            for chosen, colour in zip(is_in_class, WARM_TO_COLD, strict=True)
        )


def released(
    coefficients: Mapping[str, float],
    regime: str,
    power: np.ndarray | float,
    above_reference_K: np.ndarray | float,
) -> np.ndarray:
    """Heat release [K] at a relative power [1] and an ambient temperature above the reference [K], or NaN."""
    constant = coefficients.get(f"heat_release_{regime}", math.nan)
    release_K = constant + coefficients.get(f"heat_release_{regime}_ambient", 0.0) * above_reference_K
    if regime == "operation":
        for name, value in coefficients.items():
            exponent = name.removeprefix("heat_release_power_")
            if exponent != name and exponent.isdigit():
                release_K = release_K + value * power ** int(exponent)
    return np.asarray(release_K + 0.0 * power)


def _likelihood(fit: FitResults) -> tuple[dict[str, float], float]:
    """The coefficients of the heat release in the final estimate, and their reference temperature [°C]."""
    values = {name: row.value for name, row in fit.parameters.items() if name.startswith("heat_release_")}
    mechanisms = {} if fit.design is None else dict(fit.design.mechanisms)
    reference = mechanisms.get("heat_release", {}).get("reference_K")
    return values, reference - ZERO_CELSIUS_K if isinstance(reference, (int, float)) else math.nan


def _round_edges(low: float, high: float) -> np.ndarray:
    """Return the edges (7,) of six classes of ambient temperature [°C], at round numbers."""
    step = next((s for s in (1.0, 2.0, 2.5, 5.0, 10.0) if 6 * s >= high - low), 20.0)
    first = step * math.floor(low / step)
    return first + step * np.arange(7)


def _classes(value: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the class of each value (n,), from its edges; values beyond the ends belong to the first or last
    class."""
    return np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(WARM_TO_COLD) - 1)


def _operation(points: _Points, edges: np.ndarray, fit: FitResults) -> list[Mark]:
    """Return curves over the power at a cold, a usual and a warm ambient temperature: by the regression, and
    by the final estimate (dashed)."""
    power = np.linspace(min(0.0, float(points.power.min())), max(1.0, float(points.power.max())), 60)
    final_coefficients, final_reference = _likelihood(fit)
    marks: list[Mark] = []
    cold, usual, warm = np.quantile(points.ambient, [0.1, 0.5, 0.9])
    for degrees in sorted({round(float(cold)), round(float(usual)), round(float(warm))}):
        colour = WARM_TO_COLD[int(_classes(np.array([degrees]), edges)[0])]
        curve = released(points.coefficients, "operation", power, degrees - points.reference)
        final = released(final_coefficients, "operation", power, degrees - final_reference)
        marks += [Curve(power, curve, colour, 1.6), Curve(power, final, colour, 1.0, dashed=True)]
        if math.isfinite(float(curve[-1])):
            marks.append(Note(f"{degrees} °C", float(power[-1]), float(curve[-1]), colour, bold=True))
    return marks


def _standstill(points: _Points, fit: FitResults) -> list[Mark]:
    """Return lines over the ambient temperature: by the regression, and by the final estimate (dashed)."""
    ambient = np.linspace(float(points.ambient.min()), float(points.ambient.max()), 2)
    final_coefficients, final_reference = _likelihood(fit)
    by_regression = released(points.coefficients, "standstill", 0.0, ambient - points.reference)
    final = released(final_coefficients, "standstill", 0.0, ambient - final_reference)
    return [Curve(ambient, by_regression, INK, 1.6), Curve(ambient, final, INK, 1.0, dashed=True)]


# --- time constants --------------------------------------------------------------------------


def figure_profiles(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Draw the profile likelihood of both time constants with bounds, beside the free run's estimate."""
    constants = fit.time_constants
    shown = [name for name in PRODUCT if name in constants and constants[name].value_h > 0]
    if not shown:
        raise NothingToShow("No time constant was identified, so there is no profile to show.")
    return Picture(tuple(_profile(name, constants[name]) for name in shown), height_in=2.5, columns=2)


def _profile(name: str, constant: TimeConstant) -> Panel:
    """Return the panel of one time constant: twice the drop of the log-likelihood over its values [h]."""
    # the likelihood's own bounds, where they stand beside the headline interval
    by_likelihood = (
        constant.profile if constant.profile is not None and constant.profile.value_h > 0 else constant
    )
    value, low, high = by_likelihood.value_h, by_likelihood.lower_h, by_likelihood.upper_h
    threshold = constant.threshold if constant.threshold > 0 else CHI_SQUARE_95
    top = 2.1 * threshold
    is_usable = np.isfinite(constant.curve).all(axis=1) & (constant.curve[:, 0] > 0)
    points = constant.curve[is_usable][np.argsort(constant.curve[is_usable][:, 0])]
    free_run = constant.simulation or Interval()
    free_run_values = (free_run.value_h, free_run.lower_h, free_run.upper_h)
    shown_values = [
        hours
        for hours in (value, low, high, *free_run_values)
        if math.isfinite(hours) and value / 8 < hours < value * 8
    ]
    shown_values += list(points[points[:, 1] <= top, 0])
    left, right = min(shown_values) / 1.04, max(shown_values) * 1.04
    shade_left = low if math.isfinite(low) and low > 0 else left / 10
    shade_right = high if math.isfinite(high) else right * 10
    label = f"{100 * constant.level:.0f} %" if math.isfinite(constant.level) else "threshold"
    if constant.factor > 1.005:
        label += f", widened × {constant.factor:.2f}"
    marks: list[Mark] = [
        Shade(shade_left, shade_right, MEASURED, 0.09),
        CrossLine(threshold, "y", INK, 0.8, dashed=True),
        Note(label, 1.0, threshold, INK, "right", "bottom", "x"),
        CrossLine(value, "x", MEASURED, 0.8),
        Note(f"{value:.3g} h", value, top, MEASURED, "left", "top", bold=True),
    ]
    if len(points) >= 3:
        marks.append(Curve(*_smooth_profile(points, value), MEASURED, 1.5))
        marks.append(Curve(points[:, 0], points[:, 1], MEASURED, 0.0, marker="o"))
    if math.isfinite(free_run_values[0]):
        height = 1.62 * threshold
        free_lower, free_upper = (
            bound if math.isfinite(bound) else free_run_values[0] for bound in free_run_values[1:]
        )
        marks.append(bounds(free_lower, free_upper, height, SIMULATED_COLOUR, alpha=1.0))
        marks.append(point(free_run_values[0], height, "D", SIMULATED_COLOUR, 4.0))
        middle = min(max(free_run_values[0], left), right)
        position = math.log(middle / left) / math.log(right / left)
        side: Literal["left", "center", "right"] = (
            "left" if position < 0.3 else "right" if position > 0.7 else "center"
        )
        note = "by simulation (free run)"
        marks.append(
            Note(note, middle, 1.04 * height, SIMULATED_COLOUR, side, "bottom", bold=True, boxed=True)
        )
    kind: Literal["logarithmic", "linear"] = "logarithmic" if right / left > 3.0 else "linear"
    return Panel(
        tuple(marks),
        Axis("time constant [h]", (left, right), kind, most=6),
        Axis("2 × drop of log-likelihood", (0.0, top)),
        f"{name} time constant {PRODUCT[name]}",
    )


def _smooth_profile(points: np.ndarray, value: float) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate the profile (n, 2) between its points: the signed root of the drop is nearly straight over
    the logarithm of the time constant; `value`: its estimate [h]."""
    sign = np.sign(np.log(points[:, 0] / value))
    root = sign * np.sqrt(np.maximum(points[:, 1], 0.0))
    x = np.geomspace(points[0, 0], points[-1, 0], 120)
    return x, np.interp(np.log(x), np.log(points[:, 0]), root) ** 2


# --- composition of intervals ----------------------------------------------------------------


def figure_composition(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Draw how the interval of each time constant grows source by source: a bar for each step, the last one
    the reported interval."""
    steps = {name: _steps(fit.time_constants[name]) for name in PRODUCT if name in fit.time_constants}
    steps = {name: rows for name, rows in steps.items() if len(rows) > 1}
    if not steps:
        raise NothingToShow("No interval is composed of several sources, so there is nothing to take apart.")
    return Picture(
        tuple(_composed(name, fit.time_constants[name], rows) for name, rows in steps.items()),
        height_in=0.75 + 0.2 * max(map(len, steps.values())),
        columns=2,
    )


def _steps(constant: TimeConstant) -> list[CompositionStep]:
    """Return the steps of an interval without those that add nothing; empty if any step is open at an end."""
    rows = [row for row in constant.composition if row.source in LABELS]
    if not all(0 < row.lower_h < row.upper_h < math.inf for row in rows):
        return []
    return [row for number, row in enumerate(rows) if number == 0 or row.sd_ln > SHOWN_SD]


def _composed(name: str, constant: TimeConstant, steps: list[CompositionStep]) -> Panel:
    """The panel of one time constant: a bar for each step, and markers for other estimates."""
    *partial_bars, final_bar = [
        (step.lower_h, step.upper_h, row_number) for row_number, step in enumerate(steps)
    ]
    marks: list[Mark] = [bounds(*bar, MEASURED, 2.6, 0.55) for bar in partial_bars]
    marks += [bounds(*final_bar, MEASURED, 5.0, 1.0), CrossLine(constant.value_h, "x", INK, 0.8)]
    # other estimates, each on the row of the source that it stands for
    other_estimates = [
        ("forms", form.value_h, QUIET, 2.5 + 4.0 * form.weight)
        for form in constant.forms
        if form.form != "base" and form.weight >= SHOWN_WEIGHT
    ]
    if constant.simulation is not None:
        other_estimates.append(("free run", constant.simulation.value_h, SIMULATED_COLOUR, 4.5))
    row_of_source = {step.source: row_number for row_number, step in enumerate(steps)}
    for source, value, colour, size in other_estimates:
        if source in row_of_source and math.isfinite(value):
            marks.append(point(value, row_of_source[source], "D", colour, size, edge="white"))
    labels = [LABELS[step.source] for step in steps]
    return Panel(tuple(marks), Axis("[h]", most=5), rows(labels), f"{name} time constant")


def figure_of(name: str, fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """Return one of the figures of `FIGURES` as a block of the page of a fit."""
    heading, caption, draw = FIGURES[name]
    return Figure(name, heading, caption, lambda: draw(fit, series))


# -- the report's figures ------------------------------------------------------------------------------------
FIGURES: Mapping[str, tuple[str, str, Callable[[FitResults, Mapping[str, np.ndarray]], Picture]]] = {
    "validation": (
        "Readings and free run after the identification period",
        "The model saw the weather and the power of these days, and no reading of the cabinet. Red should "
        "follow blue, and about one blue reading in twenty should lie outside the 95 % band.",
        figure_validation,
    ),
    "temperature": (
        "Cabinet temperature, whole record",
        "Red should follow blue through seasons, days and standstills, with an error around zero, before and "
        "in the shaded validation period.",
        figure_temperature,
    ),
    "humidity": (
        "Absolute humidity in the cabinet, whole record",
        "The humidity inside and outside is similar in most cabinets: a useful model follows blue more "
        "closely than yellow does.",
        figure_humidity,
    ),
    "excerpts": (
        "Three excerpts",
        "Check the lag after a change of load and at sunrise, and the level at standstill. About one blue "
        "reading in twenty should lie outside the band.",
        figure_excerpts,
    ),
    "heat-release": (
        "Heat release by operating point",
        "The points should scatter evenly around the curve of their own colour at every power. Where solid "
        "and dashed curves differ, the stationary periods and the dynamic record disagree.",
        figure_heat_release,
    ),
    "profiles": (
        "How well the record determines the time constants",
        "The likelihood's own bounds (shaded) lie where the curve crosses the dashed line. A curve that "
        "stays below the line on one side leaves that side open. A red bar outside the shading means that "
        "the two criteria disagree.",
        figure_profiles,
    ),
    "composition": (
        "Sources of uncertainty in the intervals",
        "Each bar adds one source of uncertainty to the bar above it; the last bar is the reported interval. "
        "Diamonds are other estimates: grey from other forms of the model (sized by their weights), red from "
        "the free run.",
        figure_composition,
    ),
    "residuals": (
        "Error of the free run by operating point",
        "The medians should lie on zero everywhere. Others show at which power, temperature or hour the "
        "model is wrong.",
        figure_residuals,
    ),
    "innovations-temperature": (
        "Innovations of the temperature",
        "Bars and curves should stay inside the grey bands and the dashed limits. Red marks the lag, the "
        "period or the input with which the one-step predictions are still correlated.",
        figure_innovations,
    ),
    "innovations-humidity": (
        "Innovations of the humidity",
        "As above. Bars beyond the dashed limits at positive lags of an input show a response to that input "
        "that the model lacks.",
        partial(figure_innovations, output="humidity"),
    ),
}
"""Name of a figure → its heading, its caption (what to look for), and the function that draws it."""
