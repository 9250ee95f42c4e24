"""The courses of the margin on the overview: which steps they have, and when they are read again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from builders.store_case import queried

from hygrokf.live.batch import Batch, Estimates
from hygrokf.live.condition import Z95, Condition, Quantity
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.web import views
from hygrokf.live.web.views import (
    AHEAD_STEPS,
    MARGIN_STEP_S,
    PAST_STEPS,
    SHOWN_BACK_S,
    MarginsCache,
    lowest_margins,
    margins_of,
)

T0 = 1.7e9


def with_margins(times: np.ndarray, margin: np.ndarray) -> Condition:
    def of(value: float) -> Quantity:
        return Quantity(np.full(len(times), value), np.full(len(times), 0.5))

    course = Quantity(margin, np.full(len(times), 1.0))
    return Condition(
        times, of(300.0), of(0.5), of(8.0), of(280.0), of(np.nan), course, np.zeros(len(times)), None
    )


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = open_store(f"sqlite:{tmp_path / 'live.db'}")
    made.add_turbines(dict.fromkeys("AB", "digest"))
    times = T0 - SHOWN_BACK_S + 600.0 * np.arange(round(SHOWN_BACK_S / 600.0))
    condition = with_margins(times, np.linspace(10.0, 1.0, len(times)))
    made.commit(Batch(estimates={"A": Estimates(condition, len(times), float(times[0]))}))
    with made.transaction():
        for hour, margin in ((-1, -9.0), (1, 3.0), (1.5, 0.04), (47, -2.0), (49, -9.0)):
            queried(
                made,
                "INSERT INTO forecast (turbine, time, made, margin_K, margin_sd) VALUES (?, ?, ?, ?, ?)",
                ("A", T0 + 3600.0 * hour, T0, margin, 2.0),
            )
    yield made
    made.close()


def test_each_step_shows_its_lowest_margin_and_its_band(store: Store) -> None:
    found = margins_of(store, ["A", "B"], T0 - SHOWN_BACK_S)
    assert list(found) == ["A"]  # of B nothing is known
    value, half = found["A"]["value"], found["A"]["half"]
    assert len(value) == len(half) == PAST_STEPS + AHEAD_STEPS
    # the margin falls, so that the last of a step is its lowest
    per_step = round(MARGIN_STEP_S / 600.0)
    fall = np.linspace(10.0, 1.0, PAST_STEPS * per_step)
    assert value[:PAST_STEPS] == [round(v, 1) for v in fall[per_step - 1 :: per_step]]
    assert half[:PAST_STEPS] == [round(Z95, 1)] * PAST_STEPS
    # forecasts: neither of the past nor beyond two days; steps without any have none
    assert (
        value[PAST_STEPS] == 0.0
        and value[-1] == -2.0
        and value[PAST_STEPS + 1 : -1] == [None] * (AHEAD_STEPS - 2)
    )
    assert half[PAST_STEPS] == round(2.0 * Z95, 1)


def test_steps_without_a_number_have_none() -> None:
    place = np.array([0.2, 0.9, 1.5, 2.5, 7.0])
    value, half = lowest_margins(
        place, np.array([3.0, 2.0, np.nan, 1.0, 5.0]), np.array([1.0, 2.0, 1.0, np.inf, 1.0]), 4
    )
    assert value == [2.0, None, None, None] and half == [round(2.0 * Z95, 1), None, None, None]


def test_they_are_read_again_when_they_are_old(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[int] = []

    class Counting:
        def read(self, view: Callable[[Store], dict]) -> dict:
            reads.append(1)
            return view(store)

    clock = [100.0]
    monkeypatch.setattr(views.time, "monotonic", lambda: clock[0])
    kept, reader = MarginsCache(), Counting()

    def starts(now: float) -> float:
        return kept.view(reader, ["A", "B"], now)["start"] + SHOWN_BACK_S  # type: ignore[arg-type]

    assert starts(T0) == T0 and starts(T0 + 0.9 * views.MARGINS_KEPT_S) == T0 and len(reads) == 1
    assert starts(T0 + 2.0 * views.MARGINS_KEPT_S) == T0  # a playback is faster than real time
    clock[0] += views.KEPT_REAL_S
    assert starts(T0 + 2.0 * views.MARGINS_KEPT_S) == T0 + 2.0 * views.MARGINS_KEPT_S and len(reads) == 2
    monkeypatch.setattr(views, "TURBINES_AT_ONCE", 1)
    clock[0] += views.KEPT_REAL_S
    assert starts(T0 - 1e6) == T0 - 1e6 and len(reads) == 4  # another start of a record
