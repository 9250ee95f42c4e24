"""Alarms about the process, and the causes of shifts, follow from the times of the readings alone, not from
when these came or in which portions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from builders.live_case import SIGNALS, count_of, live_record, live_turbine
from builders.store_case import queried

from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S
from hygrokf.live import forecast_job
from hygrokf.live.alarms import DELIVERY, kinds_of
from hygrokf.live.condition import Surface
from hygrokf.live.fault_isolation import ISOLATION_EVERY_S, CauseFinding
from hygrokf.live.forecast_job import isolation_steps
from hygrokf.live.plan import Plan
from hygrokf.live.service import Service
from hygrokf.live.sources.local import Playback, delay_and_repeat, record_mapping, record_messages
from hygrokf.live.sources.payload_formats import Content
from hygrokf.live.sources.stream import Delivery, Reach
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.tracker import Point
from hygrokf.live.turbines import Fleet, Turbine

HUMIDITY = "cabinet_relative_humidity"
Messages = Sequence[tuple[float, Content]]


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """Eleven days with three wrong readings of humidity, six hours without any reading of the cabinet,
    and air that is moister than explained at last."""
    made = live_record(tmp_path_factory.mktemp("turbine"), seed=61, days=11.0)
    value = made[HUMIDITY].value.copy()
    wrong = [700, 900, 901]
    value[wrong] = np.where(value[wrong] < 0.5, 0.95, 0.1)
    value[made[HUMIDITY].time > made.start_s + 9.0 * DAY_S] += 0.2
    made = made.replace_series(replace(made[HUMIDITY], value=np.minimum(value, 0.99)))
    ambient = made["ambient_temperature"]
    stuck = (ambient.time > made.start_s + 6.0 * DAY_S) & (ambient.time < made.start_s + 6.5 * DAY_S)
    repeated = np.where(stuck, ambient.value[stuck][0], ambient.value)
    made = made.replace_series(replace(ambient, value=repeated))
    begin = made.start_s + 8.0 * DAY_S
    for signal in (HUMIDITY, "cabinet_temperature"):
        one = made[signal]
        heard = (one.time < begin) | (one.time > begin + 0.25 * DAY_S)
        made = made.replace_series(replace(one, time=one.time[heard], value=one.value[heard]))
    return made


@pytest.fixture(scope="module")
def cold(record: Record) -> Turbine:
    """A cabinet that exchanges less air than its model says, with a cold surface."""
    return replace(live_turbine(record, hygric_k=0.1), surface=Surface(0.0, -2.0))


def searched(
    plan: Plan, given: Record, reference: Point | None = None, sisters: Sequence[Record] = ()
) -> Iterator[CauseFinding | None]:
    """Stands in for the search for a cause: its finding hangs on every reading that it is given."""
    assert set(given.signals) == set(SIGNALS)
    yield None
    marks = []
    for of in (given, *sisters):
        readings = [array.tobytes() for s in sorted(of.series, key=lambda s: s.signal) for array in s.known]
        marks.append(crc32(b"".join(readings)))
    cause = ("", "hygric_k")[int(given.end_s // DAY_S) % 2]
    yield CauseFinding(given.end_s, cause, value=float(marks[0]), gain=float(sum(marks[1:])))


@pytest.fixture(scope="module", autouse=True)
def quick_search() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(forecast_job, "isolate", searched)
        yield


def isolated(fleet: Fleet, store: Store) -> list[float]:
    """Isolate every cause that is due; returns for which times."""
    times = []
    while (due := fleet.isolation_due()) is not None:
        name, step = due
        beside = fleet.sisters(name, step.time)
        found = next(
            filter(None, isolation_steps(name, fleet.tracked[name].turbine, step, store, None, beside))
        )
        store.commit(fleet.keep_finding(name, found))
        times.append(step.time)
    return times


def told(store: Store) -> dict[str, object]:
    """What a store holds of alarms about the process, of causes, properties and final estimates."""
    delivery = kinds_of(*DELIVERY)
    alarms = "SELECT id, kind, severity, began, ended, statement, remedy FROM alarm ORDER BY id"
    return {
        "alarms": [row for row in queried(store, alarms) if row[1] not in delivery],
        "finding": store.memory("T1", "finding"),
        "shifts": store.memory("T1", "parameter_shifts"),
        "properties": queried(store, "SELECT * FROM property ORDER BY turbine, time, name"),
        "estimates": queried(store, "SELECT * FROM estimate WHERE final = 1 ORDER BY turbine, time"),
    }


def departures(found: dict[str, object], expected: dict[str, object]) -> list[object]:
    """What differs: for each name its first rows that one of the two does not hold."""
    departed: list[object] = []
    for name in expected:
        one, other = found[name], expected[name]
        if isinstance(one, list) and isinstance(other, list):
            one, other = [r for r in one if r not in other][:3], [r for r in other if r not in one][:3]
        if one != other:
            departed.append((name, one, other))
    return departed


def tracked(
    folder: Path, turbine: Turbine, record: Record, messages: Messages, count: int, at_once: bool = True,
    restarts: int = 0,
) -> tuple[dict[str, object], list[float]]:  # fmt: skip
    """What a store holds after rounds of `count` messages, and for which times causes were isolated: after
    each round, or only at the end.  The tracker begins anew after every so many rounds."""
    mapping, store = record_mapping(record, "T1"), open_store(f"sqlite:{folder / 'live.db'}")
    fleet, times = Fleet.from_store({"T1": turbine}, store), []
    for number, first in enumerate(range(0, len(messages), count), 1):
        part = [Delivery(content, at) for at, content in messages[first : first + count]]
        store.commit(fleet.round(part, mapping, "replay:"))
        if restarts and number % restarts == 0:
            fleet = Fleet.from_store({"T1": turbine}, store)
        if at_once:
            times += isolated(fleet, store)
    times += isolated(fleet, store)
    found = told(store)
    store.close()
    return found, times


@pytest.fixture(scope="module")
def expected(
    tmp_path_factory: pytest.TempPathFactory, cold: Turbine, record: Record
) -> tuple[dict[str, object], list[float]]:
    return tracked(tmp_path_factory.mktemp("expected"), cold, record, record_messages(record, "T1"), 400)


def test_there_is_something_to_compare(expected: tuple[dict, list]) -> None:
    found, times = expected
    kinds = {row[1] for row in found["alarms"]}
    assert kinds >= {"condensation", "cabinet changed", "reading contradicts", "sensor or water"}
    assert len(times) > 3 and times == sorted(times)
    assert ISOLATION_EVERY_S in set(np.diff(times)), "once a day while shifts last"
    assert all(at % 3600.0 < 900.0 for at in times), "with the first estimate of an hour"


@pytest.mark.parametrize(
    ("count", "late_s", "at_once", "restarts"),
    [(60, 0.0, False, 0), (100_000, 0.0, False, 0), (150, 1700.0, True, 0), (97, 1700.0, False, 10)],
    ids=["small rounds", "at once", "shuffled and repeated", "restarted"],
)
def test_alarms_and_causes_hang_on_event_times_alone(
    tmp_path: Path, cold: Turbine, record: Record, expected: tuple[dict, list], count: int, late_s: float,
    at_once: bool, restarts: int,
) -> None:  # fmt: skip
    messages = delay_and_repeat(record_messages(record, "T1"), late_s, 0.1 * bool(late_s), seed=3)
    found, times = tracked(tmp_path, cold, record, messages, count, at_once, restarts)
    assert times == expected[1]
    assert departures(found, expected[0]) == []


def test_sisters_are_evidence_in_whatever_order_turbines_are_delivered(
    tmp_path: Path, cold: Turbine, record: Record
) -> None:
    """What sisters read by a cause's time is waited for, but not one that has been silent for a day."""
    noise = np.random.default_rng(2)
    ambient = record["ambient_temperature"]
    warm = replace(ambient, value=ambient.value + 0.2 * noise.standard_normal(len(ambient.time)))
    beside = record.replace_series(warm)
    ended = beside.window(beside.start_s, beside.start_s + 3.0 * DAY_S)
    found = {}
    for name, other, hours, order in (
        ("alternating", beside, 6.0, 1), ("the other first", beside, 20.0, -1),
        ("a sister that ends", ended, 20.0, 1),
    ):  # fmt: skip
        records = {"T1": record, "T2": other}
        store = open_store(f"sqlite:{tmp_path / name}.db")
        fleet = Fleet.from_store(dict.fromkeys(records, cold), store)
        for begin in np.arange(record.start_s, record.end_s + 1.0, 3600.0 * hours):
            for turbine, one in list(records.items())[::order]:
                part = one.window(begin, begin + 3600.0 * hours - 1.0)
                messages = record_messages(part, turbine) if any(len(s.time) for s in part.series) else []
                delivered = [Delivery(content, at) for at, content in messages]
                store.commit(fleet.round(delivered, record_mapping(one, turbine), f"replay:{turbine}"))
                isolated(fleet, store)
        found[name] = told(store), fleet.tracked["T1"].finding
        store.close()
    assert found["the other first"] == found["alternating"]
    assert found["a sister that ends"][1].time_s > record.start_s + 7.0 * DAY_S


