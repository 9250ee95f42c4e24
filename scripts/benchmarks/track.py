"""Figures of the live tracker: messages a second, waits, start, memory, one turbine's update and its
parts."""

from __future__ import annotations

import gc
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from builders.brokers import authority, mosquitto
from builders.ports import free_port

from benchmarks import track_cases as cases
from benchmarks.measure import Figure, Times, interleaved, timed
from hygrokf.estimation.batch_filter import SideBySide
from hygrokf.live import service as loop
from hygrokf.live.plan import Form, plan
from hygrokf.live.service import Service
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import open_store
from hygrokf.live.tracker import offline_course, record_of
from hygrokf.live.turbines import Fleet, Turbine, conditions
from hygrokf.modelling.inputs import model_inputs

PUBLISHER = Path(__file__).with_name("publisher.py")
ROOT = Path(__file__).resolve().parents[2]
DAYS = 2.0
"""[d] of readings that every turbine has when it is measured."""
QUIET = ("allow_anonymous true", "log_type none", "log_type subscribe")
"""The broker's settings; of its log only what tells that the tracker has subscribed."""

Section = Callable[[bool], Iterable[Figure]]


def _stamps(days: float, end_s: float) -> list:
    return cases.rows(end_s, round(days * cases.DAY_S / cases.STEP_S))


# -- one turbine alone ---------------------------------------------------------------------------------------
def update(quick: bool) -> Iterator[Figure]:
    """What a stamp of one turbine costs: taken in, filtered, committed; alone, and a hundred of them
    together."""
    stamps = _stamps(DAYS, 1.7e9)
    more = 10 if quick else 100
    for count in (1,) if quick else (1, 100):
        with tempfile.TemporaryDirectory() as folder:
            store = open_store(f"sqlite:{folder}/live.db")
            fleet = Fleet.from_store(cases.turbines(count), store)
            cases.fill(store, fleet, stamps[:-more])
            how, taken, committed = cases.mapping(list(fleet.tracked)), [], []
            for stamp in stamps[-more:]:
                texts = [text for name in fleet.tracked for text in cases.messages(name, [stamp])]
                deliveries = [Delivery(text.encode(), stamp[0]) for text in texts]
                begin = time.process_time()
                batch = fleet.round(deliveries, how, "mqtt://filled")
                middle = time.process_time()
                store.commit(batch)
                taken.append(1e3 * (middle - begin) / count)
                committed.append(1e3 * (time.process_time() - middle) / count)
            section = f"update, {count} turbine{'s at once' if count > 1 else ''}"
            yield timed(section, "taken and filtered", "ms", Times(np.array(taken)))
            yield timed(section, "committed", "ms", Times(np.array(committed)))
            if count == 1:
                yield from _parts(fleet, more)
            store.close()


def _parts(fleet: Fleet, repetitions: int) -> Iterator[Figure]:
    (name, state), *_ = fleet.tracked.items()
    one, tracker = state.turbine, state.tracker
    stored = one.plan, tracker._times, tracker._values, tracker.lost
    record = record_of(*stored)
    made = model_inputs(one.plan.design, record)
    course = tracker._course(made)
    found = interleaved(
        {
            "readings as a record": lambda: record_of(*stored),
            "from the record to instants": lambda: model_inputs(one.plan.design, record),
            "the filter": lambda: tracker._course(made),
            "the air's condition": lambda: conditions({name: (one, course)}),
        },
        repetitions,
    )
    for part, times in found.items():
        yield timed("update, its parts", part, "ms", times * 1e3)


def step(quick: bool) -> Iterator[Figure]:
    """One step of many turbines in the lanes of one call: the fitted model, and the tracked one with what
    wanders in it."""
    count = 100 if quick else 10_000
    for words, wandering in (("the fitted model", {}), ("the tracked model", None)):
        runs, move = _side_by_side(count, wandering)
        calls = {f"{minutes} minutes": partial(move, minutes / 60.0) for minutes in (10, 20)}
        section = f"a step of {count:,} turbines, {len(runs.model.states)} states"
        for name, call in calls.items():
            times = interleaved({name: call}, 10 if quick else 50)[name]
            yield timed(section, name, "ms", times * 1e3, at_most=3.0, note=words)


