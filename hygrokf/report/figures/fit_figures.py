"""The figures of a fit in the order of the report, and those of what was identified: heat release by
operating point, profile likelihood of the time constants, and how their intervals grow source by source.

Each function takes (fit, series), the content of `fit.json` and `series.npz`, and raises
`drawing.NothingToShow` with one sentence where its data are missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from statistics import NormalDist
from typing import Literal

import numpy as np

from hygrokf.data.result_file import array, instants, scalar
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.evaluation.innovation_tests import (
    Autocorrelation,
    CrossCorrelation,
    CumulativePeriodogram,
    OutputDiagnosis,
    Periodogram,
)
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
    Band,
    ColourScale,
    CrossLine,
    Curve,
    Mark,
    Note,
    Panel,
    Picture,
    Shade,
    bounds,
    course,
    point,
    rows,
    strokes,
)
from hygrokf.report.quantities import spoken
from hygrokf.texts.parts import PARTS
from hygrokf.texts.wording import one_line, p_equation

CHI_SQUARE_95 = 3.8415
"""95 % quantile of χ² with one degree of freedom."""
PRODUCT = dict(zip(PARTS, ("(R_AT+R_IC)·C", "R_D*·V*"), strict=True))
"""Symbols of the time constants."""
CLOUD_POINTS = 500
"""Points of one cloud; more of them only hide each other."""
LABELS = {
    "profile": "profile likelihood",
    "parts": "+ parts of the record",
    "forms": "+ other forms",
    "free run": "+ free run",
    "clocks": "+ clocks",
    "sampling": "+ ambient sampling",
}
SHOWN_SD = 1e-3
"""[1] standard deviation of the logarithm from which a source has a bar of its own."""
SHOWN_WEIGHT = 0.01
"""[1] share of the evidence above which another form is drawn."""


# --- heat release ----------------------------------------------------------------------------


def figure_heat_release(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Quasi-stationary periods and the regression over them, operation and standstill (Fig. 4 of the
    paper)."""
    release = fit.heat_release
    reference = (
        math.nan if release is None or release.reference_K is None else release.reference_K - ZERO_CELSIUS_K
    )
    regimes = {} if release is None else release.regimes
    found = [_Points(name, regime, reference) for name, regime in regimes.items()]
    shown = [one for one in found if len(one.power)]
    if not shown:
        why = ""
        if release is not None and release.statements:
            why = f" ({'; '.join(map(str, release.statements))})"
        raise NothingToShow(f"There are too few quasi-stationary periods for a regression{why}.")
    edges = _round_edges(*np.quantile(np.concatenate([one.ambient for one in shown]), [0.02, 0.98]))
    highest = max(float(np.nanmax(one.difference)) for one in shown)
    lowest = min(0.0, *(float(np.nanmin(one.difference)) for one in shown))
    limits = (lowest - 0.3, highest + 0.08 * (highest - lowest))
    panels = []
    for one in shown:
        operation = one.regime == "operation"
        count, episodes = one.data.n_points, one.data.n_episodes
        panels.append(
            Panel(
                (*one.cloud(edges), *(_operation(one, edges, fit) if operation else _standstill(one, fit))),
                Axis("power / rated [1]" if operation else "ambient temperature [°C]"),
                Axis("cabinet − ambient [K]" if one is shown[0] else "", limits),
                f"{one.regime}: {count} stationary periods, {episodes} episodes",
            )
        )
    key = [Curve((), (), INK, label="regression over the points")]
    if _likelihood(fit)[0]:
        key.append(Curve((), (), INK, 1.0, "final estimate, all data", dashed=True))
    scale = ColourScale(WARM_TO_COLD, "ambient [°C]", edges=tuple(edges))
    return Picture(tuple(panels), height_in=2.9, columns=len(shown), key=tuple(key), scale=scale)


