"""What OPC UA says, in the tracker's terms: nodes, samples, and faults in words."""

from __future__ import annotations

import logging
import socket
from dataclasses import dataclass
from datetime import UTC
from typing import Any

from hygrokf.errors import HygrokfError

OVERFLOW = 0x0480
"""Bits of a status code that say: a data value, and others before it found no room in the server's queue."""
NO_HISTORY = (
    "BadHistoryOperationUnsupported", "BadHistoryOperationInvalid", "BadServiceUnsupported", "BadNotSupported",
    "BadNotImplemented", "BadNotReadable", "BadUserAccessDenied", "BadNodeIdUnknown", "BadAttributeIdInvalid",
)  # fmt: skip
"""What a server answers that will not give a node's history, however often it is asked."""
REMEDIES = {
    "BadUserAccessDenied": "the server refuses the user: check user and password",
    "BadIdentityTokenRejected": "the server refuses the user: check user and password, or state them where they are missing",
    "BadIdentityTokenInvalid": "the server refuses the user: check user and password, or state them where they are missing",
    "BadSecurityChecksFailed": "the server refuses this client's certificate: let the server trust it",
    "BadCertificateUntrusted": "the server does not trust this client's certificate: let the server trust it",
    "BadCertificateUriInvalid": "the client's certificate was made for another application",
    "BadCertificateTimeInvalid": "a certificate is not valid today: check both clocks, or make a new one",
    "BadTooManySessions": "the server has no session left: close other clients",
}


class ConnectionFault(HygrokfError):
    """A connection that was not made or is lost, in words."""


class HistoryFault(HygrokfError):
    """A node's history that was not read, with the server's word for why; `final` where asking again is of no use."""

    def __init__(self, word: str) -> None:
        super().__init__(word)
        self.final = word in NO_HISTORY


@dataclass(frozen=True)
class Node:
    """A variable of the server: its id as text, and of which turbine and of which field of the mapping it is."""

    id: str
    turbine: str
    field: str


@dataclass(frozen=True)
class Sample:
    """A value of a node: `time` [s] by its source or else the server, None by neither; when it was `received` [s].

    `quality` is "good", "uncertain" or "bad" (a value that is missing is bad), `word` the status code's name; `overflowed`
    where values before it were lost in the server's queue.
    """

    node: Node
    time: float | None
    value: object
    quality: str
    word: str
    overflowed: bool
    received: float


@dataclass(frozen=True)
class Rates:
    """How often the server is to sample and to publish [s], and how many samples of a node it is to keep in between."""

    sampling_s: float = 1.0
    publishing_s: float = 1.0
    queue: int = 100


def library() -> Any:
    """asyncua, which the extra brings.  Raises ConnectionFault without it."""
    try:
        import asyncua
    except ImportError:
        raise ConnectionFault("OPC UA needs asyncua: pip install 'hygrokf[opcua]'") from None
    # what matters of its log is raised as well, and told in our words; its debug lines show passwords
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    return asyncua


def node_fault(text: str) -> str | None:
    """What is wrong with the text of a node id, None where nothing is.  Raises ConnectionFault without asyncua."""
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


def sample_of(node: Node, found: Any, received: float) -> Sample:
    """A sample from asyncua's DataValue; the year 1601 is OPC UA's way to say that there is no time."""
    status, value = found.StatusCode, None if found.Value is None else found.Value.Value
    quality = "good"
    if value is None or (status is not None and status.is_bad()):
        quality = "bad"
    elif status is not None and status.is_uncertain():
        quality = "uncertain"
    stamps = (s for s in (found.SourceTimestamp, found.ServerTimestamp) if s is not None and s.year > 1601)
    at = next(stamps, None)
    if at is not None and at.tzinfo is None:
        at = at.replace(tzinfo=UTC)
    return Sample(
        node,
        None if at is None else at.timestamp(),
        value,
        quality,
        "Good" if status is None else type(status)(status.value & 0xFFFF0000).name,
        status is not None and status.value & 0x0C80 == OVERFLOW,
        received,
    )


def name_of(fault: Exception) -> str:
    """The name of a status code that was raised."""
    return type(fault).__name__ if type(fault).__name__.startswith("Bad") else str(fault)[:80]


def words_of(fault: Exception) -> str:
    """A fault of asyncua or of the network in words."""
    if isinstance(fault, ConnectionFault):
        return str(fault)
    if isinstance(fault, ConnectionRefusedError):
        return "nobody listens there"
    if isinstance(fault, socket.gaierror):
        return f"the host is not known ({fault.strerror})"
    if isinstance(fault, TimeoutError):
        return "no answer in time"
    name = name_of(fault)
    return f"{REMEDIES[name]} ({name})" if name in REMEDIES else _shown(fault)


def _shown(fault: Exception) -> str:
    """A fault in one short line."""
    return " ".join(f"{type(fault).__name__} {fault}".split())[:160].strip()
