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
    """The decimal mark, and the mark that divides groups of three digits ("": none does)."""

    decimal: str = "."
    thousands: str = ""


class Meaning(NamedTuple):
    """What texts stand for: a signal, its unit ("": unknown), and the text of `POLES` that is 1, or ""."""

    signal: str = ""
    unit: str = ""
    one: str = ""


POINT, UNKNOWN_MEANING = Marks(), Meaning()


class Unread(Exception):
    """A value that is not used, with the reason; `kind` is the name under which it is counted."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(words)
        self.kind = kind


def stated_marks(decimal: str | None, thousands: str | None = None) -> Marks | None:
    """The marks that a user states; None if none is stated.

    A mark that is not stated is the counterpart of the stated mark: point and comma imply each other.
    """
    if not decimal and not thousands:
        return None
    decimal = decimal or ("," if thousands == "." else ".")
    return Marks(decimal, thousands or {",": ".", ".": ","}.get(decimal, ""))


def number_in(text: str, marks: Marks = POINT) -> float | None:
    """A finite number in decimal digits; None for any other text, also for misplaced marks."""
    integer_part, decimal_mark, decimals = text.strip().partition(marks.decimal)
    if marks.thousands and marks.thousands in integer_part:
        if not re.fullmatch(
            rf"[+-]?[1-9][0-9]{{0,2}}(?:{re.escape(marks.thousands)}[0-9]{{3}})+", integer_part
        ):
            return None
        integer_part = integer_part.replace(marks.thousands, "")
    if marks.decimal != "." and "." in integer_part + decimals:
        return None
    plain = f"{integer_part}.{decimals}" if decimal_mark else integer_part
    number = float(plain) if _PLAIN.fullmatch(plain) else math.nan
    return number if math.isfinite(number) else None


def value_in(text: str, marks: Marks = POINT, meaning: Meaning = UNKNOWN_MEANING) -> float:
    """The value of a text in the unit of its meaning: a number, a number with its unit, or a flag.

    A unit with the same zero is converted (MW to kW).  Raises Unread.
    """
    number, word, shown = number_in(text, marks), text.strip().lower(), repr(text[:40])
    if number is None and meaning.unit in ("", "1"):
        number = FLAGS.get(word)
    if number is not None:
        return number
    if meaning.unit in ("", "1") and word in POLES:
        true_word = meaning.one or ("open" if meaning.signal == "door_open" else "")
        if true_word:
            return float(word == true_word)
        raise Unread("unknown polarity", f'{shown} may be 1 or 0: state one = "open" or "closed"')
    measure = _MEASURE.fullmatch(text.strip())
    unit = unit_named(measure[2]) if measure is not None else None
    number = number_in(measure[1], marks) if measure is not None and unit is not None else None
    if number is None or unit is None or not meaning.unit:
        raise Unread("no number", f"{shown} is no number")
    given, stated = UNITS[unit], UNITS[meaning.unit]
    if (given.dimension, given.offset) != (stated.dimension, stated.offset):
        raise Unread("other unit", f"{shown} is in {unit}, not in {meaning.unit} as stated")
    return number if unit == meaning.unit else number * given.factor / stated.factor


def values_in(
    texts: pandas.Series, marks: Marks = POINT, meaning: Meaning = UNKNOWN_MEANING
) -> tuple[np.ndarray, dict[str, Unread]]:
    """Values (N,) of texts and numbers, NaN where a text has no value; the texts without value and why."""
    import pandas as pd

    plain = texts
    if marks.decimal != ".":
        no_point = texts.where([not (isinstance(text, str) and "." in text) for text in texts])
        plain = no_point.map(lambda text: text.replace(",", ".") if isinstance(text, str) else text)
    values = pd.to_numeric(plain, errors="coerce").astype(float)
    value_of: dict[object, float] = {}
    refused: dict[str, Unread] = {}
    for text in texts[values.isna() & texts.notna()].unique():
        try:
            value_of[text] = value_in(str(text), marks, meaning)
        except Unread as reason:
            refused[text] = reason
    return values.fillna(texts.map(value_of).astype(float)).to_numpy(), refused


def evidence(texts: pandas.Series, mark: str) -> Literal["none", "decimal", "thousands", "either"]:
    """Whether a mark ("." or ",") is decimal or divides thousands in the texts (N,) of a column.

    The mark is decimal if a number does not have one to three digits before it and three after it, if a text
    without the mark reaches 1000, or if every text has the mark.  Otherwise the interpretation counts under
    which the logarithms of the values jump less than half as far, where texts with and without the mark
    follow each other; "either" if no interpretation does.
    """
    import pandas as pd

    other, escaped = "," if mark == "." else ".", re.escape(mark)
    grouped = rf"[+-]?[1-9]\d{{0,2}}(?:{escaped}\d{{3}})+(?:[{other}]\d*)?"
    present = texts.dropna().astype(str)
    if not present.str.contains(mark, regex=False).any():
        return "none"
    for sample in (present.iloc[:500], present):  # in most columns the first 500 suffice
        bare = sample.str.extract(_BARE)[0].dropna()
        marked = bare.str.contains(mark, regex=False)
        if not bare[marked].str.fullmatch(grouped).all():
            return "decimal"
    if not marked.any():
        return "none"
    if bare.str.contains(other, regex=False).any() or (bare[marked].str.count(escaped) > 1).any():
        return "thousands"
    thousands = pd.to_numeric(bare.str.replace(mark, "")).abs().to_numpy(float)
    is_positive, without = thousands > 0.0, thousands[~marked]
    if not np.any(without > 0.0) or np.any(without >= 1e3):
        return "decimal"
    mark_changes = np.diff(marked.to_numpy()[is_positive])
    readings = (thousands, thousands / np.where(marked, 1e3, 1.0))
    variation_as_thousands, variation_as_decimal = (
        np.sum(np.abs(np.diff(np.log(reading[is_positive])))[mark_changes]) for reading in readings
    )
    if variation_as_thousands < 0.5 * variation_as_decimal:
        return "thousands"
    return "decimal" if variation_as_decimal < 0.5 * variation_as_thousands else "either"


def unit_among(texts: pandas.Series) -> str:
    """The unit after the number in most texts of a column, as `UNITS` names it; "" if there is none."""
    matches = [_MEASURE.fullmatch(text) for text in texts.dropna().iloc[:500].astype(str).str.strip()]
    units = [unit for match in matches if match and (unit := unit_named(match[2])) is not None]
    return max(set(units), key=units.count) if len(units) > 0.5 * len(matches) else ""


def flag_word(texts: pandas.Series) -> str:
    """The text that means 1 in a column of flags, "open" or "on"; "" for other columns."""
    words = {str(text).strip().lower() for text in texts.dropna().unique()[:9]}
    if not words or words - {*FLAGS, *POLES}:
        return ""
    return "open" if words & {*POLES} else "on"
