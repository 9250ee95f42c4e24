"""Tables of a fit, and of its evaluation on another record."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from hygrokf.evaluation.actuator_effects import EstimatedChange
from hygrokf.evaluation.innovation_tests import CumulativePeriodogram
from hygrokf.evaluation.scoring import REGIMES, Errors, Scored
from hygrokf.identification.fit_on_record import Evaluation
from hygrokf.identification.fit_results import FitResults, PriorTerms, SensorResponse, TimeConstant
from hygrokf.identification.verdict import inherited
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.blocks import FREE_RUN, Block, Heading, Items, Prose, Table, inherited_verdicts, present
from hygrokf.report.figures.fit_figures import PRODUCT
from hygrokf.report.fit_text import lead_words, level_and_method, range_text
from hygrokf.report.quantities import interval, parameter_cells, quantity
from hygrokf.report.terminal import blocks_text
from hygrokf.texts.parts import SCORED
from hygrokf.texts.wording import (
    NONE,
    QUANTITY_NAMES,
    RULE_NAMES,
    decimals_for,
    fixed,
    p_value,
    percent,
    plain_number,
    sentence,
    signed,
)

RegimeRow = tuple[tuple[str, ...], Iterable[float], tuple[float, float] | None, int]
"""Words of a row, its number in each of `REGIMES`, bounds and readings of the total."""
ACTUATORS_NOTE = (
    "Mean difference between the simulations with and without the actuator while it is above half of its "
    "span, with 95 % bounds."
)


def time_constants_table(fit: FitResults) -> Table:
    """The time constants: reported, by the likelihood alone, and by the free run alone."""
    rows: list[tuple[str, ...]] = []
    notes: list[str] = []
    for name, reported in inherited(fit).items():
        constant = fit.time_constants[name]
        for label, estimate, method, verdict in (
            (f"{name} {PRODUCT[name]}", reported, level_and_method(constant), reported.words),
            ("  by the likelihood alone", constant.profile, "95 %, profile likelihood", ""),
            ("  R·C at the median ΔT", constant.resistance_capacity, "95 %, all sources", ""),
            ("  by the free run alone", constant.simulation, "95 %, sandwich", ""),
        ):
            if estimate is not None and (estimate is reported or math.isfinite(estimate.value_h)):
                value, bounds = estimate.texts
                rows.append((label, value, bounds if estimate.closed else NONE, method, verdict))
        if (response := constant.response) is not None:
            rows += _response(response)
        if range_of_values := range_text(constant):
            rows.append(("  over all temperatures", range_of_values, NONE, "", ""))
        notes += _notes(name, constant)
    return Table(
        "Time constants",
        ("", "value", "bounds [h]", "method", "verdict"),
        tuple(rows),
        left=(0, 3, 4),
        note=" ".join(notes),
        brief=(0, 1, 2, 3),  # at the terminal the verdicts stand above
    )


def _response(response: SensorResponse) -> list[tuple[str, ...]]:
    """Return the row of the humidity sensor's response time; empty if it is stated to be zero."""
    value, bounds, source = f"{response.minutes:.1f} min", NONE, f"response, {response.kind}"
    if response.kind == "estimated":
        bounds = interval(response.lower_minutes, response.upper_minutes, "{:.1f}".format, "min")
    elif response.kind == "included":
        value, source = "included", "response not stated, none seen"
    elif not response.minutes > 0:
        return []
    return [("  humidity sensor", value, bounds, source, "")]


def _notes(name: str, constant: TimeConstant) -> list[str]:
    """Return sentences on the conditions for which a time constant holds."""
    notes = []
    differences, decays = constant.difference_K or (), constant.range_h or ()
    if len(differences) == 3:
        low, median, high = (f"{value:.1f}" for value in differences)
        note = (
            f"The temperature difference between cabinet and ambient is {low}, {median} and {high} K at the "
            "10th, 50th and 90th percentile of the readings"
        )
        if len(decays) == 3:
            at_low, at_median, at_high = map(plain_number, decays)
            note += f"; small changes there decay with {at_low}, {at_median} and {at_high} h"
        notes.append(f"{note}.")
    if (mean_temperatures := constant.mean_temperatures) is not None:
        kelvin = (mean_temperatures.cabinet_temperature_K, mean_temperatures.ambient_temperature_K)
        inside, outside = (fixed(value - ZERO_CELSIUS_K, 1) for value in kelvin)
        notes.append(f"The {name} time constant holds at {inside} °C inside and {outside} °C outside.")
    if len(constant.modes) > 1:
        poles = ", ".join(f"{plain_number(v)} h" for v in constant.modes)
        notes.append(f"Time constants of all modes of the {name} model: {poles}.")
    return notes


