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
"""[1] relative standard error below which a parameter counts as well known despite correlations."""
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
    identification_part = record.identification()
    if model is not None:
        _expect_model(model, criterion, prior, identification_part)
    with reporting(progress, "identify") as say:
        if model is not None:
            return assemble_fit(
                record, _identify_model(identification_part, model, starts, profiles, say), {}, say=say
            )
        stages_and_regression = identify_stages(identification_part, kind, starts, profiles, say, prior)
        say("output-error fit")
        simulated = output_errors(
            identification_part, stages_and_regression.whole, stages_and_regression.values
        )
        return assemble_fit(record, stages_and_regression, simulated, criterion, say)


@dataclass(frozen=True)
class Basis:
    """The stages of an identification (one, or two for a cascade) and the heat-release `regression`."""

    kind: str
    stages: tuple[Stage, ...]
    regression: HeatRelease

    @property
    def whole(self) -> Design:
        """The joint design of all stages."""
        return merged([stage.base for stage in self.stages])

    @property
    def values(self) -> dict[str, float]:
        """Estimated parameter values of all stages, by name."""
        return {name: value for stage in self.stages for name, value in stage.estimate.values.items()}


def identify_stages(
    early: PreparedRecord,
    kind: str,
    starts: int,
    profiles: bool,
    say: Progress,
    prior: Callable[[Design], Mapping[str, Prior]] | None = None,
) -> Basis:
    """Estimate every stage of a "joint" or "cascade" model on the identification period `early`.

    starts: number of start points.  profiles: whether to compute profile bounds.
    """
    from hygrokf.identification.steady_state import heat_release_regression

    expect_readings(early)
    say("heat-release regression")
    regression = heat_release_regression(early)

    def base_of(kind_of_design: str) -> Design:
        """Return the design of one kind for the record, with the given priors."""
        base = design(
            early, kind=kind_of_design, power_order=regression.power_order, heat_start=regression.start()
        )
        if prior is None:
            return base
        priors = {name: (p.mean, p.sd, p.logarithmic) for name, p in prior(base).items()}
        return replace(base, priors=priors)

    first_design = base_of(JOINT if kind == JOINT else "thermal")
    first_estimate, forms = select_form(estimate_design(early, first_design, starts, say), say)
    second_design = None if kind == JOINT else base_of(CASCADE)

    def assess_first() -> Stage:
        """Compute the uncertainty of the first stage."""
        return assess_stage(first_estimate, profiles, say, forms)

    def identify_hygric(base: Design, humidity: str) -> Stage:
        """Identify the hygric stage, with the smoothed cabinet temperature of the first stage as input."""
        say("smoothed cabinet temperature")
        temperature_series = smoothed_temperature(
            first_estimate.base, first_estimate.run, first_estimate.estimate.values, humidity
        )
        return identify_stage(early.replace_series(temperature_series), base, starts, profiles, say)

    jobs: list[Callable[[], Stage]] = [assess_first]
    if second_design is not None and second_design.humidity is not None:
        # the hygric stage needs the thermal estimate, not its bounds
        jobs.append(partial(identify_hygric, second_design, second_design.humidity))
    return Basis(kind, tuple(mapped(lambda job: job(), jobs)), regression)


def _expect_model(model: Fit, criterion: str, prior: object, early: Record) -> None:
    """Check the options of `identify` beside `model`; raises ValueError that lists all faults."""
    faults, humidity = [], model.design.humidity
    if prior is not None:
        faults.append("prior: expected none together with model, which has its own priors; leave it out")
    if criterion != "likelihood":
        faults.append(
            "criterion: expected 'likelihood' together with model, since a free-run fit would lack its added "
            f"mechanisms, found {criterion!r}"
        )
    count = int(np.isfinite(early[humidity].value).sum()) if humidity and humidity in early else 0
    if humidity and count < FEWEST_READINGS:
        faults.append(
            f"{humidity}: expected at least {FEWEST_READINGS} readings in the identification period for the "
            f"model of {model.name}, found {count}; add them, or leave model out"
        )
    if faults:
        raise ValueError("; ".join(faults))


