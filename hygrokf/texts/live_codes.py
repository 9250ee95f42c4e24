"""Sentences of the live tracker: alarms with their remedies, states of turbines, forecasts, and advice for a
restart."""

from __future__ import annotations

from hygrokf.texts.statement import Code

_SENSOR_OR_WATER = (
    "look for water in the cabinet, and compare the humidity sensor with another one; if it is the sensor, "
    "state it on the turbine's page with the date"
)
_RENEW_HUMIDITY = "compare the humidity sensor with another one; clean or renew it"
_DATA_PATH = (
    "check the logger, its power supply and the data path; the estimate continues without these readings"
)
_MAPPING = "check the sensor, the logger and its name in the mapping of payloads"
_CLOCKS = "compare the clocks of this machine and of the sender, and synchronise both by NTP"
_HELD_BACK = "They are stored and held back until this machine's clock reaches them"


class AlarmCode(Code):
    """The sentence of an alarm, and the remedy; `change`, `size` and their bounds are in the unit that the
    template states."""

    WATER_CONDENSES = (
        "water condenses on the coldest surface with a probability of {probability:chance}: its margin to "
        "the dew point is {margin_K:+.1} K ({lower_K:+.1} … {upper_K:+.1})",
        "pre-heat before the converter is started, and look for water at the coldest surface",
    )
    SIGNAL_FROZEN = (
        "{signal:words} has read {value:4g}{unit} since {since:stamp} without any change",
        "look whether sensor, logger and data path are alive; what is estimated from it is doubtful",
    )
    READING_CONTRADICTS = (
        "{signal:words} reads {reading:.1}{unit}, where the estimate expects {expected:.1} "
        "({lower:.1} … {upper:.1})",
        "compare the sensor with another one, and ask what happened in the cabinet at that time",
    )
    # the cabinet has changed
    HEAT_LOSS_LOWER = (
        "the cabinet loses its heat more slowly: thermal time constant {change:+.0} "
        "({lower:+.0} … {upper:+.0}) %{others}",
        "look for clogged filters, a stopped fan, or added insulation",
    )
    HEAT_LOSS_HIGHER = (
        "the cabinet loses its heat faster: thermal time constant {change:+.0} "
        "({lower:+.0} … {upper:+.0}) %{others}",
        "look for an open door or flap, missing insulation, or a fan that never stops",
    )
    AIR_EXCHANGE_LOWER = (
        "the cabinet exchanges less air with the ambient: hygric k {change:+.0} "
        "({lower:+.0} … {upper:+.0}) %{others}",
        "look for clogged vents and filters, or a renewed seal",
    )
    AIR_EXCHANGE_HIGHER = (
        "the cabinet exchanges more air with the ambient: hygric k {change:+.0} "
        "({lower:+.0} … {upper:+.0}) %{others}",
        "check door, seals and cable glands",
    )
    AIR_DRIER = (
        "the air is drier than air exchange and heat release explain: humidity offset {change:+.0} "
        "({lower:+.0} … {upper:+.0}) % relative humidity{others}",
        "compare the humidity sensor with another one, and check whether something dries the air",
    )
    HEAT_RELEASE_HIGHER = (
        "more heat is released than the operation explains: heat release change {change:+.1} "
        "({lower:+.1} … {upper:+.1}) K{others}",
        "check cooling and fans, and whether a heater stays on",
    )
    HEAT_RELEASE_LOWER = (
        "less heat is released than the operation explains: heat release change {change:+.1} "
        "({lower:+.1} … {upper:+.1}) K{others}",
        "check the heater and its thermostat, and the temperature sensor against another one",
    )
    # a sensor is wrong
    HUMIDITY_SENSOR_OR_WATER = (
        "the humidity sensor reads {change:+.0} ({lower:+.0} … {upper:+.0}) % relative humidity more than "
        "air exchange and heat release explain: it is wrong, or there is water in the cabinet",
        _SENSOR_OR_WATER,
    )
    EITHER_SENSOR_OR_WATER = (
        "the humidity sensor reads {change:+.0} ({lower:+.0} … {upper:+.0}) % relative humidity more than "
        "air exchange and heat release explain: it or the ambient's is wrong, or there is water in the "
        "cabinet",
        _SENSOR_OR_WATER,
    )
    TEMPERATURE_SENSOR_SUSPECT = (
        "the temperature sensor reads {size:.1} ({lower:.1} … {upper:.1}) K too {side}{either}: the humidity "
        "readings do not follow it{others}",
        "compare the temperature sensor with another one, and check where it is mounted",
    )
    HUMIDITY_SENSOR_SUSPECT = (
        "the humidity sensor reads {size:.0} ({lower:.0} … {upper:.0}) % too {side}{either}: air exchange "
        "and heat release do not explain its level{others}",
        _RENEW_HUMIDITY,
    )
    HUMIDITY_SCALE_SUSPECT = (
        "the humidity sensor reads {size:.0} ({lower:.0} … {upper:.0}) % of its value too "
        "{side}{either}{others}",
        "compare the humidity sensor with another one at low and at high humidity; clean or renew it",
    )
    AMBIENT_TEMPERATURE_SUSPECT = (
        "the ambient's temperature sensor reads {size:.1} ({lower:.1} … {upper:.1}) K too {side}: neither "
        "its sisters nor the cabinet follow it{others}",
        "compare the ambient's temperature sensor with another one, and check where it is mounted",
    )
    AMBIENT_HUMIDITY_SUSPECT = (
        "the ambient's humidity sensor reads {size:.0} ({lower:.0} … {upper:.0}) % too {side}: neither its "
        "sisters nor the cabinet follow it{others}",
        "compare the ambient's humidity sensor with another one; clean or renew it",
    )
    # readings do not come, or with wrong stamps
    NOTHING_ARRIVES = ("no signal has arrived for {age_h:.1} h", _DATA_PATH)
    SIGNALS_SILENT = ("no reading of {signals:words} has arrived for {age_h:.1} h", _DATA_PATH)
    SENDER_LEFT = (
        "{sender} is offline by its death certificate of {at:stamp}: its signals are stale until its next "
        "birth certificate",
        _DATA_PATH,
    )
    SIGNAL_NEVER_CAME = ("no reading of {quantity:words} has arrived since {since:stamp}", _MAPPING)
    REQUIRED_NEVER_CAME = (
        "no reading of {quantity:words} has arrived since {since:stamp}: without it there is no estimate",
        _MAPPING,
    )
    SOURCE_NOT_REACHED = (
        "{source} has not been reached since {since:stamp}: {reason}",
        "run `hygrokf doctor` to find out what cannot be reached and why",
    )
    MACHINE_CLOCK_SLOW = (
        "readings of {count:.0} of {of:.0} turbines are stamped {ahead:duration} ahead of this machine's "
        f"clock: this clock is slow, or a clock that they share is fast. {_HELD_BACK}",
        _CLOCKS,
    )
    SENDER_CLOCK_FAST = (
        "its readings are stamped {ahead:duration} ahead of this machine's clock: its sender's clock is "
        f"fast. {_HELD_BACK}",
        _CLOCKS,
    )
    SENDER_OR_MACHINE_CLOCK = (
        "its readings are stamped {ahead:duration} ahead of this machine's clock: its sender's clock is "
        f"fast, or this machine's clock is slow. {_HELD_BACK}",
        _CLOCKS,
    )
    # beside others
    OR_OTHERS = " (or {causes})"
    OR_AMBIENT = ", or the ambient's too {side}"
    YEARS = "{count:.1} years"


