"""Marks of quality beside readings: what they mean in each vocabulary, and which columns hold them."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hygrokf.texts.record import RecordCode
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
    """A mark as a whole number or a text in lower case; None where nothing is said."""
    text = str(mark).strip().lower()
    try:
        number = float(int(text, 16)) if text.startswith("0x") else float(text)
    except ValueError:
        return None if text in ("", "none", "null", "<na>", "nat") else text
    return int(number) if number.is_integer() else None if number != number else text


def _of_opc_da(number: int) -> bool:
    """Whether OPC Data Access 3.0, 6.8, defines quality and substatus of a number."""
    return 0 <= number <= 0xFFFF and number & 0xFC in _SUBSTATUS


def _of_opc_ua(number: int) -> bool:
    """Whether a number, perhaps with a sign, has the form of a StatusCode of OPC UA, part 4, 7.39."""
    code = number % 2**32
    form = code < 0xC0000000 and not code & 0x30000000 and (not code & 0xFFFF or code & 0x0C00 == 0x0400)
    return form and -(2**31) <= number < 2**32


def _is_flag(number: int) -> bool:
    return number in (0, 1)


@dataclass(frozen=True)
class QualityVocabulary:
    """Which marks mean good, uncertain or bad.

    outcomes: of a number after `mask`, or of a text. defines: whether the standard defines a number; a stated
    vocabulary judges other numbers too, but these speak against it. rest: outcome of further marks.
    """

    name: str
    outcomes: Mapping[int | str, str]
    mask: int = -1
    defines: Callable[[int], bool] = _is_flag
    rest: str = AMBIGUOUS

    def judge(self, mark: object) -> str:
        """The outcome of a mark; good where nothing is said."""
        key = _key(mark)
        if key is None:
            return GOOD
        if not self.name and isinstance(key, int):
            found = {one.judge(key) for one in VOCABULARIES.values() if one.defines(key)}
            return found.pop() if len(found) == 1 else AMBIGUOUS
        if isinstance(key, int) or self.rest == BAD:
            return self.outcomes.get(key & self.mask if isinstance(key, int) else key, self.rest)
        begins = (one for one in (GOOD, UNCERTAIN, BAD) if key.startswith(one))  # such as Bad_SensorFailure
        return _WORDS.get(key) or next(begins, AMBIGUOUS)


VOCABULARIES = {
    "opc-da": QualityVocabulary(
        "opc-da", {0xC0: GOOD, 0x40: UNCERTAIN, 0x80: BAD, 0x00: BAD}, 0xC0, _of_opc_da
    ),
    "opc-ua": QualityVocabulary(
        "opc-ua", {0: GOOD, 1 << 30: UNCERTAIN, 2 << 30: BAD, 3 << 30: BAD}, 3 << 30, _of_opc_ua
    ),
    "words": QualityVocabulary("words", {1: GOOD, 0: BAD}),
}
UNSTATED = QualityVocabulary("", {})
"""All vocabularies at once: an outcome holds if all that define a number agree."""


def stated_vocabulary(value: object) -> QualityVocabulary:
    """A vocabulary by its name, or from a list of good marks.  Raises ValueError."""
    if isinstance(value, str) and value in VOCABULARIES:
        return VOCABULARIES[value]
    if isinstance(value, list | tuple) and value:
        return QualityVocabulary(
            "its list", {key: GOOD for one in value if (key := _key(one)) is not None}, rest=BAD
        )
    known = ", ".join(f'"{one}"' for one in VOCABULARIES)
    raise ValueError(f"expected one of {known} or a list of good marks such as [1], found {value!r}")


def fitting(marks: Iterable[object]) -> tuple[str, ...]:
    """Names of the vocabularies that define all numbers among the marks and find a good one."""
    numbers = {one for one in map(_key, marks) if isinstance(one, int)}
    fits = {name: one for name, one in VOCABULARIES.items() if all(map(one.defines, numbers))}
    return tuple(name for name, one in fits.items() if GOOD in map(one.judge, numbers))


def advice(marks: Iterable[object]) -> Statement:
    """What to state for a column of marks."""
    seen = sorted({_key(one) for one in marks} - {None}, key=lambda one: (isinstance(one, str), one))
    shown = tuple(map(str, seen[:8]))
    more = (RecordCode.AND_MORE(),) if len(seen) > 8 else ()
    if fits := tuple(f'"{one}"' for one in fitting(seen)):
        return RecordCode.VOCABULARY_FITS(fits=fits, marks=shown, more=more)
    return RecordCode.NO_VOCABULARY_FITS(marks=shown, more=more)


def misfit(stated: QualityVocabulary, marks: Sequence[object]) -> Statement | None:
    """A doubt about a vocabulary that does not tell what all marks of a column mean."""
    fits = fitting(marks)
    wrong = bool(fits) and stated.name in VOCABULARIES and stated.name not in fits
    if not wrong and AMBIGUOUS not in map(stated.judge, marks):
        return None
    return RecordCode.QUALITY_MISFIT(advice=advice(marks))


# -- columns -------------------------------------------------------------------------------------------------
def _bare(name: str) -> str:
    """Letters and digits of a column's name, without a unit in brackets."""
    return re.sub(r"\[[^\]]*\]|\([^)]*\)|code|[\W_]", "", name.lower())


