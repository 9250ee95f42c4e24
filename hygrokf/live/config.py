"""The tracker's file, `track.toml`: turbines, how payloads are read, sources, store, page.  All faults are told at once."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Mapping as MappingOf
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hygrokf.data.record import Site
from hygrokf.data.signals import SIGNALS, difference_to_si, unit_fault
from hygrokf.errors import HygrokfError, suggestion
from hygrokf.identification.results import ResultFault, read_fit
from hygrokf.identification.verdict import inherited
from hygrokf.live.condition import Surface
from hygrokf.live.forecast import LIMIT
from hygrokf.live.plan import LATENESS_S, WANDERING, Form, plan
from hygrokf.live.properties import standard_errors
from hygrokf.live.sources.kinds import stream_of
from hygrokf.live.sources.payload import GOOD, Field, Mapping
from hygrokf.live.sources.streams import Stream
from hygrokf.live.storage.postgres import url_fault
from hygrokf.live.table_reader import TableReader
from hygrokf.live.turbines import STALE_S, Turbine
from hygrokf.live.web.page_settings import PAGE, PageSettings, page_settings

STAMPS = ("instant", "start", "middle", "end")
RETENTION_S = 400.0 * 86400.0
LEAST_RETENTION_S = 7.0 * 86400.0

_TOP = ("store", "page", "lateness", "retention", "turbine", "mapping", "source", "wandering")
_TURBINE = (
    "name", "fit", "known_as", "cold_surface", "site", "rated_power_kW", "lateness", "humidity_limit", "stale"
)  # fmt: skip
_MAPPING = ("turbine", "time", "quality", "good", "tag", "value", "signals")
_SIGNAL = ("signal", "unit", "stamp", "interval", "accuracy", "resolution", "response_time")
_SURFACE = ("follows", "offset_K")
_SITE = ("latitude_deg", "longitude_deg", "altitude_m")


class ConfigFault(HygrokfError):
    """A tracker's file that cannot be used: every fault, one on a line."""

    def __init__(self, file: str, faults: list[str]) -> None:
        super().__init__("\n".join(f"{file}: {one}" for one in faults))
        self.faults = tuple(faults)


@dataclass(frozen=True)
class Config:
    """What a tracker runs on."""

    turbines: MappingOf[str, Turbine]
    streams: tuple[Stream, ...]
    store: str
    page: PageSettings = field(default_factory=PageSettings)
    retention_s: float = RETENTION_S


def read_config(path: str | os.PathLike[str]) -> Config:
    """The tracker's file.  Files in it are relative to it.  Raises ConfigFault."""
    file = Path(path)
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise ConfigFault(file.name, [f"no TOML: {fault}"]) from None
    except OSError as fault:
        raise ConfigFault(str(file), [f"cannot be read: {fault.strerror}"]) from None
    reader = TableReader()
    reader.known(content, _TOP, "the file")
    lateness_s = reader.seconds(content, "lateness", "the file", LATENESS_S)
    mapping = _mapping(content.get("mapping", {}), reader)
    turbines, names = _turbines(content, file.parent, mapping, lateness_s, reader)
    mapping = replace(mapping, turbines=names)
    streams: list[Stream] = []
    for where, table in reader.tables(content, "source"):
        made = stream_of(table, where, file.parent, mapping, reader)
        if made is None:
            continue
        if made.url in [one.url for one in streams]:
            reader.faults.append(
                f"{where}: {made.url} is a source already; two of one broker need a client_id each"
            )
        streams.append(made)
    if not streams and "source" not in content:
        reader.faults.append('no source: add [[source]] with url = "file:…" or "stdin"')
    store = reader.text(content, "store", "the file", "sqlite:live.db")
    if (wrong := url_fault(store)) is not None:
        reader.faults.append(f"store: {wrong}")
    if store.startswith("sqlite:") and not Path(store.removeprefix("sqlite:")).is_absolute():
        store = f"sqlite:{file.parent / store.removeprefix('sqlite:')}"
    retention_s = reader.seconds(content, "retention", "the file", RETENTION_S)
    if retention_s < LEAST_RETENTION_S:
        reader.faults.append("retention must be at least 7 d: a restart needs what was read before")
    page = page_settings(content.get("page", PAGE), file.parent, reader)
    if reader.faults:
        raise ConfigFault(file.name, reader.faults)
    return Config(turbines, tuple(streams), store, page, retention_s)


