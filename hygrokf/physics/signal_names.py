"""Names of the signals that models and judgements read; the table of all signals is `data.signals`."""

CABINET_TEMPERATURE = "cabinet_temperature"
CABINET_RELATIVE_HUMIDITY = "cabinet_relative_humidity"
CABINET_HUMIDITIES = (CABINET_RELATIVE_HUMIDITY, "cabinet_absolute_humidity")
"""Humidities of the cabinet that a model predicts; of two in a record the first is read."""
CABINET_SIGNALS = (CABINET_TEMPERATURE, *CABINET_HUMIDITIES)
AMBIENT_TEMPERATURE = "ambient_temperature"
AMBIENT_RELATIVE_HUMIDITY = "ambient_relative_humidity"
AMBIENT_HUMIDITIES = (
    AMBIENT_RELATIVE_HUMIDITY,
    "ambient_absolute_humidity",
    "ambient_dew_point_temperature",
)
"""Signals each of which determines the ambient's humidity."""
ACTIVE_POWER = "active_power"
