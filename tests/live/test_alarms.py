"""Alarms begin, worsen and end by level, hold-off and hysteresis; none is raised twice."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from builders.documents import document

from hygrokf.identification.verdict_terms import Inherited
from hygrokf.live import alarms
from hygrokf.live.alarms import (
    ALARM_RULES,
    CABINET_CHANGED,
    CHANGES,
    FROZEN_S,
    SENSOR_OR_WATER,
    STUCK,
    SUSPECT,
    Estimated,
    Level,
    Standing,
    condensation_levels,
    estimate_levels,
    frozen_levels,
    judge,
    shift_levels,
)
from hygrokf.live.batch import Alarm
from hygrokf.live.condition import Condition, Quantity
from hygrokf.live.fault_isolation import CauseFinding, shift_step
from hygrokf.live.frozen import Frozen
from hygrokf.live.properties import WATCHED, ParameterShift, TrackedState
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.live_codes import AlarmCode, CauseCode
from hygrokf.texts.reasons import REJECT
from hygrokf.texts.statement import Code, Statement

MINUTE = 60.0


def said_of(
    shifts: dict[str, ParameterShift], finding: CauseFinding | None, now: dict[str, TrackedState]
) -> list[Level]:
    return shift_levels(shift_step(0.0, shifts, now, -math.inf), finding)


def condensing(probability: float) -> Statement:
    return AlarmCode.WATER_CONDENSES(probability=probability, margin_K=-1.0, lower_K=-2.0, upper_K=0.0)


def course(levels: list[tuple[float, float | None]], kind: str = "condensation") -> tuple[dict, list[Alarm]]:
    """Standings and all changes after (minute, level) pairs; None: nothing is told."""
    known: dict[str, Standing] = {}
    changes: list[Alarm] = []
    for minute, level in levels:
        told = [] if level is None else [Level(kind, level, (condensing(level),))]
        known, changed = judge("T1", known, minute * MINUTE, told, ALARM_RULES)
        changes += changed
    return known, changes


def values_of(level: Level, size: str = "change") -> tuple[int, ...]:
    """Size and bounds of what a level says, rounded."""
    return tuple(round(level.statements[0].values[name]) for name in (size, "lower", "upper"))


def test_an_alarm_begins_after_its_hold_off() -> None:
    assert course([(0, 0.6), (10, 0.6)])[1] == []
    known, (alarm,) = course([(0, 0.6), (10, 0.55), (20, 0.6)])
    assert (alarm.began, alarm.severity, alarm.ended) == (0.0, "warning", None)
    assert alarm.id == "T1:condensation:0" and "pre-heat" in alarm.remedy
    assert known["condensation"].alarm == alarm
    assert course([(0, 0.6), (10, 0.4), (15, 0.6), (30, 0.6)])[1] == []  # interrupted


def test_it_ends_by_hysteresis() -> None:
    begun = [(0, 0.6), (20, 0.6)]
    assert len(course([*begun, (30, 0.3), (90, 0.3)])[1]) == 1  # between the levels it stays
    known, changes = course([*begun, (30, 0.1), (40, 0.3), (50, 0.1), (69, 0.1)])
    assert len(changes) == 1
    known, changes = course([*begun, (30, 0.1), (50, 0.1)])
    assert changes[1].ended == 30 * MINUTE and changes[1].id == changes[0].id and known == {}
    assert course([*begun, (30, None), (50, None)])[1][1].ended == 30 * MINUTE


def test_it_worsens_once_and_keeps_its_name() -> None:
    _, changes = course([(0, 0.6), (20, 0.6), (25, 0.97), (26, 0.99), (27, 0.6)])
    assert [one.severity for one in changes] == ["warning", "alarm"]
    assert changes[1].id == changes[0].id and "probability of 97 %" in changes[1].statement
    assert course([(0, 0.97), (20, 0.97)])[1][0].severity == "alarm"


def test_a_late_delivery_goes_back_and_ends_only_what_began_before() -> None:
    """Judged again from the fortieth minute on, with a beginning at the sixtieth."""
    begun = [(40, 0.1), (60, 0.6), (80, 0.6)]
    assert len(course([*begun, (40, 0.1), (50, 0.7), (59, 0.7), (80, 0.6)])[1]) == 1
    _, changes = course([*begun, (30, 0.1), (55, 0.1), (65, 0.1), (85, 0.1)])
    assert [one.ended for one in changes] == [None, 65 * MINUTE]
    assert course([(60, 0.6), (20, 0.6), (40, 0.6)])[1][0].began == 20 * MINUTE  # what was pending


def test_several_subjects_of_one_kind_stand_apart() -> None:
    two = [Level("clock wrong", 1.0, subject=subject) for subject in ("file:a", "file:b")]
    known, changes = judge("T1", {}, 0.0, two, ALARM_RULES)
    assert changes == []
    known, changes = judge("T1", known, 900.0, two, ALARM_RULES)
    assert [one.id for one in changes] == ["T1:clock wrong file:a:0", "T1:clock wrong file:b:0"]
    known, changes = judge("T1", known, 1200.0, two[:1], ALARM_RULES)
    assert changes == []
    known, changes = judge("T1", known, 2100.0, two[:1], ALARM_RULES)
    assert [(one.id, one.ended) for one in changes] == [("T1:clock wrong file:b:0", 1200.0)]


def test_condensation_has_its_probability_and_margin() -> None:
    one = Quantity(np.array([2.0, -1.5]), np.array([1.0, 0.5]))
    found = Condition(np.array([0.0, 600.0]), one, one, one, one, one, one, np.array([0.02, 0.998]), one)
    assert [one.level for one in condensation_levels(Estimated(found, 0))] == [0.02]
    (level,) = condensation_levels(Estimated(found, 1))
    assert level.level == 0.998
    (statement,) = level.statements
    ends = {"lower_K": pytest.approx(-2.48, abs=1e-3), "upper_K": pytest.approx(-0.52, abs=1e-3)}
    assert statement.code is AlarmCode.WATER_CONDENSES
    assert statement.values == {"probability": 0.998, "margin_K": -1.5, **ends}
    bare = Condition(np.array([0.0]), one, *[None] * 7)
    assert condensation_levels(Estimated(bare, 0)) == []


def test_shifts_name_cause_and_remedy() -> None:
    found = {
        "hygric_k": ParameterShift("hygric_k", 0.0, True, math.log(0.5)),
        "thermal_time_constant": ParameterShift("thermal_time_constant", 0.0, False, 0.4),
        "heat_release_change": ParameterShift("heat_release_change", 0.0, True, 2.25),
    }
    now = {"hygric_k": TrackedState(math.log(0.5), 0.1), "heat_release_change": TrackedState(2.25, 0.5)}
    exchange, heat = said_of(found, CauseFinding(0.0, ""), now)
    assert exchange.statements[0].code is AlarmCode.AIR_EXCHANGE_HIGHER and exchange.subject == "hygric_k"
    assert values_of(exchange) == (-50, -59, -39) and "seals" in exchange.statements[0].remedy
    assert heat.statements[0].code is AlarmCode.HEAT_RELEASE_HIGHER
    assert heat.statements[0].values["change"] == 2.25
    assert {name for name, _ in CHANGES} == {one.name for one in WATCHED}


def test_no_change_is_said_while_its_bounds_contain_zero() -> None:
    """What is open then stays open."""
    found = {"heat_release_change": ParameterShift("heat_release_change", 0.0, True, 2.25)}
    (unsure,) = said_of(found, CauseFinding(0.0, ""), {"heat_release_change": TrackedState(1.2, 0.7)})
    assert CABINET_CHANGED.off <= unsure.level < CABINET_CHANGED.on
    sensor = CauseFinding(0.0, "temperature_sensor", "temperature_reading_change", 0.4, 20.0, sd=0.3)
    (unsure,) = said_of(found, sensor, {})
    assert SUSPECT.off <= unsure.level < SUSPECT.on
    (statement,) = unsure.statements
    assert statement.code is AlarmCode.TEMPERATURE_SENSOR_SUSPECT
    assert (statement.values["size"], statement.values["side"]) == (0.4, "high")
    assert statement.values["lower"] == pytest.approx(-0.188, abs=1e-3)
    (sure,) = said_of(found, replace(sensor, sd=0.1), {})
    assert sure.level == SUSPECT.on
    pair = replace(sensor, sd=0.1, alike=("ambient_temperature", "heat_release_change"))
    (either,) = said_of(found, pair, {})
    assert either.statements[0].values["either"] == AlarmCode.OR_AMBIENT(side="low")
    others = AlarmCode.OR_OTHERS(causes=(CauseCode.CHANGED_HEAT_RELEASE(),))
    assert either.statements[0].values["others"] == others


def test_air_that_is_too_moist_is_sensor_or_water_whatever_the_finding() -> None:
    """Only another sensor's fault explains it, so that nothing begins or ends before fault isolation."""
    moist, dry = ({"humidity_offset": TrackedState(x, 0.006)} for x in (0.12, -0.12))
    lasting = {"humidity_offset": ParameterShift("humidity_offset", 0.0, True, 0.12)}
    for shifts in ({}, lasting):
        (unsure,) = said_of(shifts, None, moist)
        assert SENSOR_OR_WATER.off <= unsure.level < SENSOR_OR_WATER.on
    (level,) = said_of(lasting, CauseFinding(9.0, ""), moist)
    assert level.kind == SENSOR_OR_WATER.kind and level.level == pytest.approx(3.0)
    assert level.statements[0].code is AlarmCode.HUMIDITY_SENSOR_OR_WATER and values_of(level) == (12, 11, 13)
    high = CauseFinding(9.0, "humidity_sensor", "humidity_scale_change", 0.3, 50.0, sd=0.02)
    for finding in (None, CauseFinding(9.0, ""), high):
        assert [one.kind for one in said_of(lasting, finding, moist)] == [SENSOR_OR_WATER.kind]
    other = CauseFinding(9.0, "temperature_sensor", "temperature_reading_change", 3.0, 50.0, sd=0.2)
    assert [one.kind for one in said_of(lasting, other, moist)] == [SUSPECT.kind]
    ambient = CauseFinding(9.0, "ambient_humidity", "ambient_humidity_change", -0.1, 50.0, sd=0.02)
    (level,) = said_of(lasting, ambient, moist)
    assert level.subject == "ambient_humidity" and values_of(level, "size") == (10, 6, 14)
    (level,) = said_of(lasting, replace(high, alike=("ambient_humidity",)), moist)
    assert level.level == pytest.approx(3.0)
    assert level.statements[0].code is AlarmCode.EITHER_SENSOR_OR_WATER
    lasting = {"humidity_offset": ParameterShift("humidity_offset", 0.0, True, -0.12)}
    below, low = said_of(lasting, replace(high, value=-0.3), dry)
    assert below.level < 0.0 and low.kind == SUSPECT.kind
    assert low.statements[0].code is AlarmCode.HUMIDITY_SCALE_SUSPECT
    assert values_of(low, "size") == (30, 26, 34) and low.statements[0].values["side"] == "low"


