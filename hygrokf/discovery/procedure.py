"""From a record to its discovery: the errors of the simulation, their cause, the extended model, and its
gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from hygrokf.data.clocks import shifted
from hygrokf.data.drawn import drawn
from hygrokf.data.progress import Progress, reporting
from hygrokf.data.record import Record
from hygrokf.data.structured import JsonObject, plain
from hygrokf.discovery.baseline import SECONDS, Baseline, Budget
from hygrokf.discovery.candidate import Candidate, clock_shifts
from hygrokf.discovery.cause import Cause
from hygrokf.discovery.discovery_results import (
    DiscoveryResults,
    ModelScores,
    NotTried,
    Refuted,
    Rejected,
    ResidualStructure,
    Verdict,
)
from hygrokf.discovery.evidence import cause_entry, evidence
from hygrokf.discovery.findings import findings
from hygrokf.discovery.held_out import SIMULATION_STEP, HeldOut, model_of, without_refuted
from hygrokf.discovery.library import LIBRARY
from hygrokf.discovery.model_selection import Selection, brings_switch, select
from hygrokf.discovery.own_causes import adopt, origins_of
from hygrokf.discovery.repeats import REPEATED, repeated_text, without_repeats
from hygrokf.discovery.residual_structure import remaining
from hygrokf.discovery.residuals import Residuals, residuals
from hygrokf.discovery.submodel import HYGRIC, SEARCH_STEP, THERMAL, simulation_values, submodel_of
from hygrokf.estimation.optimiser import refine
from hygrokf.identification.estimation import DesignEstimate, Stage, assess_stage, output_errors
from hygrokf.identification.fit import Fit
from hygrokf.identification.procedure import Basis, assemble_fit, identify_stages
from hygrokf.modelling.design import CASCADE
from hygrokf.version import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REFUTED = (
    "the held-out period refutes the cause found in the identification period: the model lacks something else"
)
UNEXPLAINED_AT_MOST = 0.5
"""[1] largest confidence of a cause under the verdict "unexplained"."""


@dataclass(frozen=True)
class Discovery:
    """The base fit, the extended fit where a cause was accepted, and the results.

    `results`: the data of `discovery.json`; `results.to_frame()` lists every cause that was tried.  `before`,
    `after`: residuals of both models, for figures.  A discovery can be pickled.
    """

    base: Fit
    extended: Fit | None
    results: DiscoveryResults
    before: Residuals | None = None
    after: Residuals | None = None

    def to_json(self) -> JsonObject:
        """The data of `discovery.json`."""
        data: JsonObject = plain(self.results)
        return data

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """Readings, base and extended model where the error is largest; else errors over the drivers.

        axes: matplotlib's; one, or one for each panel (episodes, or drivers by quantity).
            None: a new figure of pyplot, in the style of the reports.

        Returns the axes that were drawn on; nothing is shown.  Raises HygrokfError where the picture's
        data or matplotlib are missing, ValueError for more axes than panels.
        """
        return drawn("plot_discovery", self, axes)

    def __str__(self) -> str:
        """The name with its verdict, and each cause with its confidence [1]."""
        causes = [
            f"  {one.cause} ({one.form}), confidence {one.confidence:.2f}" for one in self.results.causes
        ]
        return "\n".join([f"{self.results.name}: {self.results.verdict}", *causes])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return str(self.results.to_frame().to_html())


def discover(
    record: Record,
    *,
    library: Sequence[Cause] = LIBRARY,
    starts: int = 4,
    progress: Progress | bool | None = None,
    budget_s: float = SECONDS,
) -> Discovery:
    """Find what the identified model of a record lacks, and name the cause from a library.

    All choices use the identification period; the validation period can refute them and gives the reported
    gain.

    record: as for `identify`.
    library: the causes to try; `load_library` reads further ones from a file.
    starts: number of start points of each maximisation.
    progress: called with each step in words; True: shows them as one line, also in a notebook.
    budget_s: [s] of wall-clock time.  `not_tried` of the results lists what was left out; `math.inf` gives
        results that do not depend on the machine.

    Returns the base fit, the extended fit where a cause was accepted, and `results` as in discovery.json.
    Raises ValueError as `identify` does, and LibraryFault for user causes that cannot be used.
    """
    adopt(library)
    with reporting(progress, "discover") as say:
        return _discovered(record, library, starts, say, budget_s)


def _discovered(
    record: Record, library: Sequence[Cause], starts: int, say: Progress, budget_s: float
) -> Discovery:
    budget = Budget(budget_s)
    record, repeated = without_repeats(record)
    early = record.identification()
    basis = identify_stages(early, CASCADE, starts, True, say)
    simulated = output_errors(early, basis.whole, basis.values)
    base = assemble_fit(record, basis, simulated, say=say)
    names = (THERMAL, HYGRIC)[: len(basis.stages)]
    baseline = Baseline(
        early,
        {
            name: submodel_of(name, driven, stage)
            for name, driven, stage in zip(names, basis.records, basis.stages, strict=True)
        },
        budget,
    )
    say("base model as a simulator")
    simulator = assemble_fit(record, _simulating(basis, baseline), simulated, say=say)
    selection = select(baseline, library, say)
    baseline = replace(baseline, budget=Budget())
    if selection.accepted:
        say("held-out period")
    tested = without_refuted(baseline, selection, record)
    wider = basis
    while tested.selection.accepted:
        say("extended model")
        selection = tested.selection
        wider = replace(basis, stages=_stages(basis, selection, not budget.spent, say))
        ended = model_of(_ended(selection.baseline, wider.stages), record, selection.candidates)
        tested = tested.ending(ended)
        if tested.selection is selection:
            break
    selection = tested.selection
    before = after = residuals(base, record)
    corrected = shifted(record, *clock_shifts(selection.candidates))
    extended, stages = None, basis.stages
    if selection.accepted:
        stages = wider.stages
        extended = assemble_fit(corrected, wider, {}, say=say, rate_step=SIMULATION_STEP)
        wider = _simulating(wider, selection.baseline)
        simulator = assemble_fit(corrected, wider, {}, say=say, rate_step=SIMULATION_STEP)
        after = residuals(extended, corrected)
    say("what is left")
    left = remaining((after, residuals(simulator, corrected)))
    results = _results(baseline, before, left, base, extended, tested, stages, library, repeated, budget_s)
    return Discovery(base, extended, results, before, None if extended is None else after)


def _simulating(basis: Basis, baseline: Baseline) -> Basis:
    """The basis with parameters moved toward the least free-run error of each submodel."""
    stages = []
    for name, stage in zip((THERMAL, HYGRIC), basis.stages, strict=False):
        values = simulation_values(replace(baseline.submodels[name], values=stage.estimate.values))
        stages.append(replace(stage, estimate=replace(stage.estimate, values=values)))
    return replace(basis, stages=tuple(stages))


def _stages(basis: Basis, selection: Selection, profiles: bool, say: Progress) -> tuple[Stage, ...]:
    """The stages with the accepted causes, estimated to the end, with bounds by profiles or (without
    `profiles`) Wald bounds."""
    found: list[Stage] = []
    for name, stage in zip((THERMAL, HYGRIC), basis.stages, strict=False):
        submodel = selection.baseline.submodels[name]
        if submodel.base is not stage.base or submodel.record is not basis.records[len(found)]:
            estimate = refine(submodel.likelihood, submodel.values)
            estimated = DesignEstimate(submodel.base, submodel.run, estimate, SEARCH_STEP)
            stage = assess_stage(submodel.record, estimated, profiles, say)
        found.append(stage)
    return tuple(found)


def _ended(baseline: Baseline, stages: Sequence[Stage]) -> Baseline:
    """The baseline with its submodels at the stages' final estimates."""
    submodels = {
        name: submodel_of(name, submodel.record, stage)
        for (name, submodel), stage in zip(baseline.submodels.items(), stages, strict=True)
    }
    return replace(baseline, submodels=submodels)


