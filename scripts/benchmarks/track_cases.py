"""What the tracker is measured on: turbines of one model, five signals each ten minutes, and a store that
they fill."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import SIGNALS
from hygrokf.identification.fit import Fit, write_fit
from hygrokf.live.plan import WANDERING, Form, plan
from hygrokf.live.sources.local import record_mapping
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import Store
from hygrokf.live.turbines import Fleet, Turbine
from hygrokf.modelling.design import CASCADE, design, merged
from hygrokf.physics.psychrometrics import relative_humidity
from hygrokf.version import __version__

STEP_S = 600.0
DAY_S = 86400.0
PER_STAMP = 5
"""Messages of a turbine every ten minutes."""


@cache
def record(days: float = 6.0, end_s: float = 1.7e9) -> Record:
    """Weather, power and a cabinet's readings, all of them on one clock of ten minutes; nothing is
    missing."""
    random = np.random.default_rng(3)
    time = end_s - STEP_S * np.arange(round(days * DAY_S / STEP_S))[::-1]
    count = len(time)
    swing = np.cumsum(random.standard_normal(count)) * 0.05
    outside = 283.0 - 4.0 * np.cos(2.0 * np.pi * time / DAY_S) + swing
    vapour = 6.5e-3 * np.exp(0.1 * np.cumsum(random.standard_normal(count)) / np.sqrt(count))
    share = np.clip(0.5 + 0.5 * np.sin(time / 20_000.0) + 0.2 * random.standard_normal(count), 0.0, 1.0)
    inside = outside + 5.0 + 8.0 * share + 0.1 * random.standard_normal(count)
    course = {
        "ambient_temperature": outside,
        "ambient_relative_humidity": np.minimum(relative_humidity(vapour, outside), 1.0),
        "cabinet_temperature": inside,
        "cabinet_relative_humidity": np.minimum(relative_humidity(vapour * outside / inside, inside), 1.0),
    }
    power = Series("active_power", time, 2e6 * share, hold="mean", interval_s=STEP_S)
    series = (*(Series(name, time, values) for name, values in course.items()), power)
    return Record("made", series, Site(52.0, 1.0), 2e6)


def fit() -> Fit:
    """The record's model at its start values."""
    base = merged([design(record(), kind="thermal"), design(record(), kind=CASCADE)])
    return Fit("T", base, {p.name: p.start for p in base.model.parameters})


def turbines(count: int) -> dict[str, Turbine]:
    """Turbines with a model each: one kind of model, other values, as fits of their own would have them."""
    made, usual = record(), fit()
    forms = {s.signal: Form(s.hold, s.interval_s) for s in made.series}
    found = {}
    for number in range(count):
        own = {**usual.values, "hygric_k": 0.4 + 0.2 * number / count}
        one = Fit(f"T{number}", replace(usual.design), own)
        found[one.name] = Turbine(plan(one, forms=forms, site=made.site, rated_power_W=made.rated_power_W))
    return found


def write_model(one: Turbine, folder: Path) -> None:
    """A turbine's model as `hygrokf fit` would have written it, without what the tracker adds."""
    made = replace(
        one.plan.design, mechanisms=tuple(m for m in one.plan.design.mechanisms if m[0] not in WANDERING)
    )
    values = {p.name: one.plan.values[p.name] for p in made.model.parameters}
    results = {
        "name": one.plan.name, "version": __version__, "design": made.to_json(), "synthetic": True,
        "time_constants": {},
        "parameters": {name: {"value": value} for name, value in values.items()},
        "covariance": {"names": ["thermal_time_constant"], "matrix": [[0.01]]},
    }  # fmt: skip
    write_fit(Fit.from_json(results), folder)


def fields() -> list[str]:
    """The rows of `[mapping.signals]`."""
    form = ', stamp = "end", interval = "10min"'
    return [
        f'{s.signal} = {{ signal = "{s.signal}", unit = '
        f'"{SIGNALS[s.signal].unit}"{form if s.interval_s else ""} }}'
        for s in record().series
    ]


def mapping(names: Sequence[str]):
    return replace(record_mapping(record(), ""), turbines={name: name for name in names})


def rows(end_s: float, count: int) -> list[tuple[float, dict[str, float]]]:
    """(time [s], value by signal) of the last `count` stamps, as if the last one were at `end_s` [s]."""
    series = record().series
    last = len(series[0])
    return [
        (end_s - STEP_S * (last - 1 - i), {s.signal: float(s.value[i]) for s in series})
        for i in range(last - count, last)
    ]


def messages(name: str, stamps: Sequence[tuple[float, Mapping[str, float]]]) -> Iterator[str]:
    """One message a signal and stamp."""
    for at, values in stamps:
        for signal, value in values.items():
            yield f'{{"turbine": "{name}", "time": {at!r}, "{signal}": {value!r}}}'


def fill(store: Store, fleet: Fleet, stamps: Sequence[tuple[float, Mapping[str, float]]]) -> None:
    """Every turbine of a fleet gets the same stamps, and the store all that follows from them."""
    how = mapping(list(fleet.tracked))
    for name in fleet.tracked:
        deliveries = [Delivery(text, stamps[-1][0]) for text in messages(name, stamps)]
        store.commit(fleet.round(deliveries, how, "mqtt://filled"))
