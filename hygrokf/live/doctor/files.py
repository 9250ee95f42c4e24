"""Certificates and secrets that the tracker's file names: how long they last, and who may read them."""

from __future__ import annotations

import os
import time
import tomllib
from collections.abc import Iterator
from collections.abc import Mapping as MappingOf
from pathlib import Path

from hygrokf.data.timestamps import stamp_text
from hygrokf.live.doctor.check import Check, doubt, fault, lasting, ok
from hygrokf.live.sources.broker import OTHERS_READ
from hygrokf.live.sources.certificates import Validity, validities

SOON_S = 30 * 86400.0
"""[s] of validity left, below which it is time for another certificate."""
CERTIFICATES = ("certificate", "ca", "server_certificate")
SECRETS = ("key", "password_file", "token_file")


def file_checks(file: Path) -> Iterator[Check]:
    """All files that a tracker's file names, which was read without fault."""
    content = tomllib.loads(file.read_text(encoding="utf-8"))
    for where, table in _tables(content):
        for key in (*CERTIFICATES, *SECRETS):
            if not isinstance(table.get(key), str):
                continue
            about, path = f"{where} {key}", file.parent / table[key]
            try:
                yield _secret(about, path) if key in SECRETS else _certificate(about, path, key)
            except OSError as error:
                yield fault(about, f"{path}: {error.strerror}", "put it back, or name another file")


def _tables(content: MappingOf) -> Iterator[tuple[str, MappingOf]]:
    if isinstance(content.get("page"), dict):
        yield "[page]", content["page"]
    for number, table in enumerate(content.get("source", []), start=1):
        yield f"[[source]] {number}", table


def _secret(about: str, path: Path) -> Check:
    """Who may read a secret; where files have no such rights nothing is wrong."""
    if os.name == "posix" and path.stat().st_mode & OTHERS_READ:
        return doubt(about, f"every user of this machine may read {path}", f"chmod o-rwx {path}")
    return ok(about, f"{path} is closed to other users")


def _certificate(about: str, path: Path, key: str) -> Check:
    try:
        found = validities(path.read_bytes())
    except ValueError as error:
        return fault(about, f"{path}: {error}", "name a file with a certificate, PEM or DER")
    # a chain holds as long as its weakest part; of several CAs that are trusted each stands alone
    ends = (max if key == "ca" else min)(found, key=lambda one: one.end)
    check = validity_check(about, ends, str(path))
    if key == "server_certificate" and check.level == "fault":  # the pinned one is compared, not judged
        return doubt(about, check.found, check.remedy)
    return check


def validity_check(about: str, found: Validity, where: str) -> Check:
    """How long a certificate still lasts."""
    now = time.time()
    if found.begin > now:
        return fault(
            about, f"{where} is not valid before {stamp_text(found.begin)}", "compare the clocks, or wait"
        )
    if found.end < now:
        return fault(
            about, f"{where} has expired {lasting(now - found.end)} ago", "put a new certificate there"
        )
    left = f"{where} is valid for {lasting(found.end - now)}"
    if found.end - now < SOON_S:
        return doubt(about, left, "order a new certificate now")
    return ok(about, left)