@pytest.mark.parametrize("speed", [0.0, 1e6])
def test_a_replay_gives_the_same_at_any_speed(
    tmp_path: Path, cold: Turbine, record: Record, expected: tuple[dict, list], speed: float
) -> None:
    """And no alarm about delivery, although the record is years old and has no rain gauge."""
    stream = Playback("replay:", record_messages(record, "T1"), record_mapping(record, "T1"), speed)
    url = f"sqlite:{tmp_path / 'live.db'}"
    service = Service({"T1": cold}, [stream], url)
    service.run(until_ended=True)
    store = open_store(url)
    assert service.health.failures == 0
    assert departures(told(store), expected[0]) == []
    assert queried(store, "SELECT COUNT(*) FROM alarm") == [(len(expected[0]["alarms"]),)]
    store.close()


def test_a_source_that_ends_while_the_loop_looks_is_read_to_its_end(
    tmp_path: Path, cold: Turbine, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The queue is empty, then the rest comes and the source ends, then the loop asks whether it has."""

    class Halting(Playback):
        def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
            half = len(self.messages) // 2
            for number, (at, content) in enumerate(self.messages):
                self._ended.wait(2.0 if number == half else 0.0)
                put(Delivery(content, at, place=str(number + 1)))

    day = record.window(record.start_s, record.start_s + DAY_S)
    stream = Halting("replay:", record_messages(day, "T1"), record_mapping(day, "T1"))
    service = Service({"T1": cold}, [stream], f"sqlite:{tmp_path / 'live.db'}")
    empty, ended = service._waiting.empty, service._sources_ended

    def slowly() -> bool:
        found = empty()
        if found and stream.state.word == "connected":
            assert stream._thread is not None
            stream._thread.join()
        return found

    def asked() -> bool:
        with monkeypatch.context() as patched:
            patched.setattr(service._waiting, "empty", slowly)
            return ended()

    monkeypatch.setattr(service, "_sources_ended", asked)
    service.run(until_ended=True)
    with closing(open_store(service.store_url)) as store:
        assert store.place("replay:") == str(len(stream.messages))
        assert store.size()["observation"] == count_of(day)


def test_alarms_about_delivery_do_not_begin_in_a_replay(cold: Turbine) -> None:
    """The same turbine, silent for a day: live it is stale, played back nothing is said."""
    for quiet, kinds in (((), ["data stale"]), (("T1",), [])):
        fleet = Fleet({"T1": cold})
        for hour in range(25):
            fleet.tick(1.6e9 + 3600.0 * hour, {}, None, quiet)
        assert [one.kind for one in fleet.open_alarms()] == kinds


def test_a_source_that_is_not_reached_is_one_alarm_after_its_limit(cold: Turbine) -> None:
    fleet, begin = Fleet(dict.fromkeys(("T1", "T2", "T3"), cold)), 1.6e9
    limits = {"mqtt://b": 60.0, "file:hourly.csv": 3.0 * 3600.0}
    begun = {}
    for second in range(0, 4 * 3600, 10):
        reaches = {url: Reach(begin, limit, "no answer") for url, limit in limits.items()}
        for alarm in fleet.tick(begin + second, reaches).alarms:
            if alarm.kind == "source lost":
                begun[alarm.id] = (alarm.turbine, alarm.began - begin, alarm.statement)
    assert [(turbine, after) for turbine, after, _ in begun.values()] == [("", 60.0), ("", 10800.0)]
    assert all("not been reached since 2020-09-13T12:26:40Z: no answer" in one[2] for one in begun.values())


@pytest.mark.parametrize("seed", [0, 7])
def test_every_estimate_up_to_the_point_is_final(
    tmp_path: Path, cold: Turbine, record: Record, seed: int
) -> None:
    """Readings a little out of order, in rounds of any size: a provisional estimate at an instant of the
    ambient alone goes when the final ones have passed it."""
    day = record.window(record.start_s, record.start_s + DAY_S)
    mapping, random = record_mapping(day, "T1"), np.random.default_rng(seed)
    single = [
        Delivery({"turbine": "T1", "time": content["time"], name: content[name]}, at)
        for at, content in record_messages(day, "T1")
        for name in content.keys() - {"turbine", "time"}
    ]
    order = np.argsort(np.arange(len(single)) + random.uniform(0.0, 15.0, len(single)))
    cuts = np.cumsum(random.choice([1, 2, 3, 5, 10, 30], len(single)))
    with closing(open_store(f"sqlite:{tmp_path / 'live.db'}")) as store:
        fleet = Fleet.from_store({"T1": cold}, store)
        for part in np.split(order, cuts[cuts < len(order)]):
            store.commit(fleet.round([single[place] for place in part], mapping, "replay:"))
        point = store.point("T1")
        rows = queried(store, "SELECT time, final FROM estimate WHERE turbine = 'T1'")
    assert point is not None and len(rows) > 80
    assert [final for at, final in rows] == [int(at <= point.time) for at, _ in rows]
