"""A result of the doctor: level, finding and remedy; the checks that sources of every kind share; and those
of this machine's clock, and of the certificates and secret files that a tracker's file names."""

from __future__ import annotations

import ctypes
import math
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.data.toml_form import read_toml
from hygrokf.live.sources.endpoint import OTHERS_READ
from hygrokf.live.sources.payload import PayloadStatistics
from hygrokf.live.sources.payload_values import AHEAD_S
from hygrokf.live.sources.stream import several
from hygrokf.texts.wording import duration_text, one_line, stamp_text

LEVELS = ("ok", "doubt", "fault")
CLOSE_S = 60.0
"""Tolerated difference of two clocks [s]."""
OLD_S = 2.0 * HOUR_S
"""Age [s] from which a file or a value may no longer be updated."""
LARGEST_ZONE_H = 14
SHARP_S = 300.0
"""Tolerance [s] within which a lag counts as whole hours."""


@dataclass(frozen=True)
class Check:
    """The result of one check: its `level` (see `LEVELS`), what it is `about`, what was `found`, and the
    `remedy`."""

    level: str
    about: str
    found: str
    remedy: str = ""

    def __str__(self) -> str:
        said = f"{self.level:5}  {self.about}: {self.found}" + (f"; to do: {self.remedy}" * bool(self.remedy))
        return one_line(said)


ok, doubt, fault = (partial(Check, level) for level in LEVELS)
"""A check of each level: what it is about, what was found, and the remedy."""


def lasting(seconds: float) -> str:
    """A duration [s] as text, rounded to a useful precision."""
    return duration_text(max(float(round(seconds, 0 if seconds >= 10.0 else 1)), 0.0))


def of_names(about: str, *rows: tuple[str, Collection[str], str, str]) -> Iterator[Check]:
    """A check of each row (level, names, finding, remedy) that has names, the first of which stand in place
    of the {} of its finding."""
    for level, names, finding, remedy in rows:
        if names:
            yield Check(level, about, finding.format(several(names)), remedy)


def worst(checks: Iterable[Check]) -> str:
    """The worst level of some checks; "ok" without any."""
    return max((one.level for one in checks), key=LEVELS.index, default=LEVELS[0])


# -- of sources ----------------------------------------------------------------------------------------------
def payload_checks(about: str, statistics: PayloadStatistics, what: str = "payloads") -> Iterator[Check]:
    """Whether payloads gave readings; no check without payloads."""
    if not statistics.payloads:
        return
    found = f"{statistics.used} of {statistics.payloads} {what} gave readings"
    if statistics.rejected:
        found += f"; not used: {statistics.rejected}"
    remedy = "compare [mapping] and known_as of each [[turbine]] with the delivered payloads"
    level = "fault" if not statistics.used else "doubt" if statistics.rejected else "ok"
    yield Check(level, about, found, remedy if level != "ok" else "")


def stamp_check(about: str, lag_s: float, lateness_s: float = math.inf, fresh: bool = True) -> Check | None:
    """Judge a source's clock by the lag [s] from its newest stamp to its arrival; None if the lag is not
    finite.

    `lateness_s`: tolerated lateness of readings [s]; without `fresh` an old stamp says nothing about the
    clock.
    """
    if not math.isfinite(lag_s):
        return None
    if lag_s < -CLOSE_S:
        found = f"its newest stamp is {lasting(-lag_s)} ahead of this machine's clock"
        remedy = "compare both clocks; stamps in local time need their offset from UTC"
        if lag_s < -AHEAD_S:
            return fault(about, f"{found}; readings more than {lasting(AHEAD_S)} ahead are held back", remedy)
        return doubt(about, found, remedy)
    found = f"its newest stamp is {lasting(max(lag_s, 0.0))} old"
    if not fresh:
        return ok(about, found)
    hours = round(lag_s / HOUR_S)
    if 1 <= hours <= LARGEST_ZONE_H and abs(lag_s - hours * HOUR_S) < SHARP_S:
        return doubt(
            about,
            f"{found} on arrival: {hours} whole hours",
            "check whether local time is stamped as UTC: stamps need their offset",
        )
    if lag_s > lateness_s:
        return doubt(
            about,
            f"{found} on arrival, more than the lateness allows ({lasting(lateness_s)})",
            "set the source's clock, or state a larger lateness if its readings do arrive so late",
        )
    return ok(about, found)


