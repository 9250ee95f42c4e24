"""The `[[notify]]` tables of the tracker's file: each becomes a channel."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from email.utils import parseaddr
from functools import partial
from pathlib import Path
from typing import ClassVar

from hygrokf.data.timestamps import DAY_S, duration
from hygrokf.data.toml_form import Place, across, read_form, setting
from hygrokf.errors import suggestion
from hygrokf.live.alarms import RULES
from hygrokf.live.notification.notices import SEVERITIES, Channel, ChannelFault
from hygrokf.live.notification.transports import Mail, Webhook
from hygrokf.live.sources.endpoint import Address, PasswordKeys, Secret, address_of
from hygrokf.live.sources.stream import SourceFault

LONGEST_NAME = 40
PORTS = {"smtp": 587, "smtps": 465, "http": 80, "https": 443}
"""Scheme of a URL -> default port."""
MOST_HOLD_OFF_S, MOST_DIGEST_S = 7.0 * DAY_S, DAY_S
_ADDRESS = 'an address such as "ops@farm.example"'


def _is_address(text: str) -> bool:
    address = parseaddr(text)[1]
    user, at, host = address.rpartition("@")
    return bool(user and at and host) and text.isprintable() and text.isascii() and " " not in address


def _of(value: object, choices: tuple[str, ...]) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
        raise ValueError(f"expected a list of {', '.join(choices)}, found {value!r}")
    for one in value:
        if one not in choices:
            raise ValueError(f'expected {", ".join(choices)}, found "{one}"{suggestion(one, choices)}')
    return tuple(value)


@dataclass(frozen=True, kw_only=True)
class ChannelForm:
    """What the tables of all channels have in common."""

    name: str = setting(
        help="the name of the channel",
        fits=lambda name: len(name) <= LONGEST_NAME and name.isprintable() and ":" not in name,
        expected=f"text of 1 to {LONGEST_NAME} printable characters without a colon",
    )
    hold_off_s: float = setting(
        0.0,
        "time that an alarm must stand",
        read=duration,
        least=0.0,
        most=MOST_HOLD_OFF_S,
        expected="at most 7 d",
    )
    digest_s: float = setting(
        0.0, "interval of collected messages", read=duration, least=0.0, most=MOST_DIGEST_S,
        expected="at most 1 d",
    )  # fmt: skip
    kinds: tuple[str, ...] = setting((), "kinds of alarms", read=partial(_of, choices=tuple(RULES)))
    severities: tuple[str, ...] = setting((), "severities of alarms", read=partial(_of, choices=SEVERITIES))
    turbines: tuple[str, ...] = setting((), "names of turbines", empty=True)
    ca: str = setting("", "certificates of the CAs to trust, PEM")
    url: str

    @property
    def address(self) -> Address:
        """The parts of the url."""
        return address_of(self.url, PORTS, has_path=self.url.startswith("http"))

    @across("url")
    def url_form(self) -> str | None:
        if not self.url.isascii():
            return "url must be ASCII"
        return self.address.fault


@dataclass(frozen=True, kw_only=True)
class MailForm(PasswordKeys, ChannelForm):
    """A [[notify]] by mail."""

    url: str = setting(help="smtp://[USER@]HOST[:PORT] for STARTTLS, or smtps:// for TLS from the start")
    sender: str = setting(help="the sender's address", fits=_is_address, expected=_ADDRESS)
    to: tuple[str, ...] = setting(
        help="receivers", expected='a list of addresses such as ["ops@farm.example"]',
        fits=lambda to: bool(to) and all(map(_is_address, to)),
    )  # fmt: skip
    unencrypted: bool = setting(False, "whether the server is reached without TLS")
    timeout_s: float = setting(60.0, "of one message", read=duration, least=1.0, most=600.0,
                               expected="1 s to 10 min")  # fmt: skip

    @across("password_file", "password_env", "url")
    def login(self) -> str | None:
        if self.has_password == bool(self.address.user):
            return None
        return "user and password belong together: smtp://USER@HOST and password_file or password_env"

    @across("unencrypted", "url", "password_file", "password_env")
    def secured(self) -> Iterator[str]:
        if self.unencrypted and self.url.startswith("smtps:"):
            yield "unencrypted does not go with smtps://: keep one"
        if self.unencrypted and self.has_password:
            yield "unencrypted: a password is only sent over TLS"

    def transport(self, folder: Path) -> Mail:
        """The mail server.  Raises SourceFault or ChannelFault for a password that cannot be used."""
        scheme, host, port, user, _, _ = self.address
        password = self.password(folder)
        if not f"{user}{password.read() or ''}".isascii():
            raise ChannelFault("user and password must be ASCII, as Python's SMTP client sends no other")
        return Mail(
            host, port, self.sender, self.to, scheme == "smtps", self.unencrypted, user, password,
            folder / self.ca if self.ca else None, self.timeout_s,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class WebhookForm(ChannelForm):
    """A [[notify]] by a webhook."""

    REFUSED: ClassVar = {
        "secret": "a secret must not be in this file: name a file as secret_file, or an environment "
        "variable as secret_env"
    }
    url: str = setting(help="https://HOST[:PORT]/PATH")
    secret_file: str = setting("", "file with the secret that signs, as its only line")
    secret_env: str = setting("", "environment variable with the secret")
    timeout_s: float = setting(10.0, "of one message", read=duration, least=1.0, most=120.0,
                               expected="1 s to 2 min")  # fmt: skip

    @across("url")
    def no_user(self) -> str | None:
        wrong = "url: user and password do not belong here; sign by secret_file"
        return wrong if self.address.user else None

    @across("secret_file", "secret_env")
    def one_secret(self) -> str | None:
        return "secret_file and secret_env: keep one" if self.secret_file and self.secret_env else None

    def transport(self, folder: Path) -> Webhook:
        """The receiver.  Raises ChannelFault for a secret that cannot be used."""
        scheme, host, port, _, path, _ = self.address
        file = folder / self.secret_file if self.secret_file else None
        secret = Secret(file, self.secret_env, "secret")
        ca = folder / self.ca if self.ca else None
        made = Webhook(host, port, path, scheme == "https", secret, ca, self.timeout_s)
        made.signing_key()
        return made


KINDS: Mapping[str, type[MailForm] | type[WebhookForm]] = {
    "smtp": MailForm, "smtps": MailForm, "https": WebhookForm, "http": WebhookForm,
}  # fmt: skip
"""Scheme of a URL -> form of the table."""


def channel_of(
    table: Mapping[str, object], place: Place, folder: Path, turbines: Collection[str]
) -> Channel | None:
    """The channel of a `[[notify]]` table; None if the table is faulty, with the faults in `place`.

    Nothing is connected yet.  Paths are relative to `folder`.
    """
    url = table.get("url")
    scheme = url.partition(":")[0] if isinstance(url, str) else ""
    if scheme not in KINDS:
        place.fault(f"url must begin with one of {', '.join(f'{one}:' for one in KINDS)}, found {scheme!r}")
        return None
    own = replace(place, faults=[])
    form: MailForm | WebhookForm = read_form(KINDS[scheme], table, own)
    if not own.faults:
        unknown = [one for one in form.turbines if one not in turbines]
        if unknown:
            own.fault(f"turbines: no turbine is named {unknown[0]!r}{suggestion(unknown[0], turbines)}")
    made = None
    if not own.faults:
        try:
            transport, covered = form.transport(folder), (form.kinds, form.severities, form.turbines)
            made = Channel(form.name, transport, form.hold_off_s, form.digest_s, *covered)
        except (SourceFault, ChannelFault) as fault:
            own.fault(str(fault))
    place.faults.extend(own.faults)
    return None if own.faults else made
