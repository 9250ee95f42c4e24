"""Why a server is not reached or sends one away, in words: names, sockets, certificates, and MQTT's reason codes."""

from __future__ import annotations

import socket
import ssl

_CERTIFICATE = {
    9: "its certificate is not valid yet: compare the clocks",
    10: "its certificate has expired",
    18: "its certificate is signed by itself alone: name its CA's file as ca",
    19: "its certificate is signed by a CA that is not trusted here: name the CA's file as ca",
    20: "its certificate is signed by a CA that is not trusted here: name the CA's file as ca",
    21: "its certificate is signed by a CA that is not trusted here: name the CA's file as ca",
    62: "its certificate is for another name: connect by the name that the certificate states",
    64: "its certificate is for another address: connect by the name that the certificate states",
}
"""OpenSSL's number of what is wrong with the server's certificate -> words."""
_TLS = {
    "CERTIFICATE_REQUIRED": "it demands a client certificate: name certificate and key",
    "HANDSHAKE_FAILURE": "it refused TLS with what was offered: it may demand a client certificate",
    "ALERT_UNKNOWN_CA": "it does not trust the CA of the client certificate",
    "ALERT_CERTIFICATE_EXPIRED": "the client certificate has expired",
    "ALERT_CERTIFICATE_REVOKED": "the client certificate was revoked",
    "ALERT_BAD_CERTIFICATE": "it does not take the client certificate",
    "ALERT_CERTIFICATE_UNKNOWN": "it does not take the client certificate",
    "ALERT_PROTOCOL_VERSION": "it speaks no TLS that is safe: 1.2 or newer is needed",
    "WRONG_VERSION_NUMBER": "it does not speak TLS on this port",
    "EOF": "it closed the connection where TLS should have begun: is this its TLS port?",
}
"""Part of OpenSSL's name of what went wrong with TLS -> words."""
_MQTT = {
    132: "it does not speak MQTT 5",
    133: "it does not take this client_id",
    134: "user name or password is wrong",
    135: "not authorised: user name, password, or the rights of this user and client_id",
    136: "it is not available now",
    137: "it is busy",
    138: "this client was banned",
    139: "it is shutting down",
    141: "it heard nothing from here for longer than agreed",
    142: "another client with this client_id took the session over: give every process a client_id of its own",
    149: "it was sent a packet larger than it takes",
    151: "a quota is exceeded",
    152: "its administrator closed the connection",
    158: "it has no shared subscriptions",
    159: "connections come faster than it allows",
    162: "it has no subscriptions with + or #",
}
"""MQTT 5's reason code -> words; what is not here is told by its own name."""


def unreached(fault: BaseException, where: str) -> str:
    """Why `where` (HOST:PORT) is not reached, in words."""
    if isinstance(fault, ssl.SSLCertVerificationError):
        said = (
            _CERTIFICATE.get(fault.verify_code) or f"its certificate is not trusted: {fault.verify_message}"
        )
    elif isinstance(fault, ssl.SSLError):
        said = tls_words(str(fault)) or f"TLS failed: {fault.reason or fault}"
    elif isinstance(fault, socket.gaierror | UnicodeError):
        said = "its name is not resolved: check the name, and the name server of this machine"
    elif isinstance(fault, ConnectionRefusedError):
        said = "refused: nothing listens there; check host and port, and that it is running"
    elif isinstance(fault, TimeoutError):
        said = "it does not answer: check the network and firewalls between"
    elif isinstance(fault, ConnectionError):
        said = "it closed the connection while it was made: check the port, and whether it speaks TLS"
    elif isinstance(fault, OSError):
        said = fault.strerror or str(fault)
    else:
        said = f"{type(fault).__name__}: {fault}"
    return f"{where}: {said}"


def tls_words(text: str) -> str | None:
    """Words for what OpenSSL said, where they are known."""
    shown = text.upper()
    return next((words for name, words in _TLS.items() if name in shown), None)


def reason_words(code: int, name: str) -> str:
    """Words for a reason code of MQTT 5; `name` its own."""
    return _MQTT.get(code, f"{name.lower()} (reason code {code})")
