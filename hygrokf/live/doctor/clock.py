"""Clocks: this machine's, and what the stamps of a source say of the source's."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from hygrokf.live.doctor.check import Check, doubt, fault, lasting, ok
from hygrokf.live.sources.payload import AHEAD_S

CLOSE_S = 60.0
"""[s] by which two clocks may differ."""
JUMP_S = 0.5
"""[s] by which this machine's clock may move against the time that passes."""
HOUR_S = 3600.0
LARGEST_ZONE_H = 14
SHARP_S = 300.0
"""[s] within which a lag is that of a whole hour."""
_ERROR = 5
"""What adjtimex answers where the kernel's clock is not synchronised."""
_SET = "let this machine's clock be set by NTP (timedatectl set-ntp true, or chrony)"


@dataclass(frozen=True)
class Watch:
    """This machine's clock beside the time that passes, from now on."""

    begin: float = field(default_factory=lambda: time.time() - time.monotonic())

    @property
    def jump_s(self) -> float:
        """[s] by which the clock was set since then."""
        return time.time() - time.monotonic() - self.begin


def synchronised() -> bool | None:
    """Whether something keeps this machine's clock, as its kernel knows; None where it does not say."""
    try:
        read = ctypes.CDLL(None).adjtimex
    except (OSError, TypeError, AttributeError):
        return None
    state = read(ctypes.create_string_buffer(512))  # all zero: nothing is set
    return None if state < 0 else state != _ERROR


def machine_checks(watch: Watch, received_s: float) -> Iterator[Check]:
    """This machine's clock; `received_s` [s] when the store's newest reading was received (−∞: unknown)."""
    jump_s, known, before = watch.jump_s, synchronised(), time.time() - received_s
    if abs(jump_s) > JUMP_S:
        yield doubt("clock", f"it was set by {jump_s:+.1f} s during this examination", _SET)
    if before < -CLOSE_S:
        yield fault(
            "clock",
            f"the store has readings that were received {lasting(-before)} from now: it was ahead then, or is behind now",
            _SET,
        )
    if known is False:
        yield doubt("clock", "nothing keeps it, as the kernel says", _SET)
    elif abs(jump_s) <= JUMP_S and before >= -CLOSE_S:
        yield ok(
            "clock",
            "it is kept by NTP" if known else "it runs evenly; whether something keeps it is not known",
        )


def stamp_check(about: str, lag_s: float, lateness_s: float = math.inf, fresh: bool = True) -> Check | None:
    """What the lag [s] from a newest stamp to its arrival says; None without any.

    `lateness_s` [s] by which readings may come later than others; without `fresh` an old stamp says nothing of the clock.
    """
    if not math.isfinite(lag_s):
        return None
    if lag_s < -CLOSE_S:
        found = f"its newest stamp is {lasting(-lag_s)} ahead of the clock here"
        remedy = "compare both clocks; stamps need their offset from UTC, and local time is not UTC"
        if lag_s < -AHEAD_S:
            return fault(about, f"{found}; beyond {lasting(AHEAD_S)} readings are refused", remedy)
        return doubt(about, found, remedy)
    found = f"its newest stamp is {lasting(max(lag_s, 0.0))} old"
    if not fresh:
        return ok(about, found)
    hours = round(lag_s / HOUR_S)
    if 1 <= hours <= LARGEST_ZONE_H and abs(lag_s - hours * HOUR_S) < SHARP_S:
        return doubt(
            about,
            f"{found} as it arrives, {hours} whole hours",
            "look whether local time is stamped as UTC: stamps need their offset",
        )
    if lag_s > lateness_s:
        return doubt(
            about,
            f"{found} as it arrives, more than lateness allows ({lasting(lateness_s)})",
            "set the source's clock; where its readings do come so late, state a larger lateness",
        )
    return ok(about, found)


def server_check(about: str, difference_s: float) -> Check:
    """A server's clock that differs from the one here by so much [s]; above 0 it is ahead."""
    if abs(difference_s) <= CLOSE_S:
        return ok(about, f"its clock is that of this machine to {CLOSE_S:.0f} s")
    side = "ahead of" if difference_s > 0.0 else "behind"
    said = f"its clock is {lasting(abs(difference_s))} {side} the one here"
    return (fault if difference_s > AHEAD_S else doubt)(about, said, "let both clocks be set by NTP")
