"""What `hygrokf simulate` and `hygrokf evaluate` give: tables of a fit on another record."""

from __future__ import annotations

import io
from collections.abc import Mapping
from datetime import UTC, datetime

import numpy as np

from hygrokf.data.record import Record
from hygrokf.evaluation.scoring import PERIODS, SCORED, bands, baselines, scores, sensor_share
from hygrokf.evaluation.simulation import Prediction, simulate
from hygrokf.identification.fit import Fit
from hygrokf.identification.verdict import inherited, told
from hygrokf.identification.wording import RULES
from hygrokf.modelling.design import HUMIDITIES, Design, read_as
from hygrokf.modelling.inputs import Run, prepare_run

COLUMNS = {
    "cabinet_temperature_degC": "temperature_K",
    "cabinet_relative_humidity_pct": "relative_humidity",
    "cabinet_absolute_humidity_g_m3": "absolute_humidity_g_m3",
}
"""Columns of a simulation file and the quantities they hold; each has a second one with its standard deviation."""


def simulated(fit: Fit, record: Record) -> tuple[Design, Run, Prediction]:
    """The fitted model driven by a record's inputs alone; its loggers may average otherwise than the fitted ones."""
    base = read_as(fit.design, record)
    made = prepare_run(base, record)
    return base, made, simulate(base, fit.values, made, fit.covariance)


def simulation_csv(fit: Fit, record: Record) -> str:
    """Free run as CSV text: time (UTC), three quantities with their standard deviations, and whether inputs are known."""
    _, made, predicted = simulated(fit, record)
    t = made.timeline
    milliseconds = np.round(1e3 * (t.origin_s + t.time * 3600.0)).astype("int64")
    instants = milliseconds.astype("datetime64[ms]")
    whole = bool(np.all(milliseconds % 1000 == 0))
    stamps = np.datetime_as_string(instants, unit="s" if whole else "ms")
    columns, names = [], []
    for name, quantity in COLUMNS.items():
        pair = predicted.of(quantity)
        if pair is None:
            continue
        value, sd = pair
        if quantity == "temperature_K":
            value = value - 273.15
        elif quantity == "relative_humidity":
            value, sd = 100.0 * value, 100.0 * sd
        columns += [value, sd]
        names += [name, f"{name}_sd"]
    buffer = io.StringIO()
    buffer.write(",".join(["time", *names, "inputs_known"]) + "\n")
    for stamp, row, known in zip(stamps, np.column_stack(columns), made.scored, strict=True):
        numbers = ",".join("" if not np.isfinite(v) else f"{v:.4f}" for v in row)
        buffer.write(f"{stamp}Z,{numbers},{int(known)}\n")
    return buffer.getvalue()


def simulation_summary(fit: Fit, record: Record) -> dict:
    """Span and means of a simulation."""
    _, made, predicted = simulated(fit, record)
    t = made.timeline
    ends = [
        datetime.fromtimestamp(t.origin_s + h * 3600.0, UTC).isoformat(timespec="seconds")
        for h in (t.time[0], t.time[-1])
    ]
    means = {
        quantity: float(np.mean(pair[0]))
        for quantity in COLUMNS.values()
        if (pair := predicted.of(quantity)) is not None
    }
    return {
        "fit": fit.name,
        "record": record.name,
        "start": ends[0],
        "end": ends[1],
        "n": len(t),
        "share_with_known_inputs": float(made.scored.mean()),
        "means": means,
        "verdicts": inherited(fit.results),
        "statements": [*unlike(fit, record), *_unknown_throughout(fit, record, made)],
    }


def _unknown_throughout(fit: Fit, record: Record, made: Run) -> list[str]:
    """A sentence where no instant has all inputs known, with the input that lacks."""
    if made.scored.any():
        return []
    inputs = fit.design.model.inputs
    powered = "operating" in inputs or any(name.startswith("power_") for name in inputs)
    lacking = "an input is unknown, or was until shortly before, all along; see the gaps in `hygrokf check`"
    if powered and "active_power" not in record:
        lacking = (
            "the fit knows the power, the record brings no active_power: it is taken as standstill throughout"
        )
    return [f"no row has all inputs known (inputs_known is 0 throughout): {lacking}"]


