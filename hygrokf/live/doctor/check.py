"""A result of the doctor: level, finding and remedy."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from hygrokf.data.timestamps import duration_text

LEVELS = ("ok", "doubt", "fault")


@dataclass(frozen=True)
class Check:
    """The result of one check: its `level` (see `LEVELS`), what it is `about`, what was `found`, and the
    `remedy`."""

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


def lasting(seconds: float) -> str:
    """A duration [s] as text, rounded to a useful precision."""
    return duration_text(max(float(round(seconds, 0 if seconds >= 10.0 else 1)), 0.0))


def worst(checks: Iterable[Check]) -> str:
    """The worst level of some checks; "ok" without any."""
    return max((one.level for one in checks), key=LEVELS.index, default=LEVELS[0])
