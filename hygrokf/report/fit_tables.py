"""The tables of a fit, and of its evaluation on another record."""

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
    """Both time constants by both criteria."""
    rows: list[tuple[str, ...]] = []
    notes: list[str] = []
    for name, known in inherited(fit).items():
        found = fit.time_constants[name]
        for words, one, how, verdict in (
            (f"{name} {PRODUCT[name]}", known, level_and_method(found), known.words),
            ("  by the likelihood alone", found.profile, "95 %, profile likelihood", ""),
            ("  R·C at the median ΔT", found.resistance_capacity, "95 %, all sources", ""),
            ("  by the free run alone", found.simulation, "95 %, sandwich", ""),
        ):
            if one is not None and (one is known or math.isfinite(one.value_h)):
                value, bounds = one.texts
                rows.append((words, value, bounds if one.closed else NONE, how, verdict))
        if (response := found.response) is not None:
            rows += _response(response)
        if span := range_text(found):
            rows.append(("  over all temperatures", span, NONE, "", ""))
        notes += _notes(name, found)
    return Table(
        "Time constants",
        ("", "value", "bounds [h]", "method", "verdict"),
        tuple(rows),
        left=(0, 3, 4),
        note=" ".join(notes),
        brief=(0, 1, 2, 3),  # at the terminal the verdicts stand above
    )


def _response(found: SensorResponse) -> list[tuple[str, ...]]:
    """The row of the humidity sensor's response time, where it is not stated to be none."""
    value, bounds, how = f"{found.minutes:.1f} min", NONE, f"response, {found.kind}"
    if found.kind == "estimated":
        bounds = interval(found.lower_minutes, found.upper_minutes, "{:.1f}".format, "min")
    elif found.kind == "included":
        value, how = "included", "response not stated, none seen"
    elif not found.minutes > 0:
        return []
    return [("  humidity sensor", value, bounds, how, "")]


def _notes(name: str, found: TimeConstant) -> list[str]:
    """Sentences on the conditions under which a time constant holds."""
    notes = []
    differences, decays = found.difference_K or (), found.range_h or ()
    if len(differences) == 3:
        low, middle, high = (f"{value:.1f}" for value in differences)
        note = (
            f"The temperature difference between cabinet and ambient is {low}, {middle} and {high} K at the "
            "10th, 50th and 90th percentile of the readings"
        )
        if len(decays) == 3:
            first, second, third = map(plain_number, decays)
            note += f"; small changes there decay with {first}, {second} and {third} h"
        notes.append(f"{note}.")
    if (at := found.mean_temperatures) is not None:
        kelvin = (at.cabinet_temperature_K, at.ambient_temperature_K)
        inside, outside = (fixed(value - ZERO_CELSIUS_K, 1) for value in kelvin)
        notes.append(f"The {name} time constant holds at {inside} °C inside and {outside} °C outside.")
    if len(found.modes) > 1:
        poles = ", ".join(f"{plain_number(v)} h" for v in found.modes)
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
    share = [fit.sensor_share.get(period, {}).get(q, math.nan) for q in SCORED]
    if any(math.isfinite(one) for one in share):
        cells = [cell for one in share for cell in (NONE, NONE, percent(one))]
        rows.append(("share explained by sensor accuracy", *cells))
    return Table(
        f"Root mean squared error, {period}",
        ("", *REGIMES, *REGIMES),
        tuple(rows),
        marked=(0,),
        groups=(("", 1), *((quantity(q).change, 3) for q in SCORED)),
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
    return [fixed(getattr(error, regime)) for error in errors for regime in REGIMES]


def bands_table(fit: Scored) -> Table:
    """Coverage of the 95 % bands by lead."""
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
    """Every parameter with standard error, bounds, unit, meaning and remarks."""
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
    """What the logged actuators change while they are on."""
    rows, left_out = [], []
    for actuator in fit.actuators:
        if not actuator.used:
            left_out.append(sentence(str(actuator.statement)))
            rows.append((actuator.signal, *[NONE] * 4))
            continue
        cells = []
        factors = {"temperature_K": 1.0, "relative_humidity": 100.0, "absolute_humidity_g_m3": 1.0}
        for name, factor in factors.items():
            change = (actuator.changes or {}).get(name, EstimatedChange())
            value, low, high = (factor * v for v in (change.value, change.lower, change.upper))
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
        note=" ".join([ACTUATORS_NOTE, *left_out]),
    )


def optima_table(fit: FitResults) -> Table:
    """Other local optima that the search met."""
    rows = []
    for one in fit.other_optima:
        constants = {"thermal time constant": one.thermal_time_constant, "hygric k": one.hygric_k}
        there = [f"{name} {plain_number(value)}" for name, value in constants.items() if math.isfinite(value)]
        rows.append((fixed(one.objective), fixed(one.objective - fit.loglik), ", ".join(there)))
    return Table(
        "Other optima met on the way",
        ("objective", "against the log-likelihood", "there"),
        tuple(rows),
        left=(2,),
    )


def innovations_table(fit: FitResults) -> Table:
    """Moments and whiteness of the innovations."""
    rows = []
    day = {test.output: test.p for test in reversed(fit.innovations.tests) if test.test == "autocorrelation"}
    for name, output in fit.innovations.outputs.items():
        spectrum = output.cumulative_periodogram or CumulativePeriodogram()
        moments = (
            fixed(output.mean, 3),
            fixed(output.variance),
            fixed(output.excess_kurtosis),
            percent(output.beyond_3, 2),
        )
        chances = (p_value(day.get(name, math.nan)), p_value(spectrum.p))
        rows.append((name, str(output.n), *moments, *chances))
    columns = ("output", "n", "mean", "variance", "kurtosis", "beyond ±3", "Ljung–Box p", "spectrum p")
    note = (
        "Innovations over their standard deviation. White and normal ones have mean 0, variance 1, excess "
        "kurtosis 0 and 0.27 % beyond ±3. Ljung–Box: test for correlation over a day."
    )
    return Table("Standardised innovations", columns, tuple(rows), note=note)


# --- evaluation ------------------------------------------------------------------------------


def evaluation_text(found: Evaluation) -> str:
    """The scores of a fit on another record as text of at most 100 columns."""
    return "\n\n".join(blocks_text(evaluation_blocks(found)))


def evaluation_blocks(found: Evaluation) -> tuple[Block, ...]:
    """Table III of the paper for both periods, with the rules that need no model, and the bands."""
    tables = [rmse_table(found, period) for period in ("identification", "validation")]
    scored = any(tables)
    return present(
        Heading(f"{found.fit} on {found.record}: errors of the free run"),
        Prose(FREE_RUN),
        inherited_verdicts(found.verdicts, ""),
        Items(tuple(f"note: {line}" for line in found.statements)) if found.statements else None,
        *(tables if scored else [Prose(NOTHING, "missing")]),
        bands_table(found) if scored else None,
    )


NOTHING = (
    "Nothing to score: there is no temperature or absolute humidity of the cabinet at a time when all inputs "
    "are known. Relative humidity needs the temperature beside it; a fit that knows the power needs the "
    "power; after a gap in the inputs the score waits 12 h. See the gaps in `hygrokf check`."
)
