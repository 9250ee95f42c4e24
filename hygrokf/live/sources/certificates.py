"""When certificates begin and end to be valid, read from PEM or DER without any package for it."""

from __future__ import annotations

import re
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime

_PEM = re.compile(rb"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)
_VERSION = 0xA0
_TIMES = {0x17: "%y%m%d%H%M%SZ", 0x18: "%Y%m%d%H%M%SZ"}
"""Tags of ASN.1's UTCTime and GeneralizedTime -> how they are written."""


@dataclass(frozen=True)
class Validity:
    """A certificate is valid from `begin` to `end` [s since 1970]."""

    begin: float
    end: float


def validities(content: bytes) -> list[Validity]:
    """Validity of every certificate in a PEM file, or of the one in a DER file.  Raises ValueError where there is none."""
    if b"-----BEGIN" not in content:
        return [validity(content)]
    found = [validity(ssl.PEM_cert_to_DER_cert(one.decode("ascii"))) for one in _PEM.findall(content)]
    if not found:
        raise ValueError("expected a certificate, found none")
    return found


def validity(der: bytes) -> Validity:
    """Validity of a certificate in DER (RFC 5280, section 4.1).  Raises ValueError where it is none."""
    try:
        signed = _parts(_parts(_parts(der)[0][1])[0][1])
        serial = int(signed[0][0] == _VERSION)  # the version may be left out
        begin, end = (_seconds(*one) for one in _parts(signed[serial + 3][1]))
    except (IndexError, KeyError, ValueError) as fault:
        raise ValueError("expected a certificate, found something else") from fault
    return Validity(begin, end)


def _parts(content: bytes) -> list[tuple[int, bytes]]:
    """(tag, content) of what stands one after the other in DER."""
    found, place = [], 0
    while place < len(content):
        tag, length, place = content[place], content[place + 1], place + 2
        if length & 0x80:
            end = place + (length & 0x7F)
            length, place = int.from_bytes(content[place:end], "big"), end
        if place + length > len(content):
            raise ValueError("cut off")
        found.append((tag, content[place : place + length]))
        place += length
    return found


def _seconds(tag: int, content: bytes) -> float:
    at = datetime.strptime(content.decode("ascii"), _TIMES[tag]).replace(tzinfo=UTC)
    # two digits of a year: 50 and above are of the last century
    return at.timestamp() if tag == 0x18 or at.year < 2050 else at.replace(year=at.year - 100).timestamp()