def quality_columns(names: Sequence[str], columns: Iterable[str]) -> dict[str, str]:
    """Column of readings -> the column among `names` that, by its name, holds their quality.

    That is one named after it ("Cabinet Temp Quality", "q_Tcab"), else the only one called quality, or the
    next one on its right if there are several.
    """
    bare = {_bare(name): name for name in reversed(names)}
    alone = [name for name in names if _bare(name) in (*_NAMES, "q")]
    right = dict(itertools.pairwise(names))
    found: dict[str, str | None] = {}
    for column in columns:
        stem, words = _bare(column), (*_NAMES, *_FURTHER_NAMES)
        named = (bare[one] for word in words for one in (stem + word, word + stem) if one in bare)
        beside = alone[0] if len(alone) == 1 else right.get(column)
        found[column] = next(named, beside if beside in alone else None)
    return {column: name for column, name in found.items() if name is not None and name != column}


def seems_quality(name: str, marks: Sequence[object]) -> bool:
    """Whether a column's marks are those of a vocabulary, or at least its name is certain."""
    known = AMBIGUOUS not in map(UNSTATED.judge, marks) or bool(fitting(marks))
    return len(marks) > 0 and (known or any(word in _bare(name) for word in _NAMES))


def unstated(column: str, name: str, marks: Sequence[object]) -> Statement | None:
    """The doubt about a quality that nobody stated; None where all marks are good, or where it is none."""
    outcomes = set(map(UNSTATED.judge, marks))
    if outcomes == {GOOD} or not seems_quality(name, marks):
        return None
    further = (RecordCode.FURTHER_ADVICE(advice=advice(marks)),) if AMBIGUOUS in outcomes else ()
    return RecordCode.QUALITY_UNSTATED(column=column, name=name, advice=further)


def drafted(
    marks: Mapping[str, Sequence[object]], columns: Iterable[str]
) -> tuple[dict[str, str], QualityVocabulary, tuple[Statement, ...]]:
    """Column of readings -> column of its quality, by names and marks; the vocabulary that fits; doubts.

    marks: different cells of every column of a table.
    """
    beside = quality_columns(list(marks), columns)
    beside = {one: of for one, of in beside.items() if one not in beside.values()}
    found = {
        one: of
        for one, of in beside.items()
        if seems_quality(of, marks[of]) and (fitting(marks[of]) or not misfit(UNSTATED, marks[of]))
    }
    doubts = [unstated(one, of, marks[of]) for one, of in beside.items() if one not in found]
    seen = [mark for of in dict.fromkeys(found.values()) for mark in marks[of]]
    fits = fitting(seen)
    if len(fits) > 1 or (fits and {*map(UNSTATED.judge, seen)} == {AMBIGUOUS}):
        doubts.append(RecordCode.QUALITY_MEANING(advice=advice(seen)))
    return found, VOCABULARIES[fits[0]] if fits else UNSTATED, tuple(filter(None, doubts))


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
    vocabulary: QualityVocabulary = UNSTATED
    use_uncertain: bool = True

    def beside(self, names: Sequence[str], columns: Sequence[str]) -> dict[str, str]:
        """Column of readings -> column of its quality, as stated or, by its name, among those of a table."""
        found = {one: of for one, of in quality_columns(names, columns).items() if names.count(of) == 1}
        found |= {one: of for one, of in self.columns.items() if of is not None}
        return {one: found[one] for one in columns if found.get(one)}

    def judged(self, column: str, name: str, marks: pandas.Series) -> MarkedReadings:
        """What the quality in a column says of a column of readings.

        marks: (N,).  A quality that nobody stated leaves all readings as they are, with a doubt.
        """
        import pandas as pd

        codes, seen = pd.factorize(marks)
        if self.columns.get(column) is None:
            return MarkedReadings(np.ones(len(marks), dtype=bool), (), unstated(column, name, list(seen)))
        outcome = np.array([*map(self.vocabulary.judge, seen), GOOD])[codes]
        counts, used = Counter(outcome.tolist()), (GOOD, UNCERTAIN) if self.use_uncertain else (GOOD,)
        said = [
            f"{counts[one]} {one} {'used' if one in used else 'left out'}"
            for one in (BAD, UNCERTAIN, AMBIGUOUS)
            if counts[one]
        ]
        warnings = (f'column "{column}": by "{name}" {", ".join(said)}',) if said else ()
        doubt = misfit(self.vocabulary, list(seen))
        if doubt is not None:
            doubt = RecordCode.QUALITY_OF_COLUMN(column=column, name=name, doubt=doubt)
        return MarkedReadings(np.isin(outcome, used), warnings, doubt)


NOTHING_STATED = StatedQuality()
