"""Checks that sources of every kind share, and those of this machine's clock, and of the certificates and
secret files that a tracker's file names."""

from __future__ import annotations

import ctypes
import math
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.data.toml_form import read_toml
from hygrokf.live.sources.endpoint import OTHERS_READ
from hygrokf.live.sources.payload import PayloadStatistics
from hygrokf.live.sources.payload_values import AHEAD_S
from hygrokf.texts.doctor import DOUBT, FAULT, LEVELS, OK, Check, CheckCode, ExaminedCode
from hygrokf.texts.statement import Statement, Value

CLOSE_S = 60.0
"""Tolerated difference of two clocks [s]."""
OLD_S = 2.0 * HOUR_S
"""Age [s] from which a file or a value may no longer be updated."""
LARGEST_ZONE_H = 14
SHARP_S = 300.0
"""Tolerance [s] within which a lag counts as whole hours."""
JUMP_S = 0.5
"""Tolerated jump of this machine's clock against elapsed time [s]."""
_ERROR = 5
"""Return value of adjtimex if the kernel's clock is not synchronised (TIME_ERROR)."""
SOON_S = 30.0 * DAY_S
"""Remaining validity [s] below which a certificate should be replaced."""
CERTIFICATES = ("certificate", "ca", "server_certificate")
SECRETS = ("key", "password_file", "token_file", "secret_file")


def rounded(seconds: float) -> float:
    """A duration [s], which is not negative, rounded to a useful precision."""
    return max(float(round(seconds, 0 if seconds >= 10.0 else 1)), 0.0)


def of_names(
    about: str, names: Collection[str | Statement], code: CheckCode, **values: Value
) -> Iterator[Check]:
    """The check of names, if there are any."""
    if names:
        yield code(about, names=tuple(names), **values)


def worst(checks: Iterable[Check]) -> str:
    """The worst level of some checks; "ok" without any."""
    return max((one.level for one in checks), key=LEVELS.index, default=OK)


# -- of sources ----------------------------------------------------------------------------------------------
def payload_checks(
    about: str, statistics: PayloadStatistics, examined: Statement | None = None
) -> Iterator[Check]:
    """Whether payloads gave readings; no check without payloads."""
    used, count, examined = statistics.used, statistics.payloads, examined or ExaminedCode.PAYLOADS()
    if count and (refused := statistics.rejected):
        level = DOUBT if used else FAULT
        yield CheckCode.READINGS_REFUSED(
            about, level, used=used, count=count, examined=examined, refused=refused
        )
    elif count:
        yield CheckCode.READINGS_GIVEN(about, used=used, count=count, examined=examined)


def stamp_check(about: str, lag_s: float, lateness_s: float = math.inf, fresh: bool = True) -> Check | None:
    """Judge a source's clock by the lag [s] from its newest stamp to its arrival; None if the lag is not
    finite.

    `lateness_s`: tolerated lateness of readings [s]; without `fresh` an old stamp says nothing about the
    clock.
    """
    if not math.isfinite(lag_s):
        return None
    age, hours = rounded(lag_s), round(lag_s / HOUR_S)
    if lag_s < -AHEAD_S:
        return CheckCode.STAMP_TOO_FAR_AHEAD(about, ahead=rounded(-lag_s), limit=AHEAD_S)
    if lag_s < -CLOSE_S:
        return CheckCode.STAMP_AHEAD(about, ahead=rounded(-lag_s))
    if fresh and 1 <= hours <= LARGEST_ZONE_H and abs(lag_s - hours * HOUR_S) < SHARP_S:
        return CheckCode.STAMP_OLD_BY_HOURS(about, age=age, hours=hours)
    if fresh and lag_s > lateness_s:
        return CheckCode.STAMP_TOO_LATE(about, age=age, lateness=lateness_s)
    return CheckCode.STAMP_AGE(about, age=age)


def server_check(about: str, difference_s: float) -> Check:
    """Judge a server's clock by its difference from this machine's clock [s]; positive if it is ahead."""
    if abs(difference_s) <= CLOSE_S:
        return CheckCode.SERVER_CLOCK_AGREES(about, limit=CLOSE_S)
    level = FAULT if difference_s > AHEAD_S else DOUBT
    code = CheckCode.SERVER_CLOCK_AHEAD if difference_s > 0.0 else CheckCode.SERVER_CLOCK_BEHIND
    return code(about, level, difference=rounded(abs(difference_s)))