def _identify_model(early: Record, model: Fit, starts: int, profiles: bool, say: Progress) -> Basis:
    """Estimate a fit's model on another record's identification period `early`, from the fit's values, with
    the sensors of that record."""
    from hygrokf.identification.steady_state import heat_release_regression

    expect_readings(early)
    model_design = model.design
    own_design = design(early, kind=JOINT, power_order=model_design.power_order, library=model_design.library)
    sensor_settings = {
        name: {key: settings[key] for key in ("accuracy", "resolution") if key in settings}
        for name, settings in own_design.mechanisms
        if name.endswith("_sensor")
    }
    origin = FitCode.MODEL_OF_FIT(fit=model.name, criterion=model.results.criterion)
    with_own_sensors = replace(
        own_design,
        mechanisms=tuple(
            (name, {**settings, **sensor_settings.get(name, {})})
            for name, settings in model_design.mechanisms
        ),
        averaged={}, humidity=model_design.humidity, holds=model_design.holds,
        features=model_design.features, priors=model_design.priors,
        statements=(*own_design.statements, origin, FitCode.FORMS_NOT_COMPARED()),
    )  # fmt: skip
    base = read_as(with_own_sensors, early)
    estimate = estimate_design(early, base, starts, say, model.values)
    return Basis(JOINT, (assess_stage(estimate, profiles, say),), heat_release_regression(early))


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
    """Make a fit from its stages: free run, scores, bands and tables on the whole record; `simulated`:
    output-error estimates by time constant; `tolerance`: as in `Likelihood`."""
    stages, whole, values = basis.stages, basis.whole, basis.values
    by_free_run = simulated if criterion == "simulation" else {}
    say("free run and scores")
    for output_error in by_free_run.values():
        changed = {*output_error.names, *output_error.unseen} & values.keys()
        values |= {name: output_error.values[name] for name in changed}
    standard_errors = {
        parameter.name: standard_error(stage.estimate, stage.uncertainty, parameter.name)
        for stage in stages
        for parameter in stage.estimate.coordinates.parameters
    }
    run = settled(whole, values, model_inputs(whole, record), tolerance)
    covariance = _covariance(stages, whole, by_free_run, values)
    predicted = free_run(whole, values, run, covariance, tolerance)
    thermal = next((entry for stage in stages if (entry := thermal_entry(stage, simulated))), None)
    hygric = next((entry for stage in stages if (entry := hygric_entry(stage, simulated))), None)
    if criterion == "simulation":
        thermal, hygric = by_simulation(thermal), by_simulation(hygric)
    errors_by_period = scores(run, predicted)
    partial_results = FitResults(
        rmse=errors_by_period,
        baselines=baselines(run),
        readings_sd=readings_sd(run),
        sensor_share=sensor_share(run, errors_by_period),
        bands=bands(whole, values, run, predicted, tolerance),
        heat_release=basis.regression.thinned(),
        actuators=actuator_effects(whole, values, standard_errors, run),
    )
    say("innovations")
    series = _series(whole, values, run, predicted, tolerance)
    likelihood = likelihood_on(whole, stages[0].run.record, IDENTIFICATION)
    results = replace(
        _searched(partial_results, stages, likelihood.trace(values).loglik, likelihood.timeline.n_readings),
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
        parameters=_rows(stages, values, standard_errors, by_free_run, (thermal, hygric)),
        covariance=Covariance(*covariance),
        time_constants={
            name: entry for name, entry in (("thermal", thermal), ("hygric", hygric)) if entry is not None
        },
        innovations=_diagnosis(run, series),
        identified_on=_identified_on(whole, run),
    )
    return Fit(record.name, whole, values, with_verdicts(results), series)


def _statements(stages: Sequence[Stage], unseen: bool) -> tuple[Statement, ...]:
    """Return the statements of a fit; `unseen`: whether the criterion sets constant sensor errors to 0."""
    sensor_errors_zero = [FitCode.SENSOR_ERRORS_ZERO()] if unseen else []
    of_designs = unique(statement for stage in stages for statement in stage.base.statements)
    not_determined = [statement for stage in stages for statement in undetermined(stage)]
    return (*of_designs, *sensor_errors_zero, *not_determined)


