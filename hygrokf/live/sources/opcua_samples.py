"""OPC UA data in the tracker's terms: nodes, samples and error messages."""

from __future__ import annotations

import logging
import math
import socket
from dataclasses import dataclass
from datetime import UTC
from types import ModuleType
from typing import TYPE_CHECKING

from hygrokf.errors import HygrokfError

if TYPE_CHECKING:
    from asyncua import ua

OVERFLOW = 0x0480
"""Status code bits of a data value before which others were lost in the server's full queue."""
NO_HISTORY = (
    "BadHistoryOperationUnsupported", "BadHistoryOperationInvalid", "BadServiceUnsupported",
    "BadNotSupported",
    "BadNotImplemented", "BadNotReadable", "BadUserAccessDenied", "BadNodeIdUnknown", "BadAttributeIdInvalid",
)  # fmt: skip
"""Status codes of a server that will never provide a node's history, so that asking again is useless."""
REMEDIES = {
    "BadUserAccessDenied": "the server refuses the user: check user and password",
    "BadIdentityTokenRejected": "the server refuses the user: check user and password, or state them if "
    "they are missing",
    "BadIdentityTokenInvalid": "the server refuses the user: check user and password, or state them if "
    "they are missing",
    "BadSecurityChecksFailed": "the server refuses this client's certificate: let the server trust it",
    "BadCertificateUntrusted": "the server does not trust this client's certificate: let the server trust it",
    "BadCertificateUriInvalid": "the client's certificate was made for another application",
    "BadCertificateTimeInvalid": "a certificate is not valid today: check both clocks, or make a new one",
    "BadTooManySessions": "the server has no session left: close other clients",
}


class ConnectionFault(HygrokfError):
    """A connection failed or was lost; the message says why."""


class HistoryFault(HygrokfError):
    """A node's history could not be read; `word`: the server's reason; `final`: asking again is useless."""

    def __init__(self, word: str) -> None:
        super().__init__(word)
        self.final = word in NO_HISTORY


@dataclass(frozen=True)
class Node:
    """A variable of the server: its id as text, its turbine, and its field of the mapping."""

    id: str
    turbine: str
    field: str


@dataclass(frozen=True)
class Sample:
    """A value of a node.

    `time`: stamp [s] of the source, else of the server, None without either; `quality`: "good", "uncertain"
    or "bad" (also for a missing value); `word`: name of the status code; `overflowed`: values before it were
    lost in the server's queue; `received`: time of arrival [s]; `served`: the server's stamp [s], else NaN.
    """

    node: Node
    time: float | None
    value: object
    quality: str
    word: str
    overflowed: bool
    received: float
    served: float = math.nan


@dataclass(frozen=True)
class Rates:
    """Requested sampling and publishing intervals [s], and the server's `queue` of samples per node between
    publications."""

    sampling_s: float = 1.0
    publishing_s: float = 1.0
    queue: int = 100


def library() -> ModuleType:
    """The module asyncua, an optional dependency.  Raises ConnectionFault if it is missing."""
    try:
        import asyncua
    except ImportError:
        raise ConnectionFault("OPC UA needs asyncua: pip install 'hygrokf[opcua]'") from None
    # its relevant log entries are also raised as exceptions; its debug output contains passwords
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    return asyncua


def node_fault(text: str) -> str | None:
    """An error message for an invalid node id, else None.  Raises ConnectionFault without asyncua."""
    ua = library().ua
    try:
        found = ua.NodeId.from_string(text)
    except (ua.UaError, ValueError, KeyError):
        found = None
    if found is None or getattr(found, "ServerIndex", None):
        return (
            f'expected a node id such as "ns=2;s=T07.CabinetTemp" or "nsu=urn:plant;i=1007", found {text!r}'
        )
    return None


def sample_of(node: Node, found: ua.DataValue, received: float) -> Sample:
    """A sample from asyncua's DataValue; the year 1601 means in OPC UA that there is no time."""
    status, value = found.StatusCode, None if found.Value is None else found.Value.Value
    quality = "good"
    if value is None or (status is not None and status.is_bad()):
        quality = "bad"
    elif status is not None and status.is_uncertain():
        quality = "uncertain"
    stated, served = (
        None if s is None or s.year <= 1601 else s.replace(tzinfo=s.tzinfo or UTC).timestamp()
        for s in (found.SourceTimestamp, found.ServerTimestamp)
    )
    return Sample(
        node,
        served if stated is None else stated,
        value,
        quality,
        "Good" if status is None else type(status)(type(status.value)(status.value & 0xFFFF0000)).name,
        status is not None and status.value & 0x0C80 == OVERFLOW,
        received,
        math.nan if served is None else served,
    )


def name_of(fault: Exception) -> str:
    """The name of the status code that an exception stands for."""
    return type(fault).__name__ if type(fault).__name__.startswith("Bad") else str(fault)[:80]


def words_of(fault: Exception) -> str:
    """Message for an exception of asyncua or the network."""
    if isinstance(fault, ConnectionFault):
        return str(fault)
    if isinstance(fault, ConnectionRefusedError):
        return "nothing listens there"
    if isinstance(fault, socket.gaierror):
        return f"the host is not known ({fault.strerror})"
    if isinstance(fault, TimeoutError):
        return "no answer in time"
    name = name_of(fault)
    return f"{REMEDIES[name]} ({name})" if name in REMEDIES else _shown(fault)


def _shown(fault: Exception) -> str:
    """An exception in one short line."""
    return " ".join(f"{type(fault).__name__} {fault}".split())[:160].strip()
