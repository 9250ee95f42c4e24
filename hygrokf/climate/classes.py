"""Classes of environmental conditions as limits by name; only those whose numbers are in public documents."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from hygrokf.climate.limits import Limit, read_limits
from hygrokf.errors import HygrokfError


class ClassFault(HygrokfError):
    """A name that is neither a file of limits nor a known class."""


@dataclass(frozen=True)
class ClimateClass:
    """A class of climatic conditions: the limits of a standard that public documents state.

    name: standard and class. edition: of the standard. levels: quantity, side and level of each limit, no
        hour of a year may lie beyond them. sources: of the levels. lacking: what the class limits besides,
        without a public number.
    """

    name: str
    edition: str
    levels: tuple[tuple[str, str, float], ...]
    sources: tuple[str, ...]
    lacking: tuple[str, ...]

    @property
    def limits(self) -> tuple[Limit, ...]:
        """The limits, each named after the class."""
        made = (Limit("", quantity, side, level) for quantity, side, level in self.levels)
        return tuple(Limit(f"{self.name}: {one.words()}", one.quantity, one.side, one.level) for one in made)


CLASSES = (
    ClimateClass(
        "IEC 60721-3-3 3K3",
        "2nd edition (1994), replaced in 2019 by an edition with other classes",
        (
            ("temperature_degC", "above", 40.0),
            ("temperature_degC", "below", 5.0),
            ("relative_humidity_percent", "above", 85.0),
            ("relative_humidity_percent", "below", 5.0),
        ),
        (
            "temperature and humidity: data sheet of the WiFi Fan Controller Rev 3.3, "
            "github.com/zeroflow/wifi-fancontroller",
            "humidity: KEB COMBIVERT G6, installation manual, page 9",
        ),
        ("absolute humidity", "rate of change of temperature"),
    ),
)
"""The known classes; docs/how_to/climate.md shows them with their sources."""


def limits_of(given: str | os.PathLike[str]) -> tuple[Limit, ...]:
    """Limits of a file or of a class.

    given: path of a TOML file, or the name of a class, with or without its standard: "IEC 60721-3-3 3K3",
        "EN 60721-3-3 3K3", "3K3".

    Raises FormFault for a file with faults, ClassFault for an unknown name.
    """
    path = Path(given)
    if path.suffix == ".toml" or path.exists():
        return read_limits(path)
    for one in CLASSES:
        standard, _, letters = one.name.removeprefix("IEC ").rpartition(" ")
        pattern = rf"(((DIN|EN|IEC|BS|ISO)\s+)*{re.escape(standard)}\s+(class\s+)?)?{letters}"
        if re.fullmatch(pattern, str(given).strip(), re.IGNORECASE):
            return one.limits
    names = ", ".join(one.name for one in CLASSES)
    raise ClassFault(
        f'limits "{given}": expected a file of limits (.toml) or one of the classes {names}; the numbers of '
        "other classes are not in public documents: write those of your copy of the standard into a file, "
        "see docs/how_to/climate.md"
    )
