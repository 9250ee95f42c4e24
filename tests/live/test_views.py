"""What the page shows, from a store that is filled by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders.store_case import queried

from hygrokf.data.structured import plain
from hygrokf.live.batch import Alarm, Assessment, Batch, Estimates, Observation
from hygrokf.live.condition import Condition, Quantity
from hygrokf.live.forecast import LIMIT, ForecastMade
from hygrokf.live.properties import Property
from hygrokf.live.service import Health, SourceTimes
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.stream import SourceState, Stream
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.tracker import Reading
from hygrokf.live.web.views import (
    MOST_COURSE_POINTS,
    alarms_view,
    by_hour,
    fleet_view,
    health_view,
    turbine_view,
)
from hygrokf.texts.live_codes import BasisCode

T0 = 1.7e9


def estimated(times: np.ndarray, kelvin: float, humidity: float | None, chance: float | None) -> Condition:
    def of(value: float | None, sd: float) -> Quantity | None:
        return None if value is None else Quantity(np.full(len(times), value), np.full(len(times), sd))

    wet = humidity is not None
    return Condition(
        times, of(kelvin, 0.5), of(humidity, 0.02), of(8.0 if wet else None, 0.3),
        of(280.0 if wet else None, 0.4),
        of(np.nan if wet else None, np.nan), of(2.0 if wet else None, 1.0),
        None if chance is None else np.full(len(times), chance),
        None,
    )  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = open_store(f"sqlite:{tmp_path / 'live.db'}")
    made.add_turbines(dict.fromkeys("ABC", "digest"))
    times = T0 + 600.0 * np.arange(10)
    readings = [
        Observation(n, Reading("cabinet_temperature", t, 300.15), t + 2.0) for n in "AB" for t in times
    ]
    made.commit(
        Batch(
            observations=readings,
            estimates={
                "A": Estimates(estimated(times, 300.15, 0.5, 0.02), 8, T0),
                "B": Estimates(estimated(times, 295.15, 0.9, 0.4), 10, T0),
                "C": Estimates(estimated(times, 290.15, None, None), 10, T0),
            },
            properties=[("A", T0 + d * 3600.0,
                [Property("hygric_k", "h", 0.3 + d, 0.2, 0.4, 0.3, d < 2)]) for d in range(3)],
            alarms=[
                Alarm("a", "C", "data stale", "warning", T0, "silent", "look"),
                Alarm("b", "A", "condensation", "alarm", T0, "wet", "dry", ended=T0 + 60),
            ],
            counters={("A", "late"): 3, ("", "malformed"): 2},
        )
    )  # fmt: skip
    yield made
    made.close()


def test_the_turbine_that_needs_attention_most_comes_first(store: Store) -> None:
    states = {"A": "ok", "B": "at risk", "C": "stale"}  # D was never assessed
    store.commit(Batch(assessments=[Assessment(name, one, "", T0) for name, one in states.items()]))
    rows = fleet_view(store, ["A", "B", "C", "D"], T0 + 6000.0)
    assert [row["turbine"] for row in rows] == ["B", "C", "D", "A"]


def test_of_one_state_the_turbine_at_most_risk_comes_first(store: Store) -> None:
    rows = fleet_view(store, ["A", "B", "C", "D"], T0 + 6000.0)
    assert [row["turbine"] for row in rows] == ["C", "B", "A", "D"]
    assert [row["severity"] for row in rows] == [1, -1, -1, -1]
    b = rows[1]
    assert (b["temperature"], b["relative_humidity"]) == (pytest.approx(22.0), pytest.approx(90.0))
    assert b["heard"] == T0 + 5402.0
    assert b["margin_lower"] == pytest.approx(2.0 - 1.959964) and b["time"] == T0 + 5400.0
    d = rows[3]
    assert d["time"] is d["condensation"] is d["heard"] is None


def test_one_turbine(store: Store) -> None:
    found = turbine_view(store, "A", T0 + 600.0, T0 + 6000.0)
    assert len(found["time"]) == 9 and found["final"] == [1] * 7 + [0] * 2
    warm = found["courses"]["temperature"]
    assert warm["value"][0] == pytest.approx(27.0) and warm["upper"][0] == pytest.approx(27.98, abs=0.001)
    damp = found["courses"]["relative_humidity"]
    assert damp["lower"][0] == pytest.approx(50.0 - 3.92, abs=0.001)
    assert found["readings"]["temperature"]["value"] == pytest.approx([27.0] * 9)
    (exchange,) = found["properties"]
    assert (
        exchange["value"] == [1.3, 2.3] and exchange["observable"] is False and exchange["reference"] == 0.3
    )
    assert found["counts"] == {"late": 3}
    assert found["signals"][0]["count"] == 10
    assert found["alarms"] == []  # it ended before


def test_what_a_model_lacks_is_left_out(store: Store) -> None:
    found = turbine_view(store, "C", T0, T0)
    assert list(found["courses"]) == ["temperature"] and found["condensation"] == [None] * 10
    assert found["readings"] == {} and turbine_view(store, "none", T0, T0)["time"] == []


def test_the_limit_is_that_of_the_forecast(store: Store) -> None:
    assert turbine_view(store, "A", T0, T0)["humid"]["limit"] == LIMIT
    made = ForecastMade(T0, BasisCode.OPERATION_AS_NOW(), 0.7)
    store.commit(Batch(memories={("A", "forecast"): plain(made)}))
    found = turbine_view(store, "A", T0, T0)
    assert found["humid"]["limit"] == found["forecast"]["limit"] == 0.7


def test_long_courses_are_thinned(store: Store) -> None:
    times = T0 + 60.0 * np.arange(3 * MOST_COURSE_POINTS + 7)
    store.commit(Batch(estimates={"L": Estimates(estimated(times, 290.0, 0.5, 0.1), len(times), T0)}))
    found = turbine_view(store, "L", T0, T0)["time"]
    assert MOST_COURSE_POINTS // 2 < len(found) <= MOST_COURSE_POINTS and found[-1] == times[-1]


def test_health() -> None:
    health = Health(deliveries=5)
    health.note([0.01] * 98 + [0.2, 0.5])
    ended, lost = (Stream(PayloadMapping({}, revision=one), lambda: T0) for one in ("last", "neither"))
    for stream, url, state in (
        (ended, "stdin", SourceState("ended", "read to its end")), (lost, "tail", SourceState("lost", "")),
    ):  # fmt: skip
        stream.url, stream._state = url, state
    health.sources["tail"] = SourceTimes(T0, 2.5)
    found = health_view({"stdin": ended, "tail": lost}, health, {("", "malformed"): 2, ("A", "late"): 1})
    assert found["refused"] == {"malformed": 2} and found["wait_99_s"] == 0.2
    assert found["sources"] == [
        {
            "url": "stdin", "state": "ended", "words": "read to its end", "heard": None, "lag": None,
            "not_reached": None, "ordered_by": "arrival",
        },
        {
            "url": "tail", "state": "lost", "words": "", "heard": T0, "lag": 2.5, "not_reached": T0,
            "ordered_by": "nothing: neither counts",
        },
    ]  # fmt: skip


def test_what_the_fleet_says_of_cabinets_and_of_what_comes(store: Store) -> None:
    row = "INSERT INTO forecast (turbine, time, made, condensation) VALUES (?, ?, ?, ?)"
    with store.transaction():
        for hour, chance in ((-1, 0.9), (1, 0.2), (2, 0.6), (3, 0.6), (4, None)):
            queried(store, row, ("A", T0 + 3600.0 * hour, T0, chance))
    hidden = [("B", T0, [Property("hygric_k", "h", None, None, None, 0.3, False)])]
    store.commit(Batch(properties=hidden, alarms=[Alarm("c", "C", "cabinet changed", "warning", T0, "", "")]))
    rows = {row["turbine"]: row for row in fleet_view(store, ["A", "B", "C"], T0)}
    # what is past is no forecast; of equal chances the first
    assert (
        rows["A"]["forecast"] == {"condensation": 0.6, "time": T0 + 7200.0} and rows["B"]["forecast"] is None
    )
    assert [rows[name]["cabinet"] for name in "ABC"] == ["not observable", "not observable", "changed"]
    seen = [("A", T0 + 9e4, [Property("hygric_k", "h", 0.3, 0.2, 0.4, 0.3, True)])]
    store.commit(Batch(properties=seen))
    assert fleet_view(store, ["A"], T0)[0]["cabinet"] == "as fitted"
    assert rows["A"]["temperature_half"] == pytest.approx(1.96 * 0.5, abs=1e-3)


def test_the_highest_chance_of_each_hour() -> None:
    start = 3600.0 * (T0 // 3600.0)
    time = [start, start + 3599.0, start + 3600.0, start + 9000.0]
    assert by_hour(time, [0.1, 0.3, 0.2, None]) == [(start, 0.3), (start + 3600.0, 0.2)]
    assert by_hour([], []) == []


def test_signals_are_told_in_the_units_that_are_shown(store: Store) -> None:
    store.commit(Batch(observations=[Observation("A", Reading("active_power", T0 - 9e5, 1.5e6), T0 - 9e5)]))
    power, warm = turbine_view(store, "A", T0, T0 + 6000.0)["signals"]
    assert (power["signal"], power["value"], power["unit"], power["count"]) == (
        "active_power",
        1500.0,
        "kW",
        0,
    )
    assert (warm["value"], warm["unit"], warm["last"]) == (pytest.approx(27.0), "degC", T0 + 5400.0)


def test_alarms_that_ended_long_ago_are_left_out(store: Store) -> None:
    assert [a.id for a in alarms_view(store, since=T0 + 60.0)] == ["a", "b"]
    assert [a.id for a in alarms_view(store, since=T0 + 61.0)] == ["a"]
    assert alarms_view(store, "A", T0 + 61.0) == []
