"""From a record to its discovery: errors of the simulation, their cause, the extended model, its gain, and
the report of each cause.

One estimator makes both sets of parameters.  A name that held-out readings refute under these sets is
dropped, and the estimator is chosen again.  Then lines are searched in the spectrum of the whitened errors
and of a named cause's daily scores: a missing effect that no cause describes often has a rhythm, such as a
tide, a weekly routine or a duty cycle.  Under a right model the ordinates of a periodogram are independent
exponential numbers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.prepared import prepare
from hygrokf.data.progress import Progress, reporting
from hygrokf.data.readings import mask
from hygrokf.data.record import Record
from hygrokf.data.shared_clocks import shifted, sources
from hygrokf.data.signals import SIGNALS
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.candidates import Candidate, own_parameters
from hygrokf.discovery.discovery_results import (
    CauseEvidence,
    CauseFound,
    CauseWords,
    Discovery,
    DiscoveryResults,
    ErrorGain,
    Exclusion,
    HeldOutTest,
    ModelScores,
    Rejected,
    SearchCost,
    SpectralLine,
    Verdict,
)
from hygrokf.discovery.estimate import Calibration, frame, slopes
from hygrokf.discovery.final_set import Estimator, FinalSet, final_estimator, final_fit, final_set, fitted_by
from hygrokf.discovery.findings import findings
from hygrokf.discovery.judgement import NOTICED, scores
from hygrokf.discovery.own_causes import expect_usable
from hygrokf.discovery.repeats import without_repeats
from hygrokf.discovery.residuals import NORMAL_95, RESIDUAL_QUANTITIES, Residuals, residuals, root_mean_square
from hygrokf.discovery.screening import added
from hygrokf.discovery.search import (
    Search,
    effect_of,
    held_out_test,
    refitted_with,
    required_evidence,
    with_held_out_openings,
)
from hygrokf.discovery.starting_model import base_estimate
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_results import ParameterRow
from hygrokf.identification.identify import expect_readings
from hygrokf.modelling.causes.forms import Form, Setting, Settings, ground_of, possible
from hygrokf.modelling.library import LIBRARY, Library
from hygrokf.physics.signal_names import CABINET_SIGNALS
from hygrokf.physics.switches import CONTROLLED
from hygrokf.texts.parts import PARTS
from hygrokf.texts.reasons import ReasonCode
from hygrokf.texts.statement import unique
from hygrokf.version import __version__


# -- the end of a search -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Conclusion:
    """The result of a search after its final check.

    base, extended: final parameter sets of the base model and of the model with all named causes; extended is
        None if no cause is named.
    accepted, refuted: candidates that passed and failed the held-out test.
    """

    base: FinalSet
    extended: FinalSet | None
    accepted: tuple[Candidate, ...]
    refuted: tuple[Candidate, ...]


def conclude(search: Search) -> Conclusion:
    """Fit the final parameter sets, dropping every cause that held-out readings then refute."""
    accepted, refuted, extended_estimate = list(search.accepted), list(search.refuted), search.parent
    while accepted:
        estimator = final_estimator(search.base, extended_estimate)
        base, extended = (final_set(model, estimator) for model in (search.base, extended_estimate))
        tests = [_judged(search.base, base, accepted, name, extended, estimator) for name in accepted]
        refuted_places = [i for i, test in enumerate(tests) if test.reason]
        if not refuted_places:
            named = tuple(replace(a, judged=v) for a, v in zip(accepted, tests, strict=True))
            return Conclusion(base, extended, named, tuple(refuted))
        # drop first a name without an effect, then the name with the largest growth of errors
        badness = [(v.reason == "no_effect", max(v.growth.values(), default=0.0)) for v in tests]
        worst = max(refuted_places, key=lambda i: badness[i])
        refuted.append(replace(accepted.pop(worst), judged=tests[worst]))
        extended_estimate = refitted_with(search.base, accepted, extended_estimate, refuted[-1].acts)
    return Conclusion(final_set(search.base, final_estimator(search.base)), None, (), tuple(refuted))


def _judged(
    start: Calibration,
    base: FinalSet,
    accepted: Sequence[Candidate],
    judged_candidate: Candidate,
    extended: FinalSet,
    estimator: Estimator,
) -> HeldOutTest:
    """Test one accepted cause on held-out readings: the extended model with it against the model without it.

    start: the fitted base model.  base: its final set.  extended: final set with all accepted causes.
    """
    others = [candidate for candidate in accepted if candidate is not judged_candidate]
    model_without = base.estimate
    if others:
        model_without = fitted_by(
            refitted_with(start, others, extended.estimate, judged_candidate.acts),
            estimator,
            judged_candidate.acts,
        )
    child = with_held_out_openings(model_without, replace(judged_candidate, estimate=extended.estimate))
    after = scores(child)
    accepted_before = list(itertools.takewhile(lambda candidate: candidate is not judged_candidate, accepted))
    result = held_out_test(scores(model_without), after, judged_candidate, accepted_before)
    if effect_of(judged_candidate.form, model_without, child, after) < NOTICED:
        return replace(result, reason="no_effect")
    return result


SIGNIFICANT = 1e-4
"""Probability that chance alone makes a spectral line so strong, below which the line is reported."""
SPECTRUM_BIN_H = 1.0
NEIGHBOURS = 101
"""Number of ordinates of the periodogram whose mean is compared with the ordinate in their middle."""
FEWEST_FREQUENCIES = 3 * NEIGHBOURS
CYCLES = 4
"""Fewest cycles of a rhythm within the record; with fewer it cannot be told from a trend."""
FEWEST_DAYS = 30


def lines(estimate: Calibration, causes: Mapping[str, tuple[str, ...]]) -> list[SpectralLine]:
    """Return the significant spectral lines that an estimate leaves, the least probable first.

    causes: cause → names of its own parameters.  Lines are searched in the errors and in the daily scores of
        these parameters; one line is kept for each quantity and cause.
    """
    all_lines = [line for q in estimate.quantities if (line := _in_errors(estimate, q)) is not None]
    scores = _daily_scores(estimate)
    for cause, names in causes.items():
        for (q, name), daily in scores.items():
            if name in names and (line := _in_days(q, cause, daily)) is not None:
                all_lines.append(line)
    best: dict[tuple[str, str], SpectralLine] = {}
    for line in sorted(all_lines, key=lambda line: line.p):
        best.setdefault((line.quantity, line.cause), line)
    return list(best.values())


def _in_errors(estimate: Calibration, quantity: str) -> SpectralLine | None:
    """Return the strongest line in the spectrum of the whitened errors, relative to the mean of its
    neighbours; None if it is not significant."""
    filter_result, readings = estimate.filtered[quantity], estimate.simulator.scene.readings[quantity]
    is_present = np.isfinite(filter_result.innovation)
    errors = (filter_result.standardised * filter_result.weight)[is_present]
    hours = readings.time_h[is_present]
    width = max(SPECTRUM_BIN_H, float(np.median(np.diff(hours)))) if len(hours) > 1 else SPECTRUM_BIN_H
    bin_index = ((hours - hours[0]) / width).astype(int)
    sum_in_bin = np.bincount(bin_index, errors)
    count_in_bin = np.bincount(bin_index)
    mean = np.divide(sum_in_bin, np.sqrt(np.maximum(count_in_bin, 1)))
    power = np.abs(np.fft.rfft(mean - mean[count_in_bin > 0].mean() * (count_in_bin > 0))) ** 2
    power = power[1:-1]
    if len(power) < FEWEST_FREQUENCIES:
        return None
    half = NEIGHBOURS // 2
    sums = np.cumsum(np.pad(power, (half + 1, half), mode="reflect"))
    neighbours = (sums[NEIGHBOURS:] - sums[:-NEIGHBOURS] - power) / (NEIGHBOURS - 1)
    ratio = power / np.maximum(neighbours, 1e-300)
    ratio[: CYCLES - 1] = 0.0
    best = int(np.argmax(ratio))
    # the neighbours' mean is itself uncertain: F with 2 and 2 (neighbours − 1) degrees of freedom
    tail_probability = (1.0 + ratio[best] / (NEIGHBOURS - 1)) ** (1.0 - NEIGHBOURS)
    p = -math.expm1(len(power) * math.log1p(-min(tail_probability, 1.0 - 1e-16)))
    return SpectralLine(quantity, width * len(mean) / (best + 1), p) if p < SIGNIFICANT else None


def _daily_scores(estimate: Calibration) -> dict[tuple[str, str], np.ndarray]:
    """Return the daily sums (days,) of the score of every parameter, by (quantity, parameter name)."""
    coordinates = frame(estimate.simulator.parameters, set(estimate.simulator.names), estimate.linear)
    daily_scores = {}
    for q, columns in slopes(estimate, coordinates).items():
        reference = estimate.filtered[q]
        score = (
            reference.whitened(columns) * (np.nan_to_num(reference.standardised) * reference.weight)[:, None]
        )
        readings = estimate.simulator.scene.readings[q]
        daily = readings.by_day(score)
        has_reading = np.bincount(readings.day, np.isfinite(reference.innovation)) > 0
        for i, parameter_index in enumerate(coordinates.place):
            if columns[:, i].any():
                daily_scores[q, estimate.simulator.names[parameter_index]] = daily[
                    : np.flatnonzero(has_reading)[-1] + 1, i
                ]
    return daily_scores


def _in_days(quantity: str, cause: str, daily: np.ndarray) -> SpectralLine | None:
    """Return the strongest line of daily scores (days,) by Fisher's g, the largest share of one ordinate in
    the total power; None if it is not significant."""
    if len(daily) < FEWEST_DAYS:
        return None
    ranks = np.argsort(np.argsort(daily)) - 0.5 * (len(daily) - 1)  # ranks: single days must not decide
    power = np.abs(np.fft.rfft(ranks)) ** 2
    power = power[CYCLES : (len(daily) + 1) // 2]
    if not power.sum() > 0.0:
        return None
    largest_share = float(power.max() / power.sum())
    p = min(len(power) * (1.0 - largest_share) ** (len(power) - 1), 1.0)
    period = 24.0 * len(daily) / (int(np.argmax(power)) + CYCLES)
    return SpectralLine(quantity, period, p, cause) if p < SIGNIFICANT else None


def remaining_lines(conclusion: Conclusion) -> list[SpectralLine]:
    """Return the lines in the errors of the final model and in the daily scores of the named causes."""
    final, parameters_of = conclusion.extended or conclusion.base, {}
    for candidate in conclusion.accepted:
        added_names = {p.name for p in added(conclusion.base.estimate, candidate.estimate.simulator)}
        parameters_of[candidate.cause] = tuple(
            sorted(added_names & own_parameters(candidate.form, final.estimate.simulator))
        )
    return lines(final.estimate, parameters_of)


# -- from a record to its discovery --------------------------------------------------------------------------
MOST_SIMULATIONS = 40_000
"""Number of simulations after which no further cause is tried."""
WET_SENSOR = ReasonCode.SENSOR_OR_WATER()


def discover(
    record: Record,
    *,
    library: Library = LIBRARY,
    progress: Progress | bool | None = None,
    budget: int = MOST_SIMULATIONS,
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
        readings = series.value[np.isfinite(series.value)]
        if (
            series.signal in CABINET_SIGNALS
            and len(readings)
            and np.ptp(np.quantile(readings, (0.01, 0.99))) == 0.0
        ):
            unit = SIGNALS[series.signal].unit
            value = f"{readings[0]:.6g}" if unit == "1" else f"{readings[0]:.6g} {unit}"
            still.append(
                f"{series.signal}: expected readings that move, found {value} throughout the identification "
                "period"
            )
    if still:
        raise ValueError("; ".join(still) + ": check the sensor, or leave the signal out of the case")


def _discovered(record: Record, library: Library, say: Progress, budget: int) -> Discovery:
    """Run the whole discovery on a prepared record; `budget` is the largest number of simulations."""
    saturated = _saturated(record)
    record, repeated = without_repeats(record)
    say("base model")
    start = base_estimate(record, library)
    ground = ground_of(record, start.simulator.heat, start.simulator.vapour)
    forms = {cause.name: possible(cause.forms(ground), ground) for cause in library.causes}
    all_forms = [form for forms_of_cause in forms.values() for form in forms_of_cause]
    search = Search(start, all_forms, say, budget).run()
    say("parameters of the base and of the extended model")
    conclusion = conclude(search)
    base = final_fit(record, conclusion.base, say)
    before = after = residuals(base, record)
    extended = None
    if conclusion.extended is not None:
        reasons_against = (WET_SENSOR,) if any(candidate.wet for candidate in conclusion.accepted) else ()
        extended = final_fit(record, conclusion.extended, say, reasons_against)
        after = residuals(extended, shifted(record, *conclusion.extended.estimate.simulator.scene.shifts))
    say("what is left")
    lines = remaining_lines(conclusion)
    results = DiscoveryResults(
        name=base.results.name,
        version=__version__,
        verdict=verdict(conclusion, lines),
        baseline=_scores(base),
        provenance=base.results.provenance,
        extended=None if extended is None else _scores(extended),
        estimator=conclusion.base.estimator,
        gains=gains(conclusion, before, after),
        held_out_days=len(np.unique(np.floor(before.time_s[before.validation] / DAY_S))),
        causes=tuple(cause_found(candidate, conclusion, library) for candidate in conclusion.accepted),
        rejected=tuple(_rejected(search, conclusion, library, forms)),
        refuted=tuple(_rejection(candidate, "refuted") for candidate in conclusion.refuted),
        lines=tuple(lines),
        work=SearchCost(start.simulator.work.simulations, budget, tuple(search.not_judged)),
        repeated={name: tuple(spans) for name, spans in repeated.items()},
        saturated=saturated,
        findings=tuple(findings(before)),
        left=() if extended is None else tuple(findings(after)),
        doubts=unique(doubt for part in PARTS for doubt in base.results.doubts_about(part)),
    )
    return Discovery(results, before, after if extended else None, base=base, extended=extended)


def verdict(conclusion: Conclusion, lines: Sequence[SpectralLine]) -> Verdict:
    """Return the verdict: remaining spectral lines make it "unexplained", rivals make it "ambiguous"."""
    if lines:
        return "unexplained"
    if conclusion.accepted:
        return "ambiguous" if any(candidate.rivals for candidate in conclusion.accepted) else "named"
    return "refuted" if conclusion.refuted else "none"


def _rejected(
    search: Search, conclusion: Conclusion, library: Library, forms: Mapping[str, Sequence[object]]
) -> list[Rejected]:
    """Return the causes that were left out, with reasons: dropped ones, then those of the last round, then
    the rest."""
    rejected: dict[str, Rejected] = {}
    for candidate in search.dropped:
        rejected.setdefault(candidate.cause, _rejection(candidate, "later_gone"))
    for candidate in sorted(search.last_round, key=lambda candidate: -candidate.evidence):
        is_weak = candidate.evidence < required_evidence(candidate, conclusion.accepted)
        rejected.setdefault(candidate.cause, _rejection(candidate, "weak" if is_weak else "weak_by_days"))
    for cause in library.causes:
        reason: Exclusion = "no_effect" if forms[cause.name] else "no_form"
        reason = "left_to_budget" if cause.name in search.not_judged else reason
        rejected.setdefault(cause.name, Rejected(cause.name, reason=reason))
    decided = {candidate.cause for candidate in (*conclusion.accepted, *conclusion.refuted)}
    return [rejection for name, rejection in rejected.items() if name not in decided]


def _rejection(candidate: Candidate, reason: Exclusion) -> Rejected:
    """Return a candidate as a rejected cause with the reason."""
    return Rejected(candidate.cause, candidate.form.code, evidence_of(candidate), reason, candidate.judged)


def _scores(fit: Fit) -> ModelScores:
    """Return the errors and time constants of a fit."""
    results = fit.results
    return ModelScores(results.rmse, results.baselines, results.time_constants)


def _saturated(record: Record) -> float:
    """Return the share [1] of humidity readings at the upper end of the sensor's range; NaN without
    humidity."""
    if "cabinet_relative_humidity" not in record:
        return math.nan
    humidity = record["cabinet_relative_humidity"]
    count = len(humidity.known[0]) + humidity.saturated
    return humidity.saturated / count if count else math.nan


# -- the report of a cause -----------------------------------------------------------------------------------
CONFIDENCE_WEIGHTS = (-1.26, 0.531, 0.00118)
"""Coefficients of the logistic confidence: constant, weight of ln of the evidence in days, weight of the lead
in days."""


def cause_found(candidate: Candidate, conclusion: Conclusion, library: Library) -> CauseFound:
    """Return a named cause for the results: evidence, parameters with bounds, confidence."""
    cause = library.cause(candidate.cause)
    own_entry = None if cause in LIBRARY.causes else cause
    rivals = tuple(dict.fromkeys(rival.cause for rival in candidate.rivals))
    settings = _settings(candidate, conclusion.base.estimate.simulator.scene.record)
    assert conclusion.extended is not None
    return CauseFound(
        cause=candidate.cause,
        form=candidate.form.code,
        forms_alike=candidate.alike,
        confidence=confidence(candidate.in_days, candidate.lead),
        parameters=_parameters(candidate, conclusion.base, conclusion.extended),
        settings=settings,
        chosen=tuple(chosen(candidate.form, candidate.setting)),
        evidence=evidence_of(candidate),
        held_out=candidate.judged,
        ambiguous_with=rivals,
        own=None
        if own_entry is None
        else CauseWords(own_entry.meaning, own_entry.remedy, own_entry.separate_by),
    )


def confidence(in_days: float, lead: float) -> float:
    """Return the probability [1] that a named cause is right: logistic in ln of the evidence in days and in
    the lead over the best rival, in days."""
    from scipy.special import expit

    constant, by_evidence, by_lead = CONFIDENCE_WEIGHTS
    return float(expit(constant + by_evidence * math.log(max(in_days, 1.0)) + by_lead * lead))


def evidence_of(candidate: Candidate) -> CauseEvidence:
    """Return the evidence of a candidate in the form that the results store."""
    return CauseEvidence(
        dict(candidate.gains),
        candidate.constants,
        candidate.searched,
        candidate.evidence,
        candidate.in_days,
        candidate.lead,
    )


def _settings(candidate: Candidate, record: Record) -> Settings:
    """Return the settings of a candidate's features and, for a clock cause, source, shift [s] and season; the
    shift is relative to the other clock where the record has two."""
    chosen_settings = {
        key: value for settings in candidate.setting.features.values() for key, value in settings.items()
    }
    if candidate.form.clock:
        chosen_settings |= {
            "source": candidate.form.clock,
            "shift_s": candidate.setting.shift_s,
            "summer": candidate.form.summer,
        }
        others = [name for name in sources(record) if name != candidate.form.clock]
        chosen_settings |= {"relative_to": others[0]} if len(others) == 1 else {}
    return chosen_settings


def chosen(form: Form, setting: Setting) -> Iterator[str]:
    """Yield the names of the settings that vary within a form's grid, which the search therefore chose;
    levels of a controller are parameters, not settings."""
    for feature, feature_settings in setting.features.items():
        for key, value in feature_settings.items() if feature not in CONTROLLED else ():
            if any(setting_of_grid.features[feature].get(key) != value for setting_of_grid in form.grid):
                yield key
    if form.clock:
        yield "shift_s"


def _parameters(candidate: Candidate, base: FinalSet, extended: FinalSet) -> dict[str, ParameterRow]:
    """Return the cause's own parameters in the extended model, with bounds."""
    added = set(candidate.estimate.simulator.names) - set(base.estimate.simulator.names)
    simulator, rows = extended.estimate.simulator, {}
    for parameter in simulator.parameters:
        is_level = parameter.name.rpartition("_")[0] in candidate.setting.features
        if (
            parameter.name in added
            and (parameter.name in own_parameters(candidate.form, simulator) or is_level)
        ) or parameter.name == candidate.form.freed:
            lower, upper = (b if math.isfinite(b) else math.nan for b in extended.bounds(parameter.name))
            value, standard_error = (
                extended.estimate.values[parameter.name],
                extended.deviation(parameter.name),
            )
            rows[parameter.name] = ParameterRow(
                value, parameter.unit, standard_error, lower, upper, parameter.meaning
            )
    return rows