def _searched(results: FitResults, stages: Sequence[Stage], loglik: float, n: int) -> FitResults:
    """Return the results with ln L of the whole model from its n readings, information criteria, and how the
    search of each stage ended; other optima are stated relative to `loglik`."""
    parameter_count = sum(len(stage.estimate.z) for stage in stages)
    return replace(
        results,
        loglik=loglik,
        aic=2.0 * parameter_count - 2.0 * loglik,
        bic=parameter_count * math.log(max(n, 1)) - 2.0 * loglik,
        n_obs=n,
        converged=all(stage.estimate.converged for stage in stages),
        messages=unique(stage.estimate.message for stage in stages),
        discretisation_error=sum(stage.estimate.discretisation_error for stage in stages),
        other_optima=tuple(
            LocalOptimum(
                loglik + objective - stage.estimate.objective,
                **{k: values[k] for k in TIME_CONSTANTS if k in values},
            )
            for stage in stages
            for objective, values in stage.estimate.others
        ),
        at_bounds=tuple(name for stage in stages for name in stage.estimate.at_bounds),
        flat=tuple(name for stage in stages for name in stage.uncertainty.flat),
        trade_offs=tuple(pair for stage in stages for pair in stage.uncertainty.trade_offs),
    )


def _period(record: Record, stage: Stage) -> Period:
    """Return start, end of the identification and end of a record, and the number of readings of a stage."""
    until = None if record.until_s is None else iso_time(record.until_s)
    n_readings = stage.run.timeline.n_readings
    return Period(iso_time(record.start_s), until, iso_time(record.end_s), n_readings)


def shared_error(
    pair: Sequence[Parameter], values: Sequence[float], errors: Sequence[float], correlation: float
) -> Statement:
    """Return the statement about two estimates with a high correlation.

    pair, values, errors: the two parameters, their values and standard errors.
    If both are well known, the correlation does no harm; otherwise only a combination is identified.  The
    difference (for positive parameters the ratio) of two estimates with similar errors is known better than
    either.
    """
    first, second = pair
    about: dict[str, Value] = {"first": first.name, "second": second.name, "correlation": correlation}
    if not all(se < WELL_KNOWN * abs(value) for se, value in zip(errors, values, strict=True)):
        return FitCode.ONLY_COMBINATION(**about)
    # positive parameters are estimated as logarithms, to which the correlation applies
    sizes = [se / value if p.positive else se for p, se, value in zip(pair, errors, values, strict=True)]
    if first.positive == second.positive and max(sizes) < 2.0 * abs(correlation) * min(sizes):
        if correlation > 0:
            operation = "ratio" if first.positive else "difference"
        else:
            operation = "product" if first.positive else "sum"
        return FitCode.OPERATION_KNOWN_BETTER(operation=operation, **about)
    return FitCode.COMBINATION_KNOWN_BETTER(**about)


def undetermined(stage: Stage) -> list[Statement]:
    """Return statements about what the readings of a stage do not determine."""
    statements: list[Statement] = []
    estimate, uncertainty = stage.estimate, stage.uncertainty
    if "resistance_ratio" in estimate.at_bounds and estimate.values["resistance_ratio"] > 0.99:
        statements.append(FitCode.NO_FEED_THROUGH())
    names_at_limits = tuple(name for name in estimate.at_bounds if name != "resistance_ratio")
    if names_at_limits:
        statements.append(FitCode.AT_LIMITS(names=names_at_limits))
    for name, bounds in stage.bounds.items():
        if bounds.statements:
            statements.append(FitCode.BOUNDS_OF(parameter=name, bounds=bounds.statements))
        statements += limit_statements(name, bounds)
    if uncertainty.flat:
        statements.append(FitCode.NOT_DETERMINED(names=uncertainty.flat))
    for first, second, correlation in uncertainty.trade_offs:
        pair = [p for name in (first, second) for p in stage.base.model.parameters if p.name == name]
        errors = [standard_error(estimate, uncertainty, p.name) for p in pair]
        statements.append(shared_error(pair, [estimate.values[p.name] for p in pair], errors, correlation))
    return statements


