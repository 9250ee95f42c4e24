"""The state of a turbine from what is known of it; nothing that nobody assessed is "ok"."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from hygrokf.data.record import Record
from hygrokf.live.alarms import ALARM_RULES
from hygrokf.live.assessment import Facts, Outlook, assess
from hygrokf.live.batch import Alarm, Batch, stated_content, stated_text
from hygrokf.live.condition import Condition
from hygrokf.live.forecast import Forecast
from hygrokf.live.plan import Need
from hygrokf.live.sources.local import record_messages
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Reading, Tracker
from hygrokf.live.turbines import Fleet, Turbine
from hygrokf.live.web.views import fleet_view, turbine_view
from hygrokf.physics.signal_names import AMBIENT_HUMIDITIES
from hygrokf.texts.live_codes import AlarmCode, BasisCode

RECORD = {"seed": 7, "days": 2.0}

HOUR_S = 3600.0
NOW = 1_600_000_000.0
NOTHING = {"estimate_s": None, "condensation": None}
NEED = Need(AMBIENT_HUMIDITIES, True)


def alarm(kind: str, severity: str = "warning") -> Alarm:
    content = stated_content((AlarmCode.NOTHING_ARRIVES(age_h=2.5),))
    return Alarm(f"T1:{kind}:0", "T1", kind, severity, NOW, "", "", content=content)


def known(**changed: object) -> Facts:
    """A turbine that is fine."""
    heard = {"cabinet_temperature": NOW, "ambient_temperature": NOW, "active_power": NOW}
    return Facts(**{"known_s": 0.0, "heard": heard, "estimate_s": NOW, "condensation": 0.01, **changed})


def coming(*chances: float) -> Outlook:
    return Outlook(NOW + HOUR_S * np.arange(len(chances)), np.array(chances))


@pytest.mark.parametrize(
    ("changed", "state", "words"),
    [
        ({}, "ok", "unlikely now"),
        ({"outlook": coming(0.0, 0.1)}, "ok", "now and within the forecast"),
        ({"condensation": 0.98}, "at risk", "likely now"),
        ({"condensation": 0.98, "alarms": [alarm("condensation")]}, "at risk", "likely now"),
        ({"outlook": coming(0.0, 0.2, 0.6, 0.9)}, "at risk", "likely from 2020-09-13T14:26:40Z"),
        ({"outlook": coming(0.9, 0.2)}, "ok", "within"),  # the hour is over
        ({"alarms": [alarm("cabinet changed"), alarm("data stale")]}, "alarm", "cabinet changed"),
        ({"alarms": [alarm("signal missing")]}, "alarm", "signal missing"),
        ({"alarms": [alarm("signal missing", "notice")]}, "ok", ""),
        ({"alarms": [alarm("data stale")]}, "stale", "no signal has arrived for 2.5 h"),
        ({"estimate_s": NOW - 3.0 * HOUR_S}, "stale", "from 2020-09-13T09:26:40Z"),
        ({"estimate_s": NOW - 3.0 * HOUR_S, "condensation": 0.98}, "stale", "from"),
        ({"estimate_s": NOW - 3.0 * HOUR_S, "catching_up": True}, "stale", "backlog"),
        ({"estimate_s": NOW - 3.0 * HOUR_S, "stale_s": 4.0 * HOUR_S}, "ok", ""),
        ({"condensation": None}, "no estimate", "no probability"),
        ({"condensation": math.nan}, "no estimate", "not a number"),
        ({"condensation": None, "with_humidity": False}, "no estimate", "the model has no humidity"),
        ({**NOTHING, "heard": {}}, "no estimate", "no reading has come"),
        ({**NOTHING, "awaited": [NEED]}, "no estimate", "ambient humidity never came since 1970-01-01T"),
        ({**NOTHING, "alarms": [alarm("signal missing")]}, "no estimate", "not filtered yet"),
        ({**NOTHING, "history_until_s": NOW}, "no estimate", "waiting for history until 2020-09-13T12:26"),
        ({**NOTHING, "fault": "no time"}, "no estimate", "cannot run: no time"),
        ({"standstill": True}, "off", "feeds no power"),
        ({"silent_s": NOW - 600.0}, "ok", "from the inputs alone since 2020-09-13T12:16:40Z"),
        ({"silent_s": NOW - 600.0, "alarms": [alarm("data stale")]}, "stale", "from the inputs alone since"),
        (
            {"heard": {"cabinet_temperature": NOW, "cabinet_relative_humidity": NOW - 3.0 * HOUR_S}},
            "ok",
            "without cabinet relative humidity since 2020-09-13T09:26:40Z",
        ),
        ({"standstill": True, "heard": {"active_power": NOW - 3.0 * HOUR_S}}, "ok", ""),
        ({"standstill": True, "condensation": 0.7}, "at risk", "now"),
        ({"standstill": True, "condensation": None}, "no estimate", ""),
    ],
)
def test_states(changed: dict, state: str, words: str) -> None:
    found, statements = assess(known(**changed), NOW)
    assert found == state and words in stated_text(statements) and statements


def test_every_state_and_no_null_is_ok() -> None:
    """Whatever else holds, without a probability of condensation that is a number no turbine is fine."""
    options = {
        "condensation": (None, math.nan),
        "standstill": (False, True),
        "estimate_s": (None, NOW, NOW - 9.0 * HOUR_S),
        "outlook": (None, coming(0.0, 0.1)),
        "alarms": ([], [alarm(kind) for kind in ALARM_RULES]),
    }
    for chosen in product(*options.values()):
        one = known(**dict(zip(options, chosen, strict=True)))
        assert assess(one, NOW)[0] not in ("ok", "off")


# -- in a fleet ----------------------------------------------------------------------------------------------
def rounds(fleet: Fleet, store: Store, record: Record, mapping: PayloadMapping, without: str = "-") -> None:
    rows = [row for row in record_messages(record, "T1") if without not in row[1]]
    for first in range(0, len(rows), 60):
        part = rows[first : first + 60]
        now = part[-1][0] + 2.0
        store.commit(fleet.round([Delivery(json.dumps(row), now) for _, row in part], mapping, "file"))
        store.commit(fleet.tick(now, {}))


def test_ambient_humidity_that_never_comes(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    fleet = Fleet.from_store({"T1": turbine}, store)
    (row,) = fleet_view(store, ["T1"], record.start_s)
    assert (row["state"], row["reason"], row["since"]) == ("no estimate", "not assessed yet", None)
    rounds(fleet, store, record, mapping, without="ambient_relative_humidity")
    (row,) = fleet_view(store, ["T1"], record.end_s)
    assert row["state"] == "no estimate" and row["reason"].startswith("ambient humidity never came since")
    assert [(a.kind, a.severity) for a in row["alarms"]] == [("signal missing", "warning")]
    assert "without it there is no estimate" in row["alarms"][0].statement
    view = turbine_view(store, "T1", record.start_s, record.end_s, needs=turbine.plan.needs)
    signals = {one["signal"]: one for one in view["signals"]}
    never = signals["ambient_relative_humidity"]
    assert (never["last"], never["received"], never["value"], never["count"]) == (None, None, None, 0)
    assert never["needed"] == "required" and signals["active_power"]["needed"] == "used"
    assert signals["cabinet_temperature"]["last"] == pytest.approx(record["cabinet_temperature"].time[-1])
    # a restart knows it, and once the signal comes the turbine has an estimate and the alarm ends
    fleet = Fleet.from_store({"T1": turbine}, store)
    assert fleet.tracked["T1"].assessment.since == row["since"]
    late = [r for r in record_messages(record, "T1") if "ambient_relative_humidity" in r[1]]
    now = record.end_s + 60.0
    store.commit(fleet.round([Delivery(json.dumps(content), now) for _, content in late], mapping, "file"))
    store.commit(fleet.tick(now + 3600.0, {}))
    (row,) = fleet_view(store, ["T1"], now)
    assert row["state"] in ("ok", "off", "at risk") and row["alarms"] == []
    assert row["since"] > fleet.tracked["T1"].known_s


def test_a_sensor_that_never_came_is_a_notice_where_the_model_goes_without(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    fleet = Fleet.from_store({"T1": turbine}, store)
    rounds(fleet, store, record, mapping, without="cabinet_relative_humidity")
    (row,) = fleet_view(store, ["T1"], record.end_s)
    assert [(a.kind, a.severity) for a in row["alarms"]] == [("signal missing", "notice")]
    assert row["state"] in ("ok", "off") and row["condensation"] is not None


def test_states_are_written_on_change_alone_and_survive(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    fleet = Fleet.from_store({"T1": turbine}, store)
    assert fleet.filter_waiting(Batch()).empty
    rounds(fleet, store, record, mapping)
    found = store.assessments()
    assert found == {"T1": fleet.tracked["T1"].assessment} and found["T1"].state in ("ok", "off")
    assert fleet.tick(record.end_s + 10.0, {}).assessments == []
    again = Fleet.from_store({"T1": turbine}, store)
    assert again.filter_waiting(Batch()).assessments == []  # before the time is known
    assert again.tick(record.end_s + 20.0, {}).assessments == []
    assert again.filter_waiting(Batch()).assessments == []
    (old,) = again.tick(record.end_s + 3.0 * HOUR_S, {}).assessments
    assert (old.state, old.since) == ("stale", record.end_s + 3.0 * HOUR_S)


def test_a_forecast_of_condensation_puts_a_turbine_at_risk(
    store: Store, record: Record, turbine: Turbine, mapping: PayloadMapping
) -> None:
    fleet = Fleet.from_store({"T1": turbine}, store)
    rounds(fleet, store, record, mapping)
    hours = record.end_s + HOUR_S * np.arange(1.0, 4.0)
    chances = np.array([0.1, 0.7, 0.9])
    air = Condition(hours, *[None] * 6, chances, None)
    made = Batch(forecasts={"T1": Forecast(record.end_s, air, chances, 0.8, BasisCode.OPERATION_AS_NOW())})
    fleet.keep_forecast("T1", record.end_s, made)
    (found,) = made.assessments
    assert found.state == "at risk" and found.reason.startswith("condensation is likely from ")
    store.commit(made)
    again = Fleet.from_store({"T1": turbine}, store)
    assert again.tick(record.end_s + 20.0, {}).assessments == []  # the forecast is known again


def test_a_turbine_stands_still_by_its_power(turbine: Turbine) -> None:
    def stands(*kilowatt: float) -> bool:
        tracker = Tracker(turbine.plan)
        tracker.take(Reading("active_power", 600.0 * i, 1e3 * kW) for i, kW in enumerate(kilowatt))
        return tracker.stands_still(HOUR_S)

    assert stands(500.0, *[0.0] * 7) and stands(*[-5.0] * 8)
    assert not stands(500.0, *[0.0] * 6) and not stands(*[0.0] * 7, 20.0)
    assert not stands(*[0.0] * 6) and not stands()  # not known for an hour


def test_what_a_model_reads(record: Record, turbine: Turbine) -> None:
    needs = {one.signals[0]: one.required for one in turbine.plan.needs}
    assert needs == {
        "ambient_temperature": True, "ambient_relative_humidity": True, "cabinet_temperature": False,
        "cabinet_relative_humidity": False, "active_power": False, "preheating": False,
    }  # fmt: skip
    assert turbine.plan.expected == turbine.plan.needs
    unstated = replace(turbine.plan, forms={"cabinet_temperature": turbine.plan.form("cabinet_temperature")})
    assert [one.signals[0] for one in unstated.expected] == [
        "ambient_temperature", "ambient_relative_humidity", "cabinet_temperature"
    ]  # fmt: skip
