"""A store that a real service filled up to now, for the page: its turbines, their records, and a forecast by
hand."""

from __future__ import annotations

import json
import math
import queue
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import numpy as np
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from builders.live_case import live_record, live_turbine
from builders.record_edits import without
from builders.store_case import queried
from hygrokf.data.record import Record
from hygrokf.data.structured import plain
from hygrokf.live.condition import Surface
from hygrokf.live.forecast import LIMIT, ForecastMade
from hygrokf.live.service import Service
from hygrokf.live.sources.local import Playback, record_mapping, record_messages
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.stream import Delivery, Stream
from hygrokf.live.storage.schema import forecast
from hygrokf.live.storage.statements import insert_new
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.web.application import PageEndpoints
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.server import Hub, PageServer, serve
from hygrokf.texts.live_codes import BasisCode

HOUR_S = 3600.0
LOCAL = PageSettings(port=0)


def recent_record(folder: Path, seed: int, days: float, end_s: float) -> Record:
    """The synthetic turbine's record, as if it ended at a time [s]."""
    made = live_record(folder, seed, days)
    shift = end_s - max(float(s.time[-1]) for s in made.series)
    return replace(made, series=tuple(replace(s, time=s.time + shift) for s in made.series))


@dataclass(frozen=True)
class Case:
    """A turbine of the page.

    `seed` of its record; its coldest `surface`; signals that it is `without`; for how many hours it is
    silent; values of its model that are `known`, the others are start values.
    """

    name: str
    seed: int = 7
    surface: Surface = field(default_factory=Surface)
    without: tuple[str, ...] = ()
    silent_h: float = 0.0
    known: Mapping[str, float] = field(default_factory=dict)


class Present(Playback):
    """A record that ends now, and is judged by the clock on the wall."""

    def now(self) -> float:
        return time.time()


def played(record: Record, name: str) -> Playback:
    """A source that delivers a record's messages, each at its own time."""
    return Present(f"replay:{name}", record_messages(record, name), record_mapping(record, name))


def filled(
    folder: Path,
    cases: Sequence[Case],
    days: float = 3.0,
    on_commit: Callable[[object], None] = lambda batch: None,
    url: str = "",
) -> Service:
    """A service that has run over the records of turbines, up to now; without a `url` its store is a file."""
    end_s = 60.0 * (time.time() // 60.0)
    records: dict[int, Record] = {}
    turbines, streams = {}, []
    for case in cases:
        if case.seed not in records:
            records[case.seed] = recent_record(folder / f"record{case.seed}", case.seed, days, end_s)
        record = records[case.seed]
        turbines[case.name] = replace(live_turbine(record, **case.known), surface=case.surface)
        kept = without(record, *case.without)
        if case.silent_h:
            kept = kept.window(kept.start_s, end_s - HOUR_S * case.silent_h)
        streams.append(played(kept, case.name))
    service = Service(turbines, streams, url or f"sqlite:{folder / 'live.db'}", on_commit)
    service.run(until_ended=True)
    return service


def add_forecast(
    store: Store, name: str, statement: str, hours: int = 36, sd: float = 0.6, drift: float = -0.12
) -> None:
    """A forecast that goes on from the newest estimate: a day's swing about it, less sure with time.

    drift: of the margin [K/h].
    """
    (start,) = queried(
        store,
        "SELECT time, temperature_K, relative_humidity, absolute_humidity_g_m3, dew_point_K, margin_K FROM "
        "estimate WHERE turbine = ? ORDER BY time DESC LIMIT 1",
        (name,),
    )
    made, kelvin, humidity, density, dew, margin = start
    told = BasisCode.NO_FORECAST(fault=statement)
    rows = []
    for step in range(1, 2 * hours + 1):
        h = step / 2.0
        swing = math.sin(2.0 * math.pi * h / 24.0)
        width = sd * math.sqrt(1.0 + h / 3.0)
        expected = margin + drift * h + 2.0 * swing
        chance = 0.5 * math.erfc(expected / (width * math.sqrt(2.0)))
        air, air_sd = float(np.clip(humidity - 0.03 * swing, 0.02, 1.0)), 0.02 * width
        above = 0.5 * math.erfc((LIMIT - air) / (air_sd * math.sqrt(2.0)))
        rows.append(
            (
                name, made + HOUR_S * h, made, kelvin + 2.0 * swing, width, air, air_sd,
                density, 0.3 * width, dew, width, None, None, expected, width, chance, above,
            )
        )  # fmt: skip
    with store.transaction():
        queried(store, "DELETE FROM forecast WHERE turbine = ?", (name,))
        store.execute_many(insert_new(forecast), rows)
        queried(
            store,
            "INSERT INTO memory (turbine, name, content) VALUES (?, 'forecast', ?) "
            "ON CONFLICT (turbine, name) DO UPDATE SET content = excluded.content",
            (name, json.dumps(plain(ForecastMade(made, told, LIMIT, told)))),
        )


def opened(service: Service) -> Store:
    """A connection of one's own to the service's store."""
    return open_store(service.store_url)


class Fed(Stream):
    """A source that delivers what a test gives it."""

    def __init__(self, url: str, mapping: PayloadMapping) -> None:
        super().__init__(mapping)
        self.url = url
        self._given: queue.Queue = queue.Queue()

    def give(self, messages: Sequence[tuple[float, dict]]) -> None:
        for one in messages:
            self._given.put(one)

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        while not self._ended.is_set():
            with suppress(queue.Empty):
                at, content = self._given.get(timeout=0.05)
                put(Delivery(content, at))


@contextmanager
def served(service: Service, settings: PageSettings = LOCAL) -> Iterator[tuple[PageEndpoints, PageServer]]:
    """A page of a service, and its server, which runs as long as the block."""
    hub = Hub()
    page = PageEndpoints(service, hub, settings)
    with serve(page.app(), settings, hub) as server:
        yield page, server
    page.close()


def write_certificate(certificate: Path, key: Path) -> None:
    """A certificate for localhost and 127.0.0.1, signed by itself."""
    made = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(UTC)
    names = x509.SubjectAlternativeName([x509.DNSName("localhost"), x509.IPAddress(ip_address("127.0.0.1"))])
    signed = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(made.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(minutes=5))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(names, critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(made, hashes.SHA256())
    )
    certificate.write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    key.write_bytes(
        made.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
