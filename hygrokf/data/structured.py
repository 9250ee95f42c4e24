"""Results as frozen dataclasses, written to and read from plain JSON data by one converter.

The key of an `optional()` field is left out of a file if the value is the default.  In every file null stands
for NaN in place of a number, lists become tuples or arrays, and unknown keys are ignored, because a newer
version may add keys.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, get_args

import numpy as np

from hygrokf.errors import HygrokfError
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import FaultText, Name

if TYPE_CHECKING:
    from cattrs import Converter

T = TypeVar("T")
Json: TypeAlias = "bool | int | float | str | Sequence[Json] | Mapping[str, Json] | None"
"""Any value of a JSON text."""
JsonObject: TypeAlias = dict[str, Json]
Cell: TypeAlias = bool | int | float | Name | FaultText | Statement | tuple[Name | Statement, ...] | None
"""The content of a table's cell; a tuple where a turbine has several names or statements."""
OPTIONAL = "optional"


class StructureFault(HygrokfError):
    """Data from which no result can be made; `faults` lists every fault with its place in the data."""

    def __init__(self, faults: list[str]) -> None:
        """Make the message from all faults."""
        super().__init__("; ".join(faults))
        self.faults = tuple(faults)


def optional(default: Any = None) -> Any:
    """Return a dataclass field whose key is left out of a file if it has its default value, which may be
    NaN."""
    return dataclasses.field(default=default, metadata={OPTIONAL: True})


def plain(value: object) -> Any:
    """Return a result as JSON data; keys are the names of the fields, and numbers that are not finite become
    null."""
    return _converter().unstructure(value)


def structured(kind: type[T], data: object) -> T:
    """Return a result of class `kind` from the data of `plain`.  Raises StructureFault with every fault and
    its place."""
    from cattrs import BaseValidationError

    try:
        return _converter().structure(data, kind)
    except BaseValidationError as fault:
        raise StructureFault(_faults(fault, "")) from None
    except (TypeError, ValueError, KeyError, AttributeError) as fault:
        raise StructureFault([_message(fault)]) from None


def _faults(fault: BaseException, place: str) -> list[str]:
    """Return the faults in a tree of exceptions, each as "time_constants.thermal.value_h: expected …".

    place: of the exception in the data.
    """
    from cattrs import AttributeValidationNote, BaseValidationError, IterableValidationNote

    if not isinstance(fault, BaseValidationError):
        return [f"{place}: {_message(fault)}" if place else _message(fault)]
    messages = []
    for inner_fault in fault.exceptions:
        notes = getattr(inner_fault, "__notes__", ())
        name = next((str(n.name) for n in notes if isinstance(n, AttributeValidationNote)), None)
        index = next((n.index for n in notes if isinstance(n, IterableValidationNote)), None)
        if isinstance(index, int):
            inner_place = f"{place}[{index}]"
        else:
            name_of_step = name if index is None else str(index)
            inner_place = ".".join(filter(None, (place, name_of_step)))
        messages += _faults(inner_fault, inner_place)
    return messages


def _message(fault: BaseException) -> str:
    """Return the message of an exception in the package's form."""
    if isinstance(fault, KeyError):
        return "expected, and missing"
    message = str(fault)
    if match := re.fullmatch(r"(.*) not in literal typing\.Literal\[(.*)\]", message):
        return f"expected one of {match[2]}, found {match[1]!r}"
    if match := re.match(r"(?:Not enough|Too many) values in (.*) to structure as tuple\[(.*)\]", message):
        return f"expected {len(match[2].split(', '))} values, found {match[1]}"
    return message


# --- the converter ---------------------------------------------------------------------------


_PLAIN: Mapping[type, tuple[tuple[type, ...], str]] = {
    float: ((int, float, np.integer, np.floating), "a number"),
    int: ((int, float, np.integer), "a whole number"),
    str: ((str,), "a text"),
    bool: ((bool, np.bool_), "true or false"),
}
"""Type of a field -> types of JSON values that it accepts, and their name in messages."""


def _plain(value: Any, kind: Any) -> Any:
    """Return a JSON value as a number, text or flag of the type `kind`.  Raises ValueError for another
    type."""
    if kind is float and value is None:
        return math.nan
    accepted_types, expected = _PLAIN[kind]
    has_fraction = kind is int and isinstance(value, float) and not value.is_integer()
    if (
        not isinstance(value, accepted_types)
        or has_fraction
        or (isinstance(value, bool) and kind is not bool)
    ):
        raise ValueError(f"expected {expected}, found {shown(value, 60)}")
    return kind(value)


