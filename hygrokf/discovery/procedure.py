"""From a record to its discovery: the errors of the simulation, their cause, the extended model, its gain,
and what is told of a cause."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hygrokf.data.clocks import shifted, sources
from hygrokf.data.prepared import prepare
from hygrokf.data.progress import Progress, reporting
from hygrokf.data.readings import mask
from hygrokf.data.record import Record
from hygrokf.data.signals import SIGNALS
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.candidates import Candidate, brought
from hygrokf.discovery.conclusion import Conclusion, concluded, what_is_left
from hygrokf.discovery.estimate import Calibration
from hygrokf.discovery.final_set import FinalSet, fit_of
from hygrokf.discovery.findings import findings
from hygrokf.discovery.own_causes import expect_usable
from hygrokf.discovery.repeats import without_repeats
from hygrokf.discovery.residuals import NORMAL_95, QUANTITIES, Residuals, residuals, root_mean_square
from hygrokf.discovery.results import (
    CauseEvidence,
    CauseFound,
    CauseWords,
    Discovery,
    DiscoveryResults,
    ErrorGain,
    Exclusion,
    ModelScores,
    Rejected,
    SearchCost,
    SpectralLine,
    Verdict,
)
from hygrokf.discovery.search import Search, foreseen, needed
from hygrokf.discovery.starting_model import base_estimate
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_results import ParameterRow
from hygrokf.identification.procedure import expect_readings
from hygrokf.modelling.causes.forms import Form, Setting, Settings, ground_of, possible
from hygrokf.modelling.design import PARTS
from hygrokf.modelling.library import LIBRARY, Library
from hygrokf.physics.switches import CONTROLLED
from hygrokf.texts.statement import unique
from hygrokf.texts.verdict import ReasonCode
from hygrokf.version import __version__

BUDGET = 40_000
"""Simulations after which no further cause is tried."""
MOVING = ("cabinet_temperature", "cabinet_relative_humidity", "cabinet_absolute_humidity")
"""Readings that a simulation explains."""
WET_SENSOR = ReasonCode.SENSOR_OR_WATER()


def discover(
    record: Record,
    *,
    library: Library = LIBRARY,
    progress: Progress | bool | None = None,
    budget: int = BUDGET,
) -> Discovery:
    """Find what the base model of a record lacks, and name the cause from a library.

    The model is simulated from its inputs alone; what it misses is a disturbance that enters as flows of heat
    and vapour.  All choices use the identification period; the validation period can refute them and gives
    the reported gain.

    record: as for `identify`.
    library: the causes to try, with their mechanisms; `load_library` reads further ones from a file.
    progress: called with each step in words; True: shows them as one line, also in a notebook.
    budget: simulations after which no further cause is tried; the results name those that were not judged.
        The same record, library and budget give the same results on a busy machine.

    Returns the base fit, the extended fit where a cause was accepted, and `results` as in discovery.json.
    Raises ValueError as `identify` does, and LibraryFault for user causes that cannot be used.
    """
    if not (isinstance(budget, int) and budget >= 1):
        raise ValueError(f"budget: expected a whole number of simulations from 1 on, found {budget!r}")
    from threadpoolctl import threadpool_limits

    expect_usable(library)
    record = prepare(mask(record))
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


def _discovered(record: Record, library: Library, say: Progress, budget: int) -> Discovery:
    saturated = _saturated(record)
    record, repeated = without_repeats(record)
    say("base model")
    start = base_estimate(record, library)
    ground = ground_of(record, start.simulator.heat, start.simulator.vapour)
    forms = {cause.name: possible(cause.forms(ground), ground) for cause in library.causes}
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
        provenance=base.results.provenance,
        extended=None if extended is None else _scores(extended),
        estimator=ended.base.estimator,
        gains=gains(ended, before, after),
        held_out_days=len(np.unique(np.floor(before.time_s[before.validation] / DAY_S))),
        causes=tuple(cause_found(one, ended, library) for one in ended.accepted),
        rejected=tuple(_rejected(found, ended, library, forms)),
        refuted=tuple(_told(one, "refuted") for one in ended.refuted),
        lines=tuple(left),
        work=SearchCost(start.simulator.work.simulations, budget, tuple(found.not_judged)),
        repeated={name: tuple(spans) for name, spans in repeated.items()},
        saturated=saturated,
        findings=tuple(findings(before)),
        left=() if extended is None else tuple(findings(after)),
        doubts=unique(one for part in PARTS for one in base.results.doubts_about(part)),
    )
    return Discovery(results, before, after if extended else None, base=base, extended=extended)


def verdict(ended: Conclusion, left: Sequence[SpectralLine]) -> Verdict:
    """What is left overrules a name; a name with rivals is ambiguous."""
    if left:
        return "unexplained"
    if ended.accepted:
        return "ambiguous" if any(one.rivals for one in ended.accepted) else "named"
    return "refuted" if ended.refuted else "none"


def _rejected(
    found: Search, ended: Conclusion, library: Library, forms: Mapping[str, Sequence[object]]
) -> list[Rejected]:
    """The causes that were left out: those that were estimated beside the last model first."""
    rest: dict[str, Rejected] = {}
    for one in found.left:
        rest.setdefault(one.cause, _told(one, "later_gone"))
    for one in sorted(found.beside, key=lambda c: -c.evidence):
        weak = one.evidence < needed(one, ended.accepted)
        rest.setdefault(one.cause, _told(one, "weak" if weak else "weak_by_days"))
    for cause in library.causes:
        reason: Exclusion = "no_effect" if forms[cause.name] else "no_form"
        reason = "left_to_budget" if cause.name in found.not_judged else reason
        rest.setdefault(cause.name, Rejected(cause.name, reason=reason))
    told = {one.cause for one in (*ended.accepted, *ended.refuted)}
    return [one for name, one in rest.items() if name not in told]


def _told(one: Candidate, reason: Exclusion) -> Rejected:
    return Rejected(one.cause, one.form.code, evidence_of(one), reason, one.judged)


def _scores(fit: Fit) -> ModelScores:
    found = fit.results
    return ModelScores(found.rmse, found.baselines, found.time_constants)


def _saturated(record: Record) -> float:
    """[1] share of the humidity readings at the upper end of the sensor's range."""
    if "cabinet_relative_humidity" not in record:
        return math.nan
    humidity = record["cabinet_relative_humidity"]
    count = len(humidity.known[0]) + humidity.saturated
    return humidity.saturated / count if count else math.nan


