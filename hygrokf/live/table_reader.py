"""Values out of tables of a TOML file, with every fault gathered in words."""

from __future__ import annotations

import math
from collections.abc import Mapping as MappingOf
from dataclasses import dataclass, field

from hygrokf.data.timestamps import duration
from hygrokf.errors import suggestion


@dataclass
class TableReader:
    """Values of a table; what is wrong with them is gathered in `faults`, never raised."""

    faults: list[str] = field(default_factory=list)

    def known(self, table: MappingOf, keys: tuple[str, ...], where: str) -> None:
        for key in table:
            if key not in keys:
                self.faults.append(
                    f'{where}: unknown key "{key}"; expected {", ".join(keys)}{suggestion(key, keys)}'
                )

    def text(self, table: MappingOf, key: str, where: str, default: str = "") -> str:
        value = table.get(key, default)
        if not isinstance(value, str):
            self.faults.append(f"{where}: {key} must be text in quotes, found {value!r}")
            return default
        return value

    def number(self, table: MappingOf, key: str, where: str, default: float | None = None) -> float | None:
        value = table.get(key, default)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            self.faults.append(f"{where}: {key} must be a number, found {value!r}")
            return default
        return float(value)

    def seconds(self, table: MappingOf, key: str, where: str, default: float) -> float:
        if key not in table:
            return default
        try:
            return duration(str(table[key]))
        except ValueError as fault:
            self.faults.append(f"{where}: {key}: {fault}")
            return default

    def tables(self, content: MappingOf, key: str) -> list[tuple[str, MappingOf]]:
        found = content.get(key, [])
        if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
            self.faults.append(f"{key}: expected tables [[{key}]], found {type(found).__name__}")
            return []
        return [(f"[[{key}]] {place}", one) for place, one in enumerate(found, start=1)]
