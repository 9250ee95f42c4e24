"""From a record to its discovery: what the simulation gets wrong, the cause, the extended model, and what
that gained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from hygrokf.data.record import Record
from hygrokf.data.structured import JsonObject, plain
from hygrokf.discovery import held_out
from hygrokf.discovery.baseline import (
    HYGRIC,
    SEARCH_STEP,
    SIMULATION_STEP,
    THERMAL,
    Baseline,
    part_of,
    searching,
    simulating,
)
from hygrokf.discovery.budget import SECONDS, Budget
from hygrokf.discovery.candidate import Candidate
from hygrokf.discovery.cause import Cause
from hygrokf.discovery.clocks import shifted
from hygrokf.discovery.discovery_results import (
    DiscoveryResults,
    ModelScores,
    NotTried,
    Refuted,
    Rejected,
    Remainder,
    Verdict,
)
from hygrokf.discovery.evidence import cause_entry, evidence
from hygrokf.discovery.findings import findings
from hygrokf.discovery.library import LIBRARY
from hygrokf.discovery.model_selection import Selection, select, switches
from hygrokf.discovery.own_causes import adopt, origins_of
from hygrokf.discovery.repeats import REPEATED, repeated_text, without_repeats
from hygrokf.discovery.residual_structure import remaining
from hygrokf.discovery.residuals import Residuals, residuals
from hygrokf.estimation.optimiser import refine
from hygrokf.identification.estimation import DesignEstimate, Progress, Stage, assess_stage, output_errors
from hygrokf.identification.fit import Fit
from hygrokf.identification.procedure import Basis, assemble_fit, identify_stages
from hygrokf.modelling.design import CASCADE
from hygrokf.version import __version__

REFUTED = (
    "what the identification period showed was taken for a cause that the held-out period refutes: the model "
    "lacks something else"
)
UNEXPLAINED_AT_MOST = 0.5
"""Confidence of a cause under a verdict that says that the cause is not known."""


@dataclass(frozen=True)
class Discovery:
    """The base fit, the extended one where a cause was accepted, and what was found.

    `results`: what `discovery.json` says; `results.to_frame()` lists every cause that was tried.  `before`,
    `after`: residuals of both models, for pictures.  A discovery can be pickled.
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
    progress: Progress | None = None,
    budget_s: float = SECONDS,
) -> Discovery:
    """Find what the identified model of a record lacks, and name the cause out of a library.

    All choices use the identification period; the validation period can refute them, and gives the reported
    gain.

    record: as for `identify`.
    library: the causes to try; `load_library` reads further ones from a file.
    starts: number of start points of each maximisation.
    progress: is told each step in words.
    budget_s: [s] of wall-clock time.  `not_tried` of the results lists what was left out; `math.inf` gives
        results that do not depend on the machine.

    Returns the base fit, the extended fit where a cause was accepted, and `results` as in discovery.json.
    Raises ValueError as `identify` does, and LibraryFault for causes of a user's that cannot take part.
    """
    budget = Budget(budget_s)
    adopt(library)
    say = progress or (lambda text: None)
    record, repeated = without_repeats(record)
    early = record.identification()
    basis = identify_stages(early, CASCADE, starts, True, say)
    simulated = output_errors(early, basis.whole, basis.values)
    base = assemble_fit(record, basis, simulated, say=say)
    names = (THERMAL, HYGRIC)[: len(basis.stages)]
    baseline = Baseline(
        early,
        {
            name: part_of(name, driven, DesignEstimate(stage.base, stage.run, stage.estimate))
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
    tested = held_out.judged(baseline, selection, record)
    wider, extended, simulator_after = basis, None, simulator
    while tested.selection.accepted:
        say("extended model")
        selection = tested.selection
        wider = replace(basis, stages=_stages(basis, selection, not budget.spent, say))
        ended = held_out.model_of(_ended(selection.baseline, wider.stages), record, selection.accepted)
        tested = tested.ending(ended)
        if tested.selection is selection:
            break
    selection, moved = tested.selection, record
    if selection.accepted:
        for candidate in selection.accepted:
            if candidate.variant.shift is not None:
                moved = shifted(moved, candidate.variant.shift)
        extended = assemble_fit(moved, wider, {}, say=say, rate_step=SIMULATION_STEP)
        simulating = _simulating(wider, selection.baseline)
        simulator_after = assemble_fit(moved, simulating, {}, say=say, rate_step=SIMULATION_STEP)
    stages = wider.stages if selection.accepted else basis.stages
    say("what is left")
    before = residuals(base, record)
    after = before if extended is None else residuals(extended, moved)
    left = remaining((after, residuals(simulator_after, moved)))
    results = _results(baseline, before, left, base, extended, tested, stages, library, repeated, budget_s)
    return Discovery(base, extended, results, before, after if extended is not None else None)


def _simulating(basis: Basis, baseline: Baseline) -> Basis:
    """The basis with parameters moved toward the least free-run error of each part."""
    stages = []
    for name, stage in zip((THERMAL, HYGRIC), basis.stages, strict=False):
        values = simulating(replace(baseline.parts[name], values=stage.estimate.values))
        stages.append(replace(stage, estimate=replace(stage.estimate, values=values)))
    return replace(basis, stages=tuple(stages))


def _stages(basis: Basis, selection: Selection, profiles: bool, say: Progress) -> tuple[Stage, ...]:
    """The stages with the accepted causes in them, climbed to the end and judged, by `profiles` or Wald
    bounds."""
    found: list[Stage] = []
    for name, stage in zip((THERMAL, HYGRIC), basis.stages, strict=False):
        part = selection.baseline.parts[name]
        if part.base is stage.base and part.record is basis.records[len(found)]:
            found.append(stage)
            continue
        estimate = refine(searching(part.base.model, part.run.timeline), part.values)
        found.append(
            assess_stage(
                part.record, DesignEstimate(part.base, part.run, estimate, SEARCH_STEP), profiles, say
            )
        )
    return tuple(found)


def _ended(baseline: Baseline, stages: Sequence[Stage]) -> Baseline:
    """The baseline with its parts as the stages have them in the end."""
    parts = {
        name: part_of(name, part.record, DesignEstimate(stage.base, stage.run, stage.estimate))
        for (name, part), stage in zip(baseline.parts.items(), stages, strict=True)
    }
    return replace(baseline, parts=parts)


def verdict(accepted: Sequence[Candidate], rest: Remainder | None, foreign: bool, repeated: bool) -> Verdict:
    """`none`, `named` or `unexplained`.

    rest: structure that is left; foreign: whether nobody logs what makes it; repeated: whether readings were
    set aside.  Both overrule what was accepted, the first but for switches: simulated ones lose their phase,
    and what their cycles leave goes to one side too.
    """
    overruled = repeated or (foreign and not any(switches(candidate) for candidate in accepted))
    if accepted and not overruled:
        return "named"
    return "none" if rest is None else "unexplained"


def _results(
    baseline: Baseline,
    before: Residuals,
    left: tuple[Remainder | None, bool],
    base: Fit,
    extended: Fit | None,
    tested: held_out.Judged,
    stages: Sequence[Stage],
    library: Sequence[Cause],
    repeated: Mapping[str, list[tuple[float, float]]],
    budget_s: float,
) -> DiscoveryResults:
    selection = tested.selection
    rest, foreign = left
    if repeated:
        rest = Remainder("readings", REPEATED, repeated_text(repeated))
    elif rest is None and tested.refuted and not selection.accepted:
        rest = Remainder(tested.refuted[0][1].quantity, "refuted", REFUTED)
    said = verdict(selection.accepted, rest, foreign, bool(repeated))
    known = {p.name for p in base.design.model.parameters}
    causes = [
        cause_entry(baseline, candidate, rivals, margin, gain, known, stages, library, selection.tried)
        for candidate, rivals, margin, gain in zip(
            selection.accepted, selection.rivals, selection.margins, tested.gains, strict=True
        )
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
        own_causes={cause.name: origins_of(cause) for cause in library if cause.mechanisms or cause.features},
        findings=tuple(findings(before)),
    )


def _scores(fit: Fit) -> ModelScores:
    found = fit.results
    return ModelScores(found.rmse, found.baselines, found.time_constants, found.loglik, found.n_obs)
