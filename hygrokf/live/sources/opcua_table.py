"""An OPC UA source from its table in the tracker's file, with every fault in words."""

from __future__ import annotations

from collections.abc import Mapping as MappingOf
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

from hygrokf.errors import suggestion
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.opcua_client import HELD
from hygrokf.live.sources.opcua_samples import ConnectionFault, Node, Rates, node_fault
from hygrokf.live.sources.opcua_security import SECURITY_KEYS, security_of
from hygrokf.live.sources.payload import Mapping
from hygrokf.live.sources.streams import Stream
from hygrokf.live.table_reader import TableReader

PORT = 4840
"""OPC UA's own port, where none is stated."""
_KEYS = ("url", "nodes", "sampling", "publishing", "queue", "look_back", "uncertain", *SECURITY_KEYS)
_NODE = ("turbine", "field")
_PLAIN = ("turbine", "time", "quality")


def opcua_stream(
    table: MappingOf[str, object], where: str, folder: Path, mapping: Mapping, reader: TableReader
) -> Stream | None:
    """`opc.tcp://HOST:PORT/PATH` with `nodes`, a table of node id -> turbine and field of `[mapping.signals]`."""
    before = len(reader.faults)
    reader.known({key: value for key, value in table.items() if key != "password"}, _KEYS, where)
    url, host = _address(str(table["url"]), where, reader)
    rates = Rates(
        reader.seconds(table, "sampling", where, Rates.sampling_s),
        reader.seconds(table, "publishing", where, Rates.publishing_s),
        int(reader.number(table, "queue", where, Rates.queue) or 0),
    )
    if not 2 <= rates.queue <= HELD:
        reader.faults.append(
            f"{where}: queue must lie within 2 … {HELD}: samples between two messages, found {rates.queue}"
        )
    if not 0.01 <= rates.publishing_s <= 60.0:
        reader.faults.append(
            f'{where}: publishing must lie within "0.01s" … "1min", found "{rates.publishing_s:g}s"'
        )
    uncertain = table.get("uncertain", False)
    if not isinstance(uncertain, bool):
        reader.faults.append(f"{where}: uncertain must be true or false, found {uncertain!r}")
    look_back_s = reader.seconds(table, "look_back", where, 0.0)
    security, user = security_of(table, where, host, folder, reader)
    try:
        nodes = _nodes(table.get("nodes", {}), where, mapping, reader)
    except ConnectionFault as fault:
        reader.faults.append(f"{where}: {fault}")
    if len(reader.faults) > before:
        return None
    own = replace(
        mapping,
        turbine="turbine",
        time="time",
        quality="quality",
        tag="",
        value="",
        good=("good", "uncertain") if uncertain else ("good",),
        turbines={one.turbine: one.turbine for one in nodes},
    )
    return OpcUa(url, nodes, own, rates, look_back_s, security, user)


def _address(url: str, where: str, reader: TableReader) -> tuple[str, str]:
    """URL with its port, and its host."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port or PORT
    except ValueError:
        host, port = "", 0
    if host and "@" in parts.netloc:
        reader.faults.append(
            f"{where}: a user does not belong in the url: state user, and password_file or password_env"
        )
    elif not host or parts.query or parts.fragment:
        reader.faults.append(f"{where}: url must be opc.tcp://HOST:PORT/PATH")
    shown = f"[{host}]" if ":" in host else host
    return (f"opc.tcp://{shown}:{port}{parts.path}" if host else ""), host


def _nodes(found: object, where: str, mapping: Mapping, reader: TableReader) -> list[Node]:
    """Nodes of the table; what is wrong with them goes to `reader`.  Raises ConnectionFault without asyncua."""
    if not isinstance(found, dict) or not found:
        reader.faults.append(
            f'{where}: no nodes: add nodes = {{ "ns=2;s=T07.CabinetTemp" = {{ turbine = "T07", field = "Tcab" }} }}'
        )
        return []
    turbines = set(mapping.turbines.values())
    nodes: list[Node] = []
    taken: dict[tuple[str, str], str] = {}
    for id, entry in found.items():
        at = f"{where} nodes.{id!r}"
        wrong = node_fault(id)
        if wrong is not None:
            reader.faults.append(f"{where} nodes: {wrong}")
        if not isinstance(entry, dict):
            reader.faults.append(f'{at}: expected {{ turbine = "…", field = "…" }}, found {entry!r}')
            continue
        reader.known(entry, _NODE, at)
        node = Node(id, *(reader.text(entry, key, at) for key in _NODE))
        for key, value, known, place in (
            ("turbine", node.turbine, turbines, "[[turbine]]"),
            ("field", node.field, mapping.fields, "[mapping.signals]"),
        ):
            if value not in known:
                reader.faults.append(
                    f"{at}: {key}: {place} has no {value!r}{suggestion(value, tuple(known))}"
                )
        if node.field in _PLAIN:
            reader.faults.append(
                f"{at}: a field must not be named {node.field!r} here: rename it in [mapping.signals]"
            )
        other = taken.setdefault((node.turbine, node.field), id)
        if other != id:
            reader.faults.append(f"{at}: {other!r} already is {node.field} of {node.turbine}")
        nodes.append(node)
    return nodes
