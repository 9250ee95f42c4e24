"""What each accepted cause gains on the held-out period, and which of them that period refutes.

Models are compared in the order in which their causes were accepted: without any, with the first, with the
first two, and so on, each by its free run on the whole record.  A model is taken as estimated by innovations
or, where that simulates the identification period better, moved toward its least free-run error: a likelihood
makes a poor simulator of a model that lacks something.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.clocks import cabinet_moved, shifted
from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.candidate import Candidate, added_mechanisms, attempt, clock_shifts, restarted
from hygrokf.discovery.discovery_results import Gain
from hygrokf.discovery.model_selection import WORSE, Accepted, Selection, with_candidate
from hygrokf.discovery.residuals import root_mean_square
from hygrokf.discovery.submodel import HYGRIC, THERMAL, Submodel, seconds, simulation_values
from hygrokf.evaluation.bootstrap import resampled
from hygrokf.evaluation.simulation import QUANTITIES, measured, settled, simulate
from hygrokf.modelling.design import merged
from hygrokf.modelling.inputs import prepare_run

SIMULATION_STEP = 1.0
"""Product of rate and sub-step in simulations over the whole record: without readings, coarser steps can
leave a variance below zero."""
BLOCK_DAYS = 3.0
"""[d] blocks by which errors are drawn; shorter where the period would have fewer than `FEWEST_BLOCKS`."""
FEWEST_BLOCKS = 6
DIVERGED = 1e4
"""[K], [g/m³] root mean squared error beyond which a free run has diverged: its size is that of no
cabinet."""
QUANTITY = {THERMAL: "temperature_K", HYGRIC: "absolute_humidity_g_m3"}
Errors = Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Simulated:
    """Free-run errors of one model on a record: quantity → (times [s], errors), at its scored readings.

    The times are those of the record before its clocks were corrected.
    """

    errors: Errors
    until_s: float

    def of(self, quantity: str, period: str) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) and errors (n,) in a period, "identification" or "validation"."""
        time, error = self.errors.get(quantity, (np.empty(0), np.empty(0)))
        late = time > self.until_s
        there = late if period == "validation" else ~late
        return time[there], error[there]

    def rmse(self, quantity: str, period: str) -> float:
        """Root mean squared error in a period; NaN without readings."""
        return root_mean_square(self.of(quantity, period)[1])


@dataclass(frozen=True)
class Model:
    """One model as a simulator: as `identified`, and `moved` toward its least free-run error."""

    identified: Simulated
    moved: Simulated

    def better(self, quantity: str) -> Simulated:
        """The simulation of the identification period with the smaller error."""
        identified, moved = (one.rmse(quantity, "identification") for one in (self.identified, self.moved))
        return self.moved if moved < identified else self.identified


@dataclass(frozen=True)
class HeldOut:
    """A selection without the causes that the held-out period refutes, these causes with their (negative)
    gain, and `baselines` and `models` without any cause, with the first, with the first two, …
    """

    selection: Selection
    refuted: tuple[tuple[Candidate, Gain], ...]
    baselines: tuple[Baseline, ...]
    models: tuple[Model, ...]

    @property
    def gains(self) -> list[Gain]:
        """The gain of each accepted cause in its own quantity beside those before it."""
        pairs = zip(self.models[:-1], self.models[1:], strict=True)
        return [
            gain_of(quantity_of(candidate), *pair)
            for candidate, pair in zip(self.selection.candidates, pairs, strict=True)
        ]

    def ending(self, last: Model) -> HeldOut:
        """The same with the last model in its final estimate; without its cause where that is refuted now."""
        ended = replace(self, models=(*self.models[:-1], last))
        gain = ended.gains[-1]
        if not refutes(gain):
            return ended
        *kept, one = self.selection.accepted
        refuted = ((one.candidate, gain),)
        selection = _without(self.selection, kept, refuted, self.baselines[-2])
        return HeldOut(selection, (*refuted, *self.refuted), self.baselines[:-1], self.models[:-1])


def _without(
    selection: Selection,
    kept: Sequence[Accepted],
    refuted: Sequence[tuple[Candidate, Gain]],
    baseline: Baseline,
) -> Selection:
    """A selection with the causes that were kept alone; the refuted ones are rejected."""
    rejected = [(candidate, refutation(gain)) for candidate, gain in refuted]
    return replace(
        selection, accepted=tuple(kept), rejected=(*rejected, *selection.rejected), baseline=baseline
    )


def quantity_of(candidate: Candidate) -> str:
    """A cause's own quantity: that of the submodel whose free run gains most."""
    return QUANTITY.get(candidate.submodel, QUANTITY[THERMAL])


