"""The state of a turbine from what is known of it, with the reason: nothing that is not assessed is "ok".

The states are those of `batch.STATES`, and the first one that applies is taken:

- *at risk*: condensation is likely now, by an estimate that is not old, or within the forecast;
- *alarm*: an alarm about the cabinet, its sensors or a clock is open; a notice is none;
- *stale*: the estimate is old, or an alarm about silent signals is open;
- *no estimate*: there is no probability of condensation, for the stated reason;
- *off*: condensation is unlikely, and the turbine has fed no power for `STANDSTILL_S`;
- *ok*: condensation is unlikely.

`States` keeps what the assessments rest on, from round to round and over restarts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hygrokf.data.structured import structured
from hygrokf.data.timestamps import HOUR_S, stamp_text
from hygrokf.live.alarms import CONDENSATION, MISSING, STALE
from hygrokf.live.batch import Alarm, Assessment, Batch
from hygrokf.live.condition import Condition
from hygrokf.live.plan import Need
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Tracker
from hygrokf.live.turbine import Turbine

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


KNOWN = "known"
"""Name of the memory of the time since when the tracker knows a turbine."""


class States:
    """The newest estimate, the forecast and the assessment of each turbine."""

    def __init__(self, turbines: Mapping[str, Turbine]) -> None:
        self.assessments: dict[str, Assessment] = {}
        self._turbines = turbines
        # time [s] and probability of condensation [1] of the newest estimate
        self._newest: dict[str, tuple[float, float | None]] = {}
        self._outlooks: dict[str, Outlook] = {}
        self._known_s: dict[str, float] = {}

    @classmethod
    def from_store(cls, turbines: Mapping[str, Turbine], store: Store) -> States:
        """The states that the store holds."""
        states = cls(turbines)
        states.assessments = store.assessments()
        for name in turbines:
            newest, outlook = store.newest_estimate(name), store.outlook(name)
            if newest is not None:
                states._newest[name] = newest
            if outlook:
                states._outlooks[name] = Outlook(*np.array(outlook, dtype=float).T)
            if (known := store.memory(name, KNOWN)) is not None:
                states._known_s[name] = structured(dict[str, float], known)["since"]
        return states

    def known_since(self, name: str, now: float, batch: Batch) -> float:
        """Time [s] since when the tracker knows a turbine, `now` [s] for a new one; the batch keeps it."""
        if self._known_s.get(name, math.inf) > now:  # new, or this machine's clock was ahead
            self._known_s[name] = now
            batch.memories[name, KNOWN] = {"since": now}
        return self._known_s[name]

    def note_estimate(self, name: str, found: Condition) -> None:
        """Note the condition of a turbine at its newest instants."""
        chance = None if found.condensation is None else float(found.condensation[-1])
        self._newest[name] = (float(found.time_s[-1]), chance)

    def note_forecast(self, name: str, found: Condition | None) -> None:
        """Note the forecast condition of a turbine, None without a forecast."""
        self._outlooks.pop(name, None)
        if found is not None and found.condensation is not None:
            self._outlooks[name] = Outlook(found.time_s, found.condensation)

    def assess(
        self,
        name: str,
        tracker: Tracker,
        now: float,
        alarms: Sequence[Alarm],
        fault: str,
        catching_up: bool,
        batch: Batch,
    ) -> None:
        """Assess a turbine at `now` [s] with its open alarms; a change goes to the batch.

        `fault`: why its filter cannot run; `catching_up`: whether a backlog is being delivered.
        """
        one, awaited = self._turbines[name], tracker.awaited()
        estimate_s, condensation = self._newest.get(name, (None, None))
        known = Known(
            known_s=self._known_s.get(name, now),
            heard=tracker.heard(),
            awaited=[need for need in one.plan.needs if need.required and need.signals[0] in awaited],
            estimate_s=estimate_s,
            condensation=condensation,
            with_humidity="vapour" in one.plan.model.states,
            outlook=self._outlooks.get(name),
            alarms=alarms,
            standstill=tracker.stands_still(STANDSTILL_S),
            history_until_s=tracker.history_until(),
            fault=fault,
            catching_up=catching_up,
            stale_s=one.stale_s,
            silent_s=tracker.silent_since(),
        )
        state, reason = assess(known, now)
        before = self.assessments.get(name)
        if before is None or (before.state, before.reason) != (state, reason):
            since = before.since if before is not None and before.state == state else now
            self.assessments[name] = Assessment(name, state, reason, since)
            others = [one for one in batch.assessments if one.turbine != name]
            batch.assessments = [*others, self.assessments[name]]