def rmse_table(fit: Scored, period: str) -> Table | None:
    """The paper's Table III for one period, with rules that need no model; None where nothing was scored."""
    errors = [fit.errors(period, name) for name in SCORED]
    if not any(math.isfinite(error.total) for error in errors):
        return None
    rows = [("model, free run", *_cells(errors))]
    for key, words in RULE_NAMES.items():
        cells = _cells([fit.rule_errors(period, key, name) for name in SCORED])
        if any(cell != NONE for cell in cells):
            rows.append((words, *cells))
    rows.append(("readings", *(str(getattr(error.n, regime)) for error in errors for regime in REGIMES)))
    sensor_shares = [fit.sensor_share.get(period, {}).get(name, math.nan) for name in SCORED]
    if any(math.isfinite(share_of_quantity) for share_of_quantity in sensor_shares):
        cells = [
            cell for share_of_quantity in sensor_shares for cell in (NONE, NONE, percent(share_of_quantity))
        ]
        rows.append(("share explained by sensor accuracy", *cells))
    return Table(
        f"Root mean squared error, {period}",
        ("", *REGIMES, *REGIMES),
        tuple(rows),
        marked=(0,),
        groups=(("", 1), *((quantity(name).change, 3) for name in SCORED)),
    )


def regimes_table(
    title: str,
    rows: Sequence[RegimeRow],
    *,
    heads: tuple[str, ...] = ("",),
    number: Callable[[float], str] = fixed,
    marked: tuple[int, ...] = (),
) -> Table:
    """Errors, or differences of errors, by regime, with the bounds and readings of the total; `heads` of the
    columns of words, `marked` rows are set off."""
    cells = []
    for labels, values, bounds, n in rows:
        total = NONE if bounds is None else interval(*bounds)
        cells.append((*labels, *map(number, values), total, str(n)))
    return Table(
        title,
        (*heads, *REGIMES, "total, 95 %", "n"),
        tuple(cells),
        left=tuple(range(len(heads))),
        marked=marked,
    )


def _cells(errors: list[Errors]) -> list[str]:
    """Return the cells of a row of errors: for each quantity one for each regime."""
    return [fixed(getattr(error, regime)) for error in errors for regime in REGIMES]


def bands_table(fit: Scored) -> Table:
    """Return the share of readings inside the 95 % bands, by lead time."""
    rows = []
    for lead in fit.bands:
        cells = []
        for name in QUANTITY_NAMES:
            band = fit.band(lead, name)
            cells += [percent(band.coverage, 1), fixed(band.scale), str(band.n) if band.n > 0 else NONE]
        if any(cell != NONE for cell in cells):
            rows.append((lead_words(lead), *cells))
    return Table(
        "Readings inside the 95 % bands",
        ("", *("inside", "scale", "n") * 3),
        tuple(rows),
        groups=(("", 1), *((words, 3) for words, _ in QUANTITY_NAMES.values())),
        note="Scale: the factor by which the band would have to be widened (above 1) or narrowed (below 1) "
        "to hold 95 %.",
    )


def fit_parameters_table(fit: FitResults) -> Table:
    """Return every parameter with its standard error, bounds, unit, meaning and remarks."""
    rows: list[tuple[str, ...]] = []
    marked: list[int] = []
    for name, row in fit.parameters.items():
        value, bounds, symbol = parameter_cells(row)
        remarks = []
        if row.fixed:
            remarks.append("fixed")
        if row.at_bound:
            remarks.append("at its bound")
        if name in fit.flat:
            remarks.append("not determined")
        prior = row.prior or PriorTerms()
        if math.isfinite(prior.sd):
            remarks.append(f"prior {plain_number(prior.mean, 2)} ± {plain_number(prior.sd, 2)}")
        if {"at its bound", "not determined"} & set(remarks):
            marked.append(len(rows))
        rows.append((
            name, value, plain_number(row.se, 2), bounds, symbol, row.meaning, "; ".join(remarks),
        ))  # fmt: skip
    columns = ("parameter", "value", "se", "95 % bounds", "unit", "meaning", "remarks")
    return Table(
        "Parameters", columns, tuple(rows), left=(0, 4, 5, 6), marked=tuple(marked), brief=(0, 1, 2, 3, 4, 6)
    )