def evaluate(fit: Fit, record: Record) -> dict:
    """Scores, baselines, sensor share and band coverage of a fit on a record."""
    base, made, predicted = simulated(fit, record)
    table = scores(made, predicted, record.until_s)
    return {
        "fit": fit.name,
        "record": record.name,
        "verdicts": inherited(fit.results),
        "rmse": table,
        "baselines": baselines(made, record.until_s),
        "sensor_share": sensor_share(record, made, table),
        "bands": bands(base, fit.values, made, predicted, record.until_s),
        "statements": unlike(fit, record),
    }


def unlike(fit: Fit, record: Record) -> list[str]:
    """What the fitted model knows and the record does not, and the other way round, in sentences."""
    found = []
    scale = fit.design.power_scale_W
    if record.rated_power_W and scale and abs(record.rated_power_W / scale - 1.0) > 0.02:
        found.append(
            f"this turbine's rated power is {record.rated_power_W / scale:.2f} times that of the fit: another type? "
            "The heat release counts power in the fit's scale"
        )
    inputs, outputs = fit.design.model.inputs, fit.design.model.outputs
    if "preheating" in inputs and "preheating" not in record:
        found.append("the fit knows pre-heating, the record brings none: it is taken as off throughout")
    if "preheating" not in inputs and "preheating" in record and np.nanmax(record["preheating"].value) > 0:
        found.append("the record brings pre-heating, which the fit does not know: it is left out")
    for name in HUMIDITIES:
        if (
            name in record
            and name not in outputs
            and not set(outputs) & set(HUMIDITIES) & set(record.signals)
        ):
            read = next((n for n in HUMIDITIES if n in outputs), None)
            if read is not None:
                found.append(f"the fit reads {read}, the record brings {name}: its humidity is not scored")
    return found


def evaluation_text(found: Mapping) -> str:
    """The evaluation as a fixed-width table: Table III of the paper with the baselines below it."""
    lines = [f"{found['fit']} on {found['record']}: root mean squared error of the free run"]
    lines += told(found.get("verdicts"))
    lines += [f"note: {sentence}" for sentence in found.get("statements", ())]
    lines.append("")
    title = len(lines)
    head = f"{'':36}{'operation':>12}{'standstill':>12}{'total':>12}{'n':>9}"
    for period in PERIODS:
        if not any(found["rmse"][period][q]["n"]["total"] for q in SCORED):
            continue
        lines += [period, head]
        for quantity, unit in zip(SCORED, ("temperature [K]", "absolute humidity [g/m3]"), strict=True):
            lines.append(_row(f"  model, {unit}", found["rmse"][period][quantity]))
            for name, guess in found["baselines"][period].items():
                if quantity in guess:
                    lines.append(_row(f"  {RULES[name]}", guess[quantity]))
        lines.append("")
    if len(lines) == title:
        return "\n".join(
            [
                *lines,
                "nothing to score: no temperature or absolute humidity of the cabinet at a time when all inputs are known",
                "(relative humidity needs the temperature beside it; a fit that knows the power needs the power; after a",
                "gap the score waits 12 h); see `hygrokf check`",
            ]
        )
    validated = any(found["rmse"]["validation"][q]["n"]["total"] for q in SCORED)
    lines.append("coverage of the 95 % bands" + (" (validation)" if validated else ""))
    for lead, by_quantity in found["bands"].items():
        cells = [
            f"{_LABELS[q]} {100 * c['coverage']:.1f} % (n {c['n']})"
            for q, c in by_quantity.items()
            if c["coverage"] is not None
        ]
        if cells:
            lines.append(f"  {lead.replace('_', ' '):9} " + ", ".join(cells))
    return "\n".join(lines)


_LABELS = {
    "temperature_K": "temperature",
    "relative_humidity": "relative humidity",
    "absolute_humidity_g_m3": "absolute humidity",
}


def _row(label: str, cells: Mapping) -> str:
    numbers = "".join(
        f"{'–':>12}" if cells[r] is None else f"{cells[r]:12.2f}"
        for r in ("operation", "standstill", "total")
    )
    return f"{label:36}{numbers}{cells['n']['total']:9d}"
