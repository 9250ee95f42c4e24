"""Marks of quality beside readings: what they mean in each vocabulary, and which columns hold them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas

GOOD, UNCERTAIN, BAD, AMBIGUOUS = "good", "uncertain", "bad", "ambiguous"
"""Outcomes.  Ambiguous: vocabularies contradict each other, or none knows the mark."""
_WORDS = {
    GOOD: ("ok", "valid", "true", "normal"),
    UNCERTAIN: ("questionable", "doubtful", "suspect", "substituted", "estimated"),
    BAD: ("invalid", "false", "error", "fault", "failed", "fail", "stale", "nok"),
}
_OF_WORD = {word: outcome for outcome, words in _WORDS.items() for word in words}
_UNSAID = ("", "nan", "none", "null", "<na>", "nat")


def _key(mark: object) -> int | str | None:
    """A mark as a whole number or a text in lower case; None where nothing is said."""
    text = str(mark).strip().lower()
    if text in _UNSAID:
        return None
    try:
        number = float(int(text, 16)) if text.startswith("0x") else float(text)
    except ValueError:
        return text
    return int(number) if number.is_integer() else text


@dataclass(frozen=True)
class QualityVocabulary:
    """Which marks mean good, uncertain or bad.

    outcomes: of a number after `mask`. defines: whether the standard defines a number; a stated vocabulary
    judges any other one after its mask too, but such numbers speak against it.  None: no standard.
    """

    name: str
    outcomes: Mapping[int, str]
    mask: int = -1
    defines: Callable[[int], bool] | None = None

    def judge(self, mark: object) -> str:
        """The outcome of a mark; good where nothing is said."""
        key = _key(mark)
        if isinstance(key, int):
            return self._of_number(key)
        if key is None:
            return GOOD
        begins = (one for one in (GOOD, UNCERTAIN, BAD) if key.startswith(one))  # such as Bad_SensorFailure
        return _OF_WORD.get(key) or next(begins, AMBIGUOUS)

    def _of_number(self, number: int) -> str:
        return self.outcomes.get(number & self.mask, AMBIGUOUS)


@dataclass(frozen=True)
class GoodMarks(QualityVocabulary):
    """A stated set of good marks; all others are bad."""

    name: str = "the stated marks"
    outcomes: Mapping[int, str] = field(default_factory=dict)
    marks: frozenset[int | str | None] = frozenset()

    def judge(self, mark: object) -> str:
        key = _key(mark)
        return GOOD if key is None or key in self.marks else BAD


class _Unstated(QualityVocabulary):
    """All vocabularies at once: an outcome holds if all that define a number agree."""

    def _of_number(self, number: int) -> str:
        found = {one.judge(number) for one in VOCABULARIES.values() if one.defines and one.defines(number)}
        return found.pop() if len(found) == 1 else AMBIGUOUS


def _of_opc_da(number: int) -> bool:
    """Whether quality (bits 7, 6) and substatus (5 … 2) are those of OPC Data Access 3.0, 6.8."""
    substatus = {0xC0: (0, 6), 0x40: (0, 1, 4, 5, 6), 0x00: range(9)}.get(number & 0xC0, ())
    return 0 <= number <= 0xFFFF and (number >> 2 & 0xF) in substatus


def _of_opc_ua(number: int) -> bool:
    """Whether a number has the form of a StatusCode of OPC UA, part 4, 7.39; it may have a sign."""
    code = number % 2**32
    form = code >> 30 != 3 and code & 0x30000000 == 0 and (code & 0xFFFF == 0 or code & 0x0C00 == 0x0400)
    return -(2**31) <= number < 2**32 and form


def _is_flag(number: int) -> bool:
    return number in (0, 1)


VOCABULARIES = {
    one.name: one
    for one in (
        QualityVocabulary("opc-da", {0xC0: GOOD, 0x40: UNCERTAIN, 0x80: BAD, 0: BAD}, 0xC0, _of_opc_da),
        QualityVocabulary(
            "opc-ua", {0: GOOD, 1 << 30: UNCERTAIN, 2 << 30: BAD, 3 << 30: BAD}, 3 << 30, _of_opc_ua
        ),
        QualityVocabulary("words", {1: GOOD, 0: BAD}, defines=_is_flag),
    )
}
"""Known vocabularies by name; all of them know words."""
UNSTATED = _Unstated("", {})


def stated_vocabulary(value: object) -> QualityVocabulary:
    """A vocabulary by its name, or from a list of good marks.  Raises ValueError."""
    if isinstance(value, str) and value in VOCABULARIES:
        return VOCABULARIES[value]
    if isinstance(value, list | tuple) and value:
        return GoodMarks(marks=frozenset(map(_key, value)))
    known = ", ".join(f'"{one}"' for one in VOCABULARIES)
    raise ValueError(f"expected one of {known} or a list of good marks such as [1], found {value!r}")


def fitting(marks: Iterable[object]) -> tuple[str, ...]:
    """Names of the vocabularies that define all numbers among the marks and find a good one."""
    numbers = {one for one in map(_key, marks) if isinstance(one, int)}
    return tuple(
        name
        for name, one in VOCABULARIES.items()
        if one.defines and numbers and all(map(one.defines, numbers)) and GOOD in map(one.judge, numbers)
    )


def advice(marks: Iterable[object]) -> str:
    """What to state for a column of marks, as a phrase."""
    seen = sorted({_key(mark) for mark in marks} - {None}, key=lambda one: (isinstance(one, str), one))
    shown = ", ".join(map(str, seen[:8])) + (" …" if len(seen) > 8 else "")
    fits = " or ".join(f'"{one}"' for one in fitting(seen))
    if not fits:
        return f"no known vocabulary fits {shown}: list the good marks, such as vocabulary = [1]"
    return f"state vocabulary = {fits}, which fits {shown}"


def misfit(stated: QualityVocabulary, marks: Sequence[object]) -> str:
    """What to state instead of a vocabulary that does not fit all marks of a column; "" if it may fit."""
    fits = fitting(marks)
    ambiguous = AMBIGUOUS in map(stated.judge, marks)
    wrong = ambiguous or (stated.defines is not None and bool(fits) and stated.name not in fits)
    return advice(marks) if wrong else ""


def drafted(marks: Sequence[object]) -> tuple[QualityVocabulary, str]:
    """The vocabulary of columns of marks, as far as these tell it, and a doubt or ""."""
    fits = fitting(marks)
    found = VOCABULARIES[fits[0]] if fits else UNSTATED
    sure = any(UNSTATED.judge(one) != AMBIGUOUS for one in marks if isinstance(_key(one), int))
    return found, "" if len(fits) == sure or not fits else f"the meaning of the quality: {advice(marks)}"


# -- columns -------------------------------------------------------------------------------------------------
_NAMES = ("quality", "qual", "qc", "qualität", "qualitaet", "güte", "质量")
_FURTHER = ("status", "flag", "valid", "ok", "q")
_UNITS = "deg[cfk]?|[ck]|pct|percent|[km]?w|mps|ms|k?pa|hpa"


def _words(name: str) -> tuple[str, ...]:
    """Words of a column's name, without a unit in brackets."""
    bare = re.sub(r"\[[^\]]*\]|\([^)]*\)", " ", name).replace("质量", " 质量 ")
    return tuple(re.findall(r"[^\W_]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z][a-z])", " ", bare).lower()))


