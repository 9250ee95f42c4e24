"""From a record to its discovery: the errors of the simulation, their cause, the extended model, and its
gain."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.clocks import shifted
from hygrokf.data.drawn import drawn
from hygrokf.data.progress import Progress, reporting
from hygrokf.data.readings import mask
from hygrokf.data.record import Record
from hygrokf.data.signals import SIGNALS
from hygrokf.data.structured import JsonObject, plain
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.candidates import Candidate
from hygrokf.discovery.conclusion import Conclusion, concluded, what_is_left
from hygrokf.discovery.discovery_results import (
    DiscoveryResults,
    Exclusion,
    Line,
    ModelScores,
    Rejected,
    Verdict,
    Work,
)
from hygrokf.discovery.final_set import fit_of
from hygrokf.discovery.findings import findings
from hygrokf.discovery.forms import ground_of
from hygrokf.discovery.library import LIBRARY, Cause
from hygrokf.discovery.own_causes import adopt, origins_of
from hygrokf.discovery.repeats import without_repeats
from hygrokf.discovery.residuals import Residuals, residuals
from hygrokf.discovery.search import Found, Search, needed
from hygrokf.discovery.starting_model import base_estimate
from hygrokf.discovery.told import cause_found, evidence_of, gains, refuted_cause
from hygrokf.identification.fit import Fit
from hygrokf.identification.procedure import expect_readings
from hygrokf.identification.verdict_terms import REJECT, Reason
from hygrokf.version import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BUDGET = 40_000
"""Simulations after which no further cause is tried."""
MOVING = ("cabinet_temperature", "cabinet_relative_humidity", "cabinet_absolute_humidity")
"""Readings that a simulation explains."""
WET_SENSOR = Reason(
    "sensor_or_water",
    REJECT,
    "what the model takes as an error of the humidity sensor may be water in the cabinet",
)


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
    progress: Progress | bool | None = None,
    budget: int = BUDGET,
) -> Discovery:
    """Find what the base model of a record lacks, and name the cause from a library.

    The model is simulated from its inputs alone; what it misses is a disturbance that enters as flows of heat
    and vapour.  All choices use the identification period; the validation period can refute them and gives
    the reported gain.

    record: as for `identify`.
    library: the causes to try; `load_library` reads further ones from a file.
    progress: called with each step in words; True: shows them as one line, also in a notebook.
    budget: simulations after which no further cause is tried; the results name those that were not judged.
        The same record, library and budget give the same results on a busy machine.

    Returns the base fit, the extended fit where a cause was accepted, and `results` as in discovery.json.
    Raises ValueError as `identify` does, and LibraryFault for user causes that cannot be used.
    """
    if not (isinstance(budget, int) and budget >= 1):
        raise ValueError(f"budget: expected a whole number of simulations from 1 on, found {budget!r}")
    from threadpoolctl import threadpool_limits

    adopt(library)
    record = mask(record)
    expect_readings(record.identification())
    expect_movement(record.identification())
    # sums of several threads differ in their last bits
    with threadpool_limits(1), reporting(progress, "discover") as say:
        return _discovered(record, library, say, budget)


def expect_movement(early: Record) -> None:
    """Check that the cabinet's readings move in the identification period.

    Raises ValueError that names every signal whose middle 98 % are one value.
    """
    still = []
    for series in early.series:
        known = series.value[np.isfinite(series.value)]
        if series.signal in MOVING and len(known) and np.ptp(np.quantile(known, (0.01, 0.99))) == 0.0:
            unit = SIGNALS[series.signal].unit
            value = f"{known[0]:.6g}" if unit == "1" else f"{known[0]:.6g} {unit}"
            still.append(
                f"{series.signal}: expected readings that move, found {value} throughout the identification "
                "period"
            )
    if still:
        raise ValueError("; ".join(still) + ": check the sensor, or leave the signal out of the case")


def _discovered(record: Record, library: Sequence[Cause], say: Progress, budget: int) -> Discovery:
    saturated = _saturated(record)
    record, repeated = without_repeats(record)
    say("base model")
    start = base_estimate(record)
    ground = ground_of(record, start.simulator.heat, start.simulator.vapour)
    # quantiles of too few readings leave a form without settings
    forms = {cause.name: [form for form in cause.forms(ground) if form.grid] for cause in library}
    found = Search(start, [form for one in forms.values() for form in one], say, budget).run()
    say("parameters of the base and of the extended model")
    ended = concluded(found)
    base = fit_of(record, ended.base, say)
    before = after = residuals(base, record)
    extended = None
    if ended.extended is not None:
        against = (WET_SENSOR,) if any(one.wet for one in ended.accepted) else ()
        extended = fit_of(record, ended.extended, say, against)
        after = residuals(extended, shifted(record, *ended.extended.estimate.simulator.scene.shifts))
    say("what is left")
    left = what_is_left(ended)
    results = DiscoveryResults(
        name=base.results.name,
        version=__version__,
        verdict=verdict(ended, left),
        baseline=_scores(base),
        synthetic=base.results.synthetic,
        extended=None if extended is None else _scores(extended),
        estimator=ended.base.estimator,
        gains=gains(ended, before, after),
        held_out_days=len(np.unique(np.floor(before.time_s[before.validation] / DAY_S))),
        causes=tuple(cause_found(one, ended, library, found.searched) for one in ended.accepted),
        rejected=tuple(_rejected(found, ended, library, forms)),
        refuted=tuple(refuted_cause(one, judged, found.searched) for one, judged in ended.refuted),
        lines=tuple(left),
        work=Work(start.simulator.work.simulations, budget, found.not_judged),
        repeated={name: tuple(spans) for name, spans in repeated.items()},
        saturated=saturated,
        own_causes={cause.name: origin for cause in library if (origin := origins_of(cause))},
        findings=tuple(findings(before)),
        left=() if extended is None else tuple(findings(after)),
        doubts=tuple(dict.fromkeys(line for said in base.results.doubted.values() for line in said)),
    )
    return Discovery(base, extended, results, before, None if extended is None else after)


def verdict(ended: Conclusion, left: Sequence[Line]) -> Verdict:
    """What is left overrules a name; a name with rivals is ambiguous."""
    if left:
        return "unexplained"
    if ended.accepted:
        return "ambiguous" if any(one.rivals for one in ended.accepted) else "named"
    return "refuted" if ended.refuted else "none"


def _rejected(
    found: Found, ended: Conclusion, library: Sequence[Cause], forms: Mapping[str, Sequence[object]]
) -> list[Rejected]:
    """The causes that were left out: those that were estimated beside the last model first."""
    told = {one.candidate.cause for one in ended.accepted} | {one.cause for one, _ in ended.refuted}
    rest: dict[str, Rejected] = {}

    def add(one: Candidate, reason: Exclusion) -> None:
        if one.cause not in told:
            rest.setdefault(
                one.cause, Rejected(one.cause, one.form.code, evidence_of(one, found.searched), reason)
            )

    for one in found.left:
        add(one, "later_gone")
    for one in sorted(found.beside, key=lambda c: -c.evidence):
        add(one, "weak" if one.evidence < needed(one, ended.accepted) else "weak_by_days")
    for cause in library:
        reason: Exclusion = "no_effect" if forms[cause.name] else "no_form"
        if cause.name not in told:
            rest.setdefault(
                cause.name,
                Rejected(cause.name, reason="left_to_budget" if cause.name in found.not_judged else reason),
            )
    return list(rest.values())


def _scores(fit: Fit) -> ModelScores:
    found = fit.results
    return ModelScores(found.rmse, found.baselines, found.time_constants, found.loglik, found.n_obs)


def _saturated(record: Record) -> float:
    """[1] share of the humidity readings at the upper end of the sensor's range."""
    if "cabinet_relative_humidity" not in record:
        return math.nan
    humidity = record["cabinet_relative_humidity"]
    count = len(humidity.known[0]) + humidity.saturated
    return humidity.saturated / count if count else math.nan
