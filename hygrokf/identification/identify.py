"""The whole identification from a record to a `Fit`, in the order of the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.cases.doubts import all_doubts
from hygrokf.data.prepared import PreparedRecord, prepare
from hygrokf.data.progress import Progress, reporting
from hygrokf.data.readings import mask
from hygrokf.data.record import Record, expect_record
from hygrokf.engine.parallel import mapped
from hygrokf.engine.schedule import STEP_TOLERANCE
from hygrokf.estimation.confidence import normal_quantile, standard_error, wald_bounds
from hygrokf.estimation.conventions import CONFIDENCE, STARTS
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.output_error import OutputError
from hygrokf.estimation.profile_likelihood import limit_statements
from hygrokf.estimation.subject import IDENTIFICATION
from hygrokf.evaluation.actuator_effects import actuator_effects
from hygrokf.evaluation.innovation_tests import Diagnosis
from hygrokf.evaluation.scoring import bands, baselines, period_masks, readings_sd, scores, sensor_share
from hygrokf.evaluation.simulation import QUANTITIES, Prediction, free_run, measured, settled
from hygrokf.identification.composition import nan_if_open
from hygrokf.identification.estimation import (
    Stage,
    assess_stage,
    estimate_design,
    identify_stage,
    output_errors,
    select_form,
    smoothed_temperature,
)
from hygrokf.identification.fit import Fit, likelihood_on
from hygrokf.identification.fit_results import (
    Covariance,
    FitResults,
    LocalOptimum,
    ParameterRow,
    Period,
    PriorTerms,
    TimeConstant,
)
from hygrokf.identification.time_constants import by_simulation, hygric_entry, thermal_entry
from hygrokf.identification.verdict import with_verdicts
from hygrokf.modelling.design import CASCADE, FEWEST_READINGS, JOINT, Design, design, merged, read_as
from hygrokf.modelling.inputs import IDENTIFIED_ON, Run, model_inputs
from hygrokf.physics.parameters import Parameter, Prior
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.parts import PARTS, TIME_CONSTANTS
from hygrokf.texts.statement import Statement, Value, unique
from hygrokf.texts.wording import iso_time
from hygrokf.version import __version__

if TYPE_CHECKING:
    from hygrokf.identification.steady_state import HeatRelease

DEFAULT_KIND = CASCADE
"""Chosen by trial: docs/project/decisions/0002-joint-or-cascade.md."""
WELL_KNOWN = 0.1
"""[1] relative standard error below which a parameter counts as well known, whatever its correlations."""
CRITERIA = ("likelihood", "simulation")


def identify(
    record: Record,
    *,
    criterion: str = "likelihood",
    kind: str = DEFAULT_KIND,
    starts: int = STARTS,
    profiles: bool = True,
    progress: Progress | bool | None = None,
    prior: Callable[[Design], Mapping[str, Prior]] | None = None,
    model: Fit | None = None,
) -> Fit:
    """Identify the thermal model of a record, and the hygric one where the record has humidity.

    All choices and estimates use the identification period; the validation period is only scored.

    record: with cabinet temperature, ambient temperature and, better, power.
    criterion: "likelihood" (of the innovations) or "simulation" (free run, as in the paper) gives the
        reported values; `results` has the time constants of both.
    kind: "cascade" estimates the thermal model first and the hygric one with its temperatures, "joint" both
        at once.
    starts: number of start points of the maximisation.
    profiles: whether to compute profile-likelihood bounds.
    progress: called with each step in words; True: shows them as one line, also in a notebook.
    prior: gives priors of a design's parameters, from other turbines of the type (`TurbineType.prior`).
    model: a fit whose model takes the place of the base model, such as `Discovery.extended`; its values are
        the first start, and its mechanisms are estimated in one filter, of kind "joint".  Other forms of the
        model are not compared: the bounds hold within this one.  `criterion` and `prior` cannot be set beside
        it.

    Returns the fit: time constants [h] with bounds in `results.time_constants`.
    Raises ValueError for unknown options, for records from which nothing can be identified, and for anything
    but a record.
    """
    if kind not in (JOINT, CASCADE):
        raise ValueError(f"kind: expected {JOINT!r} or {CASCADE!r}, found {kind!r}")
    if criterion not in CRITERIA:
        raise ValueError(f"criterion: expected one of {CRITERIA}, found {criterion!r}")
    # nothing to mask in a record of `read_case` and `read_frames`
    record = prepare(mask(expect_record(record, "identify")))
    early = record.identification()
    if model is not None:
        _expect_model(model, criterion, prior, early)
    with reporting(progress, "identify") as say:
        if model is not None:
            return assemble_fit(record, _identify_model(early, model, starts, profiles, say), {}, say=say)
        basis = identify_stages(early, kind, starts, profiles, say, prior)
        say("output-error fit")
        simulated = output_errors(early, basis.whole, basis.values)
        return assemble_fit(record, basis, simulated, criterion, say)


@dataclass(frozen=True)
class Basis:
    """The stages identified on a record's identification period: one, or the two of a cascade, and the
    `regression` of the heat release over quasi-stationary periods."""

    kind: str
    stages: tuple[Stage, ...]
    regression: HeatRelease

    @property
    def whole(self) -> Design:
        """The joint design of all stages."""
        return merged([stage.base for stage in self.stages])

    @property
    def values(self) -> dict[str, float]:
        return {name: value for stage in self.stages for name, value in stage.estimate.values.items()}


def identify_stages(
    early: PreparedRecord,
    kind: str,
    starts: int,
    profiles: bool,
    say: Progress,
    prior: Callable[[Design], Mapping[str, Prior]] | None = None,
) -> Basis:
    """Estimate every stage on the identification period `early`, with its uncertainty."""
    from hygrokf.identification.steady_state import heat_release_regression

    expect_readings(early)
    say("heat-release regression")
    regression = heat_release_regression(early)

    def base_of(part: str) -> Design:
        base = design(early, kind=part, power_order=regression.power_order, heat_start=regression.start())
        if prior is None:
            return base
        known = {name: (p.mean, p.sd, p.logarithmic) for name, p in prior(base).items()}
        return replace(base, priors=known)

    first = base_of(JOINT if kind == JOINT else "thermal")
    found, forms = select_form(estimate_design(early, first, starts, say), say)

    second = None if kind == JOINT else base_of(CASCADE)

    def own() -> Stage:
        return assess_stage(found, profiles, say, forms)

    def moist(base: Design, humidity: str) -> Stage:
        say("smoothed cabinet temperature")
        warm = smoothed_temperature(found.base, found.run, found.estimate.values, humidity)
        return identify_stage(early.replace_series(warm), base, starts, profiles, say)

    jobs: list[Callable[[], Stage]] = [own]
    if second is not None and second.humidity is not None:
        # the hygric stage needs the thermal estimate, not its bounds
        jobs.append(partial(moist, second, second.humidity))
    return Basis(kind, tuple(mapped(lambda job: job(), jobs)), regression)


def _expect_model(model: Fit, criterion: str, prior: object, early: Record) -> None:
    """Check a model to identify, and what stands beside it.  Raises ValueError that lists all faults."""
    faults, name = [], model.design.humidity
    if prior is not None:
        faults.append("prior: expected none beside model, whose design has priors of its own; leave it out")
    if criterion != "likelihood":
        faults.append(
            f"criterion: expected 'likelihood' beside model, whose further mechanisms a free-run fit lacks, "
            f"found {criterion!r}"
        )
    found = int(np.isfinite(early[name].value).sum()) if name and name in early else 0
    if name and found < FEWEST_READINGS:
        faults.append(
            f"{name}: expected at least {FEWEST_READINGS} readings in the identification period for the "
            f"model of {model.name}, found {found}; add them, or leave model out"
        )
    if faults:
        raise ValueError("; ".join(faults))


def _identify_model(early: Record, model: Fit, starts: int, profiles: bool, say: Progress) -> Basis:
    """Estimate the model of a fit on the identification period, with this record's loggers, beginning at its
    values."""
    from hygrokf.identification.steady_state import heat_release_regression

    expect_readings(early)
    given = model.design
    own = design(early, kind=JOINT, power_order=given.power_order, library=given.library)
    loggers = {n: s for n, s in own.mechanisms if n.endswith("_sensor")}
    origin = FitCode.MODEL_OF_FIT(fit=model.name, criterion=model.results.criterion)
    made = replace(
        own,
        mechanisms=tuple(
            (n, {**s, **{key: loggers[n][key] for key in ("accuracy", "resolution")}} if n in loggers else s)
            for n, s in given.mechanisms
        ),
        averaged={}, humidity=given.humidity, holds=given.holds, features=given.features, priors=given.priors,
        statements=(*own.statements, origin, FitCode.FORMS_NOT_COMPARED()),
    )  # fmt: skip
    base = read_as(made, early)
    found = estimate_design(early, base, starts, say, model.values)
    return Basis(JOINT, (assess_stage(found, profiles, say),), heat_release_regression(early))


def expect_readings(early: Record) -> None:
    """Check that both temperatures have enough readings for an identification.

    early: the identification period.  Raises ValueError that lists every temperature with too few readings.
    """
    missing = [
        f"{name}: expected at least {FEWEST_READINGS} readings in the identification period, found {found}"
        for name in ("cabinet_temperature", "ambient_temperature")
        if (found := int(np.isfinite(early[name].value).sum()) if name in early else 0) < FEWEST_READINGS
    ]
    if missing:
        raise ValueError(
            "; ".join(missing)
            + ": both temperatures are needed, also for the humidity; check the case with `hygrokf check`"
        )


def assemble_fit(
    record: Record,
    basis: Basis,
    simulated: Mapping[str, OutputError],
    criterion: str = "likelihood",
    say: Progress = lambda text: None,
    tolerance: float = STEP_TOLERANCE,
) -> Fit:
    """A fit from its stages: free run, scores, bands and tables on the whole record; `tolerance` as in
    `Likelihood`."""
    stages, whole, values = basis.stages, basis.whole, basis.values
    by_free_run = simulated if criterion == "simulation" else {}
    say("free run and scores")
    for found in by_free_run.values():
        values |= {n: found.values[n] for n in (*found.names, *found.unseen) if n in values}
    errors = {
        p.name: standard_error(stage.estimate, stage.uncertainty, p.name)
        for stage in stages
        for p in stage.estimate.coordinates.parameters
    }
    run = settled(whole, values, model_inputs(whole, record), tolerance)
    spread = _covariance(stages, whole, by_free_run, values)
    predicted = free_run(whole, values, run, spread, tolerance)
    thermal = next((e for stage in stages if (e := thermal_entry(stage, simulated))), None)
    moist = next((e for stage in stages if (e := hygric_entry(stage, simulated))), None)
    if criterion == "simulation":
        thermal, moist = by_simulation(thermal), by_simulation(moist)
    table = scores(run, predicted)
    scored = FitResults(
        rmse=table,
        baselines=baselines(run),
        readings_sd=readings_sd(run),
        sensor_share=sensor_share(run, table),
        bands=bands(whole, values, run, predicted, tolerance),
        heat_release=basis.regression.thinned(),
        actuators=actuator_effects(whole, values, errors, run),
    )
    say("innovations")
    series = _series(whole, values, run, predicted, tolerance)
    likelihood = likelihood_on(whole, stages[0].run.record, IDENTIFICATION)
    results = replace(
        _searched(scored, stages, likelihood.trace(values).loglik, likelihood.timeline.n_readings),
        name=record.name,
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        provenance=record.provenance,
        criterion=criterion,
        kind=basis.kind,
        rated_power_kW=math.nan if record.rated_power_W is None else record.rated_power_W / 1e3,
        site=record.site,
        period=_period(record, stages[0]),
        design=whole,
        statements=_statements(stages, any(f.unseen for f in by_free_run.values())),
        warnings=tuple(record.warnings),
        doubts=all_doubts(run.record),
        files=tuple(record.files),
        parameters=_rows(
            stages, values, errors, by_free_run, {"thermal_time_constant": thermal, "hygric_k": moist}
        ),
        covariance=Covariance(*spread),
        time_constants={n: e for n, e in zip(PARTS, (thermal, moist), strict=True) if e is not None},
        innovations=_diagnosis(run, series),
        identified_on=_identified_on(whole, run),
    )
    return Fit(record.name, whole, values, with_verdicts(results), series)


def _statements(stages: Sequence[Stage], unseen: bool) -> tuple[Statement, ...]:
    """The statements of a fit; `unseen`: the criterion sets constant sensor errors to 0."""
    zero = [FitCode.SENSOR_ERRORS_ZERO()] if unseen else []
    of_designs = unique(one for stage in stages for one in stage.base.statements)
    return (*of_designs, *zero, *(one for stage in stages for one in undetermined(stage)))


def _searched(results: FitResults, stages: Sequence[Stage], loglik: float, n: int) -> FitResults:
    """The results with ln L of the whole model from its n readings, information criteria, and how the search
    for each maximum ended; other optima are as far from `loglik` as from the best of their stage."""
    d = sum(len(stage.estimate.z) for stage in stages)
    return replace(
        results,
        loglik=loglik,
        aic=2.0 * d - 2.0 * loglik,
        bic=d * math.log(max(n, 1)) - 2.0 * loglik,
        n_obs=n,
        converged=all(stage.estimate.converged for stage in stages),
        messages=unique(stage.estimate.message for stage in stages),
        discretisation_error=sum(stage.estimate.discretisation_error for stage in stages),
        other_optima=tuple(
            LocalOptimum(loglik + o - stage.estimate.objective, **{k: v[k] for k in TIME_CONSTANTS if k in v})
            for stage in stages
            for o, v in stage.estimate.others
        ),
        at_bounds=tuple(name for stage in stages for name in stage.estimate.at_bounds),
        flat=tuple(name for stage in stages for name in stage.uncertainty.flat),
        trade_offs=tuple(pair for stage in stages for pair in stage.uncertainty.trade_offs),
    )


def _period(record: Record, stage: Stage) -> Period:
    until = None if record.until_s is None else iso_time(record.until_s)
    t = stage.run.timeline
    return Period(iso_time(record.start_s), until, iso_time(record.end_s), t.n_readings)


def shared_error(
    pair: Sequence[Parameter], values: Sequence[float], errors: Sequence[float], correlation: float
) -> Statement:
    """What a high correlation of two estimates means; `errors` are their standard errors.

    Where both are well known, the correlation does no harm; otherwise only a combination is identified.
    Their difference (for positive parameters their ratio) is known better than either where their errors are
    of similar size.
    """
    about: dict[str, Value] = {"first": pair[0].name, "second": pair[1].name, "correlation": correlation}
    if not all(se < WELL_KNOWN * abs(value) for se, value in zip(errors, values, strict=True)):
        return FitCode.ONLY_COMBINATION(**about)
    # positive parameters are estimated as logarithms, to which the correlation applies
    sizes = [se / value if p.positive else se for p, se, value in zip(pair, errors, values, strict=True)]
    if pair[0].positive == pair[1].positive and max(sizes) < 2.0 * abs(correlation) * min(sizes):
        apart, together = ("ratio", "product") if pair[0].positive else ("difference", "sum")
        return FitCode.OPERATION_KNOWN_BETTER(operation=apart if correlation > 0 else together, **about)
    return FitCode.COMBINATION_KNOWN_BETTER(**about)


def undetermined(stage: Stage) -> list[Statement]:
    """Statements about directions that the data do not determine."""
    statements: list[Statement] = []
    estimate, found = stage.estimate, stage.uncertainty
    if "resistance_ratio" in estimate.at_bounds and estimate.values["resistance_ratio"] > 0.99:
        statements.append(FitCode.NO_FEED_THROUGH())
    others = tuple(name for name in estimate.at_bounds if name != "resistance_ratio")
    if others:
        statements.append(FitCode.AT_LIMITS(names=others))
    for name, bounds in stage.bounds.items():
        if bounds.statements:
            statements.append(FitCode.BOUNDS_OF(parameter=name, bounds=bounds.statements))
        statements += limit_statements(name, bounds)
    if found.flat:
        statements.append(FitCode.NOT_DETERMINED(names=found.flat))
    for a, b, r in found.trade_offs:
        pair = [p for name in (a, b) for p in stage.base.model.parameters if p.name == name]
        errors = [standard_error(estimate, found, p.name) for p in pair]
        statements.append(shared_error(pair, [estimate.values[p.name] for p in pair], errors, r))
    return statements


def _covariance(
    stages: Sequence[Stage], whole: Design, simulated: Mapping[str, OutputError], values: Mapping[str, float]
) -> tuple[tuple[str, ...], np.ndarray]:
    """Covariance of the whole model's estimated parameters in their units: the sandwich of every stage, or of
    the output error."""
    from scipy.linalg import block_diag

    blocks: list[tuple[tuple[str, ...], np.ndarray]] = []
    known = {p.name for p in whole.model.parameters}
    known -= {name for found in simulated.values() for name in (*found.names, *found.unseen)}
    for stage in stages:
        slopes = {p.name: p.slope(values[p.name]) for p in stage.base.model.parameters}
        names = tuple(n for n in stage.uncertainty.names if n in known)
        place = [stage.uncertainty.names.index(n) for n in names]
        scale = np.array([slopes[n] for n in names])
        # the wider of both variances on the diagonal, with the sandwich's correlations
        matrix = stage.uncertainty.sandwich[np.ix_(place, place)]
        wald = np.diag(stage.uncertainty.wald)[place]
        grow = np.sqrt(np.maximum(1.0, wald / np.maximum(np.diag(matrix), 1e-300)))
        blocks.append((names, matrix * np.outer(grow * scale, grow * scale)))
        for found in simulated.values():
            if set(found.names) <= set(slopes):
                scale = np.array([slopes[n] for n in found.names])
                blocks.append((found.names, found.covariance * np.outer(scale, scale)))
    return tuple(n for part, _ in blocks for n in part), block_diag(*(matrix for _, matrix in blocks))


def _rows(
    stages: Sequence[Stage],
    values: Mapping[str, float],
    errors: Mapping[str, float],
    simulated: Mapping[str, OutputError],
    entries: Mapping[str, TimeConstant | None],
) -> dict[str, ParameterRow]:
    """The parameter table; parameters estimated by the output error have bounds from its own sandwich.

    Parameters behind a reported time constant have the bounds of that time constant.
    """
    rows = {name: row for stage in stages for name, row in _parameters(stage, values, errors).items()}
    positive = {p.name: p.positive for stage in stages for p in stage.base.model.parameters}
    for found in simulated.values():
        for name in set(found.names) & rows.keys():
            lower, upper = found.bounds(name, positive[name])
            rows[name] = replace(
                rows[name],
                value=found.values[name],
                se=nan_if_open(0.5 * (upper - lower) / normal_quantile(CONFIDENCE)),
                lower=nan_if_open(lower),
                upper=nan_if_open(upper),
                at_bound=name in found.at_bounds,
            )
        for name in set(found.unseen) & rows.keys():
            rows[name] = ParameterRow(
                0.0, rows[name].unit, meaning=rows[name].meaning, fixed=True,
                at_guard=rows[name].at_guard, parts=rows[name].parts,
            )  # fmt: skip
    for name, entry in entries.items():
        if entry is not None:
            scale = values[name] / entry.value_h
            rows[name] = replace(rows[name], lower=entry.lower_h * scale, upper=entry.upper_h * scale)
    return rows


def _parameters(
    stage: Stage, values: Mapping[str, float], errors: Mapping[str, float]
) -> dict[str, ParameterRow]:
    rows = {}
    parts = tuple(part for part, name in zip(PARTS, TIME_CONSTANTS, strict=True) if name in stage.bounds)
    for p in stage.base.model.parameters:
        b = stage.bounds.get(p.name) or wald_bounds(stage.estimate, stage.uncertainty, p.name)
        at_bound = p.name in stage.estimate.at_bounds
        se, lower, upper = (nan_if_open(one) for one in (errors.get(p.name, math.nan), b.lower, b.upper))
        prior = None if p.prior is None else PriorTerms(*p.prior.in_unit())
        fixed, at_guard = (
            p.name in stage.estimate.coordinates.fixed,
            at_bound and p.is_stopped_by_guard(values[p.name]),
        )
        rows[p.name] = ParameterRow(
            values[p.name], p.unit, se, lower, upper, p.meaning, prior, fixed, at_bound, at_guard, parts
        )
    return rows


def _series(
    base: Design,
    values: Mapping[str, float],
    run: Run,
    predicted: Prediction,
    tolerance: float,
) -> dict[str, np.ndarray]:
    """The arrays of `series.npz`: readings, free run, standardised innovations, inputs."""
    t, known = run.timeline, measured(run)
    nothing = np.full(len(t), np.nan)
    readings = {quantity.removesuffix("_K").removesuffix("_g_m3"): quantity for quantity in QUANTITIES}
    simulated: dict[str, np.ndarray] = {}
    for name, quantity in readings.items():
        value, sd = predicted.of(quantity) or (nothing, nothing)
        simulated |= {f"{name}_simulated": value, f"{name}_sd": sd}
    # of the linear filter: whiteness and kurtosis mean nothing where a reading's influence is bounded
    linear = replace(base.model, bound=math.inf)
    trace = Likelihood(linear, t, tolerance=tolerance).trace(values)
    standard = (t.y - trace.prediction) / np.sqrt(trace.variance)

    def innovation(*names: str) -> np.ndarray:
        for name in names:
            if name in t.outputs:
                return standard[:, t.outputs.index(name)]
        return nothing

    def given(name: str) -> np.ndarray:
        return t.input(name) if name in (*t.varying, *t.regimes) else nothing

    power = given("power_1") if "power_1" in t.varying else np.where(run.operating, 1.0, 0.0)
    return {
        "time_s": t.seconds,
        **{f"{name}_measured": known[quantity] for name, quantity in readings.items()},
        **simulated,
        "temperature_innovation": innovation("cabinet_temperature"),
        "humidity_innovation": innovation("cabinet_relative_humidity", "cabinet_absolute_humidity"),
        "ambient_temperature": given("ambient_temperature"),
        "ambient_absolute_humidity": given("ambient_absolute_humidity"),
        "power": power,
        "operating": run.operating.astype(float),
        "preheating": given("preheating") if "preheating" in t.varying else np.zeros(len(t)),
        "scored": run.scored.astype(float),
        "until_s": np.array(math.nan if run.record.until_s is None else run.record.until_s),
        "start_s": np.array(run.record.start_s),
    }


def _identified_on(design: Design, run: Run) -> dict[str, tuple[float, float]]:
    """0.1 and 99.9 % quantiles of the inputs over the instants used for the identification."""
    t = run.timeline
    chosen = period_masks(run)["identification"] & run.scored
    if not chosen.any():
        return {}
    return {
        key: tuple(np.quantile(t.input(name)[chosen], [0.001, 0.999]).tolist())
        for name, key in IDENTIFIED_ON.items()
        if name in design.model.inputs
    }


def _diagnosis(run: Run, series: Mapping[str, np.ndarray]) -> Diagnosis:
    """Whiteness of the innovations on the identification period."""
    from hygrokf.evaluation.innovation_tests import diagnose

    chosen = period_masks(run)["identification"]
    standard = {
        name: series[key][chosen]
        for name, key in (("temperature", "temperature_innovation"), ("humidity", "humidity_innovation"))
        if np.isfinite(series[key]).any()
    }
    inputs = {
        name: series[name][chosen]
        for name in ("ambient_temperature", "ambient_absolute_humidity", "power", "preheating")
        if np.isfinite(series[name]).any() and np.nanstd(series[name][chosen]) > 0
    }
    return diagnose(run.timeline.time[chosen], standard, inputs)
