"""Checks common to sources of every kind, and checks of this machine's clock and of the certificates and
secret files that a tracker's file names."""

from __future__ import annotations

import ctypes
import math
import os
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.data.toml_form import read_toml
from hygrokf.live.sources.endpoint import OTHERS_READ
from hygrokf.live.sources.payload import PayloadStatistics
from hygrokf.live.sources.payload_values import STAMP_AHEAD_S
from hygrokf.texts.doctor_codes import CHECK_LEVELS, DOUBT, FAULT, OK, Check, CheckCode, ExaminedCode
from hygrokf.texts.statement import Statement, Value

CLOSE_S = 60.0
"""Tolerated difference of two clocks [s]."""
OLD_S = 2.0 * HOUR_S
"""Age [s] from which a file or a value may no longer be updated."""
LARGEST_ZONE_H = 14
"""Largest offset of a time zone from UTC [h]."""
WHOLE_HOURS_S = 300.0
"""Tolerance [s] within which a lag counts as whole hours."""
JUMP_S = 0.5
"""Tolerated jump of this machine's clock against elapsed time [s]."""
TIME_ERROR = 5
"""Return value of adjtimex if the kernel's clock is not synchronised."""
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
    """The check `code` with `names` as a value; no check without names."""
    if names:
        yield code(about, names=tuple(names), **values)


def worst(checks: Iterable[Check]) -> str:
    """The worst level of some checks; "ok" without checks."""
    return max((check.level for check in checks), key=CHECK_LEVELS.index, default=OK)


# -- sources -------------------------------------------------------------------------------------------------
def payload_checks(
    about: str, statistics: PayloadStatistics, examined: Statement | None = None
) -> Iterator[Check]:
    """Check whether payloads gave readings; no check without payloads."""
    used, count, examined = statistics.used, statistics.payloads, examined or ExaminedCode.PAYLOADS()
    if count and (refused := statistics.rejected):
        level = DOUBT if used else FAULT
        yield CheckCode.READINGS_REFUSED(
            about, level, used=used, count=count, examined=examined, refused=refused
        )
    elif count:
        yield CheckCode.READINGS_GIVEN(about, used=used, count=count, examined=examined)


def stamp_check(about: str, lag_s: float, lateness_s: float = math.inf, fresh: bool = True) -> Check | None:
    """Judge a source's clock by the lag [s] from its newest stamp to the arrival of that stamp; None if the
    lag is not finite.

    lateness_s: tolerated lateness of readings [s].  fresh: readings arrive soon after they are taken, so that
        an old stamp points to a wrong clock.
    """
    if not math.isfinite(lag_s):
        return None
    age, hours = rounded(lag_s), round(lag_s / HOUR_S)
    if lag_s < -STAMP_AHEAD_S:
        return CheckCode.STAMP_TOO_FAR_AHEAD(about, ahead=rounded(-lag_s), limit=STAMP_AHEAD_S)
    if lag_s < -CLOSE_S:
        return CheckCode.STAMP_AHEAD(about, ahead=rounded(-lag_s))
    if fresh and 1 <= hours <= LARGEST_ZONE_H and abs(lag_s - hours * HOUR_S) < WHOLE_HOURS_S:
        return CheckCode.STAMP_OLD_BY_HOURS(about, age=age, hours=hours)
    if fresh and lag_s > lateness_s:
        return CheckCode.STAMP_TOO_LATE(about, age=age, lateness=lateness_s)
    return CheckCode.STAMP_AGE(about, age=age)


def server_check(about: str, difference_s: float) -> Check:
    """Judge a server's clock by its difference from this machine's clock [s]; positive if it is ahead."""
    if abs(difference_s) <= CLOSE_S:
        return CheckCode.SERVER_CLOCK_AGREES(about, limit=CLOSE_S)
    level = FAULT if difference_s > STAMP_AHEAD_S else DOUBT
    code = CheckCode.SERVER_CLOCK_AHEAD if difference_s > 0.0 else CheckCode.SERVER_CLOCK_BEHIND
    return code(about, level, difference=rounded(abs(difference_s)))


