"""Statements of results: a code with values, from which the code's template makes the sentence.

Results hold codes and values; the sentence is made where it is shown. Nothing parses a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import Any, ClassVar, Self, TypeAlias, TypeVar

from hygrokf.texts.wording import (
    bytes_text,
    chance_text,
    day_text,
    duration_text,
    fixed,
    lag_text,
    minus,
    p_equation,
    percent,
    plain_number,
    several,
    shift_text,
    signed,
    signed_shift,
    stamp_text,
)

S = TypeVar("S", bound="Statement")
Value: TypeAlias = "float | str | Statement | Sequence[str | Statement]"
"""The value of a field: a number, a name, a statement, or a list of names or statements."""


class Code(Enum):
    """The codes of statements: a member's name is the code in files, its value the template of the sentence
    (or a pair: this template and that of the remedy).

    Fields of a template:
    `{x}` a name, a statement, or a list of these with commas; `{x:and}`, `{x:or}` with this word before the
    last one; `{x:several}` the first ones of many; `{x:;}` separated by semicolons; `{x:words}` a name
    without underscores; `{x:unit}` a unit after its number.
    `{x:3}` a number with three significant digits, `{x:3g}` without trailing zeros, `{x:g}` as short as
    possible, `{x:.2}` with two decimals, `{x:+.2}` also with its sign, `{x:,}` a whole number with separated
    thousands, `{x:%}` a share in per cent, `{x:.1%}` with one decimal; `{x:reading|readings}` the first word
    for 1, else the second.
    `{x:chance}` a probability that is never called certain, `{x:p}` a p-value ("p = 0.03"), `{x:bytes}` a
    size.
    `{x:stamp}` an instant [s since 1970], `{x:day}` its date, `{x:duration}` a duration [s], `{x:lag}` a lag
    [h], `{x:shift}` the error of a clock [s], `{x:+shift}` with its sign.
    """

    def __init__(self, template: str, remedy: str = "") -> None:
        self.template = template
        self.remedy = remedy

    def __call__(self, **values: Value) -> Statement:
        """Return the statement of this code with these values."""
        return Statement(self, values)

    @property
    def key(self) -> str:
        """The code as written to files: "not_converged"."""
        return self.name.lower()

    def to_json(self) -> str:
        return self.key

    @classmethod
    def from_json(cls, name: str) -> Code:
        """Return the code with a name, of this enumeration or of its subclasses. Raises ValueError for an
        unknown name."""
        for kind in (cls, *cls.__subclasses__()):
            if isinstance(name, str) and name.upper() in kind.__members__:
                return kind[name.upper()]
        raise ValueError(f"expected a code of this version, found {name!r}")


@dataclass(frozen=True)
class Statement:
    """A `code`, and the `values` of the fields of its template by name."""

    codes: ClassVar[type[Code]] = Code

    code: Code
    values: Mapping[str, Value] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {"code": self.code, "values": dict(self.values)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the statement that `to_json` wrote. Raises ValueError for an unknown code, or for values
        that do not fill its template."""
        if not (isinstance(data, Mapping) and "code" in data and isinstance(data.get("values"), Mapping)):
            raise ValueError(f"expected a code with values, found {str(data)[:60]!r}")
        code = cls.codes.from_json(data["code"])
        statement = cls(code, {name: _value(value) for name, value in data["values"].items()})
        try:
            statement.text  # noqa: B018  values that do not fill the template are found here, not on a page
        except (KeyError, ValueError, TypeError):
            fields = ", ".join(name for _, name, *_ in Formatter().parse(code.template) if name)
            raise ValueError(f"{code.key}: expected values of {fields}, found {data['values']}") from None
        return statement

    @property
    def pieces(self) -> tuple[str | float, ...]:
        """The sentence in pieces; the numbers among them are instants [s since 1970], which a page shows in
        its own time zone."""
        return tuple(piece for piece in _pieces(self.code.template, self.values) if piece != "")

    @property
    def text(self) -> str:
        """The sentence, without a capital first letter and a full stop."""
        return _joined(self.pieces)

    @property
    def remedy(self) -> str:
        """What to do about it; "" if there is nothing to do."""
        return _joined(_pieces(self.code.remedy, self.values))

    def __str__(self) -> str:
        return self.text


