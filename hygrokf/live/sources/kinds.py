"""Creates the `Stream` for a `[[source]]` table of the tracker's file, by the scheme of its URL."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from hygrokf.data.toml_form import Place, read_form
from hygrokf.live.sources.local import FileForm, InputForm
from hygrokf.live.sources.mqtt_form import MqttForm
from hygrokf.live.sources.opcua_form import OpcUaForm
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.postgres import PostgresForm
from hygrokf.live.sources.stream import SourceKeys, Stream

KINDS: Mapping[str, type[SourceKeys]] = {
    "file": FileForm,
    "stdin": InputForm,
    "mqtt": MqttForm,
    "mqtts": MqttForm,
    "opc.tcp": OpcUaForm,
    "postgresql": PostgresForm,
    "postgres": PostgresForm,
}
"""Scheme of a URL -> form of the table."""


def stream_of(
    table: Mapping[str, object], place: Place, folder: Path, mapping: PayloadMapping
) -> Stream | None:
    """The stream of a `[[source]]` table; None if the table is faulty, with the faults in `place`.

    Nothing is connected or opened yet.  Paths are relative to `folder`.  With `weather = true` the source
    delivers weather forecasts.
    """
    url = table.get("url")
    scheme = url.partition(":")[0] if isinstance(url, str) else ""
    kind = KINDS.get(scheme)
    if kind is None:
        schemes = ", ".join(f"{name}:" if name != "stdin" else name for name in KINDS)
        # the rest of the url may hold a password
        place.fault(f"url must begin with one of {schemes}, found {scheme!r}")
        return None
    own = replace(place, faults=[])
    form = read_form(kind, table, own)
    made = form.stream(folder, replace(mapping, weather=form.weather, revision=form.revision), own)
    if made is not None and form.reach_limit_s is not None:
        made.reach_limit_s = form.reach_limit_s
    place.faults.extend(own.faults)
    return None if own.faults else made