# -- what is told of a cause ---------------------------------------------------------------------------------
CONFIDENCE = (-1.26, 0.531, 0.00118)
"""Constant, weight of ln of the evidence in days, and weight of its lead in days: of the logistic
confidence."""


def cause_found(one: Candidate, ended: Conclusion, library: Library) -> CauseFound:
    """A named cause: its evidence and parameters, and how sure its name is."""
    cause = library.cause(one.cause)
    entry = None if cause in LIBRARY.causes else cause
    rivals = tuple(dict.fromkeys(rival.cause for rival in one.rivals))
    settings = _settings(one, ended.base.estimate.simulator.scene.record)
    assert ended.extended is not None
    return CauseFound(
        cause=one.cause,
        form=one.form.code,
        forms_alike=one.alike,
        confidence=confidence(one.in_days, one.lead),
        parameters=_parameters(one, ended.base, ended.extended),
        settings=settings,
        chosen=tuple(chosen(one.form, one.setting)),
        evidence=evidence_of(one),
        held_out=one.judged,
        ambiguous_with=rivals,
        own=None if entry is None else CauseWords(entry.meaning, entry.remedy, entry.separate_by),
    )


def confidence(in_days: float, lead: float) -> float:
    """How often [1] a name with such evidence is right: logistic in ln of the evidence in days and in its
    lead in days."""
    from scipy.special import expit

    constant, by_evidence, by_lead = CONFIDENCE
    return float(expit(constant + by_evidence * math.log(max(in_days, 1.0)) + by_lead * lead))


def evidence_of(one: Candidate) -> CauseEvidence:
    """The evidence of a candidate."""
    return CauseEvidence(dict(one.gains), one.constants, one.searched, one.evidence, one.in_days, one.lead)


def _settings(one: Candidate, record: Record) -> Settings:
    """What the search chose: settings of features, and the shift of a clock [s] against another where there
    are only two."""
    found = {key: value for settings in one.setting.features.values() for key, value in settings.items()}
    if one.form.clock:
        found |= {"source": one.form.clock, "shift_s": one.setting.shift_s, "summer": one.form.summer}
        others = [name for name in sources(record) if name != one.form.clock]
        found |= {"relative_to": others[0]} if len(others) == 1 else {}
    return found


def chosen(form: Form, setting: Setting) -> Iterator[str]:
    """The settings that the search chose from a form's grid; the levels of a controller are parameters."""
    for feature, found in setting.features.items():
        for key, value in found.items() if feature not in CONTROLLED else ():
            if any(point.features[feature].get(key) != value for point in form.grid):
                yield key
    if form.clock:
        yield "shift_s"


