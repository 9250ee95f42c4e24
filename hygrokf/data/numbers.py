"""Numbers from texts, for files, frames, drafts and live payloads alike: marks, units, flags."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from hygrokf.data.signals import UNITS, unit_named

if TYPE_CHECKING:
    import pandas

FLAGS = {"true": 1.0, "on": 1.0, "false": 0.0, "off": 0.0}
POLES = ("open", "closed")
"""Texts of a flag whose meaning the signal decides."""
PARTED = re.compile(r"\s*([+-]?[1-9][0-9]{0,2}\.[0-9]{3})(?![0-9.,eE])")
"""The number at the beginning of a text whose point may divide thousands."""
_PLAIN = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MEASURE = re.compile(r"([+-]?[0-9.,]*[0-9][.,]?(?:[eE][+-]?[0-9]+)?)\s*([^\s0-9.,]\S*(?:\s\S+)?)")
_GROUPS = r"\d{1,3}(?:\.\d{3})+(?:,\d*)?|\d{1,3}(?:,\d{3})+(?:\.\d*)?"
_BARE = rf"^\s*([+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+|{_GROUPS}))\s*(?:[^\d.,\s].*)?$"


class Marks(NamedTuple):
    """The decimal mark, and the one that divides groups of three digits ("": none does)."""

    decimal: str = "."
    thousands: str = ""


class Meaning(NamedTuple):
    """What texts stand for: a signal, its unit ("": unknown), and the one of `POLES` that is 1, if stated."""

    signal: str = ""
    unit: str = ""
    one: str = ""


POINT, UNKNOWN = Marks(), Meaning()


class Unread(Exception):
    """What is not used; `kind` is the name under which it is counted."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(words)
        self.kind = kind


def stated_marks(decimal: str | None, thousands: str | None = None) -> Marks | None:
    """The marks that a user states, each by default the other one of the stated; None where neither is."""
    if not decimal and not thousands:
        return None
    decimal = decimal or ("," if thousands == "." else ".")
    return Marks(decimal, thousands or {",": ".", ".": ","}.get(decimal, ""))


def number_in(text: str, marks: Marks = POINT) -> float | None:
    """A finite number in decimal digits; None for any other text, also one whose marks stand wrongly."""
    whole, mark, rest = text.strip().partition(marks.decimal)
    if marks.thousands and marks.thousands in whole:
        if not re.fullmatch(rf"[+-]?[1-9][0-9]{{0,2}}(?:{re.escape(marks.thousands)}[0-9]{{3}})+", whole):
            return None
        whole = whole.replace(marks.thousands, "")
    if marks.decimal != "." and "." in whole + rest:
        return None
    plain = f"{whole}.{rest}" if mark else whole
    found = float(plain) if _PLAIN.fullmatch(plain) else math.nan
    return found if math.isfinite(found) else None


def value_in(text: str, marks: Marks = POINT, meaning: Meaning = UNKNOWN) -> float:
    """The value of a text in the unit of its meaning: a number, a number with its unit, or a flag.

    A unit with the same zero is converted (MW to kW).  Raises Unread.
    """
    found, word, shown = number_in(text, marks), text.strip().lower(), repr(text[:40])
    if found is None and meaning.unit in ("", "1"):
        found = FLAGS.get(word)
    if found is not None:
        return found
    if meaning.unit in ("", "1") and word in POLES:
        one = meaning.one or ("open" if meaning.signal == "door_open" else "")
        if one:
            return float(word == one)
        raise Unread("unknown polarity", f'{shown} may be 1 or 0: state one = "open" or "closed"')
    parts = _MEASURE.fullmatch(text.strip())
    unit = unit_named(parts[2]) if parts is not None else None
    found = number_in(parts[1], marks) if parts is not None and unit is not None else None
    if found is None or unit is None or not meaning.unit:
        raise Unread("no number", f"{shown} is no number")
    given, stated = UNITS[unit], UNITS[meaning.unit]
    if (given.dimension, given.offset) != (stated.dimension, stated.offset):
        raise Unread("other unit", f"{shown} is in {unit}, not in {meaning.unit} as stated")
    return found if unit == meaning.unit else found * given.factor / stated.factor


