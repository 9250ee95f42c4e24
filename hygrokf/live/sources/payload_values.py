"""Values of payloads: numbers, numbers with a unit, flags and times.  What is ambiguous is refused."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo

from hygrokf.data.signals import unit_named
from hygrokf.data.structured import Json
from hygrokf.data.timestamps import HOUR_S
from hygrokf.live.sources.payload_formats import Refused
from hygrokf.live.sources.payload_paths import LONGEST

AHEAD_S = 900.0
"""[s] a stamp may be ahead of this machine's clock."""
FLAGS = {"true": 1.0, "false": 0.0}
UNIX_UNITS = ((1e11, 1.0), (1e14, 1e3), (1e17, 1e6), (math.inf, 1e9))
"""(below this number, units per second) of Unix times in s, ms, µs and ns.

From 1990 to 5138 the sizes of the four do not overlap.
"""
_MEASURE = re.compile(r"([+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*(\D\S*(?:\s\S+)?)")


# -- numbers -------------------------------------------------------------------------------------------------
def number(raw: Json, comma: bool = False) -> float | None:
    """A finite number, which may be written as text; None for anything else, including booleans.

    comma: whether texts have a decimal comma (and then no point).
    """
    if isinstance(raw, float):
        return raw if math.isfinite(raw) else None
    if isinstance(raw, str):
        # Python also reads 1_000, other scripts' digits, inf and nan
        if len(raw) > LONGEST or "_" in raw or not raw.isascii():
            return None
        if comma:
            raw = _with_point(raw)
    elif isinstance(raw, bool) or not isinstance(raw, int):
        return None
    try:
        found = float(raw)
    except (ValueError, OverflowError):
        return None
    return found if math.isfinite(found) else None


def measured(raw: Json, unit: str, is_flag: bool, comma: bool = False) -> float:
    """A number that `number` does not read: one with its unit, or true or false of a flag.

    Raises Refused.
    """
    if is_flag and isinstance(raw, bool | str):
        flag = FLAGS.get(str(raw).strip().lower())
        if flag is not None:
            return flag
    if isinstance(raw, str) and len(raw) <= LONGEST:
        found = _MEASURE.fullmatch((_with_point(raw) if comma else raw).strip())
        stated = unit_named(found[2]) if found is not None else None
        if found is not None and stated is not None:
            value = float(found[1])
            if stated != unit:
                raise Refused("other unit", f"{quoted(raw)} is in {stated}, the mapping says {unit}")
            if math.isfinite(value):
                return value
    raise Refused("no number", f"{quoted(raw)} is no number")


def _with_point(text: str) -> str:
    """A text with decimal comma as one with a point; empty if it has a point already, which may divide
    thousands."""
    return "" if "." in text else text.replace(",", ".", 1)


# -- times ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Clock:
    """How times are written: the `zone` of stamps without an offset (None: each must have one), and the
    strptime `form` of stamps that are not ISO 8601."""

    zone: tzinfo | None = None
    form: str = ""

    @property
    def words(self) -> str:
        """What is expected of a stamp, for messages."""
        if self.form:
            return repr(self.form)
        offset = "" if self.zone is not None else " with offset"
        return f"ISO 8601{offset} or as a Unix time in s, ms, µs or ns"


STATED_OFFSETS = Clock()
"""ISO 8601 with an offset, or Unix times."""


def seconds(stamp: Json, clock: Clock = STATED_OFFSETS, received: float = math.inf) -> float | None:
    """Seconds since 1970 of a stamp; None if it is none.

    ISO 8601, the clock's own form, or a Unix time in s, ms, µs or ns.  `received` [s] tells the two passes of
    the hour apart that comes twice at the end of summer time.  Raises Refused for a local time that does not
    exist, or that `received` does not tell apart.
    """
    if not clock.form and not (isinstance(stamp, str) and ":" in stamp):
        unix = number(stamp)
        if unix is not None:
            return unix if unix < 1e11 else _of_unix(unix)
    elif clock.form and isinstance(stamp, int) and not isinstance(stamp, bool):
        stamp = str(stamp)  # such as 20260301121000
    if not isinstance(stamp, str) or len(stamp) > LONGEST:
        return None
    text = stamp.strip()
    try:
        at = datetime.strptime(text, clock.form) if clock.form else datetime.fromisoformat(text)
        if at.tzinfo is not None:
            return at.astimezone(UTC).timestamp()
        return None if clock.zone is None else _of_local(at, clock.zone, received)
    except (ValueError, OverflowError):
        return None


def _of_unix(stamp: float) -> float:
    return stamp / next(units for most, units in UNIX_UNITS if stamp < most)


def _of_local(local: datetime, zone: tzinfo, received: float) -> float:
    """Seconds since 1970 of a local time in a zone.  Raises Refused."""
    first, second = (local.replace(tzinfo=zone, fold=fold).timestamp() for fold in (0, 1))
    if first == second:
        return first
    if first > second:
        raise Refused(
            "no time",
            f"{local} does not exist in {zone}: summer time begins; if the clock does not follow it, "
            'state its fixed offset, such as timezone = "+01:00"',
        )
    if second > received + AHEAD_S:
        return first
    if received - second >= HOUR_S - AHEAD_S:
        raise Refused(
            "ambiguous time",
            f"{local} comes twice in {zone}, and the payload is too old to tell which: stamps with an offset "
            "would",
        )
    return second


def quoted(value: Json) -> str:
    """An external value for a message: shortened and quoted."""
    return repr(str(value)[:40])