# -- errors --------------------------------------------------------------------------------------------------
QUANTITY = {"temperature": "temperature", "humidity": "vapour"}
"""Name of a quantity in residuals → its name in the search."""


def gains(conclusion: Conclusion, before: Residuals, after: Residuals) -> tuple[ErrorGain, ...]:
    """Return the change of the free run's error by quantity, on held-out readings where there are any.

    before, after: residuals of the base and of the extended model; the base twice if no cause is named.
    """
    spans = _openings(conclusion)
    # a corrected clock shifts the instants of the extended model: then there are no pairs of errors
    same_instants = np.array_equal(before.time_s, after.time_s)
    quantity_gains = []
    for quantity in RESIDUAL_QUANTITIES:
        error_before = _outside(before.time_s, before.error[quantity], spans)
        error_after = _outside(after.time_s, after.error[quantity], spans)
        for period, held_out in (("validation", True), ("identification", False)):
            period_before, period_after = before.validation == held_out, after.validation == held_out
            errors_of_period = error_before[period_before], error_after[period_after]
            if not all(np.isfinite(errors).any() for errors in errors_of_period):
                continue
            bounds = math.nan, math.nan
            if same_instants:
                bounds = _bounds(*errors_of_period, np.floor(before.time_s[period_before] / DAY_S))
            driven = _driven(conclusion, QUANTITY[quantity], held_out, spans)
            rmse_before, rmse_after = map(root_mean_square, errors_of_period)
            quantity_gains.append(ErrorGain(quantity, period, rmse_before, rmse_after, *bounds, *driven))
            break
    return tuple(quantity_gains)