# -- this machine's clock ------------------------------------------------------------------------------------
def is_synchronised() -> bool | None:
    """Whether this machine's clock is synchronised according to the kernel; None if unknown."""
    try:
        adjtimex = ctypes.CDLL(None).adjtimex
    except (OSError, TypeError, AttributeError):
        return None
    state = adjtimex(ctypes.create_string_buffer(512))  # a structure of zeros sets nothing
    return None if state < 0 else state != TIME_ERROR


def monotonic_epoch() -> float:
    """The zero of the monotonic clock by this machine's present clock [s since 1970]; it moves if that
    jumps."""
    return time.time() - time.monotonic()


def machine_checks(epoch_s: float, received_s: float) -> Iterator[Check]:
    """Check this machine's clock.

    epoch_s: `monotonic_epoch` at the start of the examination [s].  received_s: arrival of the store's newest
        reading [s], −∞ if unknown.
    """
    jump_s, age_s, synchronised = monotonic_epoch() - epoch_s, time.time() - received_s, is_synchronised()
    if abs(jump_s) > JUMP_S:
        yield CheckCode.CLOCK_JUMPED("clock", jump=jump_s)
    if age_s < -CLOSE_S:
        yield CheckCode.READINGS_OF_THE_FUTURE("clock", ahead=rounded(-age_s))
    if synchronised is False:
        yield CheckCode.CLOCK_NOT_SYNCHRONISED("clock")
    elif abs(jump_s) <= JUMP_S and age_s >= -CLOSE_S:
        code = CheckCode.CLOCK_SYNCHRONISED if synchronised else CheckCode.CLOCK_EVEN
        yield code("clock")


# -- certificates and secrets --------------------------------------------------------------------------------
def certificate_checks(file: Path) -> Iterator[Check]:
    """Check all certificates and secrets that a tracker's file names; the tracker's file must be valid."""
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
    """Check whether other users may read a secret; never a fault on systems without such permissions."""
    is_readable = os.name == "posix" and path.stat().st_mode & OTHERS_READ
    code = CheckCode.SECRET_READABLE if is_readable else CheckCode.SECRET_KEPT
    return code(about, path=str(path))


def _certificate(about: str, path: Path, key: str) -> Check:
    check = validity_check(about, path.read_bytes(), str(path), all_needed=key != "ca")
    if (
        key == "server_certificate" and check.level == FAULT
    ):  # only compared with the one that the server sends
        return replace(check, level=DOUBT)
    return check


def validity_check(about: str, content: bytes, where: str, all_needed: bool = True) -> Check:
    """Check how long a certificate, PEM or DER, remains valid.

    all_needed: several certificates of a PEM file are a chain, which expires with the first of them, and not
        trusted CAs, which expire with the last.
    """
    try:
        from cryptography import x509
    except ImportError:
        return CheckCode.CERTIFICATE_NOT_EXAMINED(about, where=where)
    try:
        if b"-----BEGIN" in content:
            certificates = x509.load_pem_x509_certificates(content)
        else:
            certificates = [x509.load_der_x509_certificate(content)]
    except ValueError:
        return CheckCode.NO_CERTIFICATE(about, where=where)
    spans = [(c.not_valid_after_utc.timestamp(), c.not_valid_before_utc.timestamp()) for c in certificates]
    (end, begin), now = min(spans) if all_needed else max(spans), time.time()
    if begin > now:
        return CheckCode.CERTIFICATE_TOO_EARLY(about, where=where, begin=begin)
    if end < now:
        return CheckCode.CERTIFICATE_EXPIRED(about, where=where, since=rounded(now - end))
    code = CheckCode.CERTIFICATE_ENDS if end - now < SOON_S else CheckCode.CERTIFICATE_VALID
    return code(about, where=where, left=rounded(end - now))