def values_in(
    texts: pandas.Series, marks: Marks = POINT, meaning: Meaning = UNKNOWN
) -> tuple[np.ndarray, dict[str, Unread]]:
    """Values (N,) of texts and numbers, NaN where there is none; texts that are none, with the reason."""
    import pandas as pd

    plain = texts
    if marks.decimal != ".":
        no_point = texts.where([not (isinstance(one, str) and "." in one) for one in texts])
        plain = no_point.map(lambda one: one.replace(",", ".") if isinstance(one, str) else one)
    values = pd.to_numeric(plain, errors="coerce").astype(float)
    read: dict[object, float] = {}
    refused: dict[str, Unread] = {}
    for one in texts[values.isna() & texts.notna()].unique():
        try:
            read[one] = value_in(str(one), marks, meaning)
        except Unread as reason:
            refused[one] = reason
    return values.fillna(texts.map(read).astype(float)).to_numpy(), refused


def evidence(texts: pandas.Series, mark: str) -> Literal["none", "decimal", "thousands", "either"]:
    """What a mark ("." or ",") does in the texts (N,) of a column, in their order.

    It is decimal where other than three digits follow it, or other than one to three come first, where a text
    without it reaches 1000, or none is without it.  Else that reading counts by which the course leaps less
    than half as far (in logarithms) between texts with and without it; "either" if neither does.
    """
    import pandas as pd

    other, escaped = "," if mark == "." else ".", re.escape(mark)
    grouped = rf"[+-]?[1-9]\d{{0,2}}(?:{escaped}\d{{3}})+(?:[{other}]\d*)?"
    given = texts.dropna().astype(str)
    if not given.str.contains(mark, regex=False).any():
        return "none"
    for some in (given.iloc[:500], given):  # most columns tell at once
        bare = some.str.extract(_BARE)[0].dropna()
        marked = bare.str.contains(mark, regex=False)
        if not bare[marked].str.fullmatch(grouped).all():
            return "decimal"
    if not marked.any():
        return "none"
    if bare.str.contains(other, regex=False).any() or (bare[marked].str.count(escaped) > 1).any():
        return "thousands"
    thousands = pd.to_numeric(bare.str.replace(mark, "")).abs().to_numpy(float)
    kept, without = thousands > 0.0, thousands[~marked]
    if not np.any(without > 0.0) or np.any(without >= 1e3):
        return "decimal"
    turns = np.diff(marked.to_numpy()[kept])
    both = (thousands, thousands / np.where(marked, 1e3, 1.0))
    as_thousands, as_decimal = (np.sum(np.abs(np.diff(np.log(one[kept])))[turns]) for one in both)
    if as_thousands < 0.5 * as_decimal:
        return "thousands"
    return "decimal" if as_decimal < 0.5 * as_thousands else "either"


def unit_among(texts: pandas.Series) -> str:
    """The unit that most texts of a column hold behind their number, as `UNITS` names it; "" if none does."""
    found = [_MEASURE.fullmatch(one) for one in texts.dropna().iloc[:500].astype(str).str.strip()]
    named = [unit for one in found if one is not None and (unit := unit_named(one[2])) is not None]
    return max(set(named), key=named.count) if len(named) > 0.5 * len(found) else ""


def flag_word(texts: pandas.Series) -> str:
    """The word that names what 1 means in a column of flags, "open" or "on"; "" for other columns."""
    words = {str(one).strip().lower() for one in texts.dropna().unique()[:9]}
    if not words or words - {*FLAGS, *POLES}:
        return ""
    return "open" if words & {*POLES} else "on"
