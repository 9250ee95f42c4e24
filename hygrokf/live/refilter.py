"""Filters the stored readings of turbines anew, with the readings that came too late and with the present
versions of their values."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby

from hygrokf.data.timestamps import DAY_S
from hygrokf.live.alarms import DELIVERY, kinds_of
from hygrokf.live.batch import Alarm, Batch
from hygrokf.live.forecast_job import isolation_steps
from hygrokf.live.storage import schema, statements
from hygrokf.live.storage.statements import delete_rows
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Tracker
from hygrokf.live.turbines import Fleet, Turbine, digest
from hygrokf.texts.wording import stamp_text

KEPT_MEMORIES = ("alarms", "known_s", "forecast")
"""Memories of a turbine that do not follow from its final estimates; alarms stay as they were raised."""


@dataclass(frozen=True)
class Refiltered:
    """The result of filtering a turbine anew.

    `late`: number of readings and versions of values that had come too late; `differences`: in words, alarms
    about the process whose beginning, end or severity would have been different.
    """

    turbine: str
    late: int
    differences: tuple[str, ...]


def refilter(
    store: Store, turbines: Mapping[str, Turbine], names: Collection[str] | None = None
) -> list[Refiltered]:
    """Filter the turbines with these `names` anew, by default all, in one transaction; the others are
    sisters.

    Estimates, properties and the tracker's state are replaced; alarms stay as they were raised.  Raises
    StoreFault if a tracker is running.
    """
    chosen = turbines if names is None else names
    store.claim("turbine", chosen)
    with store.transaction():
        return [_refilter_turbine(store, name, turbines) for name in chosen]


def _refilter_turbine(store: Store, name: str, turbines: Mapping[str, Turbine]) -> Refiltered:
    ((late,),) = store.rows(statements.LATE_VERSIONS, turbine=name)
    store.execute(statements.USE_LATE_VERSIONS, turbine=name)
    late += store.execute(statements.USE_LATE, turbine=name)
    for versions in store.revised(name).values():
        store.use(name, versions)
    store.execute(statements.CHANGE_MODEL, name=name, digest=digest(turbines[name].plan))
    store.execute(statements.FORGET_MEMORIES, turbine=name, kept=KEPT_MEMORIES)
    begin, after = math.inf, {}
    for batch in _batches(store, name, turbines):
        if name in batch.estimates and not math.isfinite(begin):
            begin = batch.estimates[name].since
            for table in (schema.estimate, schema.property_):
                store.execute(delete_rows(table, "turbine", since=True), turbine=name, since=begin)
        after.update({alarm.id: alarm for alarm in batch.alarms})
        batch.memories.pop((name, "alarms"), None)
        store.write(replace(batch, alarms=[]))
    raised = store.records(Alarm, statements.BEGUN_ALARMS, turbine=name, since=begin)
    before = {alarm.id: alarm for alarm in raised}
    return Refiltered(name, late, tuple(_differences(before, after)))


def _batches(store: Store, name: str, turbines: Mapping[str, Turbine]) -> Iterator[Batch]:
    fleet, turbine = Fleet({name: turbines[name]}), turbines[name]
    fleet.tracked[name].tracker = Tracker(turbine.plan, lost=store.losses(name))
    points = {other: store.point(other) for other in turbines if other != name}
    yield fleet.take_events(store.events(name))
    readings = sorted(store.readings(name, -math.inf), key=lambda reading: reading.time)
    for _, day in groupby(readings, key=lambda reading: reading.time // DAY_S):
        fleet.tracked[name].tracker.take(reading for reading in day if not math.isnan(reading.value))
        fleet.waiting[name] = None
        yield fleet.filter_waiting(Batch())
        while (due := fleet.isolation_due()) is not None:
            final = [n for n, point in points.items() if point and point.time >= due[1].time]
            sisters = {other: turbines[other].plan for other in final}
            steps = isolation_steps(
                name, turbine, due[1], store, fleet.tracked[name].reference_point, sisters
            )
            yield fleet.keep_finding(name, next(finding for finding in steps if finding is not None))


def _differences(before: Mapping[str, Alarm], after: Mapping[str, Alarm]) -> Iterator[str]:
    """The differences between the alarms `before` and `after` filtering anew, in words, by their
    beginnings."""
    raised = {key: alarm for key, alarm in before.items() if alarm.kind not in kinds_of(*DELIVERY)}
    for key, alarm in sorted({**raised, **after}.items(), key=lambda item: (item[1].began, item[0])):
        about = f"{alarm.kind} from {stamp_text(alarm.began)}"
        if key not in raised:
            yield f"{about} would have begun: {alarm.statement}"
        elif key not in after:
            yield f"{about} would not have begun"
        elif (raised[key].ended, raised[key].severity) != (alarm.ended, alarm.severity):
            end = "be open" if alarm.ended is None else f"have ended at {stamp_text(alarm.ended)}"
            yield f"{about} would {end}, severity {alarm.severity}"
