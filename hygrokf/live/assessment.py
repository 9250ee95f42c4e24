"""The state of a turbine from what is known of it, with the reason: nothing that is not assessed is "ok".

The states are those of `batch.STATES`, and the first one that applies is taken:

- *at risk*: condensation is likely now, by an estimate that is not old, or within the forecast;
- *alarm*: an alarm about the cabinet, its sensors or a clock is open; a notice is none;
- *stale*: the estimate is old, or an alarm about silent signals is open;
- *no estimate*: there is no probability of condensation, for the stated reason;
- *off*: condensation is unlikely, and the turbine has fed no power for `STANDSTILL_S`;
- *ok*: condensation is unlikely.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hygrokf.data.timestamps import HOUR_S
from hygrokf.live.alarms import CONDENSATION, MISSING, STALE
from hygrokf.live.batch import Alarm
from hygrokf.live.plan import Need
from hygrokf.texts.wording import stamp_text

STANDSTILL_S = HOUR_S
"""[s] without power after which a turbine counts as off."""
NOT_ASSESSED = "not assessed yet"
"""Reason of a turbine that was never assessed."""


@dataclass(frozen=True)
class Outlook:
    """Forecast probabilities of condensation (T,) [1] at times (T,) [s]."""

    time_s: np.ndarray
    condensation: np.ndarray

    def likely_s(self, now: float) -> float | None:
        """First time [s] after `now` at which condensation is likely; None if it is not."""
        likely = (self.time_s > now) & (self.condensation >= CONDENSATION.on)
        return float(self.time_s[np.argmax(likely)]) if likely.any() else None


@dataclass(frozen=True)
class Known:
    """What is known of a turbine.

    `known_s`: time [s] since when the tracker knows it; `heard`: signal → time [s] of its newest reading;
    `awaited`: what the model requires and has never come; `estimate_s`: time [s] of the newest estimate, None
    before the first; `condensation` [1]: its probability, None if it gives none; `with_humidity`: whether the
    model has humidity; `outlook`: the forecast; `alarms`: its open alarms; `standstill`:
    whether it has fed no power for `STANDSTILL_S`; `history_until_s`: time [s] until which
    readings must come before the first estimate; `fault`: why the filter cannot run; `catching_up`: whether
    a backlog is being delivered; `stale_s` [s]: age of stale data; `silent_s`: time [s] since when no sensor
    of the cabinet says anything, so that the estimates go on from the inputs alone, None if one does.
    """

    known_s: float
    heard: Mapping[str, float] = field(default_factory=dict)
    awaited: Sequence[Need] = ()
    estimate_s: float | None = None
    condensation: float | None = None
    with_humidity: bool = True
    outlook: Outlook | None = None
    alarms: Sequence[Alarm] = ()
    standstill: bool = False
    history_until_s: float | None = None
    fault: str = ""
    catching_up: bool = False
    stale_s: float = 2.0 * HOUR_S
    silent_s: float | None = None


def assess(known: Known, now: float) -> tuple[str, str]:
    """The state at `now` [s], one of `batch.STATES`, and its reason, with what the estimate lacks."""
    state, reason = _assess(known, now)
    return state, reason + _lacking(known, now)


def _lacking(known: Known, now: float) -> str:
    """The sensors of the cabinet that are silent while estimates go on, in words; empty if there is none."""
    if known.estimate_s is None:
        return ""
    if known.silent_s is not None:
        return f"; from the inputs alone since {stamp_text(known.silent_s)}"
    silent = [
        f"without {signal.replace('_', ' ')} since {stamp_text(at)}"
        for signal, at in sorted(known.heard.items())
        if signal.startswith("cabinet_") and known.estimate_s - at > known.stale_s
    ]
    return "".join(f"; {one}" for one in silent)


def _assess(known: Known, now: float) -> tuple[str, str]:
    for state, judge in _JUDGES:
        reason = judge(known, now)
        if reason:
            return state, reason
    now_and = "now" if known.outlook is None else "now and within the forecast"
    unlikely = f"condensation is unlikely {now_and}"
    power_s = known.heard.get("active_power", -math.inf)
    if known.standstill and now - power_s <= known.stale_s:
        return "off", f"the turbine feeds no power; {unlikely}"
    return "ok", unlikely


def _old(known: Known, now: float) -> bool:
    """Whether the newest estimate is too old to say something about now."""
    return known.estimate_s is not None and now - known.estimate_s > known.stale_s


def _at_risk(known: Known, now: float) -> str:
    chance = known.condensation
    if chance is not None and chance >= CONDENSATION.on and not _old(known, now):
        return "condensation is likely now"
    likely_s = None if known.outlook is None else known.outlook.likely_s(now)
    return "" if likely_s is None else f"condensation is likely from {stamp_text(likely_s)} on"


def _alarm(known: Known, now: float) -> str:
    unsaid = {STALE.kind} if known.estimate_s is not None else {STALE.kind, MISSING.kind}
    said = [one.kind for one in known.alarms if one.kind not in unsaid and one.severity != "notice"]
    return ", ".join(dict.fromkeys(said))


def _stale(known: Known, now: float) -> str:
    if known.estimate_s is None:
        return ""
    if _old(known, now):
        if known.catching_up:  # the time of the estimate changes with every delivery
            return "the estimate is old; a backlog is being delivered"
        return f"the estimate is from {stamp_text(known.estimate_s)}"
    return next((one.statement for one in known.alarms if one.kind == STALE.kind), "")


def _no_estimate(known: Known, now: float) -> str:
    if known.estimate_s is not None and known.condensation is not None:
        return "" if math.isfinite(known.condensation) else "the estimate is not a number"
    since = stamp_text(known.known_s)
    if not known.with_humidity:
        return "the model has no humidity"
    if not known.heard:
        return f"no reading has come since {since}"
    if known.awaited:
        names = " and ".join(one.words for one in known.awaited)
        return f"{names} never came since {since}"
    if known.fault:
        return f"the filter cannot run: {known.fault}"
    if known.history_until_s is not None:
        return f"waiting for history until {stamp_text(known.history_until_s)}"
    if known.estimate_s is None:
        return "its readings are not filtered yet"
    return "the estimate gives no probability of condensation"


_JUDGES = (("at risk", _at_risk), ("alarm", _alarm), ("stale", _stale), ("no estimate", _no_estimate))
"""States that need attention, with what gives their reason; empty if a state does not apply."""
