"""Marks of quality beside readings: what they mean in each vocabulary, and which columns hold them."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hygrokf.texts.record_codes import RecordCode
from hygrokf.texts.statement import Statement

if TYPE_CHECKING:
    import pandas

GOOD, UNCERTAIN, BAD, AMBIGUOUS = "good", "uncertain", "bad", "ambiguous"
"""Outcomes.  Ambiguous: vocabularies contradict each other, or none knows the mark."""
_WORDS = {
    **dict.fromkeys(("ok", "valid", "true", "normal"), GOOD),
    **dict.fromkeys(("questionable", "doubtful", "suspect", "substituted", "estimated"), UNCERTAIN),
    **dict.fromkeys(("invalid", "false", "error", "fault", "failed", "stale"), BAD),
}
_SUBSTATUS = frozenset((*range(0, 0x24, 4), 0x40, 0x44, 0x50, 0x54, 0x58, 0xC0, 0xD8))
_NAMES = ("quality", "qual", "qc", "qualität", "qualitaet", "güte", "质量")
_FURTHER_NAMES = ("status", "flag", "valid", "ok", "q")


def _key(mark: object) -> int | str | None:
    """A mark as a whole number or a text in lower case; None for an empty mark."""
    text = str(mark).strip().lower()
    try:
        number = float(int(text, 16)) if text.startswith("0x") else float(text)
    except ValueError:
        return None if text in ("", "none", "null", "<na>", "nat") else text
    if math.isnan(number):
        return None
    return int(number) if number.is_integer() else text


def _of_opc_da(number: int) -> bool:
    """Whether OPC Data Access 3.0, 6.8, defines quality and substatus of a number."""
    return 0 <= number <= 0xFFFF and number & 0xFC in _SUBSTATUS


def _of_opc_ua(number: int) -> bool:
    """Whether a signed or unsigned number has the form of a StatusCode of OPC UA, part 4, 7.39."""
    code = number % 2**32
    form = code < 0xC0000000 and not code & 0x30000000 and (not code & 0xFFFF or code & 0x0C00 == 0x0400)
    return form and -(2**31) <= number < 2**32


def _is_flag(number: int) -> bool:
    return number in (0, 1)


@dataclass(frozen=True)
class QualityVocabulary:
    """Which marks mean good, uncertain or bad.

    outcomes: outcome of each number, after `mask`, or text. defines: whether the standard defines a number; a
    stated vocabulary judges undefined numbers too, but they raise a doubt. rest: outcome of all other marks.
    """

    name: str
    outcomes: Mapping[int | str, str]
    mask: int = -1
    defines: Callable[[int], bool] = _is_flag
    rest: str = AMBIGUOUS

    def judge(self, mark: object) -> str:
        """The outcome of a mark; an empty mark is good."""
        key = _key(mark)
        if key is None:
            return GOOD
        if not self.name and isinstance(key, int):
            outcomes = {option.judge(key) for option in VOCABULARIES.values() if option.defines(key)}
            return outcomes.pop() if len(outcomes) == 1 else AMBIGUOUS
        if isinstance(key, int):
            return self.outcomes.get(key & self.mask, self.rest)
        if self.rest == BAD:
            return self.outcomes.get(key, self.rest)
        # such as Bad_SensorFailure
        by_prefix = (outcome for outcome in (GOOD, UNCERTAIN, BAD) if key.startswith(outcome))
        return _WORDS.get(key) or next(by_prefix, AMBIGUOUS)


VOCABULARIES = {
    "opc-da": QualityVocabulary(
        "opc-da", {0xC0: GOOD, 0x40: UNCERTAIN, 0x80: BAD, 0x00: BAD}, 0xC0, _of_opc_da
    ),
    "opc-ua": QualityVocabulary(
        "opc-ua", {0: GOOD, 1 << 30: UNCERTAIN, 2 << 30: BAD, 3 << 30: BAD}, 3 << 30, _of_opc_ua
    ),
    "words": QualityVocabulary("words", {1: GOOD, 0: BAD}),
}
UNSTATED_VOCABULARY = QualityVocabulary("", {})
"""All vocabularies at once: an outcome holds if all that define a number agree."""


def stated_vocabulary(value: object) -> QualityVocabulary:
    """A vocabulary by its name, or from a list of good marks.  Raises ValueError."""
    if isinstance(value, str) and value in VOCABULARIES:
        return VOCABULARIES[value]
    if isinstance(value, list | tuple) and value:
        return QualityVocabulary(
            "its list", {key: GOOD for mark in value if (key := _key(mark)) is not None}, rest=BAD
        )
    names = ", ".join(f'"{name}"' for name in VOCABULARIES)
    raise ValueError(f"expected one of {names} or a list of good marks such as [1], found {value!r}")


def fitting(marks: Iterable[object]) -> tuple[str, ...]:
    """Names of the vocabularies that define all numbers among the marks and find a good one."""
    numbers = {key for key in map(_key, marks) if isinstance(key, int)}
    candidates = {
        name: vocabulary for name, vocabulary in VOCABULARIES.items() if all(map(vocabulary.defines, numbers))
    }
    return tuple(name for name, vocabulary in candidates.items() if GOOD in map(vocabulary.judge, numbers))


def advice(marks: Iterable[object]) -> Statement:
    """What to state for a column of marks."""
    # numbers before texts
    keys = sorted({_key(mark) for mark in marks} - {None}, key=lambda key: (isinstance(key, str), key))
    shown = tuple(map(str, keys[:8]))
    more = (RecordCode.AND_MORE(),) if len(keys) > 8 else ()
    if fits := tuple(f'"{name}"' for name in fitting(keys)):
        return RecordCode.VOCABULARY_FITS(fits=fits, marks=shown, more=more)
    return RecordCode.NO_VOCABULARY_FITS(marks=shown, more=more)


def misfit(stated: QualityVocabulary, marks: Sequence[object]) -> Statement | None:
    """The doubt about a vocabulary that does not define all marks of a column; None if it does."""
    fits = fitting(marks)
    contradicts_stated = bool(fits) and stated.name in VOCABULARIES and stated.name not in fits
    if not contradicts_stated and AMBIGUOUS not in map(stated.judge, marks):
        return None
    return RecordCode.QUALITY_MISFIT(advice=advice(marks))


# -- columns -------------------------------------------------------------------------------------------------
def _bare(name: str) -> str:
    """Letters and digits of a column's name, without a unit in brackets."""
    return re.sub(r"\[[^\]]*\]|\([^)]*\)|code|[\W_]", "", name.lower())


