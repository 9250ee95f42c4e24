"""Settings of the page: its address, the host names it answers to, and its token.

The page leaves TLS, HTTP/2 and limits on clients to a proxy, so other machines reach it only through a proxy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from hygrokf.data.toml_form import Place, across, read_form, setting
from hygrokf.errors import HygrokfError
from hygrokf.live.sources.endpoint import Secret, bracketed, is_loopback
from hygrokf.live.sources.stream import SourceFault

PAGE_ADDRESS = "127.0.0.1:8080"
UNIX = "unix:"
"""Beginning of an address that is the path of a Unix socket."""
NO_TLS = (
    "the page does not use TLS itself: give this file to a proxy such as nginx "
    "(docs/live_files/nginx.conf), and set behind_proxy = true"
)
SHORTEST_TOKEN = 16
"""Shortest token [characters]; tokens made by the command in the message of `_token` have 43."""

MISSING_PACKAGES = "the live page needs further packages: pip install 'hygrokf[live]'"


class PageFault(HygrokfError):
    """The page cannot be served; the message tells the operator why."""


@dataclass(frozen=True)
class PageSettings:
    """The address at which the page is served, and the requests that it accepts.

    `hosts`: further host names that requests may use; `token`: required token ("": none); `behind_proxy`:
    requests come through a proxy that terminates TLS; `unix`: path of a Unix socket in place of `host` and
    `port` ("": none).
    """

    host: str = "127.0.0.1"
    port: int = 8080
    hosts: tuple[str, ...] = ()
    token: str = field(default="", repr=False)
    behind_proxy: bool = False
    unix: str = ""

    @property
    def place(self) -> str:
        """The address as in the tracker's file: HOST:PORT or unix:PATH."""
        return f"{UNIX}{self.unix}" if self.unix else f"{bracketed(self.host)}:{self.port}"

    @property
    def names(self) -> frozenset[str]:
        """Host names, in lower case, that requests may use."""
        local = (self.host, "localhost", "127.0.0.1", "::1")
        return frozenset(name.lower().rstrip(".") for name in (*local, *self.hosts))


@dataclass(frozen=True)
class PageForm:
    """The table [page]; in its place an address alone is allowed."""

    REFUSED: ClassVar = {"certificate": NO_TLS, "key": NO_TLS}
    address: str = setting(PAGE_ADDRESS, "HOST:PORT or unix:PATH")
    hosts: tuple[str, ...] = setting(
        (),
        "further host names by which browsers reach the page",
        expected='a list of names such as ["farm.example"]',
    )
    token_file: str = setting("", "file with the token")
    token_env: str = setting("", "environment variable with the token")
    behind_proxy: bool = setting(False, "whether requests come through a proxy that provides TLS")

    @across("address")
    def host_and_port(self) -> str | None:
        if self.address.startswith(UNIX) or address(self.address):
            return None
        return f"page must be HOST:PORT such as {PAGE_ADDRESS}, or unix:PATH, found {self.address!r}"

    @across("token_file", "token_env")
    def one_token(self) -> str | None:
        has_two_tokens = self.token_file and self.token_env
        return "give token_file or token_env, not both" if has_two_tokens else None


def page_settings(value: object, folder: Path, place: Place) -> PageSettings:
    """Return the page's settings from `page = "HOST:PORT"` or a table [page]; faults are reported at `place`.

    Paths are relative to `folder`.  An address that other machines can reach needs a proxy, and a proxy needs
    a token.
    """
    table = {"address": value} if isinstance(value, str) else value
    if not isinstance(table, Mapping):
        place.fault(f'page: expected "HOST:PORT" or a table [page], found {value!r}')
        return PageSettings()
    inside, earlier_faults = place.inside("page"), len(place.faults)
    form = read_form(PageForm, table, inside)
    token = _token(form, folder, inside)
    unix = str(folder / form.address.removeprefix(UNIX)) if form.address.startswith(UNIX) else ""
    host, port = ("localhost", 0) if unix else address(form.address) or ("127.0.0.1", 0)
    if len(place.faults) == earlier_faults:
        if form.behind_proxy and not token:
            inside.fault("behind_proxy needs token_file or token_env, because others can reach the proxy")
        if not is_loopback(host) and not form.behind_proxy:
            inside.fault(
                f"other machines reach {host}: give an address such as {PAGE_ADDRESS}; or put a proxy with "
                "TLS in front of the page (docs/live_files/nginx.conf) and set behind_proxy = true, "
                "token_file"
            )
    return PageSettings(host, port, form.hosts, token, form.behind_proxy, unix)


def address(text: str) -> tuple[str, int] | None:
    """Return host and port of a text `HOST:PORT`; None for any other text."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 <= int(port) < 65536:
        return None
    return host.strip("[]"), int(port)


def _token(form: PageForm, folder: Path, place: Place) -> str:
    """Return the token from its file or environment variable, "" without one; no message contains it."""
    if form.token_file and form.token_env:
        return ""
    try:
        token = Secret(folder / form.token_file if form.token_file else None, form.token_env, "token").read()
    except SourceFault as fault:
        place.fault(str(fault))
        return ""
    if token is None:
        return ""
    if len(token) < SHORTEST_TOKEN or not (token.isascii() and token.isprintable()) or " " in token:
        place.fault(
            f"expected a token of at least {SHORTEST_TOKEN} printable characters without spaces in "
            f"{form.token_file or f'the variable {form.token_env}'}; "
            "make one with: python -c 'import secrets; print(secrets.token_urlsafe())'"
        )
        return ""
    return token