# -- this machine's clock ------------------------------------------------------------------------------------
def synchronised() -> bool | None:
    """Whether this machine's clock is synchronised according to the kernel; None if unknown."""
    try:
        read = ctypes.CDLL(None).adjtimex
    except (OSError, TypeError, AttributeError):
        return None
    state = read(ctypes.create_string_buffer(512))  # all zeros: only read, set nothing
    return None if state < 0 else state != _ERROR


def elapsed_from() -> float:
    """The time [s since 1970] at which elapsed time began, by this machine's clock as it is now."""
    return time.time() - time.monotonic()


def machine_checks(began: float, received_s: float) -> Iterator[Check]:
    """Check this machine's clock; `began`: `elapsed_from` at the start of the examination [s]; `received_s`:
    arrival of the store's newest reading [s], −∞ if unknown."""
    jump_s, known, before = elapsed_from() - began, synchronised(), time.time() - received_s
    if abs(jump_s) > JUMP_S:
        yield CheckCode.CLOCK_JUMPED("clock", jump=jump_s)
    if before < -CLOSE_S:
        yield CheckCode.READINGS_OF_THE_FUTURE("clock", ahead=rounded(-before))
    if known is False:
        yield CheckCode.CLOCK_NOT_SYNCHRONISED("clock")
    elif abs(jump_s) <= JUMP_S and before >= -CLOSE_S:
        yield (CheckCode.CLOCK_SYNCHRONISED if known else CheckCode.CLOCK_EVEN)("clock")


# -- certificates and secrets --------------------------------------------------------------------------------
def file_checks(file: Path) -> Iterator[Check]:
    """Check all files that a tracker's file names; that file must be valid."""
    content = read_toml(file)[1]
    for where, table in _tables(content):
        for key in (*CERTIFICATES, *SECRETS):
            if not isinstance(table.get(key), str):
                continue
            about, path = f"{where} {key}", file.parent / table[key]
            try:
                yield _secret(about, path) if key in SECRETS else _certificate(about, path, key)
            except OSError as error:
                yield CheckCode.FILE_UNREADABLE(about, path=str(path), fault=error.strerror or str(error))


def _tables(content: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    if isinstance(content.get("page"), dict):
        yield "[page]", content["page"]
    for name in ("source", "notify"):
        for number, table in enumerate(content.get(name, []), start=1):
            yield f"[[{name}]] {number}", table


def _secret(about: str, path: Path) -> Check:
    """Whether others may read a secret; always fine on systems without such permissions."""
    readable = os.name == "posix" and path.stat().st_mode & OTHERS_READ
    return (CheckCode.SECRET_READABLE if readable else CheckCode.SECRET_KEPT)(about, path=str(path))


def _certificate(about: str, path: Path, key: str) -> Check:
    check = validity_check(about, path.read_bytes(), str(path), max if key == "ca" else min)
    if key == "server_certificate" and check.level == FAULT:  # it is only compared with the server's
        return replace(check, level=DOUBT)
    return check


def validity_check(about: str, content: bytes, where: str, ends: Callable[[list[Any]], Any] = min) -> Check:
    """How long a certificate, PEM or DER, remains valid.

    ends: whether several of a PEM file expire with the first (of a chain) or with the last (of trusted CAs).
    """
    try:
        from cryptography import x509
    except ImportError:
        return CheckCode.CERTIFICATE_NOT_EXAMINED(about, where=where)
    try:
        pem = b"-----BEGIN" in content
        found = x509.load_pem_x509_certificates(content) if pem else [x509.load_der_x509_certificate(content)]
    except ValueError:
        return CheckCode.NO_CERTIFICATE(about, where=where)
    spans = [(one.not_valid_after_utc.timestamp(), one.not_valid_before_utc.timestamp()) for one in found]
    (end, begin), now = ends(spans), time.time()
    if begin > now:
        return CheckCode.CERTIFICATE_TOO_EARLY(about, where=where, begin=begin)
    if end < now:
        return CheckCode.CERTIFICATE_EXPIRED(about, where=where, since=rounded(now - end))
    code = CheckCode.CERTIFICATE_ENDS if end - now < SOON_S else CheckCode.CERTIFICATE_VALID
    return code(about, where=where, left=rounded(end - now))
