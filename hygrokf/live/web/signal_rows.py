"""The signals of a turbine on its page: last readings, and what the model needs and never came."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from hygrokf.data.signals import SIGNALS, from_si
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.alarms import CONTRADICTS
from hygrokf.live.batch import Alarm
from hygrokf.live.plan import Need
from hygrokf.live.storage.store import Store


def signal_rows(
    store: Store, name: str, now: float, needs: Sequence[Need], alarms: Iterable[Alarm]
) -> list[dict[str, Any]]:
    """The last reading of each signal of a turbine in its display unit, and what its model reads and never
    came.

    `last`: its time [s]; `received`: its arrival [s]; `count`: number of readings in the last day; `needed`:
    "required" if there is no estimate without it, "used" if the model reads it, "" if it does not;
    `contradicts`: whether the reading contradicts the estimate, by the open alarms.
    """
    found = []
    open_ = [one for one in alarms if one.kind == CONTRADICTS.kind and one.ended is None]
    there = store.signals(name)
    used = {signal: "required" if one.required else "used" for one in needs for signal in one.signals}
    missing = [one.signals[0] for one in needs if not set(one.signals) & set(there)]
    for signal in sorted({*missing, *there}):
        row, newest = (
            SIGNALS.get(signal),
            store.rows(
                "SELECT value, time, received FROM observation WHERE turbine = ? AND signal = ? ORDER BY "
                "time DESC LIMIT 1",
                (name, signal),
            ),
        )
        value, last, received = newest[0] if newest else (None, None, None)
        ((count,),) = store.rows(
            "SELECT COUNT(*) FROM observation WHERE turbine = ? AND signal = ? AND time >= ?",
            (name, signal, now - DAY_S),
        )
        found.append(
            {
                "signal": signal,
                "value": value if row is None or value is None else float(from_si(value, row.display, row)),
                "unit": "" if row is None else row.display,
                "last": last,
                "received": received,
                "count": count,
                "needed": used.get(signal, ""),
                "contradicts": any(f":{CONTRADICTS.kind} {signal}:" in one.id for one in open_),
            }
        )
    return found
