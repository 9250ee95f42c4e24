"""One likelihood from its design to bounds: estimate, form, uncertainty, profiles, sensitivities.

A cascade has two stages (thermal, hygric), a joint identification one.
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
from hygrokf.identification.forms import ADOPTED, FittedForm, ended_at_limits, weigh_forms
from hygrokf.identification.needed_inputs import WithoutInput, without_input
from hygrokf.modelling.design import CASCADE, Design, design, reading_step_h
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.physics.holds import LINEAR
from hygrokf.physics.parameters import within_limits

LEVEL = 0.95
"""[1] probability of the bounds of the time constants."""
TIME_CONSTANTS = ("thermal_time_constant", "hygric_k")
SEARCH_DAYS = 30.0
"""[d] stretch of the record on which starts and forms are tried."""


@dataclass(frozen=True)
class DesignEstimate:
    """One likelihood with its maximum, before its uncertainty is known."""

    base: Design
    run: Run
    estimate: Estimate

    @property
    def likelihood(self) -> Likelihood:
        return Likelihood(self.base.model, self.run.timeline)


@dataclass(frozen=True)
class Stage(DesignEstimate):
    """One identified likelihood.

    `bounds`: of its time constants, by the profile likelihood; `clock`: effect of the other sources' clocks
    on them; `sampling`: their change (ln) with half as many ambient readings; `forms`: all competing forms,
    including the chosen one; `response_stated`: whether the response time of the humidity sensor is stated;
    `without`: the best model in which the input of each time constant does not act.
    """

    uncertainty: Uncertainty
    bounds: Mapping[str, Bounds]
    clock: ClockOffsets = NO_OFFSETS
    sampling: Mapping[str, float] | None = None
    forms: tuple[FittedForm, ...] = ()
    response_stated: bool = False
    without: Mapping[str, WithoutInput] = field(default_factory=dict)


def identify_stage(early: Record, base: Design, starts: int, profiles: bool, say: Progress) -> Stage:
    """Estimate a design on the identification period `early`, in the form that the record supports, with its
    uncertainty."""
    found, forms = select_form(estimate_design(early, base, starts, say), say)
    return assess_stage(found, profiles, say, forms)


def select_form(
    found: DesignEstimate, say: Progress
) -> tuple[DesignEstimate, tuple[FittedForm, ...]]:
    """The form that the evidence of a record selects, and all forms with their weights.

    A form with more than `ADOPTED` of the evidence becomes the base, and its share is divided among the forms
    that compete with it, until no further form is adopted.  A form is not adopted when one of its own
    parameters ends at a limit of its range, there or beside a form adopted later, because this indicates
    another cause.
    """
    say("forms of the model")
    forms = weigh_forms(found.base, found.run, found.estimate, TIME_CONSTANTS, _search(found.likelihood))
    chosen = next((form for form in forms if form.adoptable and form.weight > ADOPTED), None)
    if chosen is None:
        return found, forms
    likelihood = Likelihood(chosen.design.model, found.run.timeline)
    estimate = fit_mle(likelihood, chosen.estimate.values, count=1)
    least = least_objective(estimate.coordinates, (found.estimate,))
    adopted = DesignEstimate(chosen.design, found.run, reject_below(least, estimate))
    last, further = select_form(adopted, say)
    if ended_at_limits(last.estimate, found.estimate):
        return found, forms
    return last, (*(form for form in forms if form is not chosen), *(form.within(chosen) for form in further))


def estimate_design(
    early: Record, base: Design, starts: int, say: Progress, values: Mapping[str, float] | None = None
) -> DesignEstimate:
    """Maximum likelihood of one design; `values`: of the first start."""
    run = model_inputs(base, early)
    likelihood = Likelihood(base.model, run.timeline)
    begin = within_limits(base.model.parameters, values or {})
    estimate = fit_mle(likelihood, begin, count=starts, progress=say, search=_search(likelihood))
    return DesignEstimate(base, run, estimate)


def assess_stage(
    found: DesignEstimate, profiles: bool, say: Progress, forms: tuple[FittedForm, ...] = ()
) -> Stage:
    """Uncertainty, bounds of the time constants, and their sensitivity to clocks and sampling.

    Where a profile meets a higher likelihood than the estimate's, the estimate is first refitted from there.
    """
    spread, bounds = _bounded(found, profiles, say)
    better = next((b.better for b in bounds.values() if b.better is not None), None)
    if better is not None:
        say("climb from a better point of the profile")
        found = replace(found, estimate=refine(found.likelihood, better))
        spread, bounds = _bounded(found, profiles, say)
    base, run, estimate = found.base, found.run, found.estimate
    clock = clock_offsets(base, run, estimate, spread)
    sampling = _sampling(found, tuple(bounds), say)
    moist = run.record[base.humidity] if base.humidity is not None and base.humidity in run.record else None
    stated = moist is not None and moist.response_time_s is not None
    say("models without the input")
    without = {name: without_input(name, base.model, run, estimate) for name in bounds}
    return Stage(base, run, estimate, spread, bounds, clock, sampling, forms, stated, without)


def _bounded(found: DesignEstimate, profiles: bool, say: Progress) -> tuple[Uncertainty, dict[str, Bounds]]:
    """Uncertainty of an estimate, and bounds of its time constants."""
    estimate = found.estimate
    objective = Objective(found.likelihood, estimate.coordinates)
    say("observed information")
    spread = uncertainty(objective, estimate)
    return spread, {
        name: profile(objective, estimate, spread, name, LEVEL, say)
        if profiles
        else wald_bounds(estimate, spread, name, LEVEL)
        for name in TIME_CONSTANTS
        if name in estimate.coordinates.names
    }


def _search(likelihood: Likelihood) -> Likelihood | None:
    """The likelihood of a shorter stretch for trying starts and forms; None where the record is short."""
    t = likelihood.timeline
    if t.time[-1] <= 2.0 * 24.0 * SEARCH_DAYS:
        return None
    return Likelihood(likelihood.model, t.window(0, int(np.searchsorted(t.time, 24.0 * SEARCH_DAYS))))


def _sampling(old: DesignEstimate, names: tuple[str, ...], say: Progress) -> dict[str, float] | None:
    """Change of the log time constants with half as many ambient readings.

    The course of the ambient between its readings is reconstructed; the change shows how much an error in it
    could matter.
    """
    record = old.run.record
    sparse = [thinned(s) for s in record.series if s.signal.startswith("ambient_")]
    if not sparse or not all(len(s) > 2 for s in sparse):
        return None
    say("ambient sampling")
    estimate, run = old.estimate, model_inputs(old.base, record.replace_series(*sparse))
    likelihood = Likelihood(old.base.model, run.timeline)
    found = climb(Objective(likelihood, estimate.coordinates), estimate.z, passes=8, tolerance=0.05)
    values = estimate.coordinates.values(found.z)
    shifts = {name: math.log(values[name] / estimate.values[name]) for name in names}
    return {"step_h": reading_step_h(sparse[0]) / 2.0, **shifts}


def smoothed_temperature(
    base: Design, run: Run, values: Mapping[str, float], humidity: str
) -> Series:
    """The cabinet air temperature given all its readings [K], at the run's instants and the times of the
    humidity.

    `base` is a thermal design with its run and its parameters; `humidity` is the signal of the
    cabinet's humidity.

    The hygric model divides by e_s(T).  The noise of raw readings would attenuate that dependence, as errors
    in a regressor do, and bias the humidity sensor's estimate; the smoothed temperature avoids this.  A slow
    humidity sensor also responds to the temperature between the readings, which ambient and power determine
    better than a straight line.
    """
    t = run.timeline
    mean, _ = smoothed_states(Likelihood(base.model, t), values, covariance=False)
    air, _ = project(base.model, t, values, mean, None, "cabinet_air_temperature")
    seconds = t.seconds
    raw, moist = run.record["cabinet_temperature"], run.record[humidity]
    time = np.union1d(seconds, moist.time[~moist.missing])
    time = time[(time >= seconds[0]) & (time <= seconds[-1])]
    return replace(raw, time=time, value=np.interp(time, seconds, air), hold=LINEAR, interval_s=0.0)


def output_errors(early: Record, base: Design, values: Mapping[str, float]) -> dict[str, OutputError]:
    """Output-error estimates: the thermal model on temperature, the hygric one on the measured
    temperature."""
    fitted: dict[str, Design] = {}
    if "thermal_network" in [name for name, _ in base.mechanisms]:
        fitted["thermal_time_constant"] = replace(
            base,
            mechanisms=tuple(m for m in base.mechanisms if m[0] in _THERMAL_PLAIN),
            humidity=None,
            averaged={k: v for k, v in base.averaged.items() if k == "cabinet_temperature"},
            priors={},  # priors from other turbines have no place in this criterion
        )
    if base.humidity is not None and "cabinet_temperature" in early:
        plain = design(early, kind=CASCADE, coloured=False)
        own = {name: settings for name, settings in base.mechanisms if name.endswith("humidity_sensor")}
        made = tuple((name, own.get(name, settings)) for name, settings in plain.mechanisms)
        fitted["hygric_k"] = replace(plain, mechanisms=made)

    def free_run(one: Design) -> OutputError:
        start = {p.name: values.get(p.name, p.start) for p in one.model.parameters}
        run = settled(one, start, model_inputs(one, early))
        known = run.timeline.with_readings(np.where(run.scored[:, None], run.timeline.y, np.nan))
        return fit_output_error(Likelihood(one.model, known), start)

    return dict(zip(fitted, mapped(free_run, fitted.values()), strict=True))


_THERMAL_PLAIN = (
    "thermal_network",
    "heat_release",
    "natural_convection",
    "thermal_diffusion",
    "temperature_sensor",
    *(thermal for thermal, _ in ACTUATORS.values() if thermal is not None),
)