def _array(value: object, _: object = None) -> np.ndarray:
    """Return a list of numbers, or of lists of them, as an array; null becomes NaN.  Raises ValueError."""
    if not isinstance(value, (list, tuple, np.ndarray)):
        raise ValueError(f"expected a list of numbers, found {shown(value, 60)}")
    rows = [_array(v) if isinstance(v, (list, tuple)) else _plain(v, float) for v in value]
    try:
        return np.array(rows, dtype=float)
    except ValueError:
        raise ValueError("expected rows of equal length, found others") from None


def shown(value: object, most: int = 200) -> str:
    """Return a value as text for a message, cut to `most` characters."""
    text = repr(value)
    return text if len(text) <= most else f"{text[: most - 3]}…"


def _listed(value: np.ndarray) -> Any:
    """Return an array as lists, with null where a number is not finite."""
    if value.dtype.kind != "f":
        return value.tolist()
    values = value.astype(object)
    values[~np.isfinite(value)] = None
    return values.tolist()


def _finite(value: float) -> float | None:
    """Return the number, or None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def _read(kind: type, converter: Converter) -> Callable[[Any, Any], Any]:
    """Return the function that makes a dataclass from JSON data."""
    from cattrs.gen import make_dict_structure_fn

    structure: Callable[[Any, Any], Any] = make_dict_structure_fn(kind, converter)
    name = kind.__name__

    def read(data: Any, _: Any) -> Any:
        """Return the object; data that is one already is returned as it is."""
        if isinstance(data, kind):
            return data
        if not isinstance(data, dict):
            raise ValueError(f"expected an object ({name}), found {shown(data, 60)}")
        return structure(data, kind)

    return read


def _write(kind: type, converter: Converter) -> Callable[[Any], Any]:
    """Return the function that turns a dataclass into JSON data, without optional fields that have their
    default."""
    from cattrs.gen import make_dict_unstructure_fn, override

    optional_fields = [f for f in dataclasses.fields(kind) if f.metadata.get(OPTIONAL)]
    left_out: dict[str, Any] = {f.name: override(omit_if_default=True) for f in optional_fields}
    unstructure: Callable[[Any], Any] = make_dict_unstructure_fn(kind, converter, **left_out)
    # NaN differs from itself, so the converter does not recognise it as the default
    default_nan = [f.name for f in optional_fields if isinstance(f.default, float) and math.isnan(f.default)]
    if not default_nan:
        return unstructure

    def write(value: Any) -> Any:
        """Return the JSON data without optional numbers that are NaN by default."""
        data = unstructure(value)
        return {
            key: written for key, written in data.items() if written is not None or key not in default_nan
        }

    return write


def _cell(data: Any, kind: Any) -> Cell:
    """Return the cell of a table from JSON data: a number, a text, a statement or a tuple of these."""
    if data is None or isinstance(data, bool | int | float | str | Statement):
        return data
    if isinstance(data, Mapping):
        return Statement.from_json(data)
    if isinstance(data, list):
        return tuple(Statement.from_json(item) if isinstance(item, Mapping) else item for item in data)
    raise TypeError(f"expected a number, a text or null, found {data!r}")


def _has_own_form(kind: Any) -> bool:
    """Whether a class converts itself to and from JSON."""
    return hasattr(kind, "from_json") and hasattr(kind, "to_json")


@cache
def _converter() -> Converter:
    """Return the converter of all results; classes with `to_json` and `from_json` convert themselves."""
    from cattrs import Converter

    converter = Converter(detailed_validation=True, unstruct_collection_overrides={tuple: list})
    for kind in _PLAIN:
        converter.register_structure_hook(kind, _plain)
    converter.register_structure_hook(StrEnum, lambda value, kind: kind(value))
    converter.register_structure_hook(np.ndarray, _array)
    converter.register_structure_hook(
        float | np.ndarray,
        lambda v, _: _array(v) if isinstance(v, list | tuple | np.ndarray) else _plain(v, float),
    )
    # a `Cell`, whatever its texts are declared as
    converter.register_structure_hook_func(lambda kind: {bool, Statement} <= set(get_args(kind)), _cell)
    converter.register_unstructure_hook(StrEnum, lambda value: value.value)
    converter.register_unstructure_hook(float, _finite)
    converter.register_unstructure_hook(np.ndarray, _listed)
    converter.register_unstructure_hook(np.floating, lambda value: _finite(float(value)))
    converter.register_unstructure_hook(np.integer, int)
    converter.register_unstructure_hook(np.bool_, bool)
    converter.register_structure_hook_factory(dataclasses.is_dataclass, lambda kind: _read(kind, converter))
    converter.register_unstructure_hook_factory(
        dataclasses.is_dataclass, lambda kind: _write(kind, converter)
    )
    converter.register_structure_hook_func(_has_own_form, lambda data, kind: kind.from_json(data))
    converter.register_unstructure_hook_func(
        _has_own_form, lambda value: converter.unstructure(value.to_json())
    )
    return converter