class NoticeCode(Code):
    """Why a notice is never sent."""

    ALARM_NOT_STORED = "the alarm is no longer in the store"
    BEGINNING_NOT_SENT = "no notice of the alarm's beginning was sent"
    ACKNOWLEDGED_BEFORE = "the alarm was acknowledged before the notice was due"
    ENDED_WHILE_SHELVED = "the alarm ended while it was shelved"
    ENDED_IN_HOLD_OFF = "the alarm ended within the channel's hold-off"
    OVER_BEFORE_CAUGHT_UP = "the alarm was over long before the tracker read it"
    SEVERER_SENT = "a notice of this or a higher severity was already sent"
    GIVEN_UP = "given up after {attempts:.0} attempts: {failure}"


_DRY = (
    "below {limit:%} at the coldest surface with a probability of {probability:chance}, and of at least "
    "{least:chance} until a start within {stays_h:.0} h{effect}"
)


class AdviceCode(Code):
    """How long to pre-heat before a restart, or why this is unknown."""

    HEATING_UNKNOWN = (
        "the record that identified the model has no pre-heating and no logged heater: its heating power is "
        "unknown"
    )
    HEATING_COOLS = "the identified effect of {heaters:words with} is {effect_K:+.1} K: it does not heat"
    PREHEAT = f"pre-heat for {{hours:.1}} h: relative humidity is then {_DRY}"
    NO_PREHEATING = f"no pre-heating is needed: relative humidity is {_DRY}"
    PREHEATING_TOO_WEAK = (
        "not even {longest_h:.0} h of pre-heating bring relative humidity at the coldest surface below "
        "{limit:%} for {stays_h:.0} h with a probability of {enough:chance}: at best it is "
        "{probability:chance}, after {hours:.1} h{effect}"
    )
    WITH_EFFECT = (
        " (identified effect of {heaters:words with}: {effect_K:.1} K, within {lower_K:.1} to {upper_K:.1} K"
        "{needed})"
    )
    NEEDED_HOURS = ", for which {shortest_h:.1} to {longest_h:.1} h are needed"
    NEEDED_HOURS_OPEN = ", for which {shortest_h:.1} to more than {longest_h:.0} h are needed"