def _mapping(table: object, reader: TableReader) -> Mapping:
    if not isinstance(table, dict):
        reader.faults.append(f"mapping: expected a table [mapping], found {table!r}")
        table = {}
    where = "[mapping]"
    reader.known(table, _MAPPING, where)
    texts = {
        key: reader.text(table, key, where, default)
        for key, default in (
            ("turbine", "turbine"),
            ("time", "time"),
            ("quality", ""),
            ("tag", ""),
            ("value", ""),
        )
    }
    if bool(texts["tag"]) != bool(texts["value"]):
        reader.faults.append(f"{where}: tag and value belong together: one reading a payload needs both")
    good = table.get("good", list(GOOD))
    if not isinstance(good, list):
        reader.faults.append(f"{where}: good must be a list of marks, found {good!r}")
        good = []
    signals = table.get("signals", {})
    if not isinstance(signals, dict):
        reader.faults.append(f"[mapping.signals]: expected a table, found {signals!r}")
        signals = {}
    if not signals:
        reader.faults.append(
            'no signals: add [mapping.signals] with rows such as Tcab = { signal = "cabinet_temperature", unit = "degC" }'
        )
    fields = {
        name: one for name, entry in signals.items() if (one := _field(name, entry, reader)) is not None
    }
    taken: dict[str, str] = {}
    for name, one in fields.items():
        if one.signal in taken:
            reader.faults.append(f"[mapping.signals]: {name} and {taken[one.signal]} are both {one.signal}")
        taken[one.signal] = name
    named: dict[str, Any] = dict(texts)
    return Mapping(fields, **named, good=tuple(str(one).strip().lower() for one in good))


def _field(name: str, entry: object, reader: TableReader) -> Field | None:
    where = f"mapping.signals.{name}"
    if not isinstance(entry, dict):
        reader.faults.append(f'{where}: expected {{ signal = "…", unit = "…" }}, found {entry!r}')
        return None
    before = len(reader.faults)
    reader.known(entry, _SIGNAL, where)
    signal, unit = reader.text(entry, "signal", where), reader.text(entry, "unit", where)
    if signal not in SIGNALS:
        reader.faults.append(
            f'{where}: unknown signal "{signal}"{suggestion(signal, SIGNALS)} (docs/signals.md)'
        )
    elif (wrong := unit_fault(unit, signal)) is not None:
        reader.faults.append(f"{where}: {wrong}")
    stamp = reader.text(entry, "stamp", where, "instant")
    if stamp not in STAMPS:
        reader.faults.append(f"{where}: stamp must be one of {', '.join(STAMPS)}, found {stamp!r}")
    interval_s = reader.seconds(entry, "interval", where, 0.0)
    if (stamp == "instant") != (interval_s == 0.0):
        reader.faults.append(
            f'{where}: a mean needs both, stamp = "start", "middle" or "end" and its interval'
        )
    sizes = {key: reader.number(entry, key, where) for key in ("accuracy", "resolution")}
    response_s = reader.seconds(entry, "response_time", where, 0.0)
    if len(reader.faults) > before:
        return None
    si = {k: None if v is None else difference_to_si(v, unit, signal) for k, v in sizes.items()}
    # W, duties and speeds of machines hold over steps; everything else is joined by straight lines
    stepped = SIGNALS[signal].unit in ("W", "rad/s") or signal == "preheating"
    form = Form(
        hold="zero-order" if interval_s > 0 or stepped else "linear",
        interval_s=interval_s,
        resolution=si["resolution"] or 0.0,
        accuracy=si["accuracy"],
        response_time_s=response_s if "response_time" in entry else None,
    )
    return Field(signal, unit, form, stamp)