class _Points:
    """Points and coefficients of one regime; temperatures in °C."""

    def __init__(self, regime: str, data: Regression, reference: float) -> None:
        self.regime, self.data, self.reference = regime, data, reference
        points = data.points
        ambient = points.ambient_K - ZERO_CELSIUS_K
        kept = np.isfinite(points.power) & np.isfinite(points.difference_K) & np.isfinite(ambient)
        self.power, self.difference = points.power[kept], points.difference_K[kept]
        self.ambient = ambient[kept]
        self.coefficients = data.coefficients

    def cloud(self, edges: np.ndarray) -> tuple[Curve, ...]:
        """The points, thinned, in the colours of their classes of ambient temperature."""
        kept = np.unique(np.linspace(0, len(self.power) - 1, min(CLOUD_POINTS, len(self.power))).astype(int))
        x = (self.power if self.regime == "operation" else self.ambient)[kept]
        y, place = self.difference[kept], _classes(self.ambient[kept], edges)
        return tuple(
            Curve(x[place == i], y[place == i], colour, 0.0, marker=".", size=5.0, alpha=0.7)
            for i, colour in enumerate(WARM_TO_COLD)
        )


def released(
    coefficients: Mapping[str, float], regime: str, power: np.ndarray | float, warmer: np.ndarray | float
) -> np.ndarray:
    """Heat release [K] at relative power [1] and ambient temperature above the reference [K]; NaN where
    unknown."""
    base = coefficients.get(f"heat_release_{regime}", math.nan)
    total = base + coefficients.get(f"heat_release_{regime}_ambient", 0.0) * warmer
    if regime == "operation":
        for name, value in coefficients.items():
            order = name.removeprefix("heat_release_power_")
            if order != name and order.isdigit():
                total = total + value * power ** int(order)
    return np.asarray(total + 0.0 * power)


def _likelihood(fit: FitResults) -> tuple[dict[str, float], float]:
    """Coefficients of the final estimate and their reference temperature [°C]."""
    values = {name: row.value for name, row in fit.parameters.items() if name.startswith("heat_release_")}
    mechanisms = {} if fit.design is None else dict(fit.design.mechanisms)
    reference = mechanisms.get("heat_release", {}).get("reference_K")
    return values, reference - ZERO_CELSIUS_K if isinstance(reference, (int, float)) else math.nan


def _round_edges(low: float, high: float) -> np.ndarray:
    """Six classes of ambient temperature [°C] with round edges."""
    step = next((s for s in (1.0, 2.0, 2.5, 5.0, 10.0) if 6 * s >= high - low), 20.0)
    first = step * math.floor(low / step)
    return first + step * np.arange(7)


def _classes(value: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(WARM_TO_COLD) - 1)


def _operation(one: _Points, edges: np.ndarray, fit: FitResults) -> list[Mark]:
    """Curves over the power at a cold, a usual and a warm ambient temperature."""
    p = np.linspace(min(0.0, float(one.power.min())), max(1.0, float(one.power.max())), 60)
    values, reference = _likelihood(fit)
    marks: list[Mark] = []
    for degrees in sorted({round(float(e)) for e in np.quantile(one.ambient, [0.1, 0.5, 0.9])}):
        colour = WARM_TO_COLD[int(_classes(np.array([degrees]), edges)[0])]
        curve = released(one.coefficients, "operation", p, degrees - one.reference)
        final = released(values, "operation", p, degrees - reference)
        marks += [Curve(p, curve, colour, 1.6), Curve(p, final, colour, 1.0, dashed=True)]
        if math.isfinite(float(curve[-1])):
            marks.append(Note(f"{degrees} °C", float(p[-1]), float(curve[-1]), colour, bold=True))
    return marks


def _standstill(one: _Points, fit: FitResults) -> list[Mark]:
    """Lines over the ambient temperature."""
    x = np.linspace(float(one.ambient.min()), float(one.ambient.max()), 2)
    values, reference = _likelihood(fit)
    return [
        Curve(x, released(one.coefficients, "standstill", 0.0, x - one.reference), INK, 1.6),
        Curve(x, released(values, "standstill", 0.0, x - reference), INK, 1.0, dashed=True),
    ]


