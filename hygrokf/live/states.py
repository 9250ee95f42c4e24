"""The states of all turbines: what their assessments rest on, from round to round and over restarts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.data.structured import structured
from hygrokf.live.assessment import STANDSTILL_S, Known, Outlook, assess
from hygrokf.live.batch import Alarm, Assessment, Batch
from hygrokf.live.condition import Condition
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Tracker
from hygrokf.live.turbine import Turbine

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

    def estimate_s(self, name: str) -> float | None:
        """Time [s] of a turbine's newest estimate; None before the first."""
        return self._newest.get(name, (None, None))[0]

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