def test_a_frozen_signal_is_named_whichever_it_is() -> None:
    frozen = (
        Frozen("ambient_temperature", 0.0, 281.45, 3600.0),
        Frozen("cabinet_relative_humidity", 1800.0, 0.6, 3600.0),
        Frozen("cabinet_temperature", 0.0, 290.0, 3600.0, FROZEN_S),
    )
    bare = Condition(np.array([FROZEN_S - 600.0, FROZEN_S + 600.0]), *[None] * 8)
    early, late = (frozen_levels(Estimated(bare, i, frozen)) for i in (0, 1))
    assert [one.level >= STUCK.on for one in early + late] == [False, False, False, True, False]
    (statement,) = late[0].statements
    expected = {"signal": "ambient_temperature", "value": pytest.approx(8.3), "unit": " °C", "since": 0.0}
    assert statement.code is AlarmCode.SIGNAL_FROZEN and statement.values == expected
    assert late[0].subject == "ambient_temperature"


def test_rules_can_end_what_they_begin() -> None:
    assert all(rule.off < rule.on for rule in ALARM_RULES.values())


def test_the_alarm_that_the_page_adds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of docs/explanation/live.md, put into the module as the page says."""
    page = document("live.md").read_text(encoding="utf-8")
    _, _, text = page.partition("### Adding an alarm")
    code, levels = (part.split("```")[0] for part in text.split("```text\n")[1:3])
    own: dict = {}
    exec(code, own)
    codes = Code("OwnCode", {"CABINET_HOT": own["CABINET_HOT"]})
    space = {**vars(alarms), "ZERO_CELSIUS_K": ZERO_CELSIUS_K, "AlarmCode": codes}
    exec(levels.replace("\nAlarmRule(", "\nrule = AlarmRule("), space)
    hot = space["rule"]
    monkeypatch.setattr(alarms, "ALARM_RULES", {hot.kind: hot})
    air = Quantity(np.array([300.0, 324.15]), np.array([0.1, 0.1]))
    found = Condition(np.array([0.0, 600.0]), air, *[None] * 7)
    rejected = {part: Inherited(verdict=REJECT) for part in alarms.PARTS}
    (calm,), (level,) = (estimate_levels(Estimated(found, place), rejected) for place in (0, 1))
    assert calm.level < hot.off and level.statements[0].values == {"air_C": pytest.approx(51.0)}
    assert level.statements[1].values["parts"] == ("thermal",)
    known, begun = judge("T1", {}, 0.0, [level], [hot.kind])
    (begun,) = [*begun, *judge("T1", known, 600.0, [level], [hot.kind])[1]]
    assert (begun.kind, begun.remedy.split()[0]) == (hot.kind, "check")
    assert begun.statement.startswith("the cabinet air is at 51.0 °C; the model's thermal time constant")


def test_a_kind_may_begin_with_the_words_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    soon = replace(alarms.CONDENSATION, kind="condensation soon", severity="notice")
    monkeypatch.setitem(alarms.ALARM_RULES, soon.kind, soon)
    assert [one.severity for one in course([(0, 0.6), (20, 0.6)], soon.kind)[1]] == ["notice"]
    levels = [Level("condensation", 0.6), Level(soon.kind, 0.6)]
    known, _ = judge("T1", {}, 0.0, levels, ALARM_RULES)
    assert {one.kind for one in judge("T1", known, 1200.0, levels, ALARM_RULES)[1]} == {
        "condensation",
        soon.kind,
    }