def _value(data: Any) -> Value:
    """Return a value as read from a file: an object is a statement, a list holds names or statements, null is
    NaN."""
    if isinstance(data, Mapping):
        return Statement.from_json(data)
    if isinstance(data, list):
        return tuple(Statement.from_json(entry) if isinstance(entry, Mapping) else entry for entry in data)
    return math.nan if data is None else data


def _pieces(template: str, values: Mapping[str, Value]) -> Iterator[str | float]:
    """Yield the pieces of a template with its fields filled; see `Code`."""
    for literal, name, spec, _ in Formatter().parse(template):
        yield literal
        if name is None:
            continue
        value = values[name]
        if isinstance(value, Statement):
            yield from value.pieces
        elif spec == "stamp" and not isinstance(value, str | Sequence):
            yield float(value)
        else:
            yield _filled(value, spec or "")


def _joined(pieces: Iterable[str | float]) -> str:
    """Join the pieces of a sentence; instants are written in UTC."""
    return "".join(piece if isinstance(piece, str) else stamp_text(piece) for piece in pieces)


def _filled(value: float | str | Sequence[str | Statement], spec: str) -> str:
    """Write a value in the format `spec` of its field. Raises TypeError for a text in a field of numbers."""
    if isinstance(value, str | Sequence) and spec.split(" ")[0] not in FIELDS_OF_NAMES:
        raise TypeError(f"expected a number, found {value!r}")
    if isinstance(value, str):
        return _name(value, spec)
    if isinstance(value, Sequence):
        names = [_name(str(item), spec.split()[0] if spec else "") for item in value]
        if spec == ";":
            return "; ".join(names)
        return several(names) if spec == "several" else listed(names, spec.removeprefix("words").strip())
    if "|" in spec:
        return spec.split("|")[0 if value == 1 else 1]
    return _number(float(value), spec)


def _name(text: str, spec: str) -> str:
    """Write a name in the format `spec` of its field."""
    if spec == "unit":
        return "" if text in ("", "1") else f" {text}"
    return text.replace("_", " ") if spec == "words" else text


FIELDS_OF_NAMES = ("", "and", "or", "words", "unit", "several", ";")
"""First words of the formats of fields that hold names or statements, not numbers."""


def unique(statements: Iterable[S]) -> tuple[S, ...]:
    """Return the statements without those whose sentence occurs before."""
    return tuple({statement.text: statement for statement in statements}.values())


def listed(names: Sequence[str], last: str = "") -> str:
    """Join names by commas, the last two by the word `last`: "a, b and c"."""
    if last and len(names) > 1:
        return f"{', '.join(names[:-1])} {last} {names[-1]}"
    return ", ".join(names)


def _number(value: float, spec: str) -> str:
    """Write a number in the format `spec` of its field."""
    if spec in _FORMATS:
        return _FORMATS[spec](value)
    if spec.endswith("g"):
        return minus(f"{value:.{spec[:-1] or 6}g}")
    if spec.endswith("%"):
        return minus(percent(value, int(spec[1:-1] or 0)))
    if spec.startswith("+"):
        return signed(value, int(spec[2:]))
    return fixed(value, int(spec[1:])) if spec.startswith(".") else plain_number(value, int(spec))


_FORMATS: Mapping[str, Callable[[float], str]] = {
    ",": "{:,.0f}".format,
    "stamp": stamp_text,
    "day": day_text,
    "duration": duration_text,
    "shift": shift_text,
    "+shift": signed_shift,
    "lag": lag_text,
    "p": p_equation,
    "chance": chance_text,
    "bytes": bytes_text,
}
"""Formats that do not state a number of digits → the function that writes the number."""
