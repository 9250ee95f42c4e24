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
_POINT_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MEASURE = re.compile(r"([+-]?[0-9.,]*[0-9][.,]?(?:[eE][+-]?[0-9]+)?)\s*([^\s0-9.,]\S*(?:\s\S+)?)")
_BARE = r"^\s*([+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+|\d{1,3}(?:\.\d{3})+(?:,\d*)?|\d{1,3}(?:,\d{3})+(?:\.\d*)?))\s*(?:[^\d.,\s].*)?$"
Evidence = Literal["none", "decimal", "thousands", "either"]


class Marks(NamedTuple):
    """The decimal mark, and the one that divides groups of three digits ("": none does)."""

    decimal: str = "."
    thousands: str = ""


POINT = Marks()


def stated_marks(decimal: str | None, thousands: str | None) -> Marks | None:
    """The marks that a user states, each by default the other one of the stated; None where neither is."""
    if not decimal and not thousands:
        return None
    decimal = decimal or ("," if thousands == "." else ".")
    return Marks(decimal, thousands or {",": ".", ".": ","}.get(decimal, ""))


class Meaning(NamedTuple):
    """What texts stand for: a signal and its unit ("": unknown); whether they may be flags; the pole that is
    1, "open" or "closed", where it is stated."""

    signal: str = ""
    unit: str = ""
    is_flag: bool = True
    one: str = ""


class Unread(ValueError):
    """A text that is no number; `kind` is the name under which it is counted."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(words)
        self.kind = kind


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
    found = float(plain) if _POINT_NUMBER.fullmatch(plain) else math.nan
    return found if math.isfinite(found) else None


def value_in(text: str, marks: Marks = POINT, meaning: Meaning = Meaning()) -> float:
    """The value of a text in the unit of its meaning: a number, a number with a unit, or a flag.

    A unit that is a multiple of the meaning's is converted (MW to kW).  Raises Unread.
    """
    word = text.strip()
    found = number_in(word, marks)
    if found is not None:
        return found
    flag = _flag(word.lower(), meaning) if meaning.is_flag else None
    if flag is not None:
        return flag
    parts = _MEASURE.fullmatch(word)
    unit = unit_named(parts[2]) if parts is not None else None
    found = number_in(parts[1], marks) if parts is not None and unit is not None else None
    if found is None or unit is None or not meaning.unit:
        raise Unread("no number", "is no number")
    if unit == meaning.unit:
        return found
    given, stated = UNITS[unit], UNITS[meaning.unit]
    if (given.dimension, given.offset) != (stated.dimension, stated.offset):
        raise Unread("other unit", f"is in {unit}, not in {meaning.unit} as stated")
    return found * given.factor / stated.factor


def _flag(word: str, meaning: Meaning) -> float | None:
    if word not in POLES:
        return FLAGS.get(word)
    one = meaning.one or ("open" if meaning.signal == "door_open" else "")
    if not one:
        raise Unread("unknown polarity", f'is 1 or 0: state one = "{word}" or "{POLES[word == POLES[0]]}"')
    return float(word == one)


def values_in(
    texts: pandas.Series, marks: Marks = POINT, meaning: Meaning = Meaning()
) -> tuple[np.ndarray, dict[str, Unread]]:
    """Values (N,) of texts, NaN where there is none; and the texts that cannot be read, with the reason."""
    import pandas as pd

    # most cells are plain numbers; numbers of other types than text are taken as they are
    values = pd.to_numeric(texts if marks.decimal == "." else texts.where(~_has(texts, ".")), errors="coerce")
    values = values.astype(float)
    read: dict[object, float] = {}
    refused: dict[str, Unread] = {}
    for one in texts[values.isna() & texts.notna()].unique():
        try:
            read[one] = value_in(str(one), marks, meaning)
        except Unread as reason:
            refused[one] = reason
    return values.fillna(texts.map(read).astype(float)).to_numpy(), refused


def _has(texts: pandas.Series, mark: str) -> pandas.Series:
    return texts.map(lambda one: isinstance(one, str) and mark in one)


def evidence(texts: pandas.Series, mark: str) -> Evidence:
    """What a mark ("." or ",") does in the texts (N,) of a column, in their order.

    It divides thousands if three digits follow every one, one to three stand before the first, and texts
    without it stay below 1000; it is decimal otherwise, and where all texts have it.  Where both are possible,
    that reading is taken by which the course leaps less from a text with the mark to one without, by half the
    logarithms; else "either".
    """
    import pandas as pd

    other, escaped = "," if mark == "." else ".", re.escape(mark)
    grouped = rf"[+-]?[1-9]\d{{0,2}}(?:{escaped}\d{{3}})+(?:[{other}]\d*)?"
    given = texts.dropna().astype(str)
    given = given if given.str.contains(mark, regex=False).any() else given.iloc[:0]
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
    decimal = thousands / np.where(marked, 1e3, 1.0)
    without = thousands[~marked]
    if not np.any(without > 0.0) or np.any(without >= 1e3):
        return "decimal"
    kept = thousands > 0.0
    turns = np.diff(marked.to_numpy()[kept])
    leaps = [float(np.sum(np.abs(np.diff(np.log(one[kept])))[turns])) for one in (thousands, decimal)]
    if leaps[0] < 0.5 * leaps[1]:
        return "thousands"
    return "decimal" if leaps[1] < 0.5 * leaps[0] else "either"


def unit_among(texts: pandas.Series) -> str:
    """The unit that most texts of a column hold behind their number, as `UNITS` names it; "" if none does."""
    found = [_MEASURE.fullmatch(one) for one in texts.dropna().iloc[:500].astype(str).str.strip()]
    units = [unit_named(one[2]) for one in found if one is not None]
    named = [one for one in units if one is not None]
    return max(set(named), key=named.count) if len(named) > 0.5 * len(found) else ""


def flag_word(texts: pandas.Series) -> str:
    """The word that names what 1 means in a column of flags, "open" or "on"; "" for other columns."""
    words = set(texts.dropna().unique())
    words = {str(one).strip().lower() for one in words} if len(words) < 9 else set()
    if not words or words - {*FLAGS, *POLES}:
        return ""
    return "open" if words & {*POLES} else "on"


def could_divide_thousands(values: np.ndarray) -> bool:
    """Whether numbers (N,) may be the ones of a column whose points divide thousands: its texts tell."""
    size = np.abs(values[np.isfinite(values)])
    broken = size != np.round(size)
    parted = size[broken]
    if not len(parted) or np.any(size >= 1e3) or np.any(parted < 1.0) or not np.any(size[~broken] > 0.0):
        return False
    in_thousandths = 1e3 * parted
    return bool(np.all(np.abs(in_thousandths - np.round(in_thousandths)) < 1e-6))