def _parameters(one: Candidate, base: FinalSet, extended: FinalSet) -> dict[str, ParameterRow]:
    """The cause's own parameters in the extended model, with bounds."""
    mine = set(one.estimate.simulator.names) - set(base.estimate.simulator.names)
    simulator, own = extended.estimate.simulator, {}
    for p in simulator.parameters:
        level = p.name.rpartition("_")[0] in one.setting.features
        if (p.name in mine and (p.name in brought(one.form, simulator) or level)) or p.name == one.form.freed:
            lower, upper = (b if math.isfinite(b) else math.nan for b in extended.bounds(p.name))
            value, se = extended.estimate.values[p.name], extended.deviation(p.name)
            own[p.name] = ParameterRow(value, p.unit, se, lower, upper, p.meaning)
    return own


# -- errors --------------------------------------------------------------------------------------------------
QUANTITY = {"temperature": "temperature", "humidity": "vapour"}
"""A quantity of residuals → of the search."""


def gains(ended: Conclusion, before: Residuals, after: Residuals) -> tuple[ErrorGain, ...]:
    """The gains by quantity: on held-out readings where there are any, else on those that identified.

    before, after: residuals of both models' free runs; the same ones without an extended model.
    """
    spans = _openings(ended)
    # a corrected clock moves the instants of one model: no differences remain
    together = np.array_equal(before.time_s, after.time_s)
    found = []
    for quantity in QUANTITIES:
        old = _outside(before.time_s, before.error[quantity], spans)
        new = _outside(after.time_s, after.error[quantity], spans)
        for period, held_out in (("validation", True), ("identification", False)):
            first, later = before.validation == held_out, after.validation == held_out
            pair = old[first], new[later]
            if not all(np.isfinite(one).any() for one in pair):
                continue
            bounds = math.nan, math.nan
            if together:
                bounds = _bounds(*pair, np.floor(before.time_s[first] / DAY_S))
            driven = _driven(ended, QUANTITY[quantity], held_out, spans)
            a, b = map(root_mean_square, pair)
            found.append(ErrorGain(quantity, period, a, b, *bounds, *driven))
            break
    return tuple(found)


def _openings(ended: Conclusion) -> list[list[float]]:
    """The stretches [s] in which a door was named, those of the held-out part included."""
    spans = []
    for one in ended.accepted:
        if one.form.windows and ended.extended is not None:
            whole = foreseen(ended.base.estimate, one)
            spans += next(
                design.features["door_open"]["spans"]
                for design in whole.simulator.designs
                if "door_open" in design.features
            )
    return spans


def _outside(time_s: np.ndarray, error: np.ndarray, spans: Sequence[Sequence[float]]) -> np.ndarray:
    inside = np.zeros(len(time_s), bool)
    for first, last in spans:
        inside |= (time_s >= first) & (time_s <= last)
    return np.where(inside, np.nan, error)


def _driven(
    ended: Conclusion, quantity: str, held_out: bool, spans: Sequence[Sequence[float]]
) -> tuple[float, float]:
    """RMSE of the vapour of both models on the measured temperature; NaN of the temperature."""
    if quantity == "temperature":
        return math.nan, math.nan

    def error(one: Calibration) -> float:
        r = one.simulator.scene.readings[quantity]
        chosen = np.where(r.identified != held_out, r.value - one.simulated[quantity], np.nan)
        return root_mean_square(_outside(r.time_s, chosen, spans))

    return error(ended.base.estimate), error((ended.extended or ended.base).estimate)


def _bounds(old: np.ndarray, new: np.ndarray, day: np.ndarray) -> tuple[float, float]:
    """95 % bounds of the fall of the root mean square at common instants: days are independent, the mean
    square's change is normal."""
    both = np.isfinite(old) & np.isfinite(new)
    _, which = np.unique(day[both], return_inverse=True)
    if not len(which) or which.max() < 1:
        return math.nan, math.nan
    # by the delta method: d rmse = d (mean square) / (2 rmse)
    a, b = root_mean_square(old[both]), root_mean_square(new[both])
    each = old[both] ** 2 / max(2.0 * a, 1e-12) - new[both] ** 2 / max(2.0 * b, 1e-12)
    daily = np.bincount(which, each - each.mean())
    reach = NORMAL_95 * math.sqrt(float(daily @ daily)) / len(each)
    return a - b - reach, a - b + reach
