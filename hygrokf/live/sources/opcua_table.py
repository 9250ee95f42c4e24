"""Creates an OPC UA source from its table in the tracker's file, with a message for every fault."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

from hygrokf.data.timestamps import duration
from hygrokf.data.toml_form import Place, across, entry_name, setting
from hygrokf.errors import suggestion
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.opcua_client import HELD
from hygrokf.live.sources.opcua_samples import ConnectionFault, Node, Rates, node_fault
from hygrokf.live.sources.opcua_security import SecurityForm, security_of
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.streams import WEATHER_HELP

PORT = 4840
"""OPC UA's default port."""
_PLAIN = ("turbine", "time", "quality")


@dataclass(frozen=True)
class NodeForm:
    """An entry of `nodes`."""

    id: str = entry_name()
    turbine: str = setting(help="its turbine")
    field: str = setting(help="its field of [mapping.signals]")


@dataclass(frozen=True)
class ServerForm:
    """A server and its nodes."""

    url: str = setting(help="opc.tcp://HOST:PORT/PATH")
    nodes: Mapping[str, NodeForm] = setting(dict, "node ids, each with turbine and field")
    sampling_s: float = setting(Rates.sampling_s, "how often the server looks at a value", read=duration)
    publishing_s: float = setting(
        Rates.publishing_s,
        "how often it sends what has come",
        read=duration,
        least=0.01,
        most=60.0,
        expected='within "0.01s" … "1min"',
    )
    queue: int = setting(Rates.queue, "values of one node that it keeps in between", least=2, most=HELD)
    look_back_s: float = setting(0.0, "how far back the history of a new node is read", read=duration)
    uncertain: bool = setting(False, "whether values with an uncertain status are used")

    @across("url")
    def url_form(self) -> str | None:
        return _address(self.url)[2]

    @across("nodes")
    def any_node(self) -> str | None:
        if self.nodes:
            return None
        return 'no nodes: add nodes = { "ns=2;s=T07.CabinetTemp" = { turbine = "T07", field = "Tcab" } }'


@dataclass(frozen=True)
class OpcUaForm(SecurityForm, ServerForm):
    """A [[source]] of `opc.tcp://HOST:PORT/PATH`."""

    weather: bool = setting(False, WEATHER_HELP)

    def stream(self, folder: Path, mapping: PayloadMapping, place: Place) -> OpcUa:
        """The stream; faults of its nodes and files go to `place`."""
        url, host, _ = _address(self.url)
        security, user = security_of(self, host, folder, place)
        try:
            _check_nodes(self.nodes, mapping, place)
        except ConnectionFault as fault:
            place.fault(str(fault))
        nodes = [Node(id, one.turbine, one.field) for id, one in self.nodes.items()]
        own = replace(
            mapping,
            turbine="turbine",
            time="time",
            quality="quality",
            tag="",
            value="",
            good=("good", "uncertain") if self.uncertain else ("good",),
            turbines={one.turbine: one.turbine for one in nodes},
        )
        rates = Rates(self.sampling_s, self.publishing_s, self.queue)
        return OpcUa(url, nodes, own, rates, self.look_back_s, security, user)


def _address(url: str) -> tuple[str, str, str | None]:
    """URL with the port filled in, host, and what is wrong with it."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port or PORT
    except ValueError:
        return "", "", "url must be opc.tcp://HOST:PORT/PATH"
    fault = None
    if host and "@" in parts.netloc:
        fault = "a user does not belong in the url: state user, and password_file or password_env"
    elif not host or parts.query or parts.fragment:
        fault = "url must be opc.tcp://HOST:PORT/PATH"
    shown = f"[{host}]" if ":" in host else host
    return (f"opc.tcp://{shown}:{port}{parts.path}" if host else ""), host, fault


def _check_nodes(nodes: Mapping[str, NodeForm], mapping: PayloadMapping, place: Place) -> None:
    """Faults of nodes that the mapping does not know, or that stand for one field twice.

    Raises ConnectionFault without asyncua.
    """
    turbines = tuple(set(mapping.turbines.values()))
    taken: dict[tuple[str, str], str] = {}
    for id, one in nodes.items():
        inside = place.inside("nodes", entry=repr(id))
        if (wrong := node_fault(id)) is not None:
            inside.fault(wrong)
        for key, value, known, where in (
            ("turbine", one.turbine, turbines, "[[turbine]]"),
            ("field", one.field, tuple(mapping.fields), "[mapping.signals]"),
        ):
            if value and value not in known:
                inside.fault(f"{key}: {where} has no {value!r}{suggestion(value, known)}")
        if one.field in _PLAIN:
            inside.fault(f"a field must not be named {one.field!r} here: rename it in [mapping.signals]")
        other = taken.setdefault((one.turbine, one.field), id)
        if other != id:
            inside.fault(f"{other!r} already is {one.field} of {one.turbine}")
