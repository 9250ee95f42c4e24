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
"""Texts of a flag; the signal decides which of them means 1."""
PARTED = re.compile(r"\s*([+-]?[1-9][0-9]{0,2}\.[0-9]{3})(?![0-9.,eE])")
"""The number at the beginning of a text whose point may divide thousands."""
_PLAIN = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MEASURE = re.compile(r"([+-]?[0-9.,]*[0-9][.,]?(?:[eE][+-]?[0-9]+)?)\s*([^\s0-9.,]\S*(?:\s\S+)?)")
_GROUPS = r"\d{1,3}(?:\.\d{3})+(?:,\d*)?|\d{1,3}(?:,\d{3})+(?:\.\d*)?"
_BARE = rf"^\s*([+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+|{_GROUPS}))\s*(?:[^\d.,\s].*)?$"


class Marks(NamedTuple):
    """Marks in numbers: the decimal mark, and the mark between groups of three digits ("": none)."""

    decimal: str = "."
    thousands: str = ""


class Meaning(NamedTuple):
    """What the texts of a column stand for.

    signal: "" if unknown.  unit: "" if unknown.  one: which of `POLES` means 1, or "".
    """

    signal: str = ""
    unit: str = ""
    one: str = ""


POINT, UNKNOWN_MEANING = Marks(), Meaning()


class Unread(Exception):
    """A value that cannot be used, with the reason; `kind` is the name under which it is counted."""

    def __init__(self, kind: str, words: str) -> None:
        """Make the exception; words: the reason for the user."""
        super().__init__(words)
        self.kind = kind


def stated_marks(decimal: str | None, thousands: str | None = None) -> Marks | None:
    """Return the marks that a user states; None if none is stated.

    A mark that is not stated is the counterpart of the stated one: point and comma imply each other.
    """
    if not decimal and not thousands:
        return None
    decimal = decimal or ("," if thousands == "." else ".")
    return Marks(decimal, thousands or {",": ".", ".": ","}.get(decimal, ""))


def number_in(text: str, marks: Marks = POINT) -> float | None:
    """Return the finite number in a text; None for any other text, also for misplaced marks."""
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
    """Return the value of a text in its stated unit: a number, a number with its unit, or a flag.

    A unit with the same zero is converted (MW to kW).  Raises Unread.
    """
    number, lower_text, quoted = number_in(text, marks), text.strip().lower(), repr(text[:40])
    if number is None and meaning.unit in ("", "1"):
        number = FLAGS.get(lower_text)
    if number is not None:
        return number
    if meaning.unit in ("", "1") and lower_text in POLES:
        true_word = meaning.one or ("open" if meaning.signal == "door_open" else "")
        if true_word:
            return float(lower_text == true_word)
        raise Unread("unknown polarity", f'{quoted} may be 1 or 0: state one = "open" or "closed"')
    number_and_unit = _MEASURE.fullmatch(text.strip())
    unit = unit_named(number_and_unit[2]) if number_and_unit is not None else None
    number = (
        number_in(number_and_unit[1], marks) if number_and_unit is not None and unit is not None else None
    )
    if number is None or unit is None or not meaning.unit:
        raise Unread("no number", f"{quoted} is not a number")
    unit_of_text, stated_unit = UNITS[unit], UNITS[meaning.unit]
    if (unit_of_text.dimension, unit_of_text.offset) != (stated_unit.dimension, stated_unit.offset):
        raise Unread("other unit", f"{quoted} is in {unit}, not in {meaning.unit} as stated")
    return number if unit == meaning.unit else number * unit_of_text.factor / stated_unit.factor


def values_in(
    texts: pandas.Series, marks: Marks = POINT, meaning: Meaning = UNKNOWN_MEANING
) -> tuple[np.ndarray, dict[str, Unread]]:
    """Return the values (N,) of texts and numbers, and the texts without a value with the reasons.

    A text without a value gives NaN.
    """
    import pandas as pd

    with_points = texts
    if marks.decimal != ".":
        without_points = texts.where([not (isinstance(text, str) and "." in text) for text in texts])
        with_points = without_points.map(
            lambda text: text.replace(",", ".") if isinstance(text, str) else text
        )
    values = pd.to_numeric(with_points, errors="coerce").astype(float)
    value_of: dict[object, float] = {}
    refused: dict[str, Unread] = {}
    for text in texts[values.isna() & texts.notna()].unique():
        try:
            value_of[text] = value_in(str(text), marks, meaning)
        except Unread as reason:
            refused[text] = reason
    return values.fillna(texts.map(value_of).astype(float)).to_numpy(), refused


def evidence(texts: pandas.Series, mark: str) -> Literal["none", "decimal", "thousands", "either"]:
    """Decide whether a mark ("." or ",") is decimal or divides thousands in the texts (N,) of a column.

    The mark is decimal if a number does not have one to three digits before it and three after it, if a text
    without the mark reaches 1000, or if every text has the mark.  Otherwise both interpretations are tried:
    the right one makes the values jump less than half as far (in logarithms) where texts with and without the
    mark follow each other; "either" if none does.
    """
    import pandas as pd

    other_mark, escaped_mark = "," if mark == "." else ".", re.escape(mark)
    grouped = rf"[+-]?[1-9]\d{{0,2}}(?:{escaped_mark}\d{{3}})+(?:[{other_mark}]\d*)?"
    present_texts = texts.dropna().astype(str)
    if not present_texts.str.contains(mark, regex=False).any():
        return "none"
    for sample in (present_texts.iloc[:500], present_texts):  # in most columns the first 500 suffice
        number_texts = sample.str.extract(_BARE)[0].dropna()
        marked = number_texts.str.contains(mark, regex=False)
        if not number_texts[marked].str.fullmatch(grouped).all():
            return "decimal"
    if not marked.any():
        return "none"
    if (
        number_texts.str.contains(other_mark, regex=False).any()
        or (number_texts[marked].str.count(escaped_mark) > 1).any()
    ):
        return "thousands"
    thousands = pd.to_numeric(number_texts.str.replace(mark, "")).abs().to_numpy(float)
    is_positive, values_without_mark = thousands > 0.0, thousands[~marked]
    if not np.any(values_without_mark > 0.0) or np.any(values_without_mark >= 1e3):
        return "decimal"
    mark_changes = np.diff(marked.to_numpy()[is_positive])
    both_meanings = (thousands, thousands / np.where(marked, 1e3, 1.0))
    variation_as_thousands, variation_as_decimal = (
        np.sum(np.abs(np.diff(np.log(values[is_positive])))[mark_changes]) for values in both_meanings
    )
    if variation_as_thousands < 0.5 * variation_as_decimal:
        return "thousands"
    return "decimal" if variation_as_decimal < 0.5 * variation_as_thousands else "either"


def unit_among(texts: pandas.Series) -> str:
    """Return the unit after the number in most texts of a column, as `UNITS` names it; "" if there is
    none."""
    matches = [_MEASURE.fullmatch(text) for text in texts.dropna().iloc[:500].astype(str).str.strip()]
    units = [unit for match in matches if match and (unit := unit_named(match[2])) is not None]
    return max(set(units), key=units.count) if len(units) > 0.5 * len(matches) else ""


def flag_word(texts: pandas.Series) -> str:
    """Return the text that means 1 in a column of flags, "open" or "on"; "" for other columns."""
    distinct_words = {str(text).strip().lower() for text in texts.dropna().unique()[:9]}
    if not distinct_words or distinct_words - {*FLAGS, *POLES}:
        return ""
    return "open" if distinct_words & {*POLES} else "on"
