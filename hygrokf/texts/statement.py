"""Statements of results: a code with its values, from which the code's template makes the sentence.

A result holds codes and numbers; whoever shows it asks for the `text`.  Nothing reads a sentence back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import Any, ClassVar, Self, TypeAlias

from hygrokf.texts.wording import (
    duration_text,
    fixed,
    minus,
    percent,
    plain_number,
    signed,
    stamp_text,
)

Value: TypeAlias = "float | str | Statement | Sequence[str]"
"""What fills a template: a number, a name, a statement, or names in a list."""


class Code(Enum):
    """What a statement can say: a member's name is the code in files, its value the template of its sentence.

    Fields of a template: `{x}` a name or a statement, `{x:3}` a number with three significant digits,
    `{x:.2}` with two decimals, `{x:+.2}` with its sign, `{x:%}` a share in per cent, `{x:.1%}` with one
    decimal, `{x:g}` as short as it is, `{x:stamp}` an instant [s since 1970], `{x:duration}` a duration [s],
    `{x:reading|readings}` the word for one or for another number, `{x}` names parted by commas, `{x:and}`
    the last two by "and".
    """

    def __init__(self, template: str) -> None:
        self.template = template

    def __call__(self, **values: Value) -> Statement:
        """The statement with these values."""
        return Statement(self, values)

    @property
    def key(self) -> str:
        """The code in files: "not_converged"."""
        return self.name.lower()

    def to_json(self) -> str:
        return self.key

    @classmethod
    def from_json(cls, name: str) -> Code:
        """The code of a name, of this enumeration or of those below it.  Raises ValueError."""
        for kind in (cls, *cls.__subclasses__()):
            if isinstance(name, str) and name.upper() in kind.__members__:
                return kind[name.upper()]
        raise ValueError(f"expected a code of this version, found {name!r}")


@dataclass(frozen=True)
class Statement:
    """A `code` and the `values` of its template by name."""

    codes: ClassVar[type[Code]] = Code

    code: Code
    values: Mapping[str, Value] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {"code": self.code, "values": dict(self.values)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The statement that `to_json` wrote.  Raises ValueError for other data, an unknown code, and values
        that do not fill its template."""
        if not (isinstance(data, Mapping) and "code" in data and isinstance(data.get("values"), Mapping)):
            raise ValueError(f"expected a code with values, found {str(data)[:60]!r}")
        code = cls.codes.from_json(data["code"])
        made = cls(code, {name: _value(value) for name, value in data["values"].items()})
        try:
            made.text  # noqa: B018  values that do not fill the template are found here, not on a page
        except (KeyError, ValueError, TypeError):
            fields = ", ".join(name for _, name, *_ in Formatter().parse(code.template) if name)
            raise ValueError(f"{code.key}: expected values of {fields}, found {data['values']}") from None
        return made

    @property
    def text(self) -> str:
        """The sentence, without a capital letter and a full stop."""
        return _Fields().vformat(self.code.template, (), self.values)

    def __str__(self) -> str:
        return self.text


def _value(data: Any) -> Value:
    """A value from a file: an object is a statement, a list names, null no number."""
    if isinstance(data, Mapping):
        return Statement.from_json(data)
    if isinstance(data, list):
        return tuple(data)
    return math.nan if data is None else data


class _Fields(Formatter):
    """Fields of a template as `Code` describes them."""

    def format_field(self, value: Any, spec: str) -> str:
        if isinstance(value, Statement):
            return value.text
        if isinstance(value, str | Sequence):
            if spec not in ("", "and"):
                raise TypeError(f"expected a number, found {value!r}")
            return value if isinstance(value, str) else listed(value, spec)
        if "|" in spec:
            return spec.split("|")[0 if value == 1 else 1]
        return _number(float(value), spec)


def listed(names: Sequence[str], last: str = "") -> str:
    """Names parted by commas, the last two by the word `last`: "a, b and c"."""
    if last and len(names) > 1:
        return f"{', '.join(names[:-1])} {last} {names[-1]}"
    return ", ".join(names)


def _number(value: float, spec: str) -> str:
    """A number as the field of a template asks for it."""
    if spec == "stamp":
        return stamp_text(value)
    if spec == "duration":
        return duration_text(value)
    if spec == "g":
        return minus(f"{value:g}")
    if spec.endswith("%"):
        return minus(percent(value, int(spec[1:-1] or 0)))
    if spec.startswith("+"):
        return signed(value, int(spec[2:]))
    return fixed(value, int(spec[1:])) if spec.startswith(".") else plain_number(value, int(spec))
