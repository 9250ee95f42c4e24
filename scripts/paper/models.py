"""Models as this package identifies them and as the paper does, and what each makes of a record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.structured import plain
from hygrokf.evaluation.scoring import baselines, scores
from hygrokf.evaluation.simulation import Prediction, free_run, measured
from hygrokf.identification.estimation import output_errors
from hygrokf.identification.fit import Fit
from hygrokf.identification.procedure import assemble_fit, identify_stages
from hygrokf.modelling.design import CASCADE, Design, read_as
from hygrokf.modelling.inputs import Run, model_inputs

Say = Callable[[str], None]
LIKELIHOOD = "likelihood"
FREE_RUN = "free run"
CRITERIA = (LIKELIHOOD, FREE_RUN)
"""The package's own criterion, and the paper's: the least error of the free run."""


@dataclass(frozen=True)
class Identified:
    """A record's model by both criteria: the fit, and the values of each.

    Errors of the cabinet's sensors belong to the likelihood's values; the free run's least error knows none.
    """

    fit: Fit
    values: Mapping[str, Mapping[str, float]]

    def without_sensors(self, criterion: str) -> dict[str, float]:
        """The values for another logger: constant errors of the first one are left behind."""
        return self.values[criterion] | _no_errors(self.fit.design)


def _no_errors(design: Design) -> dict[str, float]:
    return {p.name: 0.0 for p in design.model.parameters if p.prior is not None}


def identify_both(record: Record, starts: int, say: Say) -> Identified:
    """Identify a record on its identification period by both criteria."""
    early = record.identification()
    basis = identify_stages(early, CASCADE, starts, True, say)
    simulated = output_errors(early, basis.whole, basis.values)
    fit = assemble_fit(record, basis, simulated, "likelihood", say)
    free = dict(basis.values)
    for found in simulated.values():
        free |= {n: found.values[n] for n in (*found.names, *found.unseen) if n in free}
    return Identified(fit, {LIKELIHOOD: dict(basis.values), FREE_RUN: free})


@dataclass(frozen=True)
class Simulation:
    """A model's free run on a record: scores of the whole record and of its periods, and arrays for
    pictures."""

    whole: dict
    periods: dict
    baselines: dict
    series: dict[str, np.ndarray]


def simulate(
    design: Design, values: Mapping[str, float], record: Record, fit: Fit | None = None
) -> Simulation:
    """Run a model on a record's drivers and score it.

    fit: where the values are those of the fit's likelihood, its covariance widens the bands of the pictures.
    """
    base = read_as(design, record)
    made = model_inputs(base, record)
    predicted = free_run(base, values, made, None if fit is None else fit.covariance)
    return Simulation(
        whole=plain(scores(made, predicted, None)["identification"]),
        periods=plain(scores(made, predicted, record.until_s)),
        baselines=plain(baselines(made, None)["identification"]),
        series=_series(made, predicted, record),
    )


def _series(made: Run, predicted: Prediction, record: Record) -> dict[str, np.ndarray]:
    """The arrays that the figures of hygrokf.report.figures.course read, as in series.npz."""
    t, known = made.timeline, measured(made)
    nothing = np.full(len(t), np.nan)
    arrays = {
        "time_s": t.origin_s + 3600.0 * t.time,
        "ambient_temperature": t.input("ambient_temperature"),
        "ambient_absolute_humidity": t.input("ambient_absolute_humidity"),
        "power": t.input("power_1") if "power_1" in t.varying else nothing,
        "operating": made.operating.astype(float),
        "preheating": np.zeros(len(t)),
        "scored": made.scored.astype(float),
        "until_s": np.array(np.nan if record.until_s is None else record.until_s),
        "start_s": np.array(record.start_s),
    }
    for name in ("temperature", "relative_humidity", "absolute_humidity"):
        value, sd = getattr(predicted, name) or (nothing, nothing)
        reading = next(v for key, v in known.items() if key.startswith(name))
        arrays |= {f"{name}_measured": reading, f"{name}_simulated": value, f"{name}_sd": sd}
    return arrays