def quality_columns(names: Sequence[str], columns: Iterable[str]) -> dict[str, str]:
    """Column of readings -> the column among `names` that, by its name, holds their quality.

    That is one named after it ("Cabinet Temp Quality", "q_Tcab"), else the only one called quality, or the
    next one on its right if there are several.
    """
    begins: dict[tuple[str, ...], str] = {}
    whole: dict[tuple[str, ...], str] = {}
    alone = []
    for number, name in enumerate(names):
        words = tuple(one for one in _words(name) if one not in ("code", "码"))
        if words == ("q",) or (words and words[0] in _NAMES and set(words[1:]) <= {"status", "flag"}):
            alone.append(number)
        for stem, word in ((words[:-1], words[-1:]), (words[1:], words[:1])):
            for among, known in ((begins, _NAMES), (whole, _FURTHER)):
                if stem and word[0] in known:
                    among.setdefault(stem, name)
    found: dict[str, str] = {}
    for column in columns:
        words = _words(column)
        bare = words[:-1] if len(words) > 1 and re.fullmatch(_UNITS, words[-1]) else words
        named = [begins.get(words[:count]) for count in range(len(words), 0, -1)]
        right = list(names).index(column) + 1 if column in names else -1
        beside = next(filter(None, (*named, whole.get(words), whole.get(bare))), None)
        if beside is None and (len(alone) == 1 or right in alone):
            beside = names[alone[0] if len(alone) == 1 else right]
        if beside is not None and beside != column:
            found[column] = beside
    return found


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
        stated = {one: name for one, name in self.columns.items() if name is not None}
        found = quality_columns(names, columns) | stated
        return {one: found[one] for one in columns if found.get(one)}

    def judged(self, column: str, name: str, marks: pandas.Series) -> Judged:
        """What the quality in a column says of a column of readings.

        marks: (N,).  A quality that nobody stated leaves all readings as they are, with a doubt.
        """
        import pandas as pd

        codes, seen = pd.factorize(marks)
        outcome = np.array([*map(self.vocabulary.judge, seen), GOOD])[codes]
        counts = Counter(outcome.tolist())
        stated, of = self.columns.get(column) is not None, f'column "{column}"'
        if not stated:
            doubt = unstated(column, name, list(seen))
            return Judged(np.ones(len(marks), dtype=bool), (), doubt, counts[GOOD] < len(marks))
        usable = (outcome == GOOD) | ((outcome == UNCERTAIN) & self.use_uncertain)
        said = [
            f"{counts[one]} {one} {'used' if one == UNCERTAIN and self.use_uncertain else 'left out'}"
            for one in (BAD, UNCERTAIN, AMBIGUOUS)
            if counts[one]
        ]
        warnings = (f'{of}: readings by their quality in "{name}": {", ".join(said)}',) if said else ()
        better = misfit(self.vocabulary, list(seen))
        doubt = f'{of}: the vocabulary does not tell what all marks in "{name}" mean: {better}'
        return Judged(usable, warnings, doubt if better else "")


NOTHING_STATED = StatedQuality()


@dataclass(frozen=True)
class Judged:
    """Readings by their quality: usable (N,), warnings with counts, and a doubt or "", which `matters` to
    what follows from the readings."""

    usable: np.ndarray
    warnings: tuple[str, ...]
    doubt: str
    matters: bool = True


def unstated(column: str, name: str, marks: Sequence[object]) -> str:
    """The doubt about a quality that nobody stated, or "" where its marks show that it is none."""
    outcomes = set(map(UNSTATED.judge, marks))
    if not outcomes or (AMBIGUOUS in outcomes and not fitting(marks) and not set(_NAMES) & {*_words(name)}):
        return ""  # such as the state of a machine
    return (
        f'column "{column}": "{name}" beside it seems to hold its quality, which is not used: state '
        f'quality = "{name}", or "" if it is none'
        + ("" if outcomes <= {GOOD, BAD, UNCERTAIN} else f"; {advice(marks)}")
    )
