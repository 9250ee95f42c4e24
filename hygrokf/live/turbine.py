"""A turbine to be tracked, and the condition of several turbines from their courses."""

from __future__ import annotations

import hashlib
import json
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from types import MappingProxyType

import numpy as np

from hygrokf.data.structured import JsonObject, structured
from hygrokf.data.timestamps import HOUR_S
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.live.alarms import AlarmState
from hygrokf.live.condition import (
    Condition,
    Surface,
    air_condition,
    at_instants,
    carry_forward,
    inputs_of,
    safer_condition,
    vapour_from_readings,
)
from hygrokf.live.fault_isolation import CauseFinding, ShiftStep
from hygrokf.live.forecast import LIMIT
from hygrokf.live.frozen import Frozen
from hygrokf.live.plan import Plan
from hygrokf.live.properties import ParameterShift, TrackedState
from hygrokf.live.traces import SAME_S, StatedChange, humidity_sensor_trusted
from hygrokf.live.tracker import Point, TrackedCourse

THIN_S = 600.0
"""[s] between two stored estimates of a cabinet whose sensors have been silent for `SENSOR_SILENT_S`, or that
has none."""
SENSOR_SILENT_S = 0.5 * HOUR_S
"""[s] without a reading after which a cabinet's sensors count as silent for `THIN_S`."""
STALE_S = 2.0 * HOUR_S
"""Age [s] above which data are stale, unless the configuration of the turbine states another age."""


@dataclass(frozen=True)
class Turbine:
    """A turbine to be tracked: its plan and its coldest surface.

    `errors`: the fit's standard errors of the tracked properties; `limit` [1]: relative humidity for
    forecasts and restart advice; `stale_s` [s]: age above which its data are stale; `verdicts`: the fit's
    verdicts on its numbers; `heating_sd_K`: standard error of the effect of its heaters.
    """

    plan: Plan
    surface: Surface = field(default_factory=Surface)
    errors: Mapping[str, float] = field(default_factory=dict)
    limit: float = LIMIT
    stale_s: float = STALE_S
    verdicts: Mapping[str, Inherited] = field(default_factory=dict)
    heating_sd_K: float = 0.0


@dataclass(kw_only=True)
class TurbineMemory:
    """What the store keeps of a turbine beside its readings and estimates, as JSON by the names of the
    fields; the same for the alarms that belong to no turbine.

    `excess`: vapour [g/m³] by which the newest humidity reading exceeds the final estimate; `references` and
    `reference_point`: the states of properties and the complete state against which shifts are judged after a
    stated change; `shift_steps`: steps whose lasting shifts are still to be judged, the first step as soon as
    its cause is isolated; `judged`: time [s] up to which alarms have been judged; `frozen`: signals that
    repeat a value at the point; `known_s`: time [s] since when the tracker knows the turbine.
    """

    changes: list[StatedChange] = field(default_factory=list)
    parameter_shifts: dict[str, ParameterShift] = field(default_factory=dict)
    deviations: dict[str, TrackedState] = field(default_factory=dict)
    references: Mapping[str, TrackedState] = field(default_factory=dict)
    reference_point: Point | None = None
    finding: CauseFinding | None = None
    shift_steps: list[ShiftStep] = field(default_factory=list)
    alarms: dict[str, AlarmState] = field(default_factory=dict)
    excess: float = math.nan
    judged: float = -math.inf
    frozen: dict[str, Frozen] = field(default_factory=dict)
    known_s: float = math.inf

    @classmethod
    def from_memories(cls, memories: JsonObject) -> TurbineMemory:
        """Return what the store's `memories` (name → JSON) hold; memories with other names are ignored."""
        names = {field_.name for field_ in fields(TurbineMemory)}
        known = {name: data for name, data in memories.items() if name in names and data is not None}
        return structured(TurbineMemory, known)