def verdict(
    accepted: Sequence[Candidate], rest: ResidualStructure | None, foreign: bool, repeated: bool
) -> Verdict:
    """`none`, `named` or `unexplained`.

    rest: structure that is left in the errors; foreign: whether no logged signal makes it; repeated: whether
        repeated readings were set aside.  Both overrule the accepted causes, `foreign` unless a switch is
        among them: a simulated switch loses its phase, and the errors of its cycles also go to one side.
    """
    overruled = repeated or (foreign and not any(brings_switch(candidate) for candidate in accepted))
    if accepted and not overruled:
        return "named"
    return "none" if rest is None else "unexplained"


def _results(
    baseline: Baseline,
    before: Residuals,
    left: tuple[ResidualStructure | None, bool],
    base: Fit,
    extended: Fit | None,
    tested: HeldOut,
    stages: Sequence[Stage],
    library: Sequence[Cause],
    repeated: Mapping[str, list[tuple[float, float]]],
    budget_s: float,
) -> DiscoveryResults:
    selection = tested.selection
    rest, foreign = left
    if repeated:
        rest = ResidualStructure("readings", REPEATED, repeated_text(repeated))
    elif rest is None and tested.refuted and not selection.accepted:
        rest = ResidualStructure(tested.refuted[0][1].quantity, "refuted", REFUTED)
    said = verdict(selection.candidates, rest, foreign, bool(repeated))
    known = {p.name for p in base.design.model.parameters}
    causes = [
        cause_entry(baseline, accepted, gain, known, stages, library, selection.tried)
        for accepted, gain in zip(selection.accepted, tested.gains, strict=True)
    ]
    if said == "unexplained":
        causes = [replace(one, confidence=min(one.confidence, UNEXPLAINED_AT_MOST)) for one in causes]
    return DiscoveryResults(
        name=base.results.name,
        version=__version__,
        verdict=said,
        baseline=_scores(base),
        synthetic=base.results.synthetic,
        extended=None if extended is None else _scores(extended),
        causes=tuple(causes),
        rejected=tuple(
            Rejected(t.variant.cause, t.variant.form, evidence(baseline, t, selection.tried), reason)
            for t, reason in selection.rejected
        ),
        refuted=tuple(Refuted(t.variant.cause, t.variant.form, gain) for t, gain in tested.refuted),
        unexplained=rest,
        not_tried=NotTried(tuple(selection.untried), selection.cut, budget_s),
        own_causes={cause.name: found for cause in library if (found := origins_of(cause))},
        findings=tuple(findings(before)),
        doubts=tuple(dict.fromkeys(line for lines in base.results.doubted.values() for line in lines)),
    )


def _scores(fit: Fit) -> ModelScores:
    found = fit.results
    return ModelScores(found.rmse, found.baselines, found.time_constants, found.loglik, found.n_obs)
