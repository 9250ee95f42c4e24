"""The sentences of the live tracker, from the values of their codes."""

from __future__ import annotations

from string import Formatter

import pytest

from hygrokf.texts.live_codes import AdviceCode, AlarmCode, BasisCode, CauseCode, NoticeCode, StateCode
from hygrokf.texts.statement import Code, Statement

KINDS = (AlarmCode, NoticeCode, AdviceCode, BasisCode, CauseCode, StateCode)
VALUES = {
    "probability": 0.983, "margin_K": -1.5, "lower_K": -2.52, "upper_K": -0.5, "unit": " °C",
    "signal": "cabinet_temperature", "value": 21.0, "since": 86400.0, "reading": 45.0, "expected": 77.0,
    "change": 1.2, "size": 2.1, "lower": -3.2, "upper": 4.6, "side": "high",
    "others": AlarmCode.OR_OTHERS(
        causes=(CauseCode.TEMPERATURE_SENSOR(), CauseCode.CHANGED_HEAT_LOSS())
    ),
    "either": AlarmCode.OR_AMBIENT(side="low"), "age_h": 2.54,
    "signals": ("active_power", "cabinet_temperature"), "sender": "Farm/N1", "at": 86400.0,
    "quantity": "ambient_humidity", "source": "mqtt://b", "reason": "nothing listens there", "count": 3,
    "of": 4, "ahead": 7200.0, "parts": ("thermal", "hygric"), "causes": (CauseCode.CHANGED_HEAT_LOSS(),),
    "attempts": 9, "failure": "no answer", "heaters": ("preheating", "heater_duty"), "effect_K": 9.0,
    "hours": 2.5, "limit": 0.8, "least": 0.96, "stays_h": 1.0, "effect": "", "longest_h": 24.0,
    "enough": 0.95, "needed": "", "shortest_h": 1.5, "days": 28, "operation": BasisCode.OPERATION_AS_NOW(),
    "fault": "no readings", "kinds": ("condensation", "cabinet changed"),
    "quantities": ("ambient_humidity", "wind_speed"), "until": 86400.0,
}  # fmt: skip
"""Values of the fields of all templates."""
TEXTS = {
    AlarmCode.WATER_CONDENSES: (
        "water condenses on the coldest surface with a probability of 98 %: its margin to the dew point "
        "is −1.5 K (−2.5 … −0.5)"
    ),
    AlarmCode.SIGNAL_FROZEN: "cabinet temperature has read 21 °C since 1970-01-02T00:00Z without any change",
    AlarmCode.READING_CONTRADICTS: (
        "cabinet temperature reads 45.0 °C, where the estimate expects 77.0 (−3.2 … 4.6)"
    ),
    AlarmCode.HEAT_LOSS_LOWER: (
        "the cabinet loses its heat more slowly: thermal time constant +1 (−3 … +5) % (or the temperature "
        "sensor, a changed heat loss)"
    ),
    AlarmCode.HEAT_LOSS_HIGHER: (
        "the cabinet loses its heat faster: thermal time constant +1 (−3 … +5) % (or the temperature "
        "sensor, a changed heat loss)"
    ),
    AlarmCode.AIR_EXCHANGE_LOWER: (
        "the cabinet exchanges less air with the ambient: hygric k +1 (−3 … +5) % (or the temperature "
        "sensor, a changed heat loss)"
    ),
    AlarmCode.AIR_EXCHANGE_HIGHER: (
        "the cabinet exchanges more air with the ambient: hygric k +1 (−3 … +5) % (or the temperature "
        "sensor, a changed heat loss)"
    ),
    AlarmCode.AIR_DRIER: (
        "the air is drier than air exchange and heat release explain: humidity offset +1 (−3 … +5) % "
        "relative humidity (or the temperature sensor, a changed heat loss)"
    ),
    AlarmCode.HEAT_RELEASE_HIGHER: (
        "more heat is released than the operation explains: heat release change +1.2 (−3.2 … +4.6) K (or "
        "the temperature sensor, a changed heat loss)"
    ),
    AlarmCode.HEAT_RELEASE_LOWER: (
        "less heat is released than the operation explains: heat release change +1.2 (−3.2 … +4.6) K (or "
        "the temperature sensor, a changed heat loss)"
    ),
    AlarmCode.HUMIDITY_SENSOR_OR_WATER: (
        "the humidity sensor reads +1 (−3 … +5) % relative humidity more than air exchange and heat "
        "release explain: it is wrong, or there is water in the cabinet"
    ),
    AlarmCode.EITHER_SENSOR_OR_WATER: (
        "the humidity sensor reads +1 (−3 … +5) % relative humidity more than air exchange and heat "
        "release explain: it or the ambient's is wrong, or there is water in the cabinet"
    ),
    AlarmCode.TEMPERATURE_SENSOR_SUSPECT: (
        "the temperature sensor reads 2.1 (−3.2 … 4.6) K too high, or the ambient's too low: the humidity "
        "readings do not follow it (or the temperature sensor, a changed heat loss)"
    ),
    AlarmCode.HUMIDITY_SENSOR_SUSPECT: (
        "the humidity sensor reads 2 (−3 … 5) % too high, or the ambient's too low: air exchange and heat "
        "release do not explain its level (or the temperature sensor, a changed heat loss)"
    ),
    AlarmCode.HUMIDITY_SCALE_SUSPECT: (
        "the humidity sensor reads 2 (−3 … 5) % of its value too high, or the ambient's too low (or the "
        "temperature sensor, a changed heat loss)"
    ),
    AlarmCode.AMBIENT_TEMPERATURE_SUSPECT: (
        "the ambient's temperature sensor reads 2.1 (−3.2 … 4.6) K too high: neither its sisters nor the "
        "cabinet follow it (or the temperature sensor, a changed heat loss)"
    ),
    AlarmCode.AMBIENT_HUMIDITY_SUSPECT: (
        "the ambient's humidity sensor reads 2 (−3 … 5) % too high: neither its sisters nor the cabinet "
        "follow it (or the temperature sensor, a changed heat loss)"
    ),
    AlarmCode.NOTHING_ARRIVES: "no signal has arrived for 2.5 h",
    AlarmCode.SIGNALS_SILENT: "no reading of active power, cabinet temperature has arrived for 2.5 h",
    AlarmCode.SENDER_LEFT: (
        "Farm/N1 is offline by its death certificate of 1970-01-02T00:00Z: its signals are stale until its "
        "next birth certificate"
    ),
    AlarmCode.SIGNAL_NEVER_CAME: "no reading of ambient humidity has arrived since 1970-01-02T00:00Z",
    AlarmCode.REQUIRED_NEVER_CAME: (
        "no reading of ambient humidity has arrived since 1970-01-02T00:00Z: without it there is no estimate"
    ),
    AlarmCode.SOURCE_NOT_REACHED: (
        "mqtt://b has not been reached since 1970-01-02T00:00Z: nothing listens there"
    ),
    AlarmCode.MACHINE_CLOCK_SLOW: (
        "readings of 3 of 4 turbines are stamped 2 h ahead of this machine's clock: this clock is slow, "
        "or a clock that they share is fast. They are stored and held back until this machine's clock "
        "reaches them"
    ),
    AlarmCode.SENDER_CLOCK_FAST: (
        "its readings are stamped 2 h ahead of this machine's clock: its sender's clock is fast. They are "
        "stored and held back until this machine's clock reaches them"
    ),
    AlarmCode.SENDER_OR_MACHINE_CLOCK: (
        "its readings are stamped 2 h ahead of this machine's clock: its sender's clock is fast, or this "
        "machine's clock is slow. They are stored and held back until this machine's clock reaches them"
    ),
    AlarmCode.OR_OTHERS: " (or a changed heat loss)",
    AlarmCode.OR_AMBIENT: ", or the ambient's too high",
    AlarmCode.YEARS: "3.0 years",
    NoticeCode.GIVEN_UP: "given up after 9 attempts: no answer",
    AdviceCode.HEATING_COOLS: (
        "the identified effect of preheating with heater duty is +9.0 K: it does not heat"
    ),
    AdviceCode.PREHEAT: (
        "pre-heat for 2.5 h: relative humidity is then below 80 % at the coldest surface with a "
        "probability of 98 %, and of at least 96 % until a start within 1 h"
    ),
    AdviceCode.NO_PREHEATING: (
        "no pre-heating is needed: relative humidity is below 80 % at the coldest surface with a "
        "probability of 98 %, and of at least 96 % until a start within 1 h"
    ),
    AdviceCode.PREHEATING_TOO_WEAK: (
        "not even 24 h of pre-heating bring relative humidity at the coldest surface below 80 % for 1 h "
        "with a probability of 95 %: at best it is 98 %, after 2.5 h"
    ),
    AdviceCode.WITH_EFFECT: (
        " (identified effect of preheating with heater duty: 9.0 K, within −2.5 to −0.5 K)"
    ),
    AdviceCode.NEEDED_HOURS: ", for which 1.5 to 24.0 h are needed",
    AdviceCode.NEEDED_HOURS_OPEN: ", for which 1.5 to more than 24 h are needed",
    BasisCode.PERSISTENCE: "persistence of the weather, drawn from 28 days; operation as now",
    BasisCode.WEATHER_FORECAST: "a weather forecast; operation as now",
    BasisCode.NO_FORECAST: "no readings",
    BasisCode.STANDSTILL_MAY_END: "a standstill that may end as 3 earlier ones of this length did",
    StateCode.CONDENSATION_LIKELY_FROM: "condensation is likely from 1970-01-02T00:00Z on",
    StateCode.ALARMS_OPEN: "condensation, cabinet changed",
    StateCode.ESTIMATE_OLD: "the newest estimate is from 1970-01-02T00:00Z",
    StateCode.NO_READING_YET: "no reading has arrived since 1970-01-02T00:00Z",
    StateCode.INPUTS_NEVER_CAME: (
        "no reading of ambient humidity and wind speed has arrived since 1970-01-02T00:00Z"
    ),
    StateCode.FILTER_FAILS: "the filter cannot run: no readings",
    StateCode.HISTORY_AWAITED: (
        "waiting for readings until 1970-01-02T00:00Z, which the first estimate needs"
    ),
    StateCode.FROM_INPUTS_ALONE: "estimated from the inputs alone since 1970-01-02T00:00Z",
    StateCode.WITHOUT_SIGNAL: "estimated without cabinet temperature since 1970-01-02T00:00Z",
}
"""Code with fields -> its sentence with these values."""


@pytest.mark.parametrize(("code", "text"), TEXTS.items(), ids=lambda one: getattr(one, "key", ""))
def test_a_sentence_from_its_values(code: Code, text: str) -> None:
    assert Statement(code, VALUES).text == text


def test_every_code_with_fields_is_in_the_table() -> None:
    codes = [code for kind in KINDS for code in kind]
    assert set(TEXTS) == {code for code in codes if fields(code)}
    assert all(bool(Statement(code, VALUES).remedy) == bool(code.remedy) for code in codes)


def fields(code: Code) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(code.template) if name}
