"""TOML files of the climate command: read, with every fault of their form at once."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TypeGuard

import numpy as np

from hygrokf.errors import HygrokfError


class FormFault(HygrokfError):
    """A file of limits or of a test that cannot be used, with every reason."""

    def __init__(self, file: object, faults: list[str]) -> None:
        super().__init__("\n".join([f"{file}:", *(f"  {i}. {one}" for i, one in enumerate(faults, 1))]))
        self.file, self.faults = str(file), tuple(faults)


def read_toml(path: str | os.PathLike[str], what: str) -> dict:
    """The content of a TOML file that is to hold `what`; raises FormFault."""
    file = Path(path)
    try:
        return tomllib.loads(file.read_bytes().decode("utf-8-sig"))
    except OSError as fault:
        raise FormFault(
            file, [f"expected {what}, found: {fault.strerror or fault}; check the path"]
        ) from None
    except (
        ValueError,
        RecursionError,
    ) as fault:  # also a number of more digits, or more brackets, than Python reads
        raise FormFault(
            file, [f"expected TOML text with {what}, found: {fault}; see docs/climate.md"]
        ) from None


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value of a TOML file is a finite number."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number beyond all floating ones
        return False


def unknown_keys(table: Mapping, known: tuple[str, ...], where: str) -> list[str]:
    """A fault for every key that a table must not have."""
    return [
        f'{where}: unknown key "{name}"; known are {", ".join(known)}' for name in table if name not in known
    ]


def number_of(
    table: Mapping, name: str, where: str, low: float, high: float, default: float, faults: list[str]
) -> float:
    """The number under a key, within low … high; the default where there is none; a fault where it is another thing."""
    value = table.get(name, default)
    if is_number(value) and low <= value <= high:
        return float(value)
    faults.append(f"{where}: {name}: expected a number within {low:g} … {high:g}, found {value!r}")
    return default


def pair_of(
    table: Mapping, name: str, where: str, low: float, high: float, default: tuple, faults: list[str]
) -> tuple[float, float]:
    """Two rising numbers under a key, within low … high."""
    value = table.get(name, default)
    good = isinstance(value, (list, tuple)) and len(value) == 2 and all(map(is_number, value))
    if good and low <= value[0] < value[1] <= high:
        return float(value[0]), float(value[1])
    faults.append(f"{where}: {name}: expected two rising numbers within {low:g} … {high:g}, found {value!r}")
    return default


def as_list(values: np.ndarray, digits: int = 6) -> list:
    """Numbers as nested lists, rounded to significant digits: what files hold need not show the last bits."""
    values = np.asarray(values, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(values == 0.0, 1.0, 10.0 ** (digits - 1 - np.floor(np.log10(np.abs(values)))))
        return np.where(np.isfinite(values), np.round(values * scale) / scale, np.nan).tolist()
