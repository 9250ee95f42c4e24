"""Which source a URL names: every kind is one `Stream`, made from its table in the tracker's file."""

from __future__ import annotations

from collections.abc import Mapping as MappingOf
from dataclasses import replace
from pathlib import Path

from hygrokf.live.sources.mqtt import mqtt_stream
from hygrokf.live.sources.opcua_table import opcua_stream
from hygrokf.live.sources.payload import Mapping
from hygrokf.live.sources.streams import Stream, file_stream, input_stream
from hygrokf.live.table_reader import TableReader

KINDS = {
    "file": file_stream, "stdin": input_stream, "mqtt": mqtt_stream, "mqtts": mqtt_stream, "opc.tcp": opcua_stream,
}  # fmt: skip
"""Scheme of a URL -> function of (table, where, folder, mapping, reader) that makes the stream, or None with faults told."""


def stream_of(
    table: MappingOf[str, object], where: str, folder: Path, mapping: Mapping, reader: TableReader
) -> Stream | None:
    """The stream that a `[[source]]` table describes; None where `reader` was told why there is none.

    Nothing is connected or opened yet.  Paths are relative to `folder`.  With `weather = true` it brings weather forecasts.
    """
    url = reader.text(table, "url", where)
    scheme = url.partition(":")[0]
    kind = KINDS.get(scheme)
    if kind is None:
        reader.faults.append(
            f"{where}: url must begin with one of {', '.join(f'{k}:' if k != 'stdin' else k for k in KINDS)}, "
            f"found {scheme!r}"  # the rest may hold a password
        )
        return None
    weather = table.get("weather", False)
    if not isinstance(weather, bool):
        reader.faults.append(f"{where}: weather must be true or false, found {weather!r}")
        return None
    own = {key: value for key, value in table.items() if key != "weather"}
    return kind(own, where, folder, replace(mapping, weather=True) if weather else mapping, reader)