def _side_by_side(count: int, wandering: Mapping | None) -> tuple[SideBySide, Callable[[float], object]]:
    """So many runs, each with values of its own, and what takes them a step of so many hours on."""
    made = cases.record()
    fit = cases.fit()
    forms = {s.signal: Form(s.hold, s.interval_s) for s in made.series}
    own = plan(fit, forms=forms, site=made.site, rated_power_W=made.rated_power_W, wandering=wandering)
    course = offline_course(own, made)
    line, last = course.run.timeline, len(course.run.timeline) - 1
    mean = np.repeat(course.trace.mean[last : last + 1], count, axis=0)
    values = [{**own.values, "hygric_k": 0.4 + 0.2 * number / count} for number in range(count)]
    runs = SideBySide(own.model, values)
    inputs = {name: np.full(count, line.input(name)[last]) for name in own.model.inputs}
    runs.begin(inputs)
    return runs, lambda hours: runs.step(mean, hours, inputs)


# -- through a broker ----------------------------------------------------------------------------------------
class Watched:
    """What was committed when, and how long readings waited for an estimate that holds them."""

    def __init__(self) -> None:
        self.commits: list[tuple[float, int]] = []
        self.waits: list[float] = []
        self._open: dict[str, list[float]] = defaultdict(list)

    def settle(self, batch) -> None:
        now = time.time()
        if batch.observations:
            self.commits.append((now, len(batch.observations)))
        for one in batch.observations:
            self._open[one.turbine].append(one.received)
        for turbine in batch.estimates:
            self.waits += [now - received for received in self._open.pop(turbine, ())]

    @property
    def count(self) -> int:
        return sum(n for _, n in self.commits)

    @property
    def a_second(self) -> float:
        (first, before), *_, (last, _) = self.commits
        return (self.count - before) / (last - first)


@contextmanager
def served(
    port: int, turbines: dict[str, Turbine], store: str, ca: Path | None = None
) -> Iterator[tuple[Service, Watched]]:
    """A service on the broker's messages that has taken in what its store holds; with a `ca` over TLS."""
    watched = Watched()
    scheme = "mqtt" if ca is None else "mqtts"
    broker = Broker(f"{scheme}://127.0.0.1:{port}", ("scada/#",), client_id="tracker", ca=str(ca or ""))
    stream = Mqtt(broker, cases.mapping(list(turbines)))
    service = Service(turbines, [stream], store, watched.settle)
    runner = threading.Thread(target=service.run)
    runner.start()
    try:
        _until(lambda: stream.state[0] == "connected" and not service.fleet.waiting, 300.0)
        yield service, watched
    finally:
        service.stop()
        runner.join(timeout=60.0)


@contextmanager
def filled(count: int, days: float, end_s: float) -> Iterator[tuple[Path, dict[str, Turbine], str]]:
    """A folder, so many turbines, and their store with so many days of readings up to a time [s]."""
    with tempfile.TemporaryDirectory() as folder:
        url, turbines = f"sqlite:{folder}/live.db", cases.turbines(count)
        store = open_store(url)
        cases.fill(store, Fleet.from_store(turbines, store), _stamps(days, end_s))
        store.close()
        yield Path(folder), turbines, url


def _published(folder: Path, port: int, lines: Iterable[str], rate: float) -> subprocess.Popen:
    file = folder / "lines"
    file.write_text("\n".join(lines))
    command = [sys.executable, PUBLISHER, str(port), file, str(rate)]
    return subprocess.Popen(command)