def server_check(about: str, difference_s: float) -> Check:
    """Judge a server's clock by its difference from this machine's clock [s]; positive if it is ahead."""
    if abs(difference_s) <= CLOSE_S:
        return ok(about, f"its clock agrees with this machine's within {CLOSE_S:.0f} s")
    side = "ahead of" if difference_s > 0.0 else "behind"
    said = f"its clock is {lasting(abs(difference_s))} {side} this machine's clock"
    return (fault if difference_s > AHEAD_S else doubt)(about, said, "synchronise both clocks by NTP")


JUMP_S = 0.5
"""Tolerated jump of this machine's clock against elapsed time [s]."""
_ERROR = 5
"""Return value of adjtimex if the kernel's clock is not synchronised (TIME_ERROR)."""
_SET = "synchronise this machine's clock by NTP (timedatectl set-ntp true, or chrony)"
SOON_S = 30.0 * DAY_S
"""Remaining validity [s] below which a certificate should be replaced."""
CERTIFICATES = ("certificate", "ca", "server_certificate")
SECRETS = ("key", "password_file", "token_file", "secret_file")


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
        yield doubt("clock", f"it jumped by {jump_s:+.1f} s during this examination", _SET)
    if before < -CLOSE_S:
        yield fault(
            "clock",
            f"the store has readings received {lasting(-before)} in the future: the clock was ahead then, "
            "or is behind now",
            _SET,
        )
    if known is False:
        yield doubt("clock", "the kernel reports that it is not synchronised", _SET)
    elif abs(jump_s) <= JUMP_S and before >= -CLOSE_S:
        yield ok(
            "clock",
            "it is synchronised by NTP" if known else "it runs evenly; whether it is synchronised is unknown",
        )


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
                yield fault(about, f"{path}: {error.strerror}", "restore it, or name another file")


def _tables(content: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    if isinstance(content.get("page"), dict):
        yield "[page]", content["page"]
    for name in ("source", "notify"):
        for number, table in enumerate(content.get(name, []), start=1):
            yield f"[[{name}]] {number}", table


def _secret(about: str, path: Path) -> Check:
    """Whether others may read a secret; always fine on systems without such permissions."""
    if os.name == "posix" and path.stat().st_mode & OTHERS_READ:
        return doubt(about, f"every user of this machine can read {path}", f"chmod o-rwx {path}")
    return ok(about, f"other users cannot read {path}")


def _certificate(about: str, path: Path, key: str) -> Check:
    check = validity_check(about, path.read_bytes(), str(path), max if key == "ca" else min)
    if key == "server_certificate" and check.level == "fault":  # it is only compared with the server's
        return doubt(about, check.found, check.remedy)
    return check


def validity_check(about: str, content: bytes, where: str, ends: Callable[[list[Any]], Any] = min) -> Check:
    """How long a certificate, PEM or DER, remains valid.

    ends: whether several of a PEM file expire with the first (of a chain) or with the last (of trusted CAs).
    """
    try:
        from cryptography import x509
    except ImportError:
        missing = f"{where} was not examined: cryptography is missing"
        return doubt(about, missing, "pip install cryptography")
    try:
        pem = b"-----BEGIN" in content
        found = x509.load_pem_x509_certificates(content) if pem else [x509.load_der_x509_certificate(content)]
    except ValueError:
        wrong = f"{where}: expected a certificate, found something else"
        return fault(about, wrong, "name a file with a certificate, PEM or DER")
    spans = [(one.not_valid_after_utc.timestamp(), one.not_valid_before_utc.timestamp()) for one in found]
    (end, begin), now = ends(spans), time.time()
    if begin > now:
        return fault(about, f"{where} is not valid before {stamp_text(begin)}", "compare the clocks, or wait")
    if end < now:
        return fault(about, f"{where} has expired {lasting(now - end)} ago", "replace the certificate")
    left = f"{where} is valid for {lasting(end - now)}"
    return doubt(about, left, "order a new certificate now") if end - now < SOON_S else ok(about, left)
