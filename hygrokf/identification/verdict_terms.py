"""The terms of a verdict: its words, its reasons, and how results that use a number report its verdict."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.parts import BOTH_PARTS, PARTS
from hygrokf.texts.reasons import BELIEVE, PLAIN_MARKS, REJECT, WORDS, Kind, Reason, VerdictCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import UNBOUNDED, WIDE, ends, plain_number

JUDGED_PERIODS = ("validation", "identification")

QUANTITY_OF = {part.name: part.scored for part in BOTH_PARTS}
PARAMETER_OF = {part.name: part.time_constant for part in BOTH_PARTS}


@dataclass(frozen=True)
class Interval:
    """A time constant [h] with its bounds; an open upper bound is NaN, an open lower one 0."""

    value_h: float = math.nan
    lower_h: float = math.nan
    upper_h: float = math.nan

    @property
    def closed(self) -> bool:
        """Whether the interval has both ends."""
        return math.isfinite(self.value_h) and 0 < self.lower_h < math.inf and math.isfinite(self.upper_h)

    @property
    def texts(self) -> tuple[str, str]:
        """Value and bounds as printed: ("1.49 h", "1.44 … 1.54").

        Open on one side: ("≤ 0.35 h", "best 0.1 h"); open on both: ("not identifiable", "best 9 h").
        """
        if self.closed:
            shown, span = ends(self.value_h, self.lower_h, self.upper_h)
            return f"{shown} h", span
        best = f"best {plain_number(self.value_h)} h" if math.isfinite(self.value_h) else ""
        for sign, bound in (("≤", self.upper_h), ("≥", self.lower_h)):
            if 0 < bound < math.inf:
                return f"{sign} {plain_number(bound)} h", best
        return UNBOUNDED, best

    @property
    def half_width(self) -> float:
        """Half the width of the interval relative to the value."""
        return 0.5 * (self.upper_h - self.lower_h) / self.value_h if self.value_h > 0 else math.inf

    @property
    def spread(self) -> Statement:
        """The size of a closed interval: "±3.5 %", or "a factor of 4.2" for a wide one."""
        if self.upper_h > WIDE * self.lower_h:
            return FitCode.WITHIN_FACTOR(factor=math.sqrt(self.upper_h / self.lower_h))
        code = FitCode.WITHIN_SMALL_SHARE if self.half_width < 0.095 else FitCode.WITHIN_SHARE
        return code(share=self.half_width)

    @property
    def span(self) -> str:
        """Value and bounds in one piece: "1.49 h (1.44 … 1.54)"."""
        value, bounds = self.texts
        return f"{value} ({bounds})" if bounds else value


@dataclass(frozen=True)
class Inherited(Interval):
    """A time constant [h] with the verdict on it and the reasons, the most serious first, as results that use
    a fit state it."""

    verdict: Kind = BELIEVE
    reasons: tuple[Reason, ...] = ()

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

    def line(self, part: str) -> tuple[str, str]:
        """The time constant of a part with its verdict in one line, and the number that the line discredits:
        empty unless it is rejected."""
        name = f"{part} time constant"
        if self.verdict == REJECT:
            return f"{name}, {self.sentence}", self.span
        return f"{name} {self.span}: {self.sentence}", ""


def verdict_lines(inherited: Mapping[str, Inherited]) -> list[str]:
    """One line with a mark for each time constant that a result inherited, as all commands print it."""
    return [
        f"{PLAIN_MARKS[one.verdict]} {' – '.join(filter(None, one.line(part)))}"
        for part, one in inherited.items()
    ]


def rests_on(inherited: Mapping[str, Inherited], parts: Collection[str] = PARTS) -> list[Statement]:
    """A statement for a result that rests on rejected time constants; none where it does not.

    parts: those that the result rests on.
    """
    rejected = tuple(name for name, entry in inherited.items() if entry.verdict == REJECT and name in parts)
    return [VerdictCode.RESTS_ON_REJECTED(parts=rejected, count=len(rejected))] if rejected else []
