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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from hygrokf.data.timestamps import HOUR_S
from hygrokf.live.alarms import CONDENSATION, MISSING, STALE
from hygrokf.live.batch import Alarm
from hygrokf.live.plan import Need
from hygrokf.texts.live_codes import StateCode
from hygrokf.texts.statement import Statement

STANDSTILL_S = HOUR_S
"""[s] without power after which a turbine counts as off."""
Reasons: TypeAlias = tuple[Statement, ...]
"""Why a turbine is in a state."""


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


def assess(known: Known, now: float) -> tuple[str, Reasons]:
    """The state at `now` [s], one of `batch.STATES`, and its reason, with what the estimate lacks."""
    state, reason = _assess(known, now)
    return state, (*reason, *_lacking(known))


def _lacking(known: Known) -> Iterator[Statement]:
    """The sensors of the cabinet that are silent while estimates go on."""
    if known.estimate_s is None:
        return
    if known.silent_s is not None:
        yield StateCode.FROM_INPUTS_ALONE(since=known.silent_s)
        return
    for signal, at in sorted(known.heard.items()):
        if signal.startswith("cabinet_") and known.estimate_s - at > known.stale_s:
            yield StateCode.WITHOUT_SIGNAL(signal=signal, since=at)


def _assess(known: Known, now: float) -> tuple[str, Reasons]:
    for state, judge in _JUDGES:
        if reasons := judge(known, now):
            return state, reasons
    unlikely = StateCode.CONDENSATION_UNLIKELY_AHEAD()
    if known.outlook is None:
        unlikely = StateCode.CONDENSATION_UNLIKELY_NOW()
    power_s = known.heard.get("active_power", -math.inf)
    if known.standstill and now - power_s <= known.stale_s:
        return "off", (StateCode.FEEDS_NO_POWER(), unlikely)
    return "ok", (unlikely,)


def _old(known: Known, now: float) -> bool:
    """Whether the newest estimate is too old to say something about now."""
    return known.estimate_s is not None and now - known.estimate_s > known.stale_s


def _at_risk(known: Known, now: float) -> Reasons:
    chance = known.condensation
    if chance is not None and chance >= CONDENSATION.on and not _old(known, now):
        return (StateCode.CONDENSATION_LIKELY_NOW(),)
    likely_s = None if known.outlook is None else known.outlook.likely_s(now)
    return () if likely_s is None else (StateCode.CONDENSATION_LIKELY_FROM(at=likely_s),)


def _alarm(known: Known, now: float) -> Reasons:
    untold = {STALE.kind} if known.estimate_s is not None else {STALE.kind, MISSING.kind}
    kinds = [one.kind for one in known.alarms if one.kind not in untold and one.severity != "notice"]
    return (StateCode.ALARMS_OPEN(kinds=tuple(dict.fromkeys(kinds))),) if kinds else ()


def _stale(known: Known, now: float) -> Reasons:
    if known.estimate_s is None:
        return ()
    if _old(known, now):
        if known.catching_up:  # the time of the estimate changes with every delivery
            return (StateCode.ESTIMATE_OLD_IN_BACKLOG(),)
        return (StateCode.ESTIMATE_OLD(at=known.estimate_s),)
    return next((one.statements for one in known.alarms if one.kind == STALE.kind), ())


def _no_estimate(known: Known, now: float) -> Reasons:
    reason = _why_none(known)
    return () if reason is None else (reason,)


def _why_none(known: Known) -> Statement | None:
    """Why there is no probability of condensation; None if there is one."""
    if known.estimate_s is not None and known.condensation is not None:
        return None if math.isfinite(known.condensation) else StateCode.ESTIMATE_NOT_A_NUMBER()
    if not known.with_humidity:
        return StateCode.MODEL_WITHOUT_HUMIDITY()
    if not known.heard:
        return StateCode.NO_READING_YET(since=known.known_s)
    if known.awaited:
        quantities = tuple(one.quantity for one in known.awaited)
        return StateCode.INPUTS_NEVER_CAME(quantities=quantities, since=known.known_s)
    if known.fault:
        return StateCode.FILTER_FAILS(fault=known.fault)
    if known.history_until_s is not None:
        return StateCode.HISTORY_AWAITED(until=known.history_until_s)
    return StateCode.NOT_FILTERED_YET() if known.estimate_s is None else StateCode.NO_PROBABILITY()


_JUDGES = (("at risk", _at_risk), ("alarm", _alarm), ("stale", _stale), ("no estimate", _no_estimate))
"""States that need attention, with what gives their reasons; none if a state does not apply."""