def quality_columns(names: Sequence[str], columns: Iterable[str]) -> dict[str, str]:
    """Column of readings -> the column among `names` that, by its name, holds their quality.

    The quality column is named after the column of readings ("Cabinet Temp Quality", "q_Tcab").  Otherwise it
    is the only column called quality or, of several, the one directly to the right of the readings.
    """
    name_by_letters = {_bare(name): name for name in reversed(names)}
    called_quality = [name for name in names if _bare(name) in (*_NAMES, "q")]
    next_column = dict(itertools.pairwise(names))
    quality_of: dict[str, str | None] = {}
    for column in columns:
        stem, words = _bare(column), (*_NAMES, *_FURTHER_NAMES)
        named_after = (
            name_by_letters[candidate]
            for word in words
            for candidate in (stem + word, word + stem)
            if candidate in name_by_letters
        )
        beside = called_quality[0] if len(called_quality) == 1 else next_column.get(column)
        quality_of[column] = next(named_after, beside if beside in called_quality else None)
    return {column: name for column, name in quality_of.items() if name is not None and name != column}


def seems_quality(name: str, marks: Sequence[object]) -> bool:
    """Whether a column holds marks of quality: a vocabulary defines its marks, or its name says so."""
    fits_vocabulary = AMBIGUOUS not in map(UNSTATED_VOCABULARY.judge, marks) or bool(fitting(marks))
    return len(marks) > 0 and (fits_vocabulary or any(word in _bare(name) for word in _NAMES))


