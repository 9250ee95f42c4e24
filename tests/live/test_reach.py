"""Every source has one number, since when it is not reached, whatever its kind and its word for that."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
from builders.ports import free_port
from builders.waiting import eventually

from hygrokf.data.toml_form import Place
from hygrokf.live.config import stream_of
from hygrokf.live.service import Service
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.stream import Stream
from hygrokf.live.turbine import Turbine
from hygrokf.live.web.application import PageEndpoints
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.server import Hub, serve

MAPPING = PayloadMapping({"Tcab": Field("cabinet_temperature", "degC")}, turbines={"T1": "T1"})
NODES = {"ns=2;s=T1.Tcab": {"turbine": "T1", "field": "Tcab"}}
QUERY = {"query": "SELECT * FROM a WHERE at > %(after)s ORDER BY at", "watermark": "at", "poll": "40s"}


def source(folder: Path, **table: object) -> Stream:
    place = Place()
    made = stream_of(table, place, folder, MAPPING)
    assert made is not None, place.faults
    return made


@contextmanager
def started(stream: Stream) -> Iterator[Stream]:
    stream.start(None, lambda one: None)
    try:
        yield stream
    finally:
        stream.stop()
        stream.stop()


@pytest.mark.parametrize(
    ("table", "limit_s"),
    [
        ({"url": "file:none.csv"}, 60.0),
        ({"url": "file:none.csv", "reach_limit": "2h"}, 7200.0),
        ({"url": "mqtt://127.0.0.1:{port}", "topics": ["a"]}, 60.0),
        ({"url": "opc.tcp://127.0.0.1:{port}/", "nodes": NODES}, 60.0),
        ({"url": "postgresql://u@127.0.0.1:{port}/d", **QUERY}, 120.0),
    ],
    ids=["file", "limit stated", "mqtt", "opcua", "postgresql"],
)
def test_what_was_never_there_is_not_reached_from_the_start_on(
    tmp_path: Path, table: dict[str, object], limit_s: float
) -> None:
    stream = source(tmp_path, **{**table, "url": str(table["url"]).format(port=free_port())})
    assert isinstance(stream, Stream)
    stream.clock = lambda: 1000.0
    assert stream.reach().since == 1000.0
    with started(stream):
        stream.clock = lambda: 5000.0
        eventually(lambda: stream.state.word in ("waiting", "lost"))
        assert stream.reach()[:2] == (1000.0, limit_s) and stream.reach().reason
        assert stream.reach().share(1000.0 + 2.0 * limit_s) == 2.0


def test_the_limit_of_a_file_is_three_of_its_usual_intervals(tmp_path: Path) -> None:
    path = tmp_path / "live.csv"
    path.write_text("turbine,time,Tcab\n")
    stream = source(tmp_path, url=f"file:{path}")
    with started(stream):
        eventually(lambda: stream.reach().since is None)
        for number in range(3):
            grown = len(stream._growth_times)
            with path.open("a") as file:
                file.write(f"T1,{1.6e9 + number:.0f},20\n")
            eventually(lambda grown=grown: len(stream._growth_times) > grown)
        assert 0.0 < stream.usual_interval_s < 60.0 and stream.reach().limit_s == 60.0
        stream.usual_interval_s = 3600.0
        path.unlink()
        eventually(lambda: stream.reach().since is not None)
        assert stream.reach().limit_s == 3.0 * 3600.0


def test_turbines_are_not_silent_for_themselves_while_their_source_is_an_alarm(
    tmp_path: Path, turbine: Turbine
) -> None:
    stream, names = source(tmp_path, url="file:none.csv"), ("T1", "T2")
    stream.mapping = replace(MAPPING, turbines={name: name for name in names})
    service = Service(dict.fromkeys(names, turbine), [stream], f"sqlite:{tmp_path / 'live.db'}")
    began = stream.reach().since
    assert service._quiet(service.reaches(), began + 59.0) == []
    assert service._quiet(service.reaches(), began + 61.0) == list(names)


def test_liveness_and_readiness(tmp_path: Path, turbine: Turbine) -> None:
    """A source beyond its limit makes the tracker not ready, and is no reason to restart it."""
    stream = source(tmp_path, url="file:none.csv")
    service = Service({"T1": turbine}, [stream], f"sqlite:{tmp_path / 'live.db'}")
    service._open()
    settings = PageSettings("127.0.0.1", 0)
    hub = Hub()
    page = PageEndpoints(service, hub, settings)
    try:
        with serve(page.app(), settings, hub) as server, httpx.Client(base_url=server.url) as client:

            def answers() -> list[int]:
                return [client.get(path).status_code for path in ("/healthz", "/readyz")]

            assert answers() == [200, 200]
            stream._unreached_since = stream.clock() - 61.0
            assert answers() == [200, 503]
            assert client.get("/healthz").json() == {"ok": True, "sources": {"idle": 1}}
            assert client.get("/readyz").json()["fault"] == "1 of 1 sources are not reached"
            stream.reach_limit_s = 3600.0
            assert answers() == [200, 200]
            service.health.looped -= 1e9  # −∞ and ∞ alike: before its loop it cannot be stuck
            assert answers() == [200, 200]
            service.health.looped = -1e9
            assert answers() == [503, 503]
    finally:
        page.close()
        service.store.close()
