"""Both ends of a connection: hosts, and passwords that are kept outside of the tracker's file."""

from __future__ import annotations

import ipaddress
import os
from pathlib import Path
from typing import NamedTuple

from hygrokf.live.sources.stream import SourceFault

OTHERS_READ = 0o004
"""Mode bit of a file that every user of the machine may read."""
NO_PASSWORD_HERE = (
    "a password must not be in this file: put it into a separate file and name that as password_file, "
    "or into an environment variable and name that as password_env"
)


class Address(NamedTuple):
    """The parts of a URL SCHEME://[USER@]HOST[:PORT][/PATH], and what is wrong with it."""

    scheme: str
    host: str
    port: int
    user: str = ""
    path: str = "/"
    fault: str | None = None


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host, so that nothing sent there leaves this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def bracketed(host: str) -> str:
    """A host as it stands in a URL: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host


def password_of(file: Path | None, variable: str, key: str = "password") -> str | None:
    """The password (or other secret, by the name of its key) in a file or an environment variable.

    None if neither is named.  Raises SourceFault.
    """
    if variable:
        found = os.environ.get(variable, "")
        if not found:
            raise SourceFault(f"{key}_env: the environment variable {variable} is not set or empty")
        return found
    if file is None:
        return None
    try:
        found = file.read_text(encoding="utf-8").rstrip("\r\n")
    except OSError as fault:
        raise SourceFault(f"{key}_file: {file}: {fault.strerror}") from None
    except UnicodeDecodeError:
        raise SourceFault(f"{key}_file: {file}: expected text in UTF-8") from None
    if not found or "\n" in found:
        raise SourceFault(f"{key}_file: {file}: expected one line, the {key}, and nothing else")
    return found
