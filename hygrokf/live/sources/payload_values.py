"""Values of payloads: numbers, numbers with a unit, flags and times.  What is ambiguous is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo

from hygrokf.data.numbers import POINT, Marks, Meaning, Unread, number_in, value_in
from hygrokf.data.structured import Json
from hygrokf.data.timestamps import DAY_S, EXCEL, midnight_of
from hygrokf.live.sources.payload_formats import Order, Refused
from hygrokf.live.sources.payload_paths import LONGEST

AHEAD_S = 900.0
"""[s] a stamp may be ahead of this machine's clock."""
NEXT = 1.5
"""Steps of a series within which a stamp is its next one."""
UNIX_UNITS = ((1e11, 1.0), (1e14, 1e3), (1e17, 1e6), (math.inf, 1e9))
"""(below this number, units per second) of Unix times in s, ms, µs and ns.

From 1990 to 5138 the sizes of the four do not overlap.
"""


# -- numbers -------------------------------------------------------------------------------------------------
def number(raw: Json, marks: Marks = POINT) -> float | None:
    """A finite number, which may be written as text with these marks; None for anything else, including
    booleans."""
    if isinstance(raw, float):
        return raw if math.isfinite(raw) else None
    if isinstance(raw, str):
        return number_in(raw, marks) if len(raw) <= LONGEST else None
    if isinstance(raw, bool) or not isinstance(raw, int):
        return None
    try:
        return float(raw)
    except OverflowError:
        return None


def measured(raw: Json, meaning: Meaning, marks: Marks = POINT) -> float:
    """A number that `number` does not read: one with its unit, or a flag.  Raises Unread."""
    word = raw if isinstance(raw, str) else str(raw) if isinstance(raw, bool) else ""
    if not word or len(word) > LONGEST:
        raise Unread("no number", f"{quoted(raw)} is no number")
    return value_in(word, marks, meaning)


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


def seconds(
    stamp: Json,
    clock: Clock = STATED_OFFSETS,
    received: float = math.inf,
    order: Order | None = None,
    series: tuple[str, ...] = (),
) -> float | None:
    """Seconds since 1970 of a stamp; None if it is none.

    ISO 8601, the clock's own form, or a Unix time in s, ms, µs or ns.  In the hour that comes twice at the
    end of summer time a stamp is placed by the `order` of its `series`; none lies ahead of `received` [s].
    Raises Refused for a local time that does not exist, or that these do not tell apart.
    """
    if not clock.form and not (isinstance(stamp, str) and ":" in stamp):
        unix = number(stamp)
        if unix is not None:
            return unix if unix < 1e11 else unix / next(units for most, units in UNIX_UNITS if unix < most)
    elif clock.form and isinstance(stamp, int) and not isinstance(stamp, bool):
        stamp = str(stamp)  # such as 20260301121000
    days = number(stamp) if clock.form == EXCEL else None
    if days is not None and 0.0 < days < 1e5:
        at = datetime(1899, 12, 30) + timedelta(seconds=round(days * DAY_S))
        return None if clock.zone is None else _of_local(at, clock.zone, received, order, series)
    if clock.form == EXCEL or not isinstance(stamp, str) or len(stamp) > LONGEST:
        return None
    try:
        at = _read(stamp.strip(), clock.form)
        if at.tzinfo is not None:
            return at.astimezone(UTC).timestamp()
        return None if clock.zone is None else _of_local(at, clock.zone, received, order, series)
    except (ValueError, OverflowError):
        return None


def _read(text: str, form: str) -> datetime:
    """The time of a text; 24:00 is the next day's 00:00.  Raises ValueError."""
    try:
        return datetime.strptime(text, form) if form else datetime.fromisoformat(text)
    except ValueError:
        midnight = midnight_of(text, form)
        if midnight is None:
            raise
        return _read(midnight, form) + timedelta(days=1)


def _of_local(
    local: datetime, zone: tzinfo, received: float, order: Order | None, series: tuple[str, ...]
) -> float:
    """Seconds since 1970 of a local time in a zone.  Raises Refused."""
    first, second = (local.replace(tzinfo=zone, fold=fold).timestamp() for fold in (0, 1))
    if first > second:
        raise Refused(
            "no time",
            f"{local} does not exist in {zone}: summer time begins; if the clock does not follow it, "
            'state its fixed offset, such as timezone = "+01:00"',
        )
    newest, step = (order or {}).get(series, (math.nan, math.nan))
    if first < second <= received + AHEAD_S:  # else the second is still to come
        # the stamp repeats the newest of its series, or is the next one
        continued = [one for one in (first, second) if one == newest or 0.0 < one - newest <= NEXT * step]
        if len(continued) != 1:
            raise Refused(
                "ambiguous time",
                f"{local} comes twice in {zone}, and the order of its source does not tell which: stamps "
                "with an offset would",
            )
        first = continued[0]
    if order is not None and not first <= newest:
        order[series] = first, first - newest
    return first


def quoted(value: Json) -> str:
    """An external value for a message: shortened and quoted."""
    return repr(str(value)[:40])
