"""Logged actuators (heaters, fans, pumps, driers, doors) and the mechanisms by which they act on a
cabinet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.parts import PARTS
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Name

FEWEST_EACH_SIDE = 10
"""Readings needed above and below the middle of an actuator's span for its effect to be identifiable."""
TOP = 0.999
"""Quantile of the power readings that counts as full power."""
Chosen = tuple[Name, Mapping[str, Any]]
"""A mechanism of the library: its name and its settings."""


@dataclass(frozen=True)
class Actuator:
    """A logged actuator.

    `thermal` and `hygric`: mechanisms (name, settings) by which it acts on each network, or None.  `half`:
    middle of its span [SI unit], above which it counts as on.  `reason`: why a model does not use it, else
    None.
    """

    signal: str
    thermal: Chosen | None
    hygric: Chosen | None
    half: float = 0.5
    reason: Statement | None = None

    @property
    def used(self) -> bool:
        return self.reason is None

    @property
    def statement(self) -> Statement:
        """How a model uses the actuator, or why it does not."""
        if self.reason is not None:
            return FitCode.ACTUATOR_UNUSED(signal=self.signal, why=self.reason)
        mechanisms = zip(PARTS, (self.thermal, self.hygric), strict=True)
        networks = tuple(part for part, mechanism in mechanisms if mechanism)
        return FitCode.ACTUATOR_USED(signal=self.signal, networks=networks)


ACTUATORS: Mapping[str, tuple[str | None, str | None]] = {
    "heater_power": ("logged_heater", None),
    "heater_duty": ("logged_heater", None),
    "fan_duty": ("fan_loss", "fan_exchange"),
    "pump_duty": ("pump_loss", None),
    "dehumidifier_duty": ("dehumidifier_heat", "dehumidifier_drying"),
    "door_open": ("open_loss", "open_exchange"),
}
"""Signals of actuators, and their mechanisms in the thermal and the hygric network."""
HEATERS = ("preheating", "heater_power", "heater_duty", "dehumidifier_duty")
"""Signals of devices that heat the cabinet while they are on."""


def actuators(record: Record) -> tuple[Actuator, ...]:
    """All logged actuators of a record, used or not, in the order of `ACTUATORS`.

    An actuator is used if at least `FEWEST_EACH_SIDE` readings lie above the middle of its span and as many
    below: an actuator that never changes is part of the network's constants.  If both the power and the duty
    of a heater are logged, the power is used.
    """
    logged = [_actuator(record[signal]) for signal in ACTUATORS if signal in record]
    if any(actuator.signal == "heater_power" and actuator.used for actuator in logged):
        logged = [
            replace(actuator, reason=FitCode.HEATER_POWER_LOGGED())
            if actuator.signal == "heater_duty"
            else actuator
            for actuator in logged
        ]
    return tuple(logged)


def _actuator(series: Series) -> Actuator:
    thermal, hygric = ACTUATORS[series.signal]
    value = series.value[~series.missing]
    settings = {}
    if thermal == "logged_heater":
        power = series.signal == "heater_power" and len(value) > 0
        settings = {
            "signal": series.signal,
            "full": max(float(np.quantile(value, TOP)), 1.0) if power else 1.0,
        }
    return Actuator(
        series.signal,
        None if thermal is None else (thermal, settings),
        None if hygric is None else (hygric, {}),
        0.5 * float(value.min() + value.max()) if len(value) else 0.5,
        _unused_reason(value),
    )


def _unused_reason(value: np.ndarray) -> Statement | None:
    """Why the readings (n,) of an actuator cannot show its effect; None where they can."""
    if not len(value):
        return FitCode.ACTUATOR_UNREAD()
    if value.min() == value.max():
        return FitCode.ACTUATOR_CONSTANT()
    above = int((value > 0.5 * (value.min() + value.max())).sum())
    if min(above, len(value) - above) >= FEWEST_EACH_SIDE:
        return None
    return FitCode.ACTUATOR_RARE(above=above, below=len(value) - above, fewest=FEWEST_EACH_SIDE)
