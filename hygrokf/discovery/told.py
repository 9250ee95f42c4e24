"""What is told of a cause: its evidence, its parameters, how sure its name is, and what to check; and the
errors of the base and of the extended model, without the hours of named openings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.data.clocks import sources
from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.candidates import Candidate, brought
from hygrokf.discovery.conclusion import Conclusion
from hygrokf.discovery.discovery_results import (
    CauseFound,
    CauseParameter,
    Evidence,
    Gain,
    HeldOutTest,
    Refuted,
    Settings,
)
from hygrokf.discovery.estimate import Estimate
from hygrokf.discovery.final_set import FinalSet
from hygrokf.discovery.library import Cause, named
from hygrokf.discovery.residuals import NORMAL_95, QUANTITIES, Residuals, root_mean_square
from hygrokf.discovery.search import Accepted, foreseen
from hygrokf.physics.parameters import Parameter

CONFIDENCE = (-1.26, 0.531, 0.00118)
"""Constant, weight of ln of the evidence in days, and weight of its lead in days: of the logistic
confidence."""
SECOND_SENSOR = "compare the humidity sensor with a second one, before anything rests on either"


def cause_found(
    one: Accepted, ended: Conclusion, library: Sequence[Cause], searched: Mapping[str, int]
) -> CauseFound:
    """One entry of `causes`."""
    candidate = one.candidate
    cause = named(candidate.cause, library)
    rivals = tuple(dict.fromkeys(rival.cause for rival in one.rivals))
    assert ended.extended is not None
    return CauseFound(
        cause=cause.name,
        form=candidate.form.code,
        forms_alike=candidate.alike,
        confidence=confidence(candidate.in_days, one.lead),
        statement=cause.meaning,
        parameters=_parameters(candidate, ended.base, ended.extended),
        settings=_settings(candidate, ended.base.estimate.simulator.scene.record),
        evidence=evidence_of(candidate, searched, one.lead),
        held_out=one.judged,
        ambiguous_with=rivals,
        separate_by=SECOND_SENSOR if one.wet else cause.separate_by,
        remedy=SECOND_SENSOR if one.wet else _remedy(cause, candidate),
    )


def refuted_cause(one: Candidate, judged: HeldOutTest, searched: Mapping[str, int]) -> Refuted:
    """One entry of `refuted`."""
    return Refuted(one.cause, one.form.code, evidence_of(one, searched), judged)


def confidence(in_days: float, lead: float) -> float:
    """How often [1] a name with such evidence is right: logistic in ln of the evidence in days and in its
    lead in days."""
    from scipy.special import expit

    constant, by_evidence, by_lead = CONFIDENCE
    return float(expit(constant + by_evidence * math.log(max(in_days, 1.0)) + by_lead * lead))


def evidence_of(one: Candidate, searched: Mapping[str, int], lead: float = math.nan) -> Evidence:
    """The evidence of a candidate."""
    return Evidence(
        dict(one.gains), one.constants, searched.get(one.cause, 0), one.evidence, one.in_days, lead
    )


def _settings(one: Candidate, record: Record) -> Settings:
    """What the search chose: settings of features, and the shift of a clock [s] against another where there
    are only two."""
    found = {key: value for settings in one.setting.features.values() for key, value in settings.items()}
    if one.form.clock:
        found |= {"source": one.form.clock, "shift_s": one.setting.shift_s, "summer": one.form.summer}
        others = [name for name in sources(record) if name != one.form.clock]
        found |= {"relative_to": others[0]} if len(others) == 1 else {}
    return found


def _remedy(cause: Cause, one: Candidate) -> str:
    """What to check, and for an error of a clock the line that corrects it until then."""
    if not one.form.clock or one.form.summer:
        return cause.remedy
    line = f'clock_correction = "{one.setting.shift_s / 60.0:+.4g}min"'
    place = f"in each [[source]] of {one.form.clock} in the case file"
    return f"{cause.remedy}; until then write {line} {place}, added to a correction that already stands there"


def _parameters(one: Candidate, base: FinalSet, extended: FinalSet) -> dict[str, CauseParameter]:
    """The cause's own parameters in the extended model, with bounds."""
    known = set(base.estimate.simulator.names)
    mine = set(one.estimate.simulator.names) - known
    simulator = extended.estimate.simulator
    own: dict[str, Parameter] = {}
    for p in simulator.parameters:
        level = p.name.rpartition("_")[0] in one.setting.features
        if (p.name in mine and (p.name in brought(one.form, simulator) or level)) or p.name == one.form.freed:
            own[p.name] = p
    return {name: _parameter(p, extended) for name, p in own.items()}


def _parameter(p: Parameter, extended: FinalSet) -> CauseParameter:
    value = extended.estimate.values[p.name]
    lower, upper = extended.bounds(p.name)
    reach = extended.deviation(p.name)
    null = math.nan if p.null is None else p.null
    return CauseParameter(value, p.unit, _closed(lower), _closed(upper), reach, null, p.meaning)


def _closed(bound: float) -> float:
    return bound if math.isfinite(bound) else math.nan


# -- errors --------------------------------------------------------------------------------------------------
QUANTITY = {"temperature": "temperature", "humidity": "vapour"}
"""A quantity of residuals → of the search."""


def gains(ended: Conclusion, before: Residuals, after: Residuals) -> tuple[Gain, ...]:
    """The gains by quantity: on held-out readings where there are any, else on those that identified.

    before, after: residuals of both models' free runs; the same ones without an extended model.
    """
    spans = _openings(ended)
    # a corrected clock moves the instants of one model: no differences remain
    together = np.array_equal(before.time_s, after.time_s)
    found = []
    for quantity in QUANTITIES:
        old = _outside(before.time_s, before.error(quantity), spans)
        new = _outside(after.time_s, after.error(quantity), spans)
        for period, chosen in (("validation", True), ("identification", False)):
            pair = old[before.validation == chosen], new[after.validation == chosen]
            if all(np.isfinite(one).any() for one in pair):
                chosen_s = before.time_s[before.validation == chosen]
                day = np.floor(chosen_s / DAY_S) if together else np.empty(0)
                found.append(
                    _gain(quantity, period, *pair, day, _driven(ended, QUANTITY[quantity], chosen, spans))
                )
                break
    return tuple(found)


def _openings(ended: Conclusion) -> list[list[float]]:
    """The stretches [s] in which a door was named, those of the held-out part included."""
    spans = []
    for one in ended.accepted:
        if one.candidate.form.windows and ended.extended is not None:
            whole = foreseen(ended.base.estimate, one.candidate)
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

    def error(one: Estimate) -> float:
        r = one.simulator.scene.readings[quantity]
        chosen = np.where(r.identified != held_out, r.value - one.simulated[quantity], np.nan)
        return root_mean_square(_outside(r.time_s, chosen, spans))

    return error(ended.base.estimate), error((ended.extended or ended.base).estimate)


def _gain(
    quantity: str, period: str, old: np.ndarray, new: np.ndarray, day: np.ndarray, driven: tuple[float, float]
) -> Gain:
    lower, upper = _bounds(old, new, day) if len(day) else (math.nan, math.nan)
    return Gain(quantity, period, root_mean_square(old), root_mean_square(new), lower, upper, *driven)


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