def _covariance(
    stages: Sequence[Stage], whole: Design, simulated: Mapping[str, OutputError], values: Mapping[str, float]
) -> tuple[tuple[str, ...], np.ndarray]:
    """Return names and covariance of the whole model's estimated parameters, in their units.

    It is the sandwich covariance of every stage, or of the output error for the parameters in `simulated`.
    """
    from scipy.linalg import block_diag

    blocks: list[tuple[tuple[str, ...], np.ndarray]] = []
    by_likelihood = {p.name for p in whole.model.parameters}
    by_likelihood -= {
        name for output_error in simulated.values() for name in (*output_error.names, *output_error.unseen)
    }
    for stage in stages:
        slopes = {p.name: p.slope(values[p.name]) for p in stage.base.model.parameters}
        names = tuple(name for name in stage.uncertainty.names if name in by_likelihood)
        indices = [stage.uncertainty.names.index(name) for name in names]
        scale = np.array([slopes[name] for name in names])
        # the wider of both variances on the diagonal, with the sandwich's correlations
        matrix = stage.uncertainty.sandwich[np.ix_(indices, indices)]
        wald = np.diag(stage.uncertainty.wald)[indices]
        widening = np.sqrt(np.maximum(1.0, wald / np.maximum(np.diag(matrix), 1e-300)))
        blocks.append((names, matrix * np.outer(widening * scale, widening * scale)))
        for output_error in simulated.values():
            if set(output_error.names) <= set(slopes):
                scale = np.array([slopes[name] for name in output_error.names])
                blocks.append((output_error.names, output_error.covariance * np.outer(scale, scale)))
    all_names = tuple(name for names_of_block, _ in blocks for name in names_of_block)
    return all_names, block_diag(*(matrix for _, matrix in blocks))


def _rows(
    stages: Sequence[Stage],
    values: Mapping[str, float],
    errors: Mapping[str, float],
    simulated: Mapping[str, OutputError],
    entries: Sequence[TimeConstant | None],
) -> dict[str, ParameterRow]:
    """Return the parameter table; `errors` are standard errors.

    simulated: output-error estimates, which replace value and bounds of their parameters.
    entries: thermal and hygric time constant, whose bounds replace those of their parameters.
    """
    rows = {name: row for stage in stages for name, row in _parameters(stage, values, errors).items()}
    positive = {p.name: p.positive for stage in stages for p in stage.base.model.parameters}
    for output_error in simulated.values():
        for name in set(output_error.names) & rows.keys():
            lower, upper = output_error.bounds(name, positive[name])
            rows[name] = replace(
                rows[name],
                value=output_error.values[name],
                se=nan_if_open(0.5 * (upper - lower) / normal_quantile(CONFIDENCE)),
                lower=nan_if_open(lower),
                upper=nan_if_open(upper),
                at_bound=name in output_error.at_bounds,
            )
        for name in set(output_error.unseen) & rows.keys():
            rows[name] = ParameterRow(
                0.0, rows[name].unit, meaning=rows[name].meaning, fixed=True,
                at_guard=rows[name].at_guard, parts=rows[name].parts,
            )  # fmt: skip
    for name, constant in zip(TIME_CONSTANTS, entries, strict=True):
        if constant is not None:
            scale = values[name] / constant.value_h
            rows[name] = replace(rows[name], lower=constant.lower_h * scale, upper=constant.upper_h * scale)
    return rows


def _parameters(
    stage: Stage, values: Mapping[str, float], errors: Mapping[str, float]
) -> dict[str, ParameterRow]:
    """Return the table rows of a stage's parameters, by name."""
    rows = {}
    parts = tuple(part for part, name in zip(PARTS, TIME_CONSTANTS, strict=True) if name in stage.bounds)
    for parameter in stage.base.model.parameters:
        name = parameter.name
        bounds = stage.bounds.get(name) or wald_bounds(stage.estimate, stage.uncertainty, name)
        at_bound = name in stage.estimate.at_bounds
        rows[name] = ParameterRow(
            values[name],
            parameter.unit,
            se=nan_if_open(errors.get(name, math.nan)),
            lower=nan_if_open(bounds.lower),
            upper=nan_if_open(bounds.upper),
            meaning=parameter.meaning,
            prior=None if parameter.prior is None else PriorTerms(*parameter.prior.in_unit()),
            fixed=name in stage.estimate.coordinates.fixed,
            at_bound=at_bound,
            at_guard=at_bound and parameter.is_stopped_by_guard(values[name]),
            parts=parts,
        )
    return rows


