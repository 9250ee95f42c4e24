"""Models as this package identifies them and as the paper does, and what each makes of a record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record
from hygrokf.data.structured import plain
from hygrokf.evaluation.scoring import scores
from hygrokf.evaluation.simulation import free_run
from hygrokf.identification.estimation import output_errors
from hygrokf.identification.fit import Fit
from hygrokf.identification.identify import assemble_fit, identify_stages
from hygrokf.modelling.design import CASCADE, Design, read_as
from hygrokf.modelling.inputs import model_inputs

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


def _quiet(text: str) -> None:
    """Progress is told by the frame."""


def identify_both(record: Record, starts: int) -> Identified:
    """Identify a record on its identification period by both criteria."""
    early = prepare(record.identification())
    basis = identify_stages(early, CASCADE, starts, True, _quiet)
    simulated = output_errors(early, basis.whole, basis.values)
    fit = assemble_fit(record, basis, simulated, "likelihood", _quiet)
    free = dict(basis.values)
    for found in simulated.values():
        free |= {n: found.values[n] for n in (*found.names, *found.unseen) if n in free}
    return Identified(fit, {LIKELIHOOD: dict(basis.values), FREE_RUN: free})


@dataclass(frozen=True)
class Simulation:
    """Scores of a model's free run on a record: of the whole and of its periods."""

    whole: dict
    periods: dict


def simulate(design: Design, values: Mapping[str, float], record: Record) -> Simulation:
    """Run a model on a record's drivers and score it."""
    base = read_as(design, record)
    made = model_inputs(base, record)
    undivided = replace(made, record=replace(made.record, until_s=None))
    predicted = free_run(base, values, made, None)
    return Simulation(
        whole=plain(scores(undivided, predicted)["identification"]),
        periods=plain(scores(made, predicted)),
    )
