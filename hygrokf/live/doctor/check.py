"""What the doctor says of one thing: fine, doubtful or at fault, what was found, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from hygrokf.data.timestamps import duration_text

LEVELS = ("ok", "doubt", "fault")
NAMED = 5
"""Names of a list that are told; of the others only how many there are."""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at: its `level` of `LEVELS`, what it is `about`, what was `found`, and its `remedy`."""

    level: str
    about: str
    found: str
    remedy: str = ""

    def __str__(self) -> str:
        said = f"{self.level:5}  {self.about}: {self.found}" + (f"; to do: {self.remedy}" * bool(self.remedy))
        return "".join(c if c.isprintable() else " " for c in said)


def ok(about: str, found: str) -> Check:
    return Check("ok", about, found)


def doubt(about: str, found: str, remedy: str) -> Check:
    return Check("doubt", about, found, remedy)


def fault(about: str, found: str, remedy: str) -> Check:
    return Check("fault", about, found, remedy)


def several(names: Iterable[str]) -> str:
    """Names in one line, of many the first."""
    found: Sequence[str] = list(names)
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return f"{', '.join(found[:NAMED])}{more}"


def lasting(seconds: float) -> str:
    """A duration [s] in words, without what is too small to matter."""
    return duration_text(max(float(round(seconds, 0 if seconds >= 10.0 else 1)), 0.0))


def worst(checks: Iterable[Check]) -> str:
    """The worst level; "ok" without any."""
    return max((one.level for one in checks), key=LEVELS.index, default=LEVELS[0])
