"""A fit on another record: what `hygrokf simulate` writes, and the scores of `hygrokf evaluate`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hygrokf.data.record import Record, expect_record
from hygrokf.evaluation.scoring import Scored, bands, baselines, scores, sensor_share
from hygrokf.evaluation.simulation import Prediction, free_run, run_on
from hygrokf.identification.fit import Fit
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import Run
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.physics.signal_names import CABINET_HUMIDITIES
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Instant, Name
from hygrokf.texts.wording import iso_time

COLUMNS = {
    "cabinet_temperature_degC": "temperature_K",
    "cabinet_relative_humidity_pct": "relative_humidity",
    "cabinet_absolute_humidity_g_m3": "absolute_humidity_g_m3",
}
"""Columns of a simulation file and their quantities; each has a second column with its standard deviation."""


@dataclass(frozen=True)
class SimulationSummary:
    """Span and means of a simulation of the model `fit` with the inputs of `record`.

    `start`, `end` (ISO 8601) of its `n` instants; `share_with_known_inputs` [1]; `means` by quantity [K, 1,
    g/m³]; `verdicts` on the time constants it rests on; `statements`: what fit and record do not share.
    """

    fit: Name
    record: Name
    start: Instant
    end: Instant
    n: int
    share_with_known_inputs: float = math.nan
    means: Mapping[str, float] = field(default_factory=dict)
    verdicts: Mapping[str, Inherited] = field(default_factory=dict)
    statements: tuple[Statement, ...] = ()


@dataclass(frozen=True)
class Evaluation(Scored):
    """The scores of the model `fit` on `record`, with the verdicts on the time constants they rest on.

    `statements`: the differences between the record and that of the fit.
    """

    fit: Name = ""
    record: Name = ""
    verdicts: Mapping[str, Inherited] = field(default_factory=dict)
    statements: tuple[Statement, ...] = ()


def simulate_fit(fit: Fit, record: Record) -> tuple[Design, Run, Prediction]:
    """Simulate a fitted model with a record's inputs alone.

    Returns the design (averaging intervals as in the record), the run and the prediction.
    """
    base, run = run_on(fit.design, fit.values, expect_record(record, "evaluate"))
    return base, run, free_run(base, fit.values, run, fit.covariance)


def simulation_csv(run: Run, predicted: Prediction) -> str:
    """Return a free run of `simulate_fit` as CSV text.

    Columns: time (UTC), three quantities with standard deviations, and whether all inputs are known.
    """
    timeline = run.timeline
    milliseconds = np.round(1e3 * timeline.seconds).astype("int64")
    unit: Literal["s", "ms"] = "s" if np.all(milliseconds % 1000 == 0) else "ms"
    stamps = np.datetime_as_string(milliseconds.astype("datetime64[ms]"), unit=unit)
    columns, names = [], []
    for name, quantity in COLUMNS.items():
        value_and_sd = predicted.of(quantity)
        if value_and_sd is None:
            continue
        value, sd = value_and_sd
        if quantity == "temperature_K":
            value = value - ZERO_CELSIUS_K
        elif quantity == "relative_humidity":
            value, sd = 100.0 * value, 100.0 * sd
        columns += [value, sd]
        names += [name, f"{name}_sd"]
    lines = [",".join(["time", *names, "inputs_known"])]
    for stamp, numbers_of_row, inputs_known in zip(stamps, np.column_stack(columns), run.scored, strict=True):
        numbers = ",".join("" if not np.isfinite(number) else f"{number:.4f}" for number in numbers_of_row)
        lines.append(f"{stamp}Z,{numbers},{int(inputs_known)}")
    return "\n".join(lines) + "\n"


def simulation_summary(fit: Fit, run: Run, predicted: Prediction) -> SimulationSummary:
    """Return span and means of a free run of `simulate_fit`."""
    timeline, record = run.timeline, run.record
    means = {
        quantity: float(np.mean(value_and_sd[0]))
        for quantity in COLUMNS.values()
        if (value_and_sd := predicted.of(quantity)) is not None
    }
    return SimulationSummary(
        fit.name,
        record.name,
        iso_time(timeline.seconds[0]),
        iso_time(timeline.seconds[-1]),
        len(timeline),
        float(run.scored.mean()),
        means,
        inherited(fit.results),
        (*mismatches(fit, record), *_unknown_throughout(fit, run)),
    )


def _unknown_throughout(fit: Fit, run: Run) -> list[Statement]:
    """Return a statement if at least one input is unknown at every instant of a run."""
    if run.scored.any():
        return []
    inputs = fit.design.model.inputs
    uses_power = "operating" in inputs or any(name.startswith("power_") for name in inputs)
    lacks_power = uses_power and "active_power" not in run.record
    return [(FitCode.POWER_UNKNOWN_THROUGHOUT if lacks_power else FitCode.INPUT_UNKNOWN_THROUGHOUT)()]


def evaluate(fit: Fit, record: Record) -> Evaluation:
    """Score a fit on a record: the free run, simple rules beside it, and the coverage of the 95 % bands.

    fit: of `identify` or `read_fit`.
    record: the one to score it on.

    Returns errors by period and quantity ([K], [g/m³]; `errors`, `rule_errors`), the share [1] of the squared
    error that the sensors explain, and coverage [1] by lead (`band`).  Raises KeyError where the record
    lacks an input that the model reads.
    """
    base, run, predicted = simulate_fit(fit, record)
    table = scores(run, predicted)
    return Evaluation(
        table,
        baselines(run),
        sensor_share(run, table),
        bands(base, fit.values, run, predicted),
        fit.name,
        record.name,
        inherited(fit.results),
        tuple(mismatches(fit, record)),
    )


def rated_power_mismatch(design: Design, record: Record) -> list[Statement]:
    """Return a statement if a record's rated power differs from the design's power scale by more than 2 %."""
    scale = design.power_scale_W
    ratio = record.rated_power_W / scale if record.rated_power_W and scale else 1.0
    if abs(ratio - 1.0) <= 0.02:
        return []
    return [FitCode.OTHER_RATED_POWER(ratio=ratio)]


def mismatches(fit: Fit, record: Record) -> list[Statement]:
    """Return statements about differences between a fitted model and a record.

    They concern the rated power, and signals that only one of the two has.
    """
    statements = rated_power_mismatch(fit.design, record)
    inputs, outputs = fit.design.model.inputs, fit.design.model.outputs
    if "preheating" in inputs and "preheating" not in record:
        statements.append(FitCode.PREHEATING_NOT_LOGGED())
    if "preheating" not in inputs and "preheating" in record and np.nanmax(record["preheating"].value) > 0:
        statements.append(FitCode.PREHEATING_NOT_MODELLED())
    modelled_humidities = [name for name in CABINET_HUMIDITIES if name in outputs]
    if modelled_humidities and not any(name in record for name in modelled_humidities):
        statements += [
            FitCode.OTHER_HUMIDITY(predicted=modelled_humidities[0], recorded=name)
            for name in CABINET_HUMIDITIES
            if name in record
        ]
    return statements
