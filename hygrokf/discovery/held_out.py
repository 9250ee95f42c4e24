"""What each accepted cause gains on the held-out period, and which of them that period refutes.

The models are held against each other in the order in which their causes were accepted: without any, with the
first, with the first two, and so on, each by its free run on the whole record.  A model is taken as it was
estimated by innovations or, where that simulates the identification period better, moved toward its least
free-run error: a likelihood makes a poor simulator of a model that lacks something.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.baseline import HYGRIC, SIMULATION_STEP, THERMAL, Baseline, Part, simulating
from hygrokf.discovery.candidate import Candidate, added, attempt, started
from hygrokf.discovery.clocks import cabinet_moved, shifted
from hygrokf.discovery.discovery_results import Gain
from hygrokf.discovery.model_selection import WORSE, Selection, with_candidate
from hygrokf.evaluation.bootstrap import resampled
from hygrokf.evaluation.simulation import QUANTITIES, measured, simulate
from hygrokf.modelling.design import merged
from hygrokf.modelling.inputs import prepare_run

BLOCK_DAYS = 3.0
"""[d] Blocks by which errors are drawn; shorter where the period would have fewer than `FEWEST_BLOCKS`."""
FEWEST_BLOCKS = 6
QUANTITY = {THERMAL: "temperature_K", HYGRIC: "absolute_humidity_g_m3"}
Errors = Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Simulated:
    """Free-run errors of one model on a record: quantity → (times [s], errors), at its scored readings.

    The times are those of the record as it came: `moved_s` by which corrected clocks move them is taken off.
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
        _, error = self.of(quantity, period)
        return float(np.sqrt(np.mean(error**2))) if len(error) else math.nan


@dataclass(frozen=True)
class Model:
    """One model as a simulator: as it was `identified`, and `moved` toward its least free-run error."""

    identified: Simulated
    moved: Simulated

    def better(self, quantity: str) -> Simulated:
        """The one that simulates the identification period better."""
        errors = [one.rmse(quantity, "identification") for one in (self.identified, self.moved)]
        return self.moved if errors[1] < errors[0] else self.identified


@dataclass(frozen=True)
class Judged:
    """A choice without the causes that the held-out period refutes, those with their (negative) gain, and
    `baselines` and `models` without any cause, with the first, with the first two, …
    """

    selection: Selection
    refuted: tuple[tuple[Candidate, Gain], ...]
    baselines: tuple[Baseline, ...]
    models: tuple[Model, ...]

    @property
    def gains(self) -> list[Gain]:
        """What each accepted cause gains in its own quantity beside those before it."""
        pairs = zip(self.models[:-1], self.models[1:], strict=True)
        return [
            gain_of(quantity_of(candidate), *pair)
            for candidate, pair in zip(self.selection.accepted, pairs, strict=True)
        ]

    def ending(self, last: Model) -> Judged:
        """The same with the last model as it was estimated in the end; without its cause where that is
        refuted now."""
        ended = replace(self, models=(*self.models[:-1], last))
        gain = ended.gains[-1]
        if not refutes(gain):
            return ended
        candidate = self.selection.accepted[-1]
        selection = replace(
            self.selection,
            accepted=self.selection.accepted[:-1],
            rivals=self.selection.rivals[:-1],
            margins=self.selection.margins[:-1],
            rejected=((candidate, refutation(gain)), *self.selection.rejected),
            baseline=self.baselines[-2],
        )
        return Judged(selection, ((candidate, gain), *self.refuted), self.baselines[:-1], self.models[:-1])


def quantity_of(candidate: Candidate) -> str:
    """The quantity whose free run a cause gains most in: its own."""
    return QUANTITY.get(candidate.part, QUANTITY[THERMAL])


def model_of(baseline: Baseline, record: Record, candidates: Sequence[Candidate] = ()) -> Model:
    """A baseline's model on the whole record, whose clocks are corrected as its candidates say."""
    shifts = [candidate.variant.shift for candidate in candidates if candidate.variant.shift is not None]
    corrected = record
    for shift in shifts:
        corrected = shifted(corrected, shift)
    design = merged([part.base for part in baseline.parts.values()])
    made = prepare_run(design, corrected)
    seconds = made.timeline.origin_s + 3600.0 * made.timeline.time - cabinet_moved(record, shifts)
    readings = measured(made)

    def simulated(values: Mapping[str, float]) -> Simulated:
        with np.errstate(
            invalid="ignore"
        ):  # far from the estimate the spread may be lost; it is not used here
            found = simulate(design, values, made, rate_step=SIMULATION_STEP)
        errors = {}
        for quantity in QUANTITIES:
            pair = found.of(quantity)
            if pair is not None:
                error = readings[quantity] - pair[0]
                there = np.isfinite(error) & made.scored
                errors[quantity] = (seconds[there], error[there])
        return Simulated(errors, math.inf if record.until_s is None else record.until_s)

    parts = baseline.parts.values()
    as_it_is = {name: value for part in parts for name, value in part.values.items()}
    toward = {name: value for part in parts for name, value in simulating(part).items()}
    return Model(simulated(as_it_is), simulated(toward))


