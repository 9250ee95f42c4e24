"""The signals of a turbine on its page: last readings, and what the model needs and never came."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypedDict

from sqlalchemy import select

from hygrokf.data.signals import SIGNALS, from_si
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.alarms import CONTRADICTS
from hygrokf.live.batch import Alarm
from hygrokf.live.plan import Need
from hygrokf.live.storage.schema import matching, observation
from hygrokf.live.storage.store import Store


class SignalRow(TypedDict):
    """A signal's last reading in its display unit.

    `last`: its time [s]; `received`: its arrival [s], all None if it never came; `count`: number of readings
    in the last day; `needed`: "required" if there is no estimate without it, "used" if the model reads it,
    "" if it does not; `contradicts`: whether the reading contradicts the estimate.
    """

    signal: str
    value: float | None
    unit: str
    last: float | None
    received: float | None
    count: int
    needed: str
    contradicts: bool


def signal_rows(
    store: Store, name: str, now: float, needs: Sequence[Need], alarms: Iterable[Alarm]
) -> list[SignalRow]:
    """The last reading of each signal of a turbine, and what its model reads and never came."""
    found: list[SignalRow] = []
    contradicts = contradicting(alarms)
    there = store.signals(name)
    used = {signal: "required" if one.required else "used" for one in needs for signal in one.signals}
    missing = [one.signals[0] for one in needs if not set(one.signals) & set(there)]
    for signal in (*missing, *there):
        row, last, value, received, count = SIGNALS.get(signal), None, None, None, 0
        if signal in there:
            o, own = observation.c, matching(observation, turbine=name, signal=signal)
            newest = select(o.time, o.value, o.received).where(own).order_by(o.time.desc()).limit(1)
            ((last, value, received),) = store.rows(newest)
            count = store.count(observation, own, o.time >= now - DAY_S)
        found.append(
            {
                "signal": signal,
                "value": value if row is None or value is None else float(from_si(value, row.display, row)),
                "unit": "" if row is None else row.display,
                "last": last,
                "received": received,
                "count": count,
                "needed": used.get(signal, ""),
                "contradicts": signal in there and signal in contradicts,
            }
        )
    return sorted(found, key=lambda one: one["signal"])


def contradicting(alarms: Iterable[Alarm]) -> set[str]:
    """Signals whose readings contradict the estimate, by the open alarms."""
    open_ = [one for one in alarms if one.kind == CONTRADICTS.kind and one.ended is None]
    return {signal for signal in SIGNALS for one in open_ if f":{CONTRADICTS.kind} {signal}:" in one.id}