# --- time constants --------------------------------------------------------------------------


def figure_profiles(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Profile likelihood of both time constants, with bounds and the estimate by simulation beside it."""
    constants = fit.time_constants
    shown = [name for name in PRODUCT if name in constants and constants[name].value_h > 0]
    if not shown:
        raise NothingToShow("No time constant was identified, so there is no profile to show.")
    return Picture(tuple(_profile(name, constants[name]) for name in shown), height_in=2.5, columns=2)


def _profile(name: str, found: TimeConstant) -> Panel:
    # the likelihood's own bounds, where they stand beside the headline interval
    own = found.profile if found.profile is not None and found.profile.value_h > 0 else found
    value, low, high = own.value_h, own.lower_h, own.upper_h
    threshold = found.threshold if found.threshold > 0 else CHI_SQUARE_95
    top = 2.1 * threshold
    good = np.isfinite(found.curve).all(axis=1) & (found.curve[:, 0] > 0)
    points = found.curve[good][np.argsort(found.curve[good][:, 0])]
    free = found.simulation or Interval()
    simulated = (free.value_h, free.lower_h, free.upper_h)
    ends = [v for v in (value, low, high, *simulated) if math.isfinite(v) and value / 8 < v < value * 8]
    ends += list(points[points[:, 1] <= top, 0])
    left, right = min(ends) / 1.04, max(ends) * 1.04
    lower = low if math.isfinite(low) and low > 0 else left / 10
    upper = high if math.isfinite(high) else right * 10
    label = f"{100 * found.level:.0f} %" if math.isfinite(found.level) else "threshold"
    if found.factor > 1.005:
        label += f", widened × {found.factor:.2f}"
    marks: list[Mark] = [
        Shade(lower, upper, MEASURED, 0.09),
        CrossLine(threshold, "y", INK, 0.8, dashed=True),
        Note(label, 1.0, threshold, INK, "right", "bottom", "x"),
        CrossLine(value, "x", MEASURED, 0.8),
        Note(f"{value:.3g} h", value, top, MEASURED, "left", "top", bold=True),
    ]
    if len(points) >= 3:
        marks.append(Curve(*_smooth_profile(points, value), MEASURED, 1.5))
        marks.append(Curve(points[:, 0], points[:, 1], MEASURED, 0.0, marker="o"))
    if math.isfinite(simulated[0]):
        height = 1.62 * threshold
        first, last = (s if math.isfinite(s) else simulated[0] for s in simulated[1:])
        marks.append(bounds(first, last, height, SIMULATED_COLOUR, alpha=1.0))
        marks.append(point(simulated[0], height, "D", SIMULATED_COLOUR, 4.0))
        middle = min(max(simulated[0], left), right)
        third = math.log(middle / left) / math.log(right / left)
        side: Literal["left", "center", "right"] = (
            "left" if third < 0.3 else "right" if third > 0.7 else "center"
        )
        words = "by simulation (free run)"
        marks.append(
            Note(words, middle, 1.04 * height, SIMULATED_COLOUR, side, "bottom", bold=True, boxed=True)
        )
    kind: Literal["logarithmic", "linear"] = "logarithmic" if right / left > 3.0 else "linear"
    return Panel(
        tuple(marks),
        Axis("time constant [h]", (left, right), kind, most=6),
        Axis("2 × drop of log-likelihood", (0.0, top)),
        f"{name} time constant {PRODUCT[name]}",
    )


def _smooth_profile(points: np.ndarray, value: float) -> tuple[np.ndarray, np.ndarray]:
    """The curve through few points: the signed root of the drop is nearly straight over the logarithm."""
    side = np.sign(np.log(points[:, 0] / value))
    root = side * np.sqrt(np.maximum(points[:, 1], 0.0))
    x = np.geomspace(points[0, 0], points[-1, 0], 120)
    return x, np.interp(np.log(x), np.log(points[:, 0]), root) ** 2


# --- composition of intervals ----------------------------------------------------------------


def figure_composition(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """One panel a time constant: a bar for each step of the interval, the last one the headline."""
    steps = {name: _steps(fit.time_constants[name]) for name in PRODUCT if name in fit.time_constants}
    steps = {name: found for name, found in steps.items() if len(found) > 1}
    if not steps:
        raise NothingToShow("No interval is composed of several sources, so there is nothing to take apart.")
    return Picture(
        tuple(_composed(name, fit.time_constants[name], found) for name, found in steps.items()),
        height_in=0.75 + 0.2 * max(map(len, steps.values())),
        columns=2,
    )


def _steps(found: TimeConstant) -> list[CompositionStep]:
    """Steps of an interval that is closed throughout, without those that add nothing."""
    rows = [row for row in found.composition if row.source in LABELS]
    if not all(0 < row.lower_h < row.upper_h < math.inf for row in rows):
        return []
    return [row for i, row in enumerate(rows) if i == 0 or row.sd_ln > SHOWN_SD]


def _composed(name: str, found: TimeConstant, steps: list[CompositionStep]) -> Panel:
    *parts, whole = [(row.lower_h, row.upper_h, place) for place, row in enumerate(steps)]
    marks: list[Mark] = [bounds(*part, MEASURED, 2.6, 0.55) for part in parts]
    marks += [bounds(*whole, MEASURED, 5.0, 1.0), CrossLine(found.value_h, "x", INK, 0.8)]
    # other estimates, each on the row of the source that it stands for
    others = [
        ("forms", form.value_h, QUIET, 2.5 + 4.0 * form.weight)
        for form in found.forms
        if form.form != "base" and form.weight >= SHOWN_WEIGHT
    ]
    if found.simulation is not None:
        others.append(("free run", found.simulation.value_h, SIMULATED_COLOUR, 4.5))
    places = {row.source: place for place, row in enumerate(steps)}
    for source, value, colour, size in others:
        if source in places and math.isfinite(value):
            marks.append(point(value, places[source], "D", colour, size, edge="white"))
    labels = [LABELS[row.source] for row in steps]
    return Panel(tuple(marks), Axis("[h]", most=5), rows(labels), f"{name} time constant")


def figure_of(name: str, fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """One of `FIGURES` as a block of the page of a fit."""
    heading, caption, draw = FIGURES[name]
    return Figure(name, heading, caption, lambda: draw(fit, series))


# -- innovations ---------------------------------------------------------------------------------------------
QUANTILES = 160
"""Points of the quantile plot, evenly spread over the normal distribution's quantiles."""
MOST_INPUTS = 4
"""Inputs that are shown; of more of them those with the smallest p."""


def figure_innovations(
    fit: FitResults, series: Mapping[str, np.ndarray], output: str = "temperature"
) -> Picture:
    """Standardised innovations [1] of one output, "temperature" or "humidity", over the identification
    period."""
    found = fit.innovations.outputs.get(output)
    time = instants(series)
    value = array(series, f"{output}_innovation")
    until = scalar(series, "until_s")
    known = np.isfinite(value) & (time <= until if math.isfinite(until) else True)
    if found is None or not known.any():
        raise NothingToShow(
            f"There are no innovations of the {output}: the filter observed none of its readings."
        )
    if found.autocorrelation is None:
        raise NothingToShow(f"No diagnosis: {found.remark or 'too few readings'}.")
    cross = _shown_inputs(found)
    reach = max((_reach(one) for _, one in cross), default=0.0)
    e = value[known]
    panels = (
        _correlation(found.autocorrelation, _reach(found.autocorrelation), "Autocorrelation"),
        _cumulative(found.cumulative_periodogram or CumulativePeriodogram()),
        _periodogram(found.periodogram or Periodogram()),
        _quantiles(e),
        _course(time[known], e),
        *(_correlation(one, reach, f"Correlation with {spoken(one_line(name))}") for name, one in cross),
        *([] if cross else [Panel(title="no input varies, or none is known: no cross-correlation")]),
    )
    return Picture(panels, height_in=1.6 * -(-len(panels) // 3), columns=3)


def _columns(*lists: tuple[float, ...]) -> list[np.ndarray]:
    """Lists of equal length as arrays of the rows in which all are finite; empty where lengths differ."""
    if len({len(values) for values in lists}) != 1:
        return [np.empty(0) for _ in lists]
    rows = np.array(lists, dtype=float)
    return list(rows[:, np.isfinite(rows).all(axis=0)])


def _stems(lag: np.ndarray, value: np.ndarray, limit: float) -> list[Mark]:
    beyond = np.abs(value) > limit
    return [
        strokes(lag[chosen], np.zeros(chosen.sum()), lag[chosen], value[chosen], colour, width)
        for chosen, colour, width in ((~beyond, MEASURED, 0.7), (beyond, SIMULATED_COLOUR, 1.3))
    ]


def _reach(data: Autocorrelation | CrossCorrelation) -> float:
    """Height [1] at which a correlation and its limits can be seen."""
    largest = float(np.abs(_columns(data.lag_h, data.value)[1]).max(initial=0.0))
    limit = data.limit_all if data.limit_all > 0 else 0.0
    return min(max(1.9 * limit, 1.15 * largest, 0.02), 1.02)


def _correlation(data: Autocorrelation | CrossCorrelation, reach: float, title: str) -> Panel:
    """A correlation over the lag, with both of its confidence limits."""
    lag, value = _columns(data.lag_h, data.value)
    crossed = isinstance(data, CrossCorrelation)
    if len(lag) < 2 or not lag[-1] > 0:
        return Panel(title="no autocorrelation in fit.json")
    marks: list[Mark] = [CrossLine(0.0, "y")]
    if math.isfinite(data.limit):
        marks.append(Shade(-data.limit, data.limit, QUIET, 0.16, "", "y"))
    wide = data.limit_all if math.isfinite(data.limit_all) else 0.0
    marks += [CrossLine(sign * wide, "y", INK, 0.7, True) for sign in (-1.0, 1.0) if wide]
    if crossed:
        marks.append(CrossLine(0.0, "x"))
        x = _hours("lag [h], > 0: later", float(lag[0]), float(lag[-1]), 5.0)
    else:
        x = _hours("lag [h]", 0.0, float(lag[-1]))
    y = Axis(limits=(-reach, reach), most=5)
    return Panel((*marks, *_stems(lag, value, wide)), x, y, title, plain=crossed)


def _hours(label: str, low: float, high: float, ticks: float = 8.5) -> Axis:
    """An axis of lags [h] with ticks at hours, parts of a day, or days."""
    step = next((one for one in (1.0, 3.0, 6.0, 12.0, 24.0) if (high - low) / one <= ticks), 0.0)
    at: tuple[float, ...] = ()
    if step and (high - low) / step >= 2:
        at = tuple(step * np.arange(math.ceil(low / step), math.floor(high / step) + 1))
    return Axis(label, (1.02 * low, 1.02 * high), at=at)


def _cumulative(data: CumulativePeriodogram) -> Panel:
    frequency, value = _columns(data.frequency_per_h, data.value)
    if len(frequency) < 2 or not frequency[-1] > 0:
        return Panel(title="no cumulative periodogram in fit.json")
    end = float(frequency[-1])
    line = np.array([0.0, end])
    words = p_equation(data.p)
    marks = (
        Band(line, line / end - data.limit, line / end + data.limit, QUIET),
        Curve(line, line / end, QUIET, 0.6),
        Curve(frequency, value, SIMULATED_COLOUR if data.statistic > data.limit else MEASURED, 1.2),
        Note(f"Kolmogorov–Smirnov\n{words}", 0.03, 0.98, INK, "left", "top", "xy"),
    )
    limits = (0.0, end)
    return Panel(marks, Axis("frequency [1/h]", limits), Axis(limits=(0.0, 1.0)), "Cumulative periodogram")


def _periodogram(data: Periodogram) -> Panel:
    """Power over the period, of white innovations 1, with the 95 % band."""
    frequency, power, lower, upper = _columns(data.frequency_per_h, data.power, data.lower, data.upper)
    if len(frequency) < 2 or frequency[0] <= 0 or np.any(np.diff(frequency) <= 0):
        return Panel(title="no periodogram in fit.json")
    period = 1.0 / frequency
    limits = (max(0.02, 0.7 * float(power.min())), 1.4 * max(float(power.max()), 4.0))
    high, low = min(float(period[0]), 2000.0), float(period[-1])
    ticks = [p for p in (0.1, 0.5, 2.0, 6.0, 24.0, 168.0, 720.0) if low <= p <= high]
    return Panel(
        (
            Band(period, np.maximum(lower, 1e-3), upper, QUIET),
            CrossLine(1.0, "y"),
            Curve(period, np.maximum(power, 1e-3), MEASURED),
        ),
        Axis("period [h]", (high, low), "logarithmic", ticks, [f"{p:g}" for p in ticks]),
        Axis("", limits, "logarithmic"),
        "Periodogram (white = 1)",
    )


def _shown_inputs(found: OutputDiagnosis) -> list[tuple[str, CrossCorrelation]]:
    rows = [
        (name, one)
        for name, one in found.cross_correlation.items()
        if len(_columns(one.lag_h, one.value)[0]) > 1
    ]
    first = sorted(rows, key=lambda row: math.inf if math.isnan(row[1].p) else row[1].p)[:MOST_INPUTS]
    return [row for row in rows if row in first]


def _quantiles(e: np.ndarray) -> Panel:
    """Quantiles of the innovations against those of the standard normal, with a pointwise 95 % band."""
    n = len(e)
    normal = NormalDist()
    ends = normal.inv_cdf((n - 0.5) / n) if n > 1 else 0.0
    wanted = np.linspace(-ends, ends, QUANTILES)
    place = np.unique(np.clip([math.floor(n * normal.cdf(v)) for v in wanted], 0, n - 1))
    share = (place + 0.5) / n
    x = np.array([normal.inv_cdf(float(p)) for p in share])
    # standard error of an order statistic: √(p(1−p)/n) over the density
    spread = np.sqrt(share * (1 - share) / n) / (np.exp(-0.5 * x**2) / math.sqrt(2.0 * math.pi))
    reach = normal.inv_cdf(0.5 + 0.5 * CONFIDENCE)
    marks = (
        Band(x, x - reach * spread, x + reach * spread, QUIET),
        Curve(x, x, QUIET, 0.6),
        Curve(x, np.sort(e)[place], MEASURED, 0.0, marker=".", size=2.6),
    )
    return Panel(marks, Axis("standard normal [1]"), title="Quantiles of e/√S")


def _course(time: np.ndarray, value: np.ndarray) -> Panel:
    span = (float(time[0]), float(time[-1]))
    reach = min(max(4.5, 1.1 * float(np.max(np.abs(value)))), 12.0)
    return Panel(
        (
            course(time, value, span, MEASURED, 0.5, bins=200),
            *(CrossLine(level, "y", INK, 0.7, dashed=True) for level in (-3.0, 3.0)),
        ),
        Axis(limits=span, kind="time", most=5),
        Axis(limits=(-reach, reach)),
        "Course (±3 dashed)",
    )


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
"""By name: heading, caption that says what to look for, and what draws it."""
