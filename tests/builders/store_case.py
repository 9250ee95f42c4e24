"""Batches and readings that tests put into a store."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

import numpy as np
import pytest

from hygrokf.estimation.likelihood import Gaussian
from hygrokf.live.batch import Alarm, Batch, Estimates, Observation
from hygrokf.live.condition import Condition, Quantity
from hygrokf.live.properties import Property
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.tracker import Point, Reading

T0 = 1.7e9


def a_state(seed: int = 0) -> Gaussian:
    random = np.random.default_rng(seed)
    root = random.standard_normal((5, 5)) * 10.0 ** random.uniform(-9, 3, (5, 1))
    return Gaussian(random.standard_normal(5) * 300.0, root @ root.T)


def a_condition(times: list[float], value: float = 290.0) -> Condition:
    one = Quantity(np.full(len(times), value), np.full(len(times), 0.5))
    none = Quantity(np.full(len(times), np.nan), np.full(len(times), np.nan))
    return Condition(np.array(times), one, one, one, one, none, one, np.full(len(times), 0.25), one)


def observed(signal: str, time: float, value: float, late: bool = False) -> Observation:
    return Observation("T1", Reading(signal, time, value), time + 3.0, late)


def everything() -> Batch:
    return Batch(
        observations=[
            observed("cabinet_temperature", T0, 290.25),
            observed("cabinet_temperature", T0 + 600, 290.5),
        ],
        points={"T1": Point(T0, a_state())},
        estimates={"T1": Estimates(a_condition([T0, T0 + 600]), 1, T0)},
        properties=[("T1", T0, [Property("hygric_k", "h", 0.3, 0.28, 0.33, 0.31, True)])],
        alarms=[Alarm("a1", "T1", "condensation", "warning", T0, "water may condense", "close the door")],
        memories={("T1", "parameter_shifts"): {"hygric_k": [1.0, 2.0]}},
        counters={("T1", "late"): 2, ("", "malformed"): 1},
        place={"file:live.csv": "1200"},
    )


def queried(store: Store, statement: str, parameters: Sequence[object] = ()) -> list[tuple]:
    """What the database itself answers to a statement, whose parameters are question marks."""
    with closing(store.database.cursor()) as cursor:
        if store.url.startswith("sqlite:"):
            cursor.execute(statement, parameters)
        else:
            cursor.execute(statement.replace("?", "%s"), parameters or None)
        return cursor.fetchall() if cursor.description else []


def refused(url: str) -> str:
    with pytest.raises(StoreFault) as fault:
        open_store(url)
    return str(fault.value)
