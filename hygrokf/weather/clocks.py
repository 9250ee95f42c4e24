"""Check the clock of one weather source against another: right, off by a constant, or off in one season."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from hygrokf.data.clocks import in_america
from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S, MINUTE_S, modal_step
from hygrokf.weather.alignment import UNKNOWN, Alignment, Bounded, Lag, align

TOLERANCE_S = 20.0 * MINUTE_S
"""[s] largest lag that is not a clock error: slow housings, and fronts that reach the middle of a grid cell
before the site."""
APART_S = 60.0 * MINUTE_S
"""[s] largest difference between the lags from weather and mean day if a clock causes both."""
NOT_COMPARED = ("wind_direction", "rain")
"""Signals that are not compared: a direction has no mean, and rain differs between places."""
JUDGES = ("ambient_temperature", "global_horizontal_irradiance")
"""Signals whose mean day follows the sun everywhere; that of wind differs between heights and places."""


@dataclass(frozen=True)
class ClockError:
    """Error of one source's clock against another's.

    one, other: the sources. kind: "right", "constant", "seasonal", or "unclear": the lag is unknown, or
        weather and mean day disagree, as between distant places.
    winter, summer: [s] how much later readings of `one` are stamped; equal unless seasonal.
    alignments: the comparisons behind it, which have the lags from the mean day too.
    """

    one: str
    other: str
    kind: str
    winter: Bounded
    summer: Bounded
    alignments: tuple[Alignment, ...]

    @property
    def corrections_s(self) -> tuple[float, float]:
        """Corrections of the stamps of `one` in winter and in summer [s], rounded as by `rounded`."""
        if self.kind not in ("constant", "seasonal"):
            return 0.0, 0.0
        winter = rounded(-self.winter.value)
        return winter, winter if self.kind == "constant" else rounded(-self.summer.value)


def rounded(seconds: float) -> float:
    """A correction [s] rounded as clocks are set: 0 within 20 min, whole hours within 15 min, half hours
    within 10 min, otherwise to 5 min."""
    hour, half = 3600.0 * round(seconds / 3600.0), 1800.0 * round(seconds / 1800.0)
    if abs(seconds) <= TOLERANCE_S:
        return 0.0
    if abs(seconds - hour) <= 0.75 * TOLERANCE_S:
        return hour
    if abs(seconds - half) <= 0.5 * TOLERANCE_S:
        return half
    return 300.0 * round(seconds / 300.0)


def alignments(record: Record) -> tuple[Alignment, ...]:
    """Comparison of every `compared` series of a record with the series of the same signal that is used.

    The reference, `other` of an alignment, is the series with the longer step, such as a reanalysis; with
    equal steps it is the compared one.
    """
    found = []
    for other in record.compared:
        if other.signal not in record or other.signal in NOT_COMPARED:
            continue
        first, second = record[other.signal], other
        if modal_step(first.time)[0] > modal_step(second.time)[0]:
            first, second = second, first
        made = align(first, second, america=in_america(record))
        if made is not None:
            found.append(made)
    return tuple(found)


def clock_errors(found: Sequence[Alignment]) -> tuple[ClockError, ...]:
    """Errors of clocks, one for each pair of sources.

    found: of `alignments`. A clock has a constant error where the bounds of the weather's lag lie beyond
    20 min, and the mean day's lag has the same sign and differs by at most an hour.  The error is seasonal
    where both lags change by more than 20 min (mean day: 15 min) between winter and summer.  Where the mean
    day is unknown, for wind alone for instance, the weather's lag must exceed 30 min.
    """
    pairs: dict[tuple[str, str], list[Alignment]] = {}
    for one in found:
        pairs.setdefault((one.one, one.other), []).append(one)
    return tuple(_clock_error(one, other, tuple(ones)) for (one, other), ones in pairs.items())


def _clock_error(one: str, other: str, found: tuple[Alignment, ...]) -> ClockError:
    weather, day = dict[str, Bounded](), dict[str, Bounded]()
    judges = [each for each in found if each.signal in JUDGES]
    for name in ("whole", "winter", "summer"):
        lags: list[Lag | None] = [getattr(each, name) for each in found]
        weather[name] = _combined([lag.weather for lag in lags if lag is not None])
        lags = [getattr(each, name) for each in judges]
        day[name] = next((lag.mean_day for lag in lags if lag is not None and lag.mean_day.known), UNKNOWN)
    change = _combined([each.change for each in found])
    day_change = next((each.mean_day_change for each in judges if each.mean_day_change.known), UNKNOWN)
    if not weather["whole"].known and not (weather["winter"].known and weather["summer"].known):
        return ClockError(one, other, "unclear", UNKNOWN, UNKNOWN, found)
    seasonal = _beyond(change) and (
        not day_change.known
        or (day_change.value * change.value > 0 and abs(day_change.value) > 0.75 * TOLERANCE_S)
    )
    if seasonal and any(_off(weather[name], day[name]) for name in ("winter", "summer")):
        return ClockError(one, other, "seasonal", weather["winter"], weather["summer"], found)
    constant = not seasonal and _off(weather["whole"], day["whole"])
    kind = "constant" if constant else "unclear" if _beyond(weather["whole"]) or seasonal else "right"
    return ClockError(one, other, kind, weather["whole"], weather["whole"], found)


def _combined(estimates: Sequence[Bounded]) -> Bounded:
    """Mean of estimates of the same lag, weighted by inverse variance; its bounds include their spread."""
    known = [one for one in estimates if one.known]
    if len(known) < 2:
        return known[0] if known else UNKNOWN
    spread = [max((one.high - one.low) / 3.92, MINUTE_S) for one in known]
    weights = [1.0 / one**2 for one in spread]
    total = sum(weights)
    mean = sum(w * one.value for w, one in zip(weights, known, strict=True)) / total
    misfit = sum(w * (one.value - mean) ** 2 for w, one in zip(weights, known, strict=True)) / (
        len(known) - 1
    )
    half = 1.96 * math.sqrt(max(misfit, 1.0) / total)
    return Bounded(mean, mean - half, mean + half)


def _beyond(lag: Bounded, limit_s: float = TOLERANCE_S) -> bool:
    return lag.known and (lag.low > limit_s or lag.high < -limit_s)


def _off(weather: Bounded, day: Bounded) -> bool:
    """Whether the lags from weather and mean day both show a clock error."""
    if not day.known:
        return _beyond(weather, 1.5 * TOLERANCE_S)
    # a day later is the same phase: a clock that is off by half a day shows either sign
    turn = DAY_S * round((weather.value - day.value) / DAY_S)
    value, low, high = (one + turn for one in (day.value, day.low, day.high))
    same_side = weather.value * value > 0 and (low > 0.0 or high < 0.0)
    return _beyond(weather) and same_side and abs(weather.value - value) <= APART_S


def clock_sentences(errors: Sequence[ClockError], south: bool = False) -> list[str]:
    """Clock errors and their remedies, one sentence for each pair of sources; none for clocks that are right.

    south: whether the site lies in the southern hemisphere, where the seasons are exchanged.
    """
    return [_sentence(one, south) for one in errors if one.kind in ("constant", "seasonal")]


def _sentence(error: ClockError, south: bool) -> str:
    first, second = error.corrections_s
    if error.kind == "constant":
        return (
            f"the clock of {error.one} runs {pace(first)} against {error.other}: by their stamps the "
            f"weather comes {_late(error.winter)}; its stamps need {signed(first)}. If {error.other} is "
            f'right, state clock_correction = "{signed(first).replace(" ", "")}" in that source'
        )
    early, late = ("from November to March", "from April to October") if south else ("in winter", "in summer")
    return (
        f"the clock of {error.one} runs {pace(first)} {early} and {pace(second)} {late} against "
        f"{error.other}: by their stamps the weather comes {_late(error.winter)} {early} and "
        f"{_late(error.summer)} {late}; its stamps need {season_remedy(first, second, south)}"
    )


def season_remedy(winter_s: float, summer_s: float, south: bool = False) -> str:
    """What corrects a clock that needs one correction [s] in winter and another one in summer."""
    early, late = ("from November to March", "from April to October") if south else ("in winter", "in summer")
    needed = f"{signed(winter_s)} {early} and {signed(summer_s)} {late}"
    # the clock's summer time is the other season in the south
    change = winter_s - summer_s if south else summer_s - winter_s
    if abs(change - 3600.0) < 1.0:
        zone = "" if south else f": timezone = {_zone(winter_s)}"
        return (
            f"{needed}: it has no summer time although its stamps are read with it. Read them at the clock's "
            f"own fixed offset{zone}, with ignore_offset = true where the stamps carry offsets"
        )
    if abs(change + 3600.0) < 1.0:
        example = "Australia/Sydney" if south else "Europe/Berlin"
        return (
            f"{needed}: it follows summer time although its stamps are read at a fixed offset. State its "
            f'zone by name, such as timezone = "{example}"'
        )
    return needed


def _zone(winter_s: float) -> str:
    """The fixed offset of the clock in words, from the offset at which its stamps are read in winter."""
    if winter_s == 0.0:
        return "the offset of winter"
    sign, minutes = "+" if winter_s > 0 else "-", round(abs(winter_s) / MINUTE_S)
    return f'"UTC" if they are read at {sign}{minutes // 60:02d}:{minutes % 60:02d} in winter'


def pace(correction_s: float) -> str:
    """How a clock runs whose stamps need a correction [s], in words."""
    if correction_s == 0.0:
        return "right"
    return f"{_length(abs(correction_s))} {'slow' if correction_s > 0 else 'fast'}"


def signed(correction_s: float) -> str:
    """A correction [s] with its sign, such as "+2 h"."""
    return f"{'+' if correction_s >= 0 else '-'}{_length(abs(correction_s))}"


def _length(seconds: float) -> str:
    if seconds >= 3600.0 and seconds % 1800.0 == 0.0:
        return f"{seconds / 3600.0:g} h"
    return f"{seconds / 60.0:.0f} min"


def _late(lag: Bounded) -> str:
    """A lag in words: "54 min early (48 … 60)"."""
    ends = sorted(
        abs(end) / MINUTE_S if lag.low * lag.high > 0 else end / MINUTE_S for end in (lag.low, lag.high)
    )
    way = "late" if lag.value > 0 else "early"
    return f"{abs(lag.value) / MINUTE_S:.0f} min {way} ({ends[0]:.0f} … {ends[1]:.0f})"
