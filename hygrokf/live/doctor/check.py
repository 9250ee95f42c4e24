"""A result of the doctor: level, finding and remedy; and the checks that sources of every kind share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial

from hygrokf.data.timestamps import HOUR_S, duration_text
from hygrokf.identification.wording import one_line
from hygrokf.live.sources.payload_statistics import PayloadStatistics
from hygrokf.live.sources.payload_values import AHEAD_S

LEVELS = ("ok", "doubt", "fault")
CLOSE_S = 60.0
"""Tolerated difference of two clocks [s]."""
OLD_S = 2.0 * HOUR_S
"""Age [s] from which a file or a value may no longer be updated."""
LARGEST_ZONE_H = 14
SHARP_S = 300.0
"""Tolerance [s] within which a lag counts as whole hours."""


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
        return one_line(said)


ok, doubt, fault = (partial(Check, level) for level in LEVELS)
"""A check of each level: what it is about, what was found, and the remedy."""


def lasting(seconds: float) -> str:
    """A duration [s] as text, rounded to a useful precision."""
    return duration_text(max(float(round(seconds, 0 if seconds >= 10.0 else 1)), 0.0))


def worst(checks: Iterable[Check]) -> str:
    """The worst level of some checks; "ok" without any."""
    return max((one.level for one in checks), key=LEVELS.index, default=LEVELS[0])


# -- of sources ----------------------------------------------------------------------------------------------
def payload_checks(about: str, statistics: PayloadStatistics, what: str = "payloads") -> Iterator[Check]:
    """Whether payloads gave readings; no check without payloads."""
    if not statistics.payloads:
        return
    found = f"{statistics.used} of {statistics.payloads} {what} gave readings"
    if statistics.rejected:
        found += f"; not used: {statistics.rejected}"
    remedy = "compare [mapping] and known_as of each [[turbine]] with the delivered payloads"
    if not statistics.used:
        yield fault(about, found, remedy)
    elif statistics.rejected:
        yield doubt(about, found, remedy)
    else:
        yield ok(about, found)


def stamp_check(about: str, lag_s: float, lateness_s: float = math.inf, fresh: bool = True) -> Check | None:
    """Judge a source's clock by the lag [s] from its newest stamp to its arrival; None if the lag is not
    finite.

    `lateness_s`: tolerated lateness of readings [s]; without `fresh` an old stamp says nothing about the
    clock.
    """
    if not math.isfinite(lag_s):
        return None
    if lag_s < -CLOSE_S:
        found = f"its newest stamp is {lasting(-lag_s)} ahead of this machine's clock"
        remedy = "compare both clocks; stamps in local time need their offset from UTC"
        if lag_s < -AHEAD_S:
            return fault(about, f"{found}; readings more than {lasting(AHEAD_S)} ahead are held back", remedy)
        return doubt(about, found, remedy)
    found = f"its newest stamp is {lasting(max(lag_s, 0.0))} old"
    if not fresh:
        return ok(about, found)
    hours = round(lag_s / HOUR_S)
    if 1 <= hours <= LARGEST_ZONE_H and abs(lag_s - hours * HOUR_S) < SHARP_S:
        return doubt(
            about,
            f"{found} on arrival: {hours} whole hours",
            "check whether local time is stamped as UTC: stamps need their offset",
        )
    if lag_s > lateness_s:
        return doubt(
            about,
            f"{found} on arrival, more than the lateness allows ({lasting(lateness_s)})",
            "set the source's clock, or state a larger lateness if its readings do arrive so late",
        )
    return ok(about, found)


def server_check(about: str, difference_s: float) -> Check:
    """Judge a server's clock by its difference from this machine's clock [s]; positive if it is ahead."""
    if abs(difference_s) <= CLOSE_S:
        return ok(about, f"its clock agrees with this machine's within {CLOSE_S:.0f} s")
    side = "ahead of" if difference_s > 0.0 else "behind"
    said = f"its clock is {lasting(abs(difference_s))} {side} this machine's clock"
    return (fault if difference_s > AHEAD_S else doubt)(about, said, "synchronise both clocks by NTP")
