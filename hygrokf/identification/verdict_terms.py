"""The nouns of a verdict: its words, its reasons, and the thresholds from which something speaks against a number."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from hygrokf.data.lookup import number
from hygrokf.identification.wording import text_of

BELIEVE, CAUTION, REJECT = "believe", "caution", "reject"
VERDICTS = (BELIEVE, CAUTION, REJECT)
"""From the best to the worst."""
WORDS = {BELIEVE: "to be believed", CAUTION: "with caution", REJECT: "not to be believed"}
MARKS = {BELIEVE: "✓", CAUTION: "!", REJECT: "✕"}
PLAIN_MARKS = {BELIEVE: "+", CAUTION: "!", REJECT: "x"}
"""Marks for a terminal."""
PERIODS = ("validation", "identification")

TIGHT = 0.25
"""[1] half-width of the interval, relative to the value, up to which a time constant counts as pinned down."""
DECADE = 10.0
"""[1] upper over lower bound from which not even the order of magnitude is known."""
CONTRADICTION = 2.0
"""[1] distance of the two criteria, in units of what both uncertainties explain, from which they contradict each other."""
SAYING = 3.0
"""[1] upper over lower bound of the free run's time constant below which it says something."""
MATERIAL = 0.1
"""[1] share by which an error must differ from a rule's, or a time constant change, to be worth a word."""
CARRIES_OVER = 1.25
"""[1] error in validation over error in identification up to which a model carries over."""
COVERAGE = (0.90, 0.985)
"""[1] shares within a 95 % band between which it is called right."""
FAILED = 0.5
"""[1] share within the free run's 95 % band below which the free run is not to be relied on."""
FEWEST_IN_BAND = 20
"""Readings from which the share in a band says something."""
SCATTER = 2.0
"""[1] variance of the score over what the model says, from which most of what moves the estimate is not in the model."""
STRETCHED = 3.0
"""[1] standard deviations of its prior beyond which a sensor's error is no error of the sensor."""
PER_PARAMETER = 20.0
"""Readings for each estimated parameter below which bounds from asymptotic theory are doubtful."""
CONSTANTS = 20.0
"""[1] length of the identification period in time constants below which it determines none."""
FORGOTTEN = 2.0
"""[1] step between readings in time constants from which they hardly show how the cabinet forgets: 14 % of it is left."""
PARTS_SCATTER = 2.0
"""[1] scatter of the estimates from quarters of the record over what their bounds explain; above 1.6 by chance in 5 %."""
CREDIBLE = 0.1
"""[1] weight from which another form of the model is to be reckoned with."""

_OUTPUTS = {"thermal": "temperature", "hygric": "humidity"}
QUANTITY_OF = {"thermal": "temperature_K", "hygric": "absolute_humidity_g_m3"}
PARAMETER_OF = {"thermal": "thermal_time_constant", "hygric": "hygric_k"}


@dataclass(frozen=True)
class Reason:
    """What speaks against a number: `code` for machines, `verdict` "caution" or "reject", `text` a sentence.

    `numbers` those that it rests on, by name.
    """

    code: str
    verdict: str
    text: str
    numbers: Mapping[str, float] = field(default_factory=dict)

    def to_json(self) -> dict:
        """Plain data; numbers that are not finite are null."""
        known = {name: value if math.isfinite(value) else None for name, value in self.numbers.items()}
        return {"code": self.code, "verdict": self.verdict, "text": self.text, **known}

    @classmethod
    def from_json(cls, data: Mapping) -> Reason:
        """A reason from what `to_json` gave."""
        said = {"code", "verdict", "text"}
        known = {str(name): number(data, name) for name in data if name not in said}
        verdict = data.get("verdict")
        return cls(
            text_of(data.get("code")),
            verdict if verdict in (CAUTION, REJECT) else CAUTION,
            text_of(data.get("text")),
            known,
        )


@dataclass(frozen=True)
class Verdict:
    """Whether a number can be believed, and the reasons against it, the gravest first."""

    verdict: str = BELIEVE
    reasons: tuple[Reason, ...] = ()

    @classmethod
    def of(cls, reasons: Iterable[Reason]) -> Verdict:
        """The worst reason decides."""
        found = tuple(sorted(reasons, key=lambda one: -VERDICTS.index(one.verdict)))
        return cls(found[0].verdict if found else BELIEVE, found)

    @property
    def words(self) -> str:
        """ "to be believed", "with caution", "not to be believed"."""
        return WORDS[self.verdict]

    @property
    def sentence(self) -> str:
        """The words with the first reason: the one way in which a verdict is told in a line."""
        return f"{self.words}: {self.why}" if self.reasons else self.words

    @property
    def why(self) -> str:
        """The first reason, and how many more there are; nothing where there is none."""
        if not self.reasons:
            return ""
        more = len(self.reasons) - 1
        others = f" ({more} more reason{'s' if more > 1 else ''})" if more else ""
        return f"{self.reasons[0].text}{others}"

    def to_json(self) -> dict:
        return {"verdict": self.verdict, "reasons": [one.to_json() for one in self.reasons]}

    @classmethod
    def from_json(cls, data: Mapping) -> Verdict:
        """A verdict from what `to_json` gave.  Raises ValueError for a word that is no verdict."""
        found, reasons = data.get("verdict"), data.get("reasons")
        if found not in VERDICTS:
            raise ValueError(f"expected one of {', '.join(VERDICTS)}, found {found!r}")
        rows = reasons if isinstance(reasons, (list, tuple)) else ()
        return cls(found, tuple(Reason.from_json(row) for row in rows if isinstance(row, Mapping)))