def unstated(column: str, name: str, marks: Sequence[object]) -> Statement | None:
    """The doubt about a quality column that is not stated; None if all its marks are good."""
    outcomes = set(map(UNSTATED_VOCABULARY.judge, marks))
    if outcomes == {GOOD} or not seems_quality(name, marks):
        return None
    more_advice = (RecordCode.FURTHER_ADVICE(advice=advice(marks)),) if AMBIGUOUS in outcomes else ()
    return RecordCode.QUALITY_UNSTATED(column=column, name=name, advice=more_advice)


def drafted(
    marks: Mapping[str, Sequence[object]], columns: Iterable[str]
) -> tuple[dict[str, str], QualityVocabulary, tuple[Statement, ...]]:
    """Column of readings -> column of its quality, by names and marks; the vocabulary that fits; doubts.

    marks: the distinct cells of every column of a table.
    """
    quality_of = quality_columns(list(marks), columns)
    quality_of = {column: name for column, name in quality_of.items() if column not in quality_of.values()}
    certain = {
        column: name
        for column, name in quality_of.items()
        if seems_quality(name, marks[name])
        and (fitting(marks[name]) or not misfit(UNSTATED_VOCABULARY, marks[name]))
    }
    doubts = [
        unstated(column, name, marks[name]) for column, name in quality_of.items() if column not in certain
    ]
    certain_marks = [mark for name in dict.fromkeys(certain.values()) for mark in marks[name]]
    fits = fitting(certain_marks)
    if len(fits) > 1 or (fits and {*map(UNSTATED_VOCABULARY.judge, certain_marks)} == {AMBIGUOUS}):
        doubts.append(RecordCode.QUALITY_MEANING(advice=advice(certain_marks)))
    return certain, VOCABULARIES[fits[0]] if fits else UNSTATED_VOCABULARY, tuple(filter(None, doubts))


class MarkedReadings(NamedTuple):
    """Readings by their quality: usable (N,), warnings with counts, and a doubt or None."""

    usable: np.ndarray
    warnings: tuple[str, ...]
    doubt: Statement | None


@dataclass(frozen=True)
class StatedQuality:
    """What a source states of the quality of its readings.

    columns: column of readings -> column of its quality, "" if it has none, None if nothing is stated.
    """

    columns: Mapping[str, str | None] = field(default_factory=dict)
    vocabulary: QualityVocabulary = UNSTATED_VOCABULARY
    use_uncertain: bool = True

    def beside(self, names: Sequence[str], columns: Sequence[str]) -> dict[str, str]:
        """Column of readings -> column of its quality: the stated one, else one of `names` by its name."""
        by_name = quality_columns(names, columns)
        quality_of = {column: name for column, name in by_name.items() if names.count(name) == 1}
        quality_of |= {column: name for column, name in self.columns.items() if name is not None}
        return {column: quality_of[column] for column in columns if quality_of.get(column)}

    def judged(self, column: str, name: str, marks: pandas.Series) -> MarkedReadings:
        """What the quality in a column says of a column of readings.

        marks: (N,).  A quality that is not stated excludes no reading and raises a doubt.
        """
        import pandas as pd

        codes, distinct = pd.factorize(marks)
        if self.columns.get(column) is None:
            return MarkedReadings(np.ones(len(marks), dtype=bool), (), unstated(column, name, list(distinct)))
        outcome = np.array([*map(self.vocabulary.judge, distinct), GOOD])[codes]
        counts = Counter(outcome.tolist())
        used_outcomes = (GOOD, UNCERTAIN) if self.use_uncertain else (GOOD,)
        counted = [
            f"{counts[kind]} {kind} {'used' if kind in used_outcomes else 'left out'}"
            for kind in (BAD, UNCERTAIN, AMBIGUOUS)
            if counts[kind]
        ]
        warnings = (f'column "{column}": by "{name}" {", ".join(counted)}',) if counted else ()
        doubt = misfit(self.vocabulary, list(distinct))
        if doubt is not None:
            doubt = RecordCode.QUALITY_OF_COLUMN(column=column, name=name, doubt=doubt)
        return MarkedReadings(np.isin(outcome, used_outcomes), warnings, doubt)


NOTHING_STATED = StatedQuality()