def _series(
    base: Design, values: Mapping[str, float], run: Run, predicted: Prediction, tolerance: float
) -> dict[str, np.ndarray]:
    """Return the arrays of `series.npz`: readings, free run, standardised innovations, inputs."""
    timeline, observed = run.timeline, measured(run)
    unknown = np.full(len(timeline), np.nan)
    readings = {quantity.removesuffix("_K").removesuffix("_g_m3"): quantity for quantity in QUANTITIES}
    simulated: dict[str, np.ndarray] = {}
    for name, quantity in readings.items():
        value, sd = predicted.of(quantity) or (unknown, unknown)
        simulated |= {f"{name}_simulated": value, f"{name}_sd": sd}
    # of the linear filter: whiteness and kurtosis mean nothing where a reading's influence is bounded
    linear_model = replace(base.model, bound=math.inf)
    trace = Likelihood(linear_model, timeline, tolerance=tolerance).trace(values)
    standardised = (timeline.y - trace.prediction) / np.sqrt(trace.variance)

    def innovation(*names: str) -> np.ndarray:
        """Return the standardised innovations of the first of these outputs that exists; NaN without any."""
        for name in names:
            if name in timeline.outputs:
                return standardised[:, timeline.outputs.index(name)]
        return unknown

    def input_or_nan(name: str) -> np.ndarray:
        """Return an input (T,); NaN if the run lacks it."""
        return timeline.input(name) if name in (*timeline.varying, *timeline.regimes) else unknown

    power = input_or_nan("power_1") if "power_1" in timeline.varying else np.where(run.operating, 1.0, 0.0)
    has_preheating = "preheating" in timeline.varying
    preheating = timeline.input("preheating") if has_preheating else np.zeros(len(timeline))
    return {
        "time_s": timeline.seconds,
        **{f"{name}_measured": observed[quantity] for name, quantity in readings.items()},
        **simulated,
        "temperature_innovation": innovation("cabinet_temperature"),
        "humidity_innovation": innovation("cabinet_relative_humidity", "cabinet_absolute_humidity"),
        "ambient_temperature": input_or_nan("ambient_temperature"),
        "ambient_absolute_humidity": input_or_nan("ambient_absolute_humidity"),
        "power": power,
        "operating": run.operating.astype(float),
        "preheating": preheating,
        "scored": run.scored.astype(float),
        "until_s": np.array(math.nan if run.record.until_s is None else run.record.until_s),
        "start_s": np.array(run.record.start_s),
    }


def _identified_on(design: Design, run: Run) -> dict[str, tuple[float, float]]:
    """Return the 0.1 and 99.9 % quantiles of each input over the instants used for the identification."""
    timeline = run.timeline
    used_instants = period_masks(run)["identification"] & run.scored
    if not used_instants.any():
        return {}
    return {
        key: tuple(np.quantile(timeline.input(name)[used_instants], [0.001, 0.999]).tolist())
        for name, key in IDENTIFIED_ON.items()
        if name in design.model.inputs
    }


def _diagnosis(run: Run, series: Mapping[str, np.ndarray]) -> Diagnosis:
    """Test the innovations of the identification period for whiteness and for correlation with the inputs."""
    from hygrokf.evaluation.innovation_tests import diagnose

    in_period = period_masks(run)["identification"]
    standardised = {
        name: series[key][in_period]
        for name, key in (("temperature", "temperature_innovation"), ("humidity", "humidity_innovation"))
        if np.isfinite(series[key]).any()
    }
    inputs = {
        name: series[name][in_period]
        for name in ("ambient_temperature", "ambient_absolute_humidity", "power", "preheating")
        if np.isfinite(series[name]).any() and np.nanstd(series[name][in_period]) > 0
    }
    return diagnose(run.timeline.time[in_period], standardised, inputs)
