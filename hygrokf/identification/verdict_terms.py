"""The terms of a verdict: its words, its reasons, and the thresholds of evidence against a number."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias

from hygrokf.data.structured import structured

Kind: TypeAlias = Literal["believe", "caution", "reject"]
BELIEVE: Final = "believe"
CAUTION: Final = "caution"
REJECT: Final = "reject"
VERDICTS: tuple[Kind, ...] = (BELIEVE, CAUTION, REJECT)
"""From best to worst."""
WORDS = {BELIEVE: "to be believed", CAUTION: "with caution", REJECT: "not to be believed"}
MARKS = {BELIEVE: "✓", CAUTION: "!", REJECT: "✕"}
PLAIN_MARKS = {BELIEVE: "+", CAUTION: "!", REJECT: "x"}
"""Marks for a terminal."""
PERIODS = ("validation", "identification")

TIGHT = 0.25
"""[1] largest relative half-width of the interval of a well-determined time constant."""
DECADE = 10.0
"""[1] ratio of upper to lower bound above which not even the order of magnitude is known."""
CONTRADICTION = 2.0
"""[1] distance of the two criteria, in units of their joint uncertainty, above which they contradict each
other."""
SAYING = 3.0
"""[1] ratio of upper to lower bound of the free run's time constant below which it is informative."""
MATERIAL = 0.1
"""[1] relative difference of an error from a rule's error, or change of a time constant, that is worth
mentioning."""
CARRIES_OVER = 1.25
"""[1] largest ratio of validation to identification error of a model that generalises."""
COVERAGE = (0.90, 0.985)
"""[1] acceptable shares of readings within a 95 % band."""
FAILED = 0.5
"""[1] share within the free run's 95 % band below which the free run is unreliable."""
FEWEST_IN_BAND = 20
"""Fewest readings for a meaningful share within a band."""
SCATTER = 2.0
"""[1] ratio of the score's variance to the model's above which most of the scatter is not explained by the
model."""
STRETCHED = 3.0
"""[1] prior standard deviations above which a constant sensor error is no longer attributed to the sensor."""
PER_PARAMETER = 20.0
"""Readings per estimated parameter below which asymptotic bounds are doubtful."""
CONSTANTS = 20.0
"""[1] length of the identification period, in time constants, below which it cannot determine the time
constant."""
FORGOTTEN = 2.0
"""[1] step between readings, in time constants, above which they hardly show the decay: 14 % of a change is
left."""
PARTS_SCATTER = 2.0
"""[1] ratio of the scatter of estimates from quarters of the record to their bounds; exceeds 1.6 by chance in
5 %."""
CREDIBLE = 0.1
"""[1] weight above which another form of the model is considered."""

_OUTPUTS = {"thermal": "temperature", "hygric": "humidity"}
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
        said = structured(_Said, data)
        numbers = {name: value for name, value in data.items() if name not in vars(said)}
        return cls(said.code, said.verdict, said.text, structured(dict[str, float], numbers))


@dataclass(frozen=True)
class _Said:
    code: str
    verdict: Kind
    text: str


@dataclass(frozen=True)
class Verdict:
    """Whether a number can be believed, and the reasons against it, the most serious first."""

    verdict: Kind = BELIEVE
    reasons: tuple[Reason, ...] = ()

    @classmethod
    def of(cls, reasons: Iterable[Reason]) -> Verdict:
        """The worst reason decides."""
        found = tuple(sorted(reasons, key=lambda one: -VERDICTS.index(one.verdict)))
        return cls(found[0].verdict if found else BELIEVE, found)

    @property
    def words(self) -> str:
        """The verdict in words: "to be believed", "with caution" or "not to be believed"."""
        return WORDS[self.verdict]

    @property
    def sentence(self) -> str:
        """The words with the first reason: the form of a verdict that fits in one line."""
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
class Inherited:
    """A time constant [h] as results that use a fit hand it on: value, bounds, verdict and reasons."""

    value_h: float = math.nan
    lower_h: float = math.nan
    upper_h: float = math.nan
    verdict: Kind = BELIEVE
    reasons: tuple[Reason, ...] = ()

    @property
    def judged(self) -> Verdict:
        """The verdict with its reasons."""
        return Verdict(self.verdict, self.reasons)
