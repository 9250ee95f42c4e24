"""What operation may come: as on other days, as after other standstills that had lasted as long, or as it is now."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.record import Record, Series

DAY_S = 86400.0
STEP_S = 1800.0
"""[s] between the instants of an outlook."""
HORIZON_S = 48 * 3600.0
DAYS = 30
"""Days that are looked back on."""
LEAST = 5
"""Days that it takes at least."""
LEVEL_H = 4.0
"""[h] by which the power of now is forgotten."""
OPERATION = ("active_power", "preheating")

Courses = dict[str, np.ndarray]
"""Signal → values (H,) at the instants of an outlook."""


def values_at(series: Series, time: np.ndarray) -> np.ndarray:
    """Values at other times [s]; NaN outside the series and in gaps that the filter would not bridge either."""
    return at_times(series, time, bridge_h(series, AMBIENT_BRIDGE_H))


def values_held(series: Series, time: np.ndarray) -> np.ndarray:
    """The same, with the last reading held for as long as a gap is bridged."""
    known = series.time[~series.missing]
    if not len(known):
        return np.full(len(time), np.nan)
    stale = time > known[-1] + 3600.0 * bridge_h(series, AMBIENT_BRIDGE_H)
    return np.where(stale, np.nan, values_at(series, np.minimum(time, known[-1])))


def operation_ahead(
    history: Record, now_s: float, time: np.ndarray, days: Sequence[Courses], count: int
) -> tuple[list[Courses], str]:
    """So many courses of the days, in turn, with an operation that may follow that of now; and what it is, in words.

    `days`: earlier days at the outlook's instants `time` (H,) [s], with all that is not the ambient.
    """
    given = [days[i % len(days)] if days else {} for i in range(count)]
    names = [name for name in OPERATION if name in history and not history[name].missing.all()]
    past = {name: values_held(history[name], time) for name in names}
    known = [one for one in days if np.isfinite(one.get("active_power", np.nan)).all()]
    level = _level(past["active_power"], time, now_s) if "active_power" in past else np.nan
    if np.isnan(level) and len(known) < LEAST:
        off = {name: np.zeros(len(time)) for name in past if name == "preheating"}
        rest = [{n: v for n, v in one.items() if n not in OPERATION} for one in given]
        return [{**one, **off} for one in rest], "no power is known"
    if np.isnan(level):
        coming, said = (
            _as_on(known, given, names),
            "the power of now is not known: operation as on other days",
        )
    elif level <= 0.0:
        coming, said = _standing_still(history, now_s, time, given, names)
    else:
        alike = [one for one in known if _level(one["active_power"], time, now_s) > 0.0]
        coming, said = _running(alike, given, names, level, time, now_s)
    before = time <= now_s
    found = []
    for one, ahead in zip(given, coming, strict=True):
        joined = {n: np.where(before & np.isfinite(v), v, np.nan_to_num(ahead[n])) for n, v in past.items()}
        found.append({**one, **joined})
    return found, said


def _as_on(chosen: Sequence[Courses], given: Sequence[Courses], names: Sequence[str]) -> list[Courses]:
    """Each day's own operation if it is among the chosen ones, else that of one of them in turn."""
    own = {id(one) for one in chosen}
    sources = [one if id(one) in own else chosen[i % len(chosen)] for i, one in enumerate(given)]
    return [{name: one[name] for name in names} for one in sources]


def _running(
    alike: Sequence[Courses],
    given: Sequence[Courses],
    names: Sequence[str],
    level: float,
    time: np.ndarray,
    now_s: float,
) -> tuple[list[Courses], str]:
    """What follows where the turbine runs: days that began so, from today's level on."""
    if len(alike) < LEAST:
        steady = {n: np.full(len(time), level if n == "active_power" else 0.0) for n in names}
        return [steady] * len(given), "operation as it is now"
    found = _as_on(alike, given, names)
    for one in found:
        one["active_power"] = _joined(one["active_power"], level, time, now_s)
    return found, "operation as on days that began alike"


def _standing_still(
    history: Record, now_s: float, time: np.ndarray, given: Sequence[Courses], names: Sequence[str]
) -> tuple[list[Courses], str]:
    """What follows where the turbine stands still: what followed other standstills that had lasted as long, each of them
    as likely as that it is like none of them.

    Of that nothing is known but its age a: it lasts for another h with the probability a/(a + h), and then it is as on
    the day.
    """
    age_s, moments = _standstills(history, now_s)
    others = [{name: values_at(history[name], time - now_s + then) for name in names} for then in moments]
    others = [one for one in others if np.isfinite(one["active_power"]).all()]
    turn = len(others) + 1
    unlike = math.ceil(len(given) / turn)
    found = []
    for i, one in enumerate(given):
        if i % turn:
            found.append(others[i % turn - 1])
            continue
        share = (i // turn + 0.5) / unlike
        still = time <= now_s + age_s * (1.0 / share - 1.0)
        found.append({name: np.where(still, 0.0, one.get(name, 0.0)) for name in names})
    return found, f"standstill that may end, as {len(others)} others did that had lasted as long"


def _standstills(history: Record, now_s: float) -> tuple[float, list[float]]:
    """For how long [s] the turbine has stood still, and the times at which it had done so in earlier standstills."""
    time = now_s - STEP_S * np.arange(DAYS * DAY_S / STEP_S)[::-1]
    power = values_held(history["active_power"], time)
    still = power <= 0.0
    began = np.flatnonzero(still[1:] & (power[:-1] > 0.0)) + 1
    last = int(np.flatnonzero(~still).max(initial=-1)) + 1
    age = max(len(still) - 1 - last, 0)
    lasted = [b + age for b in began if b + age < len(still) and still[b : b + age + 1].all()]
    return STEP_S * max(age, 1), [float(time[m]) for m in lasted if time[m] + HORIZON_S <= now_s]


def _level(power: np.ndarray, time: np.ndarray, now_s: float) -> float:
    """Mean power [W] of the last hour; 0 where it stands still now, NaN where that is not known."""
    hour = power[(time > now_s - 3601.0) & (time <= now_s)]
    return 0.0 if hour[-1] <= 0.0 else float(np.mean(np.maximum(hour, 0.0)))


def _joined(power: np.ndarray, level: float, time: np.ndarray, now_s: float) -> np.ndarray:
    """Another day's power that begins at today's level; where that day stood still, this one does."""
    began = _level(power, time, now_s)
    fading = np.exp(-np.maximum(time - now_s, 0.0) / (3600.0 * LEVEL_H))
    # what runs goes on running: at least with a hundredth of what it fed then
    moved = np.clip(power + fading * (level - began), 0.01 * power, max(level, float(power.max())))
    return np.where((time > now_s) & (power > 0.0), moved, power)