def model_of(baseline: Baseline, record: Record, candidates: Sequence[Candidate] = ()) -> Model:
    """A baseline's model on the whole record, whose clocks are corrected as its candidates say.

    Parameters far from the estimate may make a free run diverge.
    """
    shifts = clock_shifts(candidates)
    design = merged([submodel.base for submodel in baseline.submodels.values()])
    run = prepare_run(design, shifted(record, *shifts))
    submodels = baseline.submodels.values()
    identified = {name: value for submodel in submodels for name, value in submodel.values.items()}
    moved = {name: value for submodel in submodels for name, value in simulation_values(submodel).items()}
    run = settled(design, identified, run, SIMULATION_STEP)
    time_s = seconds(run.timeline) - cabinet_moved(record, shifts)
    readings = measured(run)

    def simulated(values: Mapping[str, float]) -> Simulated:
        # far from the estimate the spread may be lost; it is not used here
        with np.errstate(invalid="ignore"):
            found = simulate(design, values, run, rate_step=SIMULATION_STEP)
        errors = {}
        for quantity in QUANTITIES:
            pair = found.of(quantity)
            if pair is not None:
                error = readings[quantity] - pair[0]
                there = np.isfinite(error) & run.scored
                errors[quantity] = (time_s[there], error[there])
        return Simulated(errors, math.inf if record.until_s is None else record.until_s)

    return Model(simulated(identified), simulated(moved))


def gain_of(quantity: str, before: Model, after: Model) -> Gain:
    """How much better one model simulates than another: errors on the validation period (the identification
    period where there is none), and 95 % bounds of their difference by a bootstrap of blocks of three days.
    """
    pair = before.better(quantity), after.better(quantity)
    period = "validation" if math.isfinite(pair[0].rmse(quantity, "validation")) else "identification"
    low, high = difference_bounds(*(one.of(quantity, period) for one in pair))
    identified = [_unless_diverged(one.identified.rmse(quantity, period)) for one in (before, after)]
    return Gain(
        quantity=quantity,
        period=period,
        rmse_before=pair[0].rmse(quantity, period),
        rmse_after=pair[1].rmse(quantity, period),
        identified_before=identified[0],
        identified_after=identified[1],
        lower=low,
        upper=high,
    )


def _unless_diverged(rmse: float) -> float:
    return rmse if rmse < DIVERGED else math.nan


def difference_bounds(
    before: tuple[np.ndarray, np.ndarray], after: tuple[np.ndarray, np.ndarray]
) -> tuple[float, float]:
    """95 % bounds of RMSE before − RMSE after, of (times [s], errors) each, over the readings that both
    have."""
    # whole seconds: no two readings are nearer; an extended model may have instants of its own
    time, *places = np.intersect1d(np.round(before[0]), np.round(after[0]), return_indices=True)
    errors = np.column_stack([before[1][places[0]], after[1][places[1]]])
    long = float(np.ptp(time)) / (FEWEST_BLOCKS * DAY_S) if len(time) else 0.0
    drawn = resampled(time, errors, length_h=24.0 * min(max(long, 1.0), BLOCK_DAYS))
    found = None if drawn is None else drawn.difference(0, 1)
    return (math.nan, math.nan) if found is None else (found[1], found[2])


def refutes(gain: Gain) -> bool:
    """Whether the model simulates the held-out period worse with a cause: materially, as in the
    identification period (`model_selection.WORSE`), and with 95 % bounds that exclude a gain.  The bounds do
    not include that the other parameters were estimated anew.
    """
    if gain.period != "validation" or not math.isfinite(gain.upper):
        return False
    return gain.upper < 0.0 and gain.rmse_after**2 > (1.0 - WORSE) * gain.rmse_before**2


def without_refuted(base: Baseline, selection: Selection, record: Record) -> HeldOut:
    """The selection without the causes with which the held-out error of their own quantity grows beyond its
    uncertainty.

    Causes after a refuted one are estimated again without it.
    """
    if not selection.accepted:
        return HeldOut(selection, (), (), ())
    kept: list[Accepted] = []
    refuted: list[tuple[Candidate, Gain]] = []
    baselines, models = [base], [model_of(base, record)]
    for place, accepted in enumerate(selection.accepted):
        candidate = accepted.candidate
        whole = place == len(selection.accepted) - 1 and not refuted
        wider = selection.baseline if whole else _with(baselines[-1], candidate)
        after = model_of(wider, record, [*(one.candidate for one in kept), candidate])
        gain = gain_of(quantity_of(candidate), models[-1], after)
        if refutes(gain):
            refuted.append((candidate, gain))
        else:
            kept.append(accepted)
            models.append(after)
            baselines.append(wider)
    remaining = _without(selection, kept, refuted, baselines[-1])
    return HeldOut(remaining, tuple(refuted), tuple(baselines), tuple(models))


def _with(baseline: Baseline, candidate: Candidate) -> Baseline:
    """A baseline with a cause that was accepted in another baseline, with its estimate there where all else
    is the same."""
    same = candidate.variant.shift is None and all(
        submodel.record is baseline.submodels[name].record
        and _added(submodel, baseline.submodels[name]) == added_mechanisms(candidate.variant)
        for name, submodel in candidate.submodels.items()
    )
    return with_candidate(baseline, candidate if same else attempt(baseline, restarted(baseline, candidate)))


def _added(wider: Submodel, submodel: Submodel) -> set[str]:
    """Names of the mechanisms that a submodel has and another one has not."""
    return {name for name, _ in wider.base.mechanisms} - {name for name, _ in submodel.base.mechanisms}


def refutation(gain: Gain) -> str:
    """Why the held-out period refutes a cause."""
    unit = "K" if gain.quantity.endswith("_K") else "g/m³"
    return (
        f"the held-out period refutes it: with it the error there grows from {gain.rmse_before:.3g} to "
        f"{gain.rmse_after:.3g} {unit} (95 % bounds of the growth {-gain.upper:.2g} … "
        f"{-gain.lower:.2g})"
    )