def conditions(
    courses: Mapping[str, tuple[Turbine, TrackedCourse]],
    kept: Mapping[str, TurbineMemory] = MappingProxyType({}),
) -> dict[str, Condition]:
    """Return turbine → its condition at the instants of its course that the store keeps.

    courses: turbine → its configuration and its course.  kept: turbine → what the store keeps of it.
    Turbines of one model are evaluated together, because numpy's overhead exceeds the work for the few
    instants of a single turbine.
    """
    by_model: dict[int, list[str]] = defaultdict(list)
    for name, (turbine, _) in courses.items():
        by_model[id(turbine.plan.model)].append(name)
    by_name: dict[str, Condition] = {}
    for names in by_model.values():
        turbines, model_courses = zip(*(courses[name] for name in names), strict=True)
        model = turbines[0].plan.model
        stored_indices = [instants_kept(course) for course in model_courses]
        counts = [len(places) for places in stored_indices]
        inputs = [inputs_of(model, course.run.timeline) for course in model_courses]
        values = {
            parameter.name: np.repeat([turbine.plan.values[parameter.name] for turbine in turbines], counts)
            for parameter in model.parameters
        }
        u = {
            name: _joined((inputs_of_run[name] for inputs_of_run in inputs), stored_indices)
            for name in model.inputs
        }
        mean = _joined((course.trace.mean for course in model_courses), stored_indices)
        covariance = _joined((course.trace.covariance for course in model_courses), stored_indices)
        seconds = _joined((course.seconds for course in model_courses), stored_indices)
        surface = Surface(
            np.repeat([turbine.surface.follows for turbine in turbines], counts),
            np.repeat([turbine.surface.offset_K for turbine in turbines], counts),
        )
        condition = air_condition(model, values, seconds, u, mean, covariance, surface)
        ends = np.cumsum(counts)
        if condition.condensation is not None and condition.temperature_K is not None:
            readings = {
                name: _joined((course.run.timeline.reading(name) for course in model_courses), stored_indices)
                for name in model.outputs
            }
            vapour = vapour_from_readings(readings, condition.temperature_K.value, u["ambient_temperature"])
            excess_of_readings = np.split(vapour - mean[:, model.states.index("vapour")], ends[:-1])
            kept_by_turbine = [kept.get(name, TurbineMemory()) for name in names]
            pieces = zip(excess_of_readings, np.split(seconds, ends[:-1]), kept_by_turbine, strict=True)
            excess = np.concatenate([_excess(*piece) for piece in pieces])
            condition = safer_condition(condition, model, values, u, mean, covariance, surface, excess)
        for name, count, end in zip(names, counts, ends.tolist(), strict=True):
            by_name[name] = at_instants(condition, slice(end - count, end))
    return by_name


def _excess(excess_of_readings: np.ndarray, seconds: np.ndarray, kept: TurbineMemory) -> np.ndarray:
    """Return the vapour (T,) [g/m³] by which the newest reading exceeds the estimate at each instant; NaN
    while the humidity sensor is stated to be wrong.

    excess_of_readings: the same at instants with a reading, NaN at others.  kept: of the turbine.
    """
    trusted = humidity_sensor_trusted(kept.changes, seconds)
    return np.where(
        trusted, carry_forward(np.where(trusted, excess_of_readings, np.nan), kept.excess), np.nan
    )


def _joined(arrays: Iterable[np.ndarray], kept: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate the elements of each array at the indices that are kept of it."""
    return np.concatenate([array[indices] for array, indices in zip(arrays, kept, strict=True)])


def instants_kept(course: TrackedCourse) -> np.ndarray:
    """Return the indices of the instants that the store keeps: with cabinet readings, one per `THIN_S` while
    the cabinet's sensors are silent, and the last one while it may change."""
    outputs = course.run.timeline.outputs
    heard = np.max([course.heard(signal) for signal in outputs], axis=0) if outputs else -np.inf
    slot = np.floor(np.append(course.after_s, course.seconds) / THIN_S)
    # also with readings that the filter does not use while an input is unknown
    kept = course.seconds - heard <= SAME_S
    kept |= (np.diff(slot) > 0) & (course.seconds - heard >= SENSOR_SILENT_S)
    kept[-1] |= course.seconds[-1] > course.final_s + SAME_S
    return np.flatnonzero(kept)


def digest(plan: Plan) -> str:
    """Return a digest of what a point depends on: model, parameter values and forms of the readings."""
    content = {
        "design": plan.design.to_json(),
        "values": dict(plan.values),
        "forms": {name: asdict(form) for name, form in sorted(plan.forms.items())},
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()