def actuators_table(fit: FitResults) -> Table:
    """Return what each logged actuator changes while it is on."""
    rows, reasons_unused = [], []
    for actuator in fit.actuators:
        if not actuator.used:
            reasons_unused.append(sentence(str(actuator.statement)))
            rows.append((actuator.signal, *[NONE] * 4))
            continue
        cells = []
        factors = {"temperature_K": 1.0, "relative_humidity": 100.0, "absolute_humidity_g_m3": 1.0}
        for name, factor in factors.items():
            change = (actuator.changes or {}).get(name, EstimatedChange())
            value, low, high = (factor * number for number in (change.value, change.lower, change.upper))
            decimals, bounds = 2, ""
            if math.isfinite(high - low):
                decimals = decimals_for(max(0.25 * (high - low), 0.01 * abs(value)))
                bounds = f" ({interval(low, high, partial(signed, decimals=decimals))})"
            cells.append(f"{signed(value, decimals)}{bounds}" if math.isfinite(value) else NONE)
        rows.append((actuator.signal, percent(actuator.on_share, 1), *cells))
    return Table(
        "What the logged actuators change while they are on",
        ("actuator", "on", "temperature [K]", "relative humidity [%]", "absolute humidity [g/m³]"),
        tuple(rows),
        note=" ".join([ACTUATORS_NOTE, *reasons_unused]),
    )


def optima_table(fit: FitResults) -> Table:
    """Return the other local optima that the search met."""
    rows = []
    for optimum in fit.other_optima:
        constants = {"thermal time constant": optimum.thermal_time_constant, "hygric k": optimum.hygric_k}
        values = [
            f"{name} {plain_number(value)}" for name, value in constants.items() if math.isfinite(value)
        ]
        rows.append((fixed(optimum.objective), fixed(optimum.objective - fit.loglik), ", ".join(values)))
    return Table(
        "Other optima met on the way",
        ("objective", "against the log-likelihood", "there"),
        tuple(rows),
        left=(2,),
    )


def innovations_table(fit: FitResults) -> Table:
    """Return moments and tests of whiteness of the innovations."""
    rows = []
    p_over_a_day = {
        test.output: test.p for test in reversed(fit.innovations.tests) if test.test == "autocorrelation"
    }
    for name, output in fit.innovations.outputs.items():
        spectrum = output.cumulative_periodogram or CumulativePeriodogram()
        moments = (
            fixed(output.mean, 3),
            fixed(output.variance),
            fixed(output.excess_kurtosis),
            percent(output.beyond_3, 2),
        )
        p_values = (p_value(p_over_a_day.get(name, math.nan)), p_value(spectrum.p))
        rows.append((name, str(output.n), *moments, *p_values))
    columns = ("output", "n", "mean", "variance", "kurtosis", "beyond ±3", "Ljung–Box p", "spectrum p")
    note = (
        "Innovations over their standard deviation. White and normal ones have mean 0, variance 1, excess "
        "kurtosis 0 and 0.27 % beyond ±3. Ljung–Box: test for correlation over a day."
    )
    return Table("Standardised innovations", columns, tuple(rows), note=note)


# --- evaluation ------------------------------------------------------------------------------


def evaluation_text(evaluation: Evaluation) -> str:
    """Return the scores of a fit on another record as text of at most 100 columns."""
    return "\n\n".join(blocks_text(evaluation_blocks(evaluation)))


def evaluation_blocks(evaluation: Evaluation) -> tuple[Block, ...]:
    """Return the errors of the free run in both periods, with the rules that need no model, and the bands."""
    tables = [rmse_table(evaluation, period) for period in ("identification", "validation")]
    is_scored = any(tables)
    return present(
        Heading(f"{evaluation.fit} on {evaluation.record}: errors of the free run"),
        Prose(FREE_RUN),
        inherited_verdicts(evaluation.verdicts, ""),
        Items(tuple(f"note: {line}" for line in evaluation.statements)) if evaluation.statements else None,
        *(tables if is_scored else [Prose(NOTHING, "missing")]),
        bands_table(evaluation) if is_scored else None,
    )


NOTHING = (
    "Nothing to score: there is no temperature or absolute humidity of the cabinet at a time when all inputs "
    "are known. Relative humidity needs the temperature beside it; a fit that knows the power needs the "
    "power; after a gap in the inputs the score waits 12 h. See the gaps in `hygrokf check`."
)
