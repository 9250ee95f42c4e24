"""The terms of a verdict: its words, its reasons, and how results that use a number report its verdict."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias

from hygrokf.data.structured import structured
from hygrokf.identification.wording import UNBOUNDED, interval
from hygrokf.modelling.design import PARTS

Kind: TypeAlias = Literal["believe", "caution", "reject"]
BELIEVE: Final = "believe"
CAUTION: Final = "caution"
REJECT: Final = "reject"
VERDICTS: tuple[Kind, ...] = (BELIEVE, CAUTION, REJECT)
"""From best to worst."""
WORDS = {BELIEVE: "reliable", CAUTION: "with caution", REJECT: "not reliable"}
MARKS = {BELIEVE: "✓", CAUTION: "!", REJECT: "✕"}
PLAIN_MARKS = {BELIEVE: "+", CAUTION: "!", REJECT: "x"}
"""Marks for a terminal."""
PERIODS = ("validation", "identification")

QUANTITY_OF = {"thermal": "temperature_K", "hygric": "absolute_humidity_g_m3"}
PARAMETER_OF = {"thermal": "thermal_time_constant", "hygric": "hygric_k"}


@dataclass(frozen=True)
class Reason:
    """Evidence against a number: `code` for machines, `verdict` "caution" or "reject", `text` a sentence.

    `numbers` are the numbers behind it, by name.
    """

    code: str
    verdict: Kind
    text: str
    numbers: Mapping[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, str | float]:
        """The numbers stand beside the words."""
        return {"code": self.code, "verdict": self.verdict, "text": self.text, **self.numbers}

    @classmethod
    def from_json(cls, data: Mapping[str, str | float]) -> Reason:
        """A reason from the data of `to_json`.  Raises ValueError for an unknown verdict."""
        words = structured(_ReasonWords, data)
        numbers = {name: value for name, value in data.items() if name not in vars(words)}
        return cls(words.code, words.verdict, words.text, structured(dict[str, float], numbers))


@dataclass(frozen=True)
class _ReasonWords:
    code: str
    verdict: Kind
    text: str


class _InWords:
    """The words of a verdict and of the reasons against a number."""

    verdict: Kind
    reasons: tuple[Reason, ...]

    @property
    def words(self) -> str:
        """The verdict in words: "reliable", "with caution" or "not reliable"."""
        return WORDS[self.verdict]

    @property
    def sentence(self) -> str:
        """The verdict in one line: its words and the first reason."""
        return f"{self.words}: {self.why}" if self.reasons else self.words

    @property
    def why(self) -> str:
        """The first reason and the number of further ones; empty without a reason."""
        if not self.reasons:
            return ""
        more = len(self.reasons) - 1
        others = f" ({more} more reason{'s' if more > 1 else ''})" if more else ""
        return f"{self.reasons[0].text}{others}"


@dataclass(frozen=True)
class Verdict(_InWords):
    """Whether a number is reliable, and the reasons against it, the most serious first."""

    verdict: Kind = BELIEVE
    reasons: tuple[Reason, ...] = ()

    @classmethod
    def of(cls, reasons: Iterable[Reason]) -> Verdict:
        """The verdict of the most serious reason."""
        found = tuple(sorted(reasons, key=lambda one: -VERDICTS.index(one.verdict)))
        return cls(found[0].verdict if found else BELIEVE, found)


@dataclass(frozen=True)
class Inherited(_InWords):
    """A time constant [h] in a result that uses a fit: value, bounds, and the verdict with its reasons."""

    value_h: float = math.nan
    lower_h: float = math.nan
    upper_h: float = math.nan
    verdict: Kind = BELIEVE
    reasons: tuple[Reason, ...] = ()


def verdict_line(name: str, span: str, found: Verdict | Inherited) -> str:
    """One line with a number and its verdict; for a rejected number the verdict comes first."""
    if found.verdict != REJECT:
        return f"{name} {span}: {found.sentence}"
    words = "" if span.startswith(UNBOUNDED) else f" {found.words},"
    return f"{name}{words} {span}{f': {found.why}' if found.why else ''}"


def verdict_lines(inherited: Mapping[str, Inherited]) -> list[str]:
    """One line with a mark for each time constant that a result inherited, as all commands print it."""
    lines = []
    for part, one in inherited.items():
        value, bounds, _ = interval(one.value_h, one.lower_h, one.upper_h)
        span = f"{value} ({bounds})" if bounds else value
        lines.append(f"{PLAIN_MARKS[one.verdict]} {verdict_line(f'{part} time constant', span, one)}")
    return lines


def rests_on(inherited: Mapping[str, Inherited], parts: Collection[str] = PARTS) -> str:
    """A sentence for a result that rests on rejected time constants; empty where it does not.

    parts: those that the result rests on.
    """
    rejected = [part for part, one in inherited.items() if one.verdict == REJECT and part in parts]
    if not rejected:
        return ""
    several = len(rejected) > 1
    return (
        f"the model's {' and '.join(rejected)} time constant{'s' if several else ''}, on which this rests, "
        f"{'are' if several else 'is'} {WORDS[REJECT]}"
    )
