"""What is told of a cause: its evidence, its parameters, how sure its name is, and what to check."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hygrokf.data.clocks import sources
from hygrokf.data.record import Record
from hygrokf.discovery.candidates import SENSOR, WATER, Candidate, brought
from hygrokf.discovery.cause import Cause
from hygrokf.discovery.conclusion import Conclusion
from hygrokf.discovery.discovery_results import (
    CauseFound,
    CauseParameter,
    Evidence,
    HeldOutTest,
    Refuted,
    Settings,
)
from hygrokf.discovery.final_set import FinalSet
from hygrokf.discovery.judgement import Judged
from hygrokf.discovery.library import named
from hygrokf.discovery.search import Accepted
from hygrokf.physics.parameters import Parameter

CONFIDENCE = (-6.1, 1.24, 0.01)
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
    wet = candidate.cause == SENSOR and bool(set(rivals) & set(WATER))
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
        held_out=held_out_test(one.judged),
        ambiguous_with=rivals,
        separate_by=SECOND_SENSOR if wet else cause.separate_by,
        remedy=SECOND_SENSOR if wet else _remedy(cause, candidate),
    )


def refuted_cause(one: Candidate, judged: Judged, searched: Mapping[str, int]) -> Refuted:
    """One entry of `refuted`."""
    return Refuted(one.cause, one.form.code, evidence_of(one, searched), held_out_test(judged))


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


def held_out_test(one: Judged) -> HeldOutTest:
    """A judgement as it is told."""
    return HeldOutTest(
        dict(one.z), dict(one.growth), dict(one.before), dict(one.after), one.gain, one.days, one.reason
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