def _turbines(
    content: MappingOf, folder: Path, mapping: Mapping, lateness_s: float, reader: TableReader
) -> tuple[dict[str, Turbine], dict[str, str]]:
    """Turbines by name, and the names in payloads that stand for each."""
    forms = {one.signal: one.form for one in mapping.fields.values()}
    rates = _wandering(content.get("wandering"), reader)
    turbines: dict[str, Turbine] = {}
    names: dict[str, str] = {}
    rows = reader.tables(content, "turbine")
    if not rows and "turbine" not in content:
        reader.faults.append('no turbine: add [[turbine]] with name = "…" and fit = "…/fit.json"')
    for where, table in rows:
        reader.known(table, _TURBINE, where)
        name = reader.text(table, "name", where)
        if not name or len(name) > 100 or not name.isprintable():
            reader.faults.append(
                f"{where}: name must be text of 1 to 100 printable characters, found {name!r}"
            )
        if name in turbines:
            reader.faults.append(f"{where}: a second turbine named {name!r}")
        for known in table.get("known_as", [name]) if isinstance(table.get("known_as", []), list) else [name]:
            if names.setdefault(str(known), name) != name:
                reader.faults.append(f"{where}: {known!r} already stands for {names[str(known)]!r}")
        made = _turbine(
            table,
            name,
            where,
            folder,
            forms,
            rates,
            reader.seconds(table, "lateness", where, lateness_s),
            reader,
        )
        if made is not None:
            turbines[name] = made
    return turbines, names


def _turbine(
    table: MappingOf,
    name: str,
    where: str,
    folder: Path,
    forms: MappingOf[str, Form],
    rates: MappingOf[str, float] | None,
    lateness_s: float,
    reader: TableReader,
) -> Turbine | None:
    surface = _table(table, "cold_surface", _SURFACE, where, reader)
    cold = Surface(surface.get("follows", Surface().follows), surface.get("offset_K", 0.0))
    if not 0.0 <= cold.follows <= 1.0:
        reader.faults.append(f"{where}: cold_surface.follows must lie within 0 … 1, found {cold.follows:g}")
    place = _table(table, "site", _SITE, where, reader)
    site = None
    if place:
        try:
            site = Site(
                place.get("latitude_deg", math.nan),
                place.get("longitude_deg", math.nan),
                place.get("altitude_m"),
            )
        except ValueError as fault:
            reader.faults.append(f"{where}: {fault}")
    rated = reader.number(table, "rated_power_kW", where)
    limit = reader.number(table, "humidity_limit", where, LIMIT) or LIMIT
    if not 0.0 < limit <= 1.0:
        reader.faults.append(f"{where}: humidity_limit must lie above 0 and at most at 1, found {limit:g}")
    stale_s = reader.seconds(table, "stale", where, STALE_S)
    if stale_s <= 0.0:
        reader.faults.append(f"{where}: stale must be longer than nothing")
    path = reader.text(table, "fit", where)
    if not path:
        reader.faults.append(f"{where}: fit is missing: the fit.json of the turbine's model")
        return None
    try:
        fit = read_fit(folder / path)
        made = plan(
            fit,
            name=name,
            forms=forms,
            lateness_s=lateness_s,
            wandering=rates,
            site=site,
            rated_power_W=None if rated is None else 1e3 * rated,
        )
    except (ResultFault, ValueError, KeyError) as fault:
        reader.faults.append(f"{where}: {fault}")
        return None
    except OSError as fault:
        reader.faults.append(f"{where}: {folder / path}: {fault.strerror}")
        return None
    return Turbine(made, cold, standard_errors(fit), limit, stale_s, inherited(fit.results))


def _table(
    table: MappingOf, key: str, keys: tuple[str, ...], where: str, reader: TableReader
) -> dict[str, float]:
    """A table of numbers within a table."""
    found = table.get(key, {})
    if not isinstance(found, dict):
        reader.faults.append(f"{where}: {key} must be a table of numbers, found {found!r}")
        return {}
    reader.known(found, keys, f"{where} {key}")
    numbers = {name: reader.number(found, name, f"{where} {key}") for name in keys if name in found}
    return {name: value for name, value in numbers.items() if value is not None}


def _wandering(table: object, reader: TableReader) -> dict[str, float] | None:
    """Rates for a day of the properties that are tracked, where the file states them."""
    if table is None:
        return None
    if not isinstance(table, dict):
        reader.faults.append(f"[wandering]: expected a table of rates for a day, found {table!r}")
        return None
    reader.known(table, tuple(WANDERING), "[wandering]")
    rates = {name: reader.number(table, name, "[wandering]") for name in WANDERING if name in table}
    for name, rate in rates.items():
        if rate is None or not 0.0 < rate <= 1.0:
            reader.faults.append(
                f"[wandering]: {name} must be a rate above 0 and at most 1 a day^0.5, found {rate}"
            )
    return {name: rate for name, rate in rates.items() if rate is not None}
