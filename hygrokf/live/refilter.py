"""Filters the stored readings of turbines anew, with those that came too late and with the versions of their
values that count now."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby

from hygrokf.data.timestamps import DAY_S
from hygrokf.live.alarms import DELIVERY_RULES
from hygrokf.live.batch import Alarm, Batch
from hygrokf.live.forecast_job import isolation_steps
from hygrokf.live.storage.database import Cursor, SqlValue
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Tracker
from hygrokf.live.turbines import Fleet, Turbine, digest
from hygrokf.texts.wording import stamp_text

KEPT = ("alarms", "known_s", "forecast")
"""Memories of a turbine that do not follow from its final estimates; alarms stay as they were told."""


@dataclass(frozen=True)
class Refiltered:
    """What filtering a turbine anew takes into account and gives.

    `late`: readings and versions of values that had come too late; `differences`: alarms about the process
    that would have begun, ended or weighed otherwise, in words.
    """

    turbine: str
    late: int
    differences: tuple[str, ...]


def refilter(
    store: Store, turbines: Mapping[str, Turbine], names: Collection[str] | None = None
) -> list[Refiltered]:
    """Filter turbines anew, all in one transaction: those of some `names`, the others being their sisters.

    Estimates, properties and the tracker's state are replaced; alarms stay as they were told.  Raises
    StoreFault if a tracker is running.
    """
    chosen = turbines if names is None else names
    store.claim("turbine", chosen)
    with store.transaction() as cursor:
        return [_refiltered(store, cursor, name, turbines) for name in chosen]


def _refiltered(store: Store, cursor: Cursor, name: str, turbines: Mapping[str, Turbine]) -> Refiltered:
    def changed(statement: str, *values: SqlValue) -> None:
        cursor.execute(store.database.text(statement), values)

    late = 0
    for table, where in (("observation", ""), ("revision", "AND number > 0")):
        counted = f"SELECT COUNT(*) FROM {table} WHERE turbine = ? AND late = 1 {where}"
        late += int(store.rows(counted, (name,))[0][0])
        changed(f"UPDATE {table} SET late = 0 WHERE turbine = ? AND late = 1", name)
    for versions in store.revised(name).values():
        store.use(cursor, name, versions)
    changed("UPDATE turbine SET model = ? WHERE name = ?", digest(turbines[name].plan), name)
    marks = ", ".join("?" * len(KEPT))
    changed(f"DELETE FROM memory WHERE turbine = ? AND name NOT IN ({marks})", name, *KEPT)
    begin, after = math.inf, {}
    for batch in _batches(store, name, turbines):
        if name in batch.estimates and not math.isfinite(begin):
            begin = batch.estimates[name].since
            for table in ("estimate", "property"):
                changed(f"DELETE FROM {table} WHERE turbine = ? AND time >= ?", name, begin)
        after.update({alarm.id: alarm for alarm in batch.alarms})
        batch.memories.pop((name, "alarms"), None)
        store.write(cursor, replace(batch, alarms=[]))
    before = {one.id: one for one in store.found(Alarm, "WHERE turbine = ? AND began >= ?", (name, begin))}
    return Refiltered(name, late, tuple(_differences(before, after)))


def _batches(store: Store, name: str, turbines: Mapping[str, Turbine]) -> Iterator[Batch]:
    fleet, one = Fleet({name: turbines[name]}), turbines[name]
    fleet.tracked[name].tracker = Tracker(one.plan, lost=store.losses(name))
    points = {other: store.point(other) for other in turbines if other != name}
    yield fleet.take_events(store.events(name))
    readings = sorted(store.readings(name, -math.inf), key=lambda reading: reading.time)
    for _, part in groupby(readings, key=lambda reading: reading.time // DAY_S):
        fleet.tracked[name].tracker.take(reading for reading in part if not math.isnan(reading.value))
        fleet.waiting[name] = None
        yield fleet.filter_waiting(Batch())
        while (due := fleet.isolation_due()) is not None:
            final = [n for n, point in points.items() if point and point.time >= due[1].time]
            sisters = {other: turbines[other].plan for other in final}
            steps = isolation_steps(name, one, due[1], store, fleet.tracked[name].reference_point, sisters)
            yield fleet.keep_finding(name, next(found for found in steps if found is not None))


def _differences(before: Mapping[str, Alarm], after: Mapping[str, Alarm]) -> Iterator[str]:
    """How the alarms of before would differ, in words, by their beginnings."""
    delivery = {rule.kind for rule in DELIVERY_RULES}
    told = {key: alarm for key, alarm in before.items() if alarm.kind not in delivery}
    for key, alarm in sorted({**told, **after}.items(), key=lambda item: (item[1].began, item[0])):
        about = f"{alarm.kind} from {stamp_text(alarm.began)}"
        if key not in told:
            yield f"{about} would have begun: {alarm.statement}"
        elif key not in after:
            yield f"{about} would not have begun"
        elif (told[key].ended, told[key].severity) != (alarm.ended, alarm.severity):
            end = "be open" if alarm.ended is None else f"have ended at {stamp_text(alarm.ended)}"
            yield f"{about} would {end}, severity {alarm.severity}"