def gain_of(quantity: str, before: Model, after: Model) -> Gain:
    """What one model simulates better than another: errors on the validation period (the
    identification period where there is none), and 95 % bounds of their difference by a bootstrap of blocks
    of three days.

    `identified_before`, `identified_after`: the errors of the models as they were estimated by innovations,
    which tables and other pages show.
    """
    pair = before.better(quantity), after.better(quantity)
    period = "validation" if math.isfinite(pair[0].rmse(quantity, "validation")) else "identification"
    low, high = difference_bounds(*(one.of(quantity, period) for one in pair))
    return Gain(
        quantity=quantity,
        period=period,
        rmse_before=pair[0].rmse(quantity, period),
        rmse_after=pair[1].rmse(quantity, period),
        identified_before=before.identified.rmse(quantity, period),
        identified_after=after.identified.rmse(quantity, period),
        lower=low,
        upper=high,
    )


def difference_bounds(
    before: tuple[np.ndarray, np.ndarray], after: tuple[np.ndarray, np.ndarray]
) -> tuple[float, float]:
    """95 % bounds of RMSE before − RMSE after, of (times [s], errors) each, over the readings that both
    have."""
    # whole seconds: no two readings are nearer, and rounding is no other one
    columns = [
        dict(zip(np.round(time).tolist(), error.tolist(), strict=True)) for time, error in (before, after)
    ]
    # an extended model may have instants of its own: those of both are compared
    time = np.array(sorted(set(columns[0]) & set(columns[1])))
    errors = np.array([[column[at] for column in columns] for at in time]).reshape(-1, 2)
    long = float(np.ptp(time)) / (FEWEST_BLOCKS * DAY_S) if len(time) else 0.0
    drawn = resampled(time, errors, length_h=24.0 * min(max(long, 1.0), BLOCK_DAYS))
    found = None if drawn is None else drawn.difference(0, 1)
    return (math.nan, math.nan) if found is None else (found[1], found[2])


def refutes(gain: Gain) -> bool:
    """Whether the held-out period is simulated worse: materially, as in the identification period
    (`model_selection.WORSE`), and with 95 % bounds that exclude a gain.  The bounds know nothing of how the
    other parameters were estimated anew.
    """
    if gain.period != "validation" or not math.isfinite(gain.upper):
        return False
    return gain.upper < 0.0 and gain.rmse_after**2 > (1.0 - WORSE) * gain.rmse_before**2


def judged(base: Baseline, selection: Selection, record: Record) -> Judged:
    """The choice without the causes under which the held-out error of their own quantity grows beyond its
    uncertainty.

    Those after a refuted one are estimated again without it.
    """
    if not selection.accepted:
        return Judged(selection, (), (), ())
    kept: list[int] = []
    refuted: list[tuple[Candidate, Gain]] = []
    baselines, models = [base], [model_of(base, record)]
    for place, candidate in enumerate(selection.accepted):
        whole = place == len(selection.accepted) - 1 and not refuted
        wider = selection.baseline if whole else _with(baselines[-1], candidate)
        after = model_of(wider, record, [selection.accepted[i] for i in (*kept, place)])
        gain = gain_of(quantity_of(candidate), models[-1], after)
        if refutes(gain):
            refuted.append((candidate, gain))
        else:
            kept.append(place)
            models.append(after)
            baselines.append(wider)
    without = replace(
        selection,
        accepted=tuple(selection.accepted[i] for i in kept),
        rivals=tuple(selection.rivals[i] for i in kept),
        margins=tuple(selection.margins[i] for i in kept),
        rejected=(*((candidate, refutation(gain)) for candidate, gain in refuted), *selection.rejected),
        baseline=baselines[-1],
    )
    return Judged(without, tuple(refuted), tuple(baselines), tuple(models))


def _with(baseline: Baseline, candidate: Candidate) -> Baseline:
    """A baseline with a cause that was accepted in another one; as it was estimated there where all else was
    the same."""
    same = candidate.variant.shift is None and all(
        part.record is baseline.parts[name].record
        and _added(part, baseline.parts[name]) == added(candidate.variant)
        for name, part in candidate.parts.items()
    )
    return with_candidate(baseline, candidate if same else attempt(baseline, started(baseline, candidate)))


def _added(wider: Part, part: Part) -> set[str]:
    """Names of the mechanisms that a part has beside those of another one."""
    return {name for name, _ in wider.base.mechanisms} - {name for name, _ in part.base.mechanisms}


def refutation(gain: Gain) -> str:
    """Why the held-out period refutes a cause."""
    unit = "K" if gain.quantity.endswith("_K") else "g/m³"
    return (
        f"the held-out period refutes it: with it the error there grows from {gain.rmse_before:.3g} to "
        f"{gain.rmse_after:.3g} {unit} (95 % bounds of the growth {-gain.upper:.2g} … "
        f"{-gain.lower:.2g})"
    )
