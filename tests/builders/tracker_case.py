"""Readings in the order of their arrival, and the plan that filters them."""

from __future__ import annotations

import numpy as np

from hygrokf.data.record import Record
from hygrokf.identification.fit import Fit
from hygrokf.live.plan import Plan, SignalReporting, plan
from hygrokf.live.tracker import Reading
from hygrokf.modelling.design import CASCADE, design, merged

LATENESS_S = 1800.0


def planned(record: Record, **options: object) -> Plan:
    """A plan with the base model at its start values: the filter's arithmetic does not care which."""
    base = merged([design(record, kind="thermal"), design(record, kind=CASCADE)])
    fit = Fit(record.name, base, {p.name: p.start for p in base.model.parameters})
    forms = {s.signal: SignalReporting(s.hold, s.interval_s, s.resolution, s.accuracy) for s in record.series}
    settings = {"site": record.site, "rated_power_W": record.rated_power_W, "lateness_s": LATENESS_S}
    return plan(fit, forms=forms, **{**settings, **options})


def readings_of(record: Record) -> list[Reading]:
    found = [
        Reading(s.signal, float(t), float(v))
        for s in record.series
        for t, v in zip(s.time[~s.missing], s.value[~s.missing], strict=True)
    ]
    return sorted(found, key=lambda one: one.time)


def arriving(readings: list[Reading], seed: int, late_s: float, twice: float = 0.1) -> list[Reading]:
    """The readings as they may arrive: each up to `late_s` late, some a second time."""
    random = np.random.default_rng(seed)
    doubled = [one for one in readings if random.random() < twice]
    everything = readings + doubled
    arrival = np.array([one.time for one in everything]) + random.uniform(0.0, late_s, len(everything))
    return [everything[i] for i in np.argsort(arrival)]
