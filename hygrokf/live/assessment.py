"""The state of a turbine with its reason, from the facts about the turbine; no state is "ok" by default.

The states are those of `batch.STATES`, and the first one that applies is taken:

- *at risk*: condensation is likely now, by an estimate that is not old, or within the forecast;
- *alarm*: an alarm about the cabinet, its sensors or a clock is open, other than a notice;
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
from hygrokf.live.alarms import CONDENSATION, SIGNAL_MISSING, STALE
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
class Facts:
    """The facts about a turbine from which its state follows.

    `known_s`: time [s] since when the tracker knows the turbine; `heard`: signal → time [s] of its newest
    reading; `awaited`: signals that the model requires and that never came; `estimate_s`: time [s] of the
    newest estimate, None before the first; `condensation` [1]: the estimate's probability of condensation,
    None if there is none; `with_humidity`: whether the model has humidity; `outlook`: the forecast; `alarms`:
    the open alarms; `standstill`: whether the turbine has fed no power for `STANDSTILL_S`; `history_until_s`:
    time [s] up to which readings are needed for the first estimate; `fault`: why the filter cannot run;
    `catching_up`: whether a backlog is being delivered; `stale_s` [s]: age of stale data; `silent_s`: time
    [s] since when all sensors of the cabinet are silent, so that estimates follow from the inputs alone, else
    None.
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


def assess(facts: Facts, now: float) -> tuple[str, Reasons]:
    """The state at `now` [s], one of `batch.STATES`, and its reason, with what the estimate lacks."""
    state, reason = _assess(facts, now)
    return state, (*reason, *_lacking(facts))


def _lacking(facts: Facts) -> Iterator[Statement]:
    """Statements about the sensors of the cabinet that are silent while estimates go on."""
    if facts.estimate_s is None:
        return
    if facts.silent_s is not None:
        yield StateCode.FROM_INPUTS_ALONE(since=facts.silent_s)
        return
    for signal, at in sorted(facts.heard.items()):
        if signal.startswith("cabinet_") and facts.estimate_s - at > facts.stale_s:
            yield StateCode.WITHOUT_SIGNAL(signal=signal, since=at)


def _assess(facts: Facts, now: float) -> tuple[str, Reasons]:
    for state, judge in _JUDGES:
        if reasons := judge(facts, now):
            return state, reasons
    unlikely = StateCode.CONDENSATION_UNLIKELY_AHEAD()
    if facts.outlook is None:
        unlikely = StateCode.CONDENSATION_UNLIKELY_NOW()
    power_s = facts.heard.get("active_power", -math.inf)
    if facts.standstill and now - power_s <= facts.stale_s:
        return "off", (StateCode.FEEDS_NO_POWER(), unlikely)
    return "ok", (unlikely,)


def _old(facts: Facts, now: float) -> bool:
    """Whether the newest estimate is too old to describe the present."""
    return facts.estimate_s is not None and now - facts.estimate_s > facts.stale_s


def _at_risk(facts: Facts, now: float) -> Reasons:
    chance = facts.condensation
    if chance is not None and chance >= CONDENSATION.on and not _old(facts, now):
        return (StateCode.CONDENSATION_LIKELY_NOW(),)
    likely_s = None if facts.outlook is None else facts.outlook.likely_s(now)
    return () if likely_s is None else (StateCode.CONDENSATION_LIKELY_FROM(at=likely_s),)


def _alarm(facts: Facts, now: float) -> Reasons:
    other_states = {STALE.kind} if facts.estimate_s is not None else {STALE.kind, SIGNAL_MISSING.kind}
    kinds = [a.kind for a in facts.alarms if a.kind not in other_states and a.severity != "notice"]
    return (StateCode.ALARMS_OPEN(kinds=tuple(dict.fromkeys(kinds))),) if kinds else ()


def _stale(facts: Facts, now: float) -> Reasons:
    if facts.estimate_s is None:
        return ()
    if _old(facts, now):
        if facts.catching_up:  # the time of the estimate changes with every delivery
            return (StateCode.ESTIMATE_OLD_IN_BACKLOG(),)
        return (StateCode.ESTIMATE_OLD(at=facts.estimate_s),)
    return next((alarm.statements for alarm in facts.alarms if alarm.kind == STALE.kind), ())


def _no_estimate(facts: Facts, now: float) -> Reasons:
    reason = _why_none(facts)
    return () if reason is None else (reason,)


def _why_none(facts: Facts) -> Statement | None:
    """Why there is no probability of condensation; None if there is one."""
    if facts.estimate_s is not None and facts.condensation is not None:
        return None if math.isfinite(facts.condensation) else StateCode.ESTIMATE_NOT_A_NUMBER()
    if not facts.with_humidity:
        return StateCode.MODEL_WITHOUT_HUMIDITY()
    if not facts.heard:
        return StateCode.NO_READING_YET(since=facts.known_s)
    if facts.awaited:
        quantities = tuple(need.quantity for need in facts.awaited)
        return StateCode.INPUTS_NEVER_CAME(quantities=quantities, since=facts.known_s)
    if facts.fault:
        return StateCode.FILTER_FAILS(fault=facts.fault)
    if facts.history_until_s is not None:
        return StateCode.HISTORY_AWAITED(until=facts.history_until_s)
    return StateCode.NOT_FILTERED_YET() if facts.estimate_s is None else StateCode.NO_PROBABILITY()


_JUDGES = (("at risk", _at_risk), ("alarm", _alarm), ("stale", _stale), ("no estimate", _no_estimate))
"""State that needs attention, and the function that gives its reasons, empty if the state does not apply."""
