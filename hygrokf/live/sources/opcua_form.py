"""A [[source]] that is an OPC UA server: its nodes, the security of its connection and its user.

Certificates and keys are read once, together with the tracker's file, the password for every connection.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hygrokf.data.timestamps import duration
from hygrokf.data.toml_form import Place, across, entry_name, setting
from hygrokf.live.sources.endpoint import PasswordKeys, UrlKeys
from hygrokf.live.sources.stream import SourceKeys

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

QUEUE_SIZE = 20_000
"""Largest number of samples in the queue of this client."""
POLICIES = ("Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss")
MODES = ("SignAndEncrypt", "Sign")
FILES = ("certificate", "key", "server_certificate")


@dataclass(frozen=True)
class Node:
    """A variable of the server, an entry of `nodes`: its id as text, its turbine, and its field."""

    id: str = entry_name()
    turbine: str = setting(help="name of the turbine")
    field: str = setting(help="field of [mapping.signals]")


@dataclass(frozen=True)
class Security:
    """Signing and encryption between this client's key pair and one server's certificate (all DER).

    `application_uri`: URI in the client's certificate; `valid_until`: end of that certificate's validity [s].
    """

    policy: str
    mode: str
    certificate: bytes = field(repr=False)
    key: bytes = field(repr=False)
    server_certificate: bytes = field(repr=False)
    application_uri: str
    valid_until: float


@dataclass(frozen=True)
class Server(UrlKeys, PasswordKeys, SourceKeys):
    """A [[source]] of `opc.tcp://HOST:PORT/PATH`: a server, its nodes, security and user."""

    url: str = setting(help="opc.tcp://HOST:PORT/PATH")
    nodes: Mapping[str, Node] = setting(dict, "node ids, each with its turbine and its field")
    sampling_s: float = setting(1.0, "interval at which the server samples a value", read=duration)
    publishing_s: float = setting(
        1.0,
        "interval at which the server sends its samples",
        read=duration,
        least=0.01,
        most=60.0,
        expected='within "0.01s" … "1min"',
    )
    queue: int = setting(
        100, "number of samples of one node that the server queues", least=2, most=QUEUE_SIZE
    )
    look_back_s: float = setting(
        0.0, "time before the first start from which a node's history is read", read=duration
    )
    uncertain: bool = setting(True, "whether values with an uncertain status are used")
    security: str = setting(
        "",
        '"none" permits an unsecured connection to another host',
        fits="none".__eq__,
        expected='"none", or left out',
    )
    policy: str | None = setting(None, f"security policy, by default {POLICIES[0]}", choices=POLICIES)
    mode: str | None = setting(None, f"message security mode, by default {MODES[0]}", choices=MODES)
    certificate: str | None = setting(None, "file with the certificate of the tracker (PEM or DER)")
    key: str | None = setting(
        None, "file with the RSA key of the certificate (PEM or DER, without a password)"
    )
    server_certificate: str | None = setting(
        None, "file with the certificate of the only trusted server (PEM or DER)"
    )
    user: str = setting("", "user name; needs password_file or password_env")

    @property
    def endpoint(self) -> str:
        """The URL with its port; "" if the URL is invalid."""
        return f"opc.tcp://{self.where}{self.address.path}" if self.address.host else ""

    @across("url")
    def url_form(self) -> str | None:
        if self.address.user:
            return "a user does not belong in the url: state user, and password_file or password_env"
        return self.address.fault

    @across("nodes")
    def has_nodes(self) -> str | None:
        if self.nodes:
            return None
        return 'no nodes: add nodes = { "ns=2;s=T07.CabinetTemp" = { turbine = "T07", field = "Tcab" } }'

    @property
    def security_keys(self) -> list[str]:
        """The stated keys that belong to a secured connection."""
        return [name for name in ("policy", "mode", *FILES) if getattr(self, name)]

    @across("security")
    def security_not_contradicted(self) -> str | None:
        if self.security != "none" or not self.security_keys:
            return None
        return f'security = "none" contradicts {", ".join(self.security_keys)}; remove one or the other'

    @across(*FILES)
    def files_complete(self) -> str | None:
        missing = [name for name in FILES if not getattr(self, name)]
        if not self.security_keys or not missing or self.security == "none":
            return None
        return f"{', '.join(missing)} missing: a secured connection needs {', '.join(FILES)}"

    @across("user", "password_file", "password_env")
    def password_of_user(self) -> str | None:
        if bool(self.user) == self.password.is_stated:
            return None
        return "user and its password_file or password_env belong together"

    @across("url", "security", "user")
    def readable_by_others(self) -> Iterator[str]:
        if not self.address.host or self.security_keys or not self.leaves_machine:
            return
        needed = ", ".join(FILES)
        if self.security != "none":
            yield (
                f"a connection to another host needs {needed}, "
                'or state security = "none" if others may read and change the data on their way'
            )
        if self.user:
            yield f"a password to another host needs {needed}: otherwise it is sent unencrypted"

    def security_from(self, place: Place) -> Security | None:
        """Return the security, read from its files; None for an unsecured connection or with faults, which
        are reported at `place`."""
        if not self.security_keys or self.security == "none":
            return None
        try:
            from cryptography.hazmat.primitives import serialization
        except ImportError:
            place.fault("certificates need cryptography: pip install 'hygrokf[opcua]'")
            return None
        certificate = self._read("certificate", place)
        key = self._read("key", place)
        server = self._read("server_certificate", place)
        uri = "" if certificate is None else _application_uri(certificate)
        if certificate is not None:
            if not uri:
                place.fault(
                    "certificate: expected a URI among its alternative names, found none: servers refuse it"
                )
            if key is not None and certificate.public_key() != key.public_key():
                place.fault("certificate and key do not belong together")
        if certificate is None or key is None or server is None:
            return None
        der = serialization.Encoding.DER
        return Security(
            self.policy or POLICIES[0],
            self.mode or MODES[0],
            certificate.public_bytes(der),
            key.private_bytes(der, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()),
            server.public_bytes(der),
            uri,
            certificate.not_valid_after_utc.timestamp(),
        )

    def _read(self, key: str, place: Place) -> Any:
        """Return the private key or certificate in the file that the setting `key` names.

        None without a file, or if the file cannot be read, with a fault at `place`.
        """
        from cryptography import x509
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey, RSAPublicKey

        path, is_key = self.path(key), key == "key"
        if path is None:
            return None
        try:
            content = path.read_bytes()
            pem = b"-----BEGIN" in content
            if is_key:
                load = serialization.load_pem_private_key if pem else serialization.load_der_private_key
                private = load(content, None)
                if isinstance(private, RSAPrivateKey):
                    return private
            else:
                read = x509.load_pem_x509_certificate if pem else x509.load_der_x509_certificate
                certificate = read(content)
                if isinstance(certificate.public_key(), RSAPublicKey):
                    return certificate
        except OSError as fault:
            place.fault(f"{key}: {path}: {fault.strerror}")
            return None
        except (ValueError, TypeError):
            pass
        kind = "a private RSA key without a password" if is_key else "an RSA certificate"
        place.fault(f"{key}: {path}: expected {kind}, as PEM or DER")
        return None


def _application_uri(certificate: Certificate) -> str:
    """Return the first URI among the alternative names of a certificate; "" without one."""
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ""
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")
