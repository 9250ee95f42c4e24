"""The cases: simulated plants that hide one cause or none, and measured boxes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from battery.measured import DATA, measured
from battery.trial import identified_until
from builders import greenhouse
from plants.as_record import to_record
from plants.hidden import hidden_plant

from hygrokf.cases.case_file import read_case
from hygrokf.data.record import Record

FIRST_SEED = 97000
DAYS = 90.0
HIDDEN = (
    "moisture_sorption",
    "solar_gain",
    "wind_driven_exchange",
    "cooling_switching",
    "exchange_step",
    "humidity_sensor_drift",
    "clock_shift",
    "internal_moisture_source",
)
NOTHING = 4
"""Plants that hide nothing."""
PLANT, BOX = "plant", "box"

_CABINET = """\
name = "controller's cabinet"
rated_power_kW = 660.0
[[source]]
file = "{file}"
time = "time"
timezone = "UTC"
stamp = "end"
interval = "10min"
signals.cabinet_temperature = {{ column = "controller_temperature_degC", unit = "degC" }}
signals.ambient_temperature = {{ column = "outside_temperature_degC", unit = "degC" }}
signals.active_power = {{ column = "active_power_kW", unit = "kW" }}
[identification]
until = "2013-05-15T00:00Z"
"""


@dataclass(frozen=True)
class Case:
    """A record to be asked: its `name`, its `kind`, the names that are `right` (None: not known), and how it
    is made."""

    name: str
    kind: str
    right: tuple[str, ...] | None
    record: Callable[[], Record]
    seed: int | None = None

    @property
    def key(self) -> str:
        return f"{self.kind}:{self.name}" + ("" if self.seed is None else f":{self.seed}")


def _plant(seed: int, cause: str) -> Case:
    def make() -> Record:
        made = hidden_plant(seed, cause, form=0, strength=1.0, days=DAYS)
        return to_record(made, until_s=identified_until(to_record(made), made))

    return Case(cause, PLANT, () if cause == "none" else (cause,), make, seed)


def _cabinet() -> Record:
    file = DATA / "turbine_controller_cabinet_660kW_10min_2013.csv.gz"
    with tempfile.TemporaryDirectory() as directory:
        case = Path(directory) / "case.toml"
        case.write_text(_CABINET.format(file=file.resolve()), encoding="utf-8")
        return read_case(case)


def _greenhouse() -> Record:
    return greenhouse.record("Koala", greenhouse.whole("Koala"), ("fan_duty",))


def cases() -> list[Case]:
    """All cases, the plants first.  What a measured box lacks is known for the greenhouse alone."""
    causes = (*HIDDEN, *("none",) * NOTHING)
    plants = [_plant(FIRST_SEED + place, cause) for place, cause in enumerate(causes)]
    return [
        *plants,
        Case("controller's cabinet", BOX, None, _cabinet),
        Case("greenhouse, vents withheld", BOX, greenhouse.CLASSES["fan_duty"], _greenhouse),
        *(
            Case(name, BOX, None, lambda name=name: measured(name))
            for name in ("attic R2", "attic R4", "house")
        ),
    ]


def outcome(names: list[str], alike: list[str], right: tuple[str, ...] | None) -> str:
    """What names are worth, the first one first: "right", "in class", "later" (another one is right), "wrong"
    or "none".

    names: in the order in which they were given. alike: causes that the method said it cannot tell from the
        first.
    right: names that are right, none where nothing is hidden, None where it is not known.
    """
    if not names:
        return "none"
    if right is None:
        return "not known"
    if names[0] in right:
        return "right"
    if set(alike) & set(right):
        return "in class"
    return "later" if set(names) & set(right) else "wrong"
