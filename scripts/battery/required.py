"""What the battery must reach, and what it did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from battery.lines import (
    FULL,
    HALF,
    Line,
    answer,
    both_named,
    first_right,
    gain_share,
    names,
    of,
    strength_class,
)
from battery.rates import Rate, quantile, rate


@dataclass(frozen=True)
class Requirement:
    """A figure that was promised: `reached` of `n` cases; None where there is no case."""

    name: str
    reached: float | None
    n: int
    wanted: float
    at_most: bool = False

    @property
    def met(self) -> bool | None:
        if self.reached is None:
            return None
        return self.reached <= self.wanted if self.at_most else self.reached >= self.wanted


def requirements(lines: Sequence[Line]) -> list[Requirement]:
    """What the battery must reach on seeds that tuning never saw."""
    hidden = of(lines, "hidden")
    found = []

    def add(name: str, one: Rate, wanted: float, at_most: bool = False) -> None:
        found.append(Requirement(name, one.share, one.n, wanted, at_most))

    for strength, wanted in ((FULL, 0.95), (HALF, 0.8)):
        these = [line for line in hidden if strength_class(line) == strength]
        add(f"named first or in its class, {strength} strength", rate(first_right(o) for o in these), wanted)
    add("false alarms", rate(bool(names(line)) for line in of(lines, "none")), 0.05, True)
    other = of(lines, "convection")
    add("false alarms, cabinets of another make", rate(bool(names(line)) for line in other), 0.05, True)
    add("both of two causes", rate(both_named(line) for line in of(lines, "pair")), 0.8)
    add(
        "outside the library: unexplained",
        rate(answer(o) == "unexplained" for o in of(lines, "outside")),
        0.9,
    )
    shares = [share for line in hidden if (share := gain_share(line)) is not None]
    found.append(Requirement("median share of the attainable gain", quantile(shares, 0.5), len(shares), 0.8))
    ran = [line for line in lines if not line["skipped"]]
    add("failures", rate(bool(line["failure"]) for line in ran), 0.0, True)
    return found