def _until(happened: Callable[[], object], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not happened():
        if time.monotonic() > end:
            raise TimeoutError("the tracker did not come that far")
        time.sleep(0.05)


def _through(
    turbines: dict[str, Turbine], folder: Path, url: str, begin_s: float, sweeps: int, rate: float,
    seconds: float = math.inf, tls: bool = False
) -> tuple[Watched, float]:  # fmt: skip
    """Stamps of all turbines, turbine by turbine, through a broker: what was seen, and the CPU time [s] that
    it took.

    With `tls` the tracker reads from a listener of its own; the publisher's is plain in any case.
    """
    stamps = [
        (begin_s + cases.STEP_S * (i + 1), values) for i, (_, values) in enumerate(cases.rows(0.0, sweeps))
    ]
    lines = [text for stamp in stamps for name in turbines for text in cases.messages(name, [stamp])]
    lines = lines[: int(min(len(lines), rate * seconds))] if rate else lines
    (folder / "broker").mkdir(exist_ok=True)
    (folder / "broker" / "mosquitto.db").unlink(missing_ok=True)
    own, port = authority(folder / "broker"), free_port()
    server, key = own.issue("server", "127.0.0.1")
    secured = (f"listener {port} 127.0.0.1", f"cafile {own.file}", f"certfile {server}", f"keyfile {key}")
    with (
        mosquitto(folder / "broker", *QUIET, *secured) as broker,
        served(port if tls else broker.port, turbines, url, own.file if tls else None) as (_, watched),
    ):
        begin = time.process_time()
        publisher = _published(folder, broker.port, lines, rate)
        try:
            _until(lambda: watched.count >= len(lines), 600.0)
            spent = time.process_time() - begin
            _until(lambda: len(watched.waits) >= len(lines), 600.0)
        finally:
            publisher.kill()
            publisher.wait()
    return watched, spent


@contextmanager
def forecasts(on: bool) -> Iterator[None]:
    before = loop.EVERY_S
    loop.EVERY_S = before if on else math.inf
    try:
        yield
    finally:
        loop.EVERY_S = before


def throughput(quick: bool) -> Iterator[Figure]:
    """Messages a second through mosquitto at quality 1 into SQLite, as fast as they are taken."""
    for count in (20,) if quick else (200, 2_000):
        sweeps = 3 if quick else 60_000 // (cases.PER_STAMP * count)
        end_s = time.time() - cases.STEP_S * (sweeps + 1)
        for on in (False, True):
            with forecasts(on), filled(count, 1.0, end_s) as (folder, turbines, url):
                watched, spent = _through(turbines, folder, url, end_s, sweeps, 0.0)
            section = f"throughput, {count:,} turbines, forecasts {'on' if on else 'off'}"
            waits = np.quantile(watched.waits, [0.5, 0.99])
            yield Figure(
                section, "sustained", "messages/s", watched.a_second, at_least=2_000.0,
                note=f"{watched.count / spent:,.0f} a second of CPU time; load {os.getloadavg()[0]:.1f}; "
                f"estimates {waits[0]:.2f} s after the arrival, 99 % within {waits[1]:.2f} s",
            )  # fmt: skip


def tls(quick: bool) -> Iterator[Figure]:
    """Messages a second over TLS and without it, taking turns in one run."""
    count, turns = (20, 1) if quick else (200, 5)
    sweeps = 3 if quick else 15
    end_s = time.time() - cases.STEP_S * (2 * turns * sweeps + 1)
    found: dict[bool, list[float]] = {False: [], True: []}
    with forecasts(False), filled(count, 1.0, end_s) as (folder, turbines, url):
        for turn in range(2 * turns):
            over_tls = bool(turn % 2)
            begin_s = end_s + cases.STEP_S * turn * sweeps
            watched, _ = _through(turbines, folder, url, begin_s, sweeps, 0.0, tls=over_tls)
            found[over_tls].append(watched.a_second)
    plain, encrypted = np.array(found[False]), np.array(found[True])
    section, load = f"over TLS, {count:,} turbines", f"load {os.getloadavg()[0]:.1f}"
    low, middle, high = np.quantile(plain, [0.25, 0.5, 0.75])
    yield Figure(section, "plain", "messages/s", float(middle), float(low), float(high), note=load)
    low, middle, high = np.quantile(encrypted, [0.25, 0.5, 0.75])
    yield Figure(
        section, "over TLS", "messages/s", float(middle), float(low), float(high), at_least=1_000.0, note=load
    )
    low, middle, high = np.quantile(encrypted / plain, [0.25, 0.5, 0.75])
    yield Figure(section, "TLS / plain", "", float(middle), float(low), float(high), at_least=0.6)


def waits(quick: bool) -> Iterator[Figure]:
    """Time from the arrival of a reading to the commit of an estimate that holds it, forecasts on."""
    count = 20 if quick else 1_000
    seconds = 3.0 if quick else 40.0
    for rate in (83.0, 500.0, 2_000.0):
        sweeps = math.ceil(rate * seconds / (cases.PER_STAMP * count))
        end_s = time.time() - cases.STEP_S * (sweeps + 1)
        with filled(count, 1.0, end_s) as (folder, turbines, url):
            watched, spent = _through(turbines, folder, url, end_s, sweeps, rate, seconds)
        found = 1e3 * np.array(watched.waits)
        section = f"waits, {count:,} turbines, {rate:,.0f} messages/s"
        low, middle, high, most = np.quantile(found, [0.25, 0.5, 0.75, 0.99])
        yield Figure(section, "median", "ms", float(middle), float(low), float(high))
        yield Figure(
            section, "99 %", "ms", float(most), at_most=250.0,
            note=f"{watched.a_second:,.0f} a second were stored, {spent / seconds:.2f} of a core; load "
                 f"{os.getloadavg()[0]:.1f}",
        )  # fmt: skip


# -- start and memory ----------------------------------------------------------------------------------------
def start(quick: bool) -> Iterator[Figure]:
    """From `hygrokf track` to its subscription at the broker, with a fit and two days of readings of every
    turbine."""
    count = 20 if quick else 1_000
    with filled(count, DAYS, time.time()) as (folder, turbines, url):
        lines = [f'store = "{url}"']
        for name, one in turbines.items():
            cases.write_model(one, folder / name)
            lines += ["[[turbine]]", f'name = "{name}"', f'fit = "{name}"', "rated_power_kW = 2000"]
        lines += ["[mapping.signals]", *cases.fields()]
        (folder / "broker").mkdir()
        with mosquitto(folder / "broker", *QUIET) as broker:
            source = ["[[source]]", f'url = "{broker.url}"', 'topics = ["scada/#"]', 'client_id = "tracker"']
            (folder / "track.toml").write_text("\n".join([*lines, *source]))
            times = []
            for number in range(1 if quick else 3):
                command = [sys.executable, "-m", "hygrokf", "track", "track.toml", "--no-page"]
                begin = time.monotonic()
                tracker = subprocess.Popen(
                    command,
                    cwd=folder,
                    stderr=subprocess.DEVNULL,
                    env={**os.environ, "PYTHONPATH": str(ROOT)},
                )
                try:
                    _until(lambda number=number: broker.log().count("tracker 1 scada/#") > number, 120.0)
                    times.append(time.monotonic() - begin)
                finally:
                    tracker.kill()
                    tracker.wait()
        size = Path(url.removeprefix("sqlite:")).stat().st_size / 2**20
    yield timed(
        f"start, {count:,} turbines", "until it has subscribed", "s", Times(np.array(times)), at_most=5.0,
        note=f"a store of {size:.0f} MB; load {os.getloadavg()[0]:.1f}",
    )  # fmt: skip


MEMORY = """
import gc, sys
from pathlib import Path
from benchmarks import track_cases as cases
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.turbines import Fleet
def resident():
    gc.collect()
    line = next(l for l in Path("/proc/self/status").read_text().splitlines() if l.startswith("VmRSS"))
    return int(line.split()[1])
few, many = int(sys.argv[1]), int(sys.argv[2])
turbines = cases.turbines(few + many)
stamps = cases.rows(1.7e9, 288)
how = cases.mapping(list(turbines))
def filled(names):
    fleet = Fleet({name: turbines[name] for name in names})
    for name in names:
        for first in range(0, len(stamps), 48):
            texts = cases.messages(name, stamps[first : first + 48])
            fleet.round([Delivery(text, 1.7e9) for text in texts], how)
    return fleet
names = list(turbines)
kept = [filled(names[:few])]
before = resident()
kept.append(filled(names[few:]))
print((resident() - before) / many)
"""


def memory(quick: bool) -> Iterator[Figure]:
    """What 1,000 turbines of one model hold beside the first ten, after two days of readings each."""
    count = 50 if quick else 1_000
    plans = _plan_kB(10 if quick else 100)
    paths = os.pathsep.join([str(ROOT), str(ROOT / "scripts"), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-c", MEMORY, "10", str(count)], env={**os.environ, "PYTHONPATH": paths},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    section = f"memory, {count:,} turbines"
    if done.returncode:
        yield Figure(
            section, "resident", "kB/turbine", math.nan, at_most=50.0, note=f"not run: {done.stderr[-200:]}"
        )
        return
    yield Figure(
        section,
        "resident",
        "kB/turbine",
        float(done.stdout) + plans,
        at_most=50.0,
        note=f"of it {plans:.1f} kB its plan",
    )


def _plan_kB(count: int) -> float:
    """[kB] that a turbine's plan holds, beside a model that is there already."""
    import tracemalloc

    first = cases.turbines(1)
    gc.collect()
    tracemalloc.start()
    kept = cases.turbines(count)
    gc.collect()
    size = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert first and kept
    return size / count / 1024


SECTIONS: dict[str, Section] = {
    "update": update,
    "step": step,
    "throughput": throughput,
    "tls": tls,
    "waits": waits,
    "start": start,
    "memory": memory,
}
