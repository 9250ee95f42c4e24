"""A stage of an identification: a model design, fitted to a record, with all that is said of its estimate.

`identify_stage` fits the design by maximum likelihood, chooses the form of the model by its evidence, and
computes the uncertainty of the parameters, the bounds of the time constants, and how these depend on the
clocks, on the sampling of the ambient and on each input.  A cascade has two stages (thermal, hygric), a joint
identification one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.data.actuators import ACTUATORS
from hygrokf.data.input_paths import thinned
from hygrokf.data.progress import Progress
from hygrokf.data.record import Record, Series
from hygrokf.engine.parallel import mapped
from hygrokf.estimation.confidence import Bounds, Uncertainty, uncertainty, wald_bounds
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import (
    Estimate,
    Objective,
    climb,
    fit_mle,
    least_objective,
    refine,
    reject_below,
)
from hygrokf.estimation.output_error import OutputError, fit_output_error
from hygrokf.estimation.profile_likelihood import profile
from hygrokf.estimation.smoother import smoothed_states
from hygrokf.evaluation.simulation import project, settled
from hygrokf.identification.clock_offsets import NO_OFFSETS, ClockOffsets, clock_offsets
from hygrokf.identification.model_forms import ADOPTED, FittedForm, ended_at_limits, weigh_forms
from hygrokf.identification.needed_inputs import WithoutInput, without_input
from hygrokf.modelling.design import CASCADE, Design, design, reading_step_h
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.physics.holds import LINEAR
from hygrokf.physics.parameters import within_limits
from hygrokf.texts.parts import TIME_CONSTANTS

SEARCH_DAYS = 30.0
"""[d] first part of a long record on which starts and forms are tried."""


@dataclass(frozen=True)
class DesignEstimate:
    """A model design on a record with its maximum of the likelihood."""

    base: Design
    run: Run
    estimate: Estimate

    @property
    def likelihood(self) -> Likelihood:
        """The likelihood of the design on the record."""
        return Likelihood(self.base.model, self.run.timeline)


@dataclass(frozen=True)
class Stage(DesignEstimate):
    """A maximum of the likelihood with its uncertainty, and what the time constants depend on.

    bounds: of the time constants, by the profile likelihood.
    clock: effect of the other sources' clocks on the time constants.
    sampling: change of their logarithms with half as many ambient readings.
    forms: all competing forms of the model, including the chosen one.
    response_stated: whether the response time of the humidity sensor is stated.
    without: for each time constant, the best model in which its input does not act.
    """

    uncertainty: Uncertainty
    bounds: Mapping[str, Bounds]
    clock: ClockOffsets = NO_OFFSETS
    sampling: Mapping[str, float] | None = None
    forms: tuple[FittedForm, ...] = ()
    response_stated: bool = False
    without: Mapping[str, WithoutInput] = field(default_factory=dict)


def identify_stage(early: Record, base: Design, starts: int, profiles: bool, say: Progress) -> Stage:
    """Estimate a design on the identification period `early`, choose its form, and assess the uncertainty."""
    initial, forms = select_form(estimate_design(early, base, starts, say), say)
    return assess_stage(initial, profiles, say, forms)


def select_form(initial: DesignEstimate, say: Progress) -> tuple[DesignEstimate, tuple[FittedForm, ...]]:
    """Choose the form of the model by its evidence; returns its estimate, and all forms with their weights.

    A form with more than `ADOPTED` of the evidence becomes the base, and its share is divided among the forms
    that extend it, until no further form is adopted.  A form is not adopted if one of its further parameters
    ends at a limit of its range, alone or together with a form adopted later: a sign of another cause.
    """
    say("forms of the model")
    forms = weigh_forms(
        initial.base, initial.run, initial.estimate, TIME_CONSTANTS, _search(initial.likelihood)
    )
    chosen = next((form for form in forms if form.adoptable and form.weight > ADOPTED), None)
    if chosen is None:
        return initial, forms
    likelihood = Likelihood(chosen.design.model, initial.run.timeline)
    estimate = fit_mle(likelihood, chosen.estimate.values, count=1)
    least = least_objective(estimate.coordinates, (initial.estimate,))
    adopted = DesignEstimate(chosen.design, initial.run, reject_below(least, estimate))
    final_estimate, forms_of_adopted = select_form(adopted, say)
    if ended_at_limits(final_estimate.estimate, initial.estimate):
        return initial, forms
    return final_estimate, (
        *(form for form in forms if form is not chosen),
        *(form.within(chosen) for form in forms_of_adopted),
    )


def estimate_design(
    early: Record, base: Design, starts: int, say: Progress, values: Mapping[str, float] | None = None
) -> DesignEstimate:
    """Fit a design by maximum likelihood.

    early: the identification period.  starts: number of start points.  values: parameters of the first one.
    """
    run = model_inputs(base, early)
    likelihood = Likelihood(base.model, run.timeline)
    begin = within_limits(base.model.parameters, values or {})
    estimate = fit_mle(likelihood, begin, count=starts, progress=say, search=_search(likelihood))
    return DesignEstimate(base, run, estimate)


def assess_stage(
    initial: DesignEstimate, profiles: bool, say: Progress, forms: tuple[FittedForm, ...] = ()
) -> Stage:
    """Compute the uncertainty of an estimate, the bounds of its time constants, and their sensitivities.

    If a profile meets a higher likelihood than that of the estimate, the estimate is refitted from there.
    """
    covariance, bounds = _bounded(initial, profiles, say)
    better_point = next((bound.better for bound in bounds.values() if bound.better is not None), None)
    if better_point is not None:
        say("climb from a better point of the profile")
        initial = replace(initial, estimate=refine(initial.likelihood, better_point))
        covariance, bounds = _bounded(initial, profiles, say)
    base, run, estimate = initial.base, initial.run, initial.estimate
    clock = clock_offsets(base, run, estimate, covariance)
    sampling = _sampling(initial, tuple(bounds), say)
    humidity = (
        run.record[base.humidity] if base.humidity is not None and base.humidity in run.record else None
    )
    response_stated = humidity is not None and humidity.response_time_s is not None
    say("models without the input")
    without = {name: without_input(name, base.model, run, estimate) for name in bounds}
    return Stage(base, run, estimate, covariance, bounds, clock, sampling, forms, response_stated, without)


def _bounded(initial: DesignEstimate, profiles: bool, say: Progress) -> tuple[Uncertainty, dict[str, Bounds]]:
    """Return the uncertainty of an estimate, and the bounds of its time constants.

    profiles: whether to compute profile bounds; otherwise Wald bounds.
    """
    estimate = initial.estimate
    objective = Objective(initial.likelihood, estimate.coordinates)
    say("observed information")
    covariance = uncertainty(objective, estimate)
    return covariance, {
        name: profile(objective, estimate, covariance, name, CONFIDENCE, say)
        if profiles
        else wald_bounds(estimate, covariance, name, CONFIDENCE)
        for name in TIME_CONSTANTS
        if name in estimate.coordinates.names
    }


def _search(likelihood: Likelihood) -> Likelihood | None:
    """Return the likelihood of the first `SEARCH_DAYS`, on which starts and forms are tried; None for a short
    record."""
    timeline = likelihood.timeline
    if timeline.time[-1] <= 2.0 * 24.0 * SEARCH_DAYS:
        return None
    return Likelihood(
        likelihood.model, timeline.window(0, int(np.searchsorted(timeline.time, 24.0 * SEARCH_DAYS)))
    )


def _sampling(initial: DesignEstimate, names: tuple[str, ...], say: Progress) -> dict[str, float] | None:
    """Return by how much ln(time constant) changes with half as many ambient readings.

    The ambient is interpolated between its readings; the change shows the effect of interpolation errors.
    """
    record = initial.run.record
    thinned_series = [thinned(series) for series in record.series if series.signal.startswith("ambient_")]
    if not thinned_series or not all(len(series) > 2 for series in thinned_series):
        return None
    say("ambient sampling")
    estimate, run = initial.estimate, model_inputs(initial.base, record.replace_series(*thinned_series))
    likelihood = Likelihood(initial.base.model, run.timeline)
    optimum = climb(Objective(likelihood, estimate.coordinates), estimate.z, passes=8, tolerance=0.05)
    values = estimate.coordinates.values(optimum.z)
    shifts = {name: math.log(values[name] / estimate.values[name]) for name in names}
    return {"step_h": reading_step_h(thinned_series[0]) / 2.0, **shifts}


def smoothed_temperature(base: Design, run: Run, values: Mapping[str, float], humidity: str) -> Series:
    """Return the cabinet air temperature [K] given all its readings, at the run's instants and the humidity
    readings.

    base, run, values: thermal design, its run and its parameters.  humidity: signal of the cabinet's
        humidity.

    The hygric model divides by e_s(T).  The noise of raw readings would attenuate that dependence, as errors
    in a regressor do, and bias the humidity sensor's estimate; the smoothed temperature avoids this.  A slow
    humidity sensor also responds to the temperature between the readings, which ambient and power determine
    better than a straight line.
    """
    timeline = run.timeline
    mean, _ = smoothed_states(Likelihood(base.model, timeline), values, covariance=False)
    air_K, _ = project(base.model, timeline, values, mean, None, "cabinet_air_temperature")
    seconds = timeline.seconds
    readings, humidity_series = run.record["cabinet_temperature"], run.record[humidity]
    time = np.union1d(seconds, humidity_series.time[~humidity_series.missing])
    time = time[(time >= seconds[0]) & (time <= seconds[-1])]
    return replace(readings, time=time, value=np.interp(time, seconds, air_K), hold=LINEAR, interval_s=0.0)


def output_errors(early: Record, base: Design, values: Mapping[str, float]) -> dict[str, OutputError]:
    """Return the output-error estimate (best free run) behind each time constant.

    The thermal model is fitted to the temperature readings, the hygric model to the humidity readings with
    the measured temperature as input.
    """
    designs: dict[str, Design] = {}
    if "thermal_network" in [name for name, _ in base.mechanisms]:
        designs["thermal_time_constant"] = replace(
            base,
            mechanisms=tuple(mechanism for mechanism in base.mechanisms if mechanism[0] in _THERMAL_PLAIN),
            humidity=None,
            averaged={
                signal: interval
                for signal, interval in base.averaged.items()
                if signal == "cabinet_temperature"
            },
            priors={},  # the output error does not use priors from other turbines
        )
    if base.humidity is not None and "cabinet_temperature" in early:
        hygric_design = design(early, kind=CASCADE, coloured=False)
        stated_sensors = {
            name: settings for name, settings in base.mechanisms if name.endswith("humidity_sensor")
        }
        mechanisms = tuple(
            (name, stated_sensors.get(name, settings)) for name, settings in hygric_design.mechanisms
        )
        designs["hygric_k"] = replace(hygric_design, mechanisms=mechanisms)

    def free_run(plain_design: Design) -> OutputError:
        """Fit a design by the error of its free run."""
        start = {
            parameter.name: values.get(parameter.name, parameter.start)
            for parameter in plain_design.model.parameters
        }
        run = settled(plain_design, start, model_inputs(plain_design, early))
        scored = run.timeline.with_readings(np.where(run.scored[:, None], run.timeline.y, np.nan))
        return fit_output_error(Likelihood(plain_design.model, scored), start)

    return dict(zip(designs, mapped(free_run, designs.values()), strict=True))


_THERMAL_PLAIN = (
    "thermal_network",
    "heat_release",
    "natural_convection",
    "thermal_diffusion",
    "temperature_sensor",
    *(thermal for thermal, _ in ACTUATORS.values() if thermal is not None),
)