class BasisCode(Code):
    """What a forecast is based on, or why there is none."""

    PERSISTENCE = "persistence of the weather, drawn from {days:.0} days; {operation}"
    WEATHER_FORECAST = "a weather forecast; {operation}"
    NO_FORECAST = "{fault}"
    OPERATION_UNKNOWN = "no readings of power: operation unknown"
    PRESENT_POWER_UNKNOWN = "the present power is unknown: operation as on other days"
    OPERATION_AS_NOW = "operation as now"
    OPERATION_OF_ALIKE_DAYS = "operation as on days that began similarly"
    STANDSTILL_MAY_END = "a standstill that may end as {count:.0} earlier ones of this length did"


class CauseCode(Code):
    """Possible causes of a lasting change."""

    CHANGED_HEAT_LOSS = "a changed heat loss"
    CHANGED_AIR_EXCHANGE = "a changed exchange of air"
    CHANGED_HEAT_RELEASE = "a changed heat release"
    TEMPERATURE_SENSOR = "the temperature sensor"
    HUMIDITY_SENSOR_OR_MOISTURE = "the humidity sensor or a source of moisture"
    AMBIENT_TEMPERATURE_SENSOR = "the ambient's temperature sensor"
    AMBIENT_HUMIDITY_SENSOR = "the ambient's humidity sensor"


class StateCode(Code):
    """Why a turbine is in its state."""

    CONDENSATION_LIKELY_NOW = "condensation is likely now"
    CONDENSATION_LIKELY_FROM = "condensation is likely from {at:stamp} on"
    CONDENSATION_UNLIKELY_NOW = "condensation is unlikely now"
    CONDENSATION_UNLIKELY_AHEAD = "condensation is unlikely now and within the forecast"
    FEEDS_NO_POWER = "the turbine feeds no power"
    ALARMS_OPEN = "{kinds}"
    ESTIMATE_OLD = "the newest estimate is from {at:stamp}"
    ESTIMATE_OLD_IN_BACKLOG = "the estimate is old; a backlog is being delivered"
    ESTIMATE_NOT_A_NUMBER = "the estimate is not a number"
    MODEL_WITHOUT_HUMIDITY = "the model has no humidity"
    NO_READING_YET = "no reading has arrived since {since:stamp}"
    INPUTS_NEVER_CAME = "no reading of {quantities:words and} has arrived since {since:stamp}"
    FILTER_FAILS = "the filter cannot run: {fault}"
    HISTORY_AWAITED = "waiting for readings until {until:stamp}, which the first estimate needs"
    NOT_FILTERED_YET = "its readings are not filtered yet"
    NO_PROBABILITY = "the estimate gives no probability of condensation"
    NOT_ASSESSED_YET = "not assessed yet"
    # what the estimate lacks
    FROM_INPUTS_ALONE = "estimated from the inputs alone since {since:stamp}"
    WITHOUT_SIGNAL = "estimated without {signal:words} since {since:stamp}"