def _openings(conclusion: Conclusion) -> list[list[float]]:
    """Return the spans [start, end] [s] of named door openings, also after the identification period."""
    spans = []
    for candidate in conclusion.accepted:
        if candidate.form.windows and conclusion.extended is not None:
            full_estimate = with_held_out_openings(conclusion.base.estimate, candidate)
            spans += next(
                design.features["door_open"]["spans"]
                for design in full_estimate.simulator.designs
                if "door_open" in design.features
            )
    return spans


def _outside(time_s: np.ndarray, error: np.ndarray, spans: Sequence[Sequence[float]]) -> np.ndarray:
    """Return the error (T,) with NaN at the times [s] inside the spans."""
    inside = np.zeros(len(time_s), bool)
    for first, last in spans:
        inside |= (time_s >= first) & (time_s <= last)
    return np.where(inside, np.nan, error)


def _driven(
    conclusion: Conclusion, quantity: str, held_out: bool, spans: Sequence[Sequence[float]]
) -> tuple[float, float]:
    """Return the RMSE of the vapour, driven by the measured temperature, for the base and the extended model.

    NaN for the temperature.  held_out: whether the held-out readings count, else the identification readings.
    """
    if quantity == "temperature":
        return math.nan, math.nan

    def error(estimate: Calibration) -> float:
        r = estimate.simulator.scene.readings[quantity]
        residual = np.where(r.identified != held_out, r.value - estimate.simulated[quantity], np.nan)
        return root_mean_square(_outside(r.time_s, residual, spans))

    return error(conclusion.base.estimate), error((conclusion.extended or conclusion.base).estimate)


def _bounds(
    error_before: np.ndarray, error_after: np.ndarray, day_of_instant: np.ndarray
) -> tuple[float, float]:
    """Return the 95 % bounds of the decrease in RMSE between errors (T,) of the same instants; days count as
    independent."""
    in_both = np.isfinite(error_before) & np.isfinite(error_after)
    _, day_index = np.unique(day_of_instant[in_both], return_inverse=True)
    if not len(day_index) or day_index.max() < 1:
        return math.nan, math.nan
    # by the delta method: d rmse = d (mean square) / (2 rmse)
    rmse_old, rmse_new = root_mean_square(error_before[in_both]), root_mean_square(error_after[in_both])
    change = error_before[in_both] ** 2 / max(2.0 * rmse_old, 1e-12) - error_after[in_both] ** 2 / max(
        2.0 * rmse_new, 1e-12
    )
    daily = np.bincount(day_index, change - change.mean())
    half_width = NORMAL_95 * math.sqrt(float(daily @ daily)) / len(change)
    return rmse_old - rmse_new - half_width, rmse_old - rmse_new + half_width
