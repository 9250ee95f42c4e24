"""How a connection to an OPC UA server is secured: policy, certificates and user, from the tracker's file.

Certificates and keys are read once, when the file is; a password never stands in the file itself.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Callable
from collections.abc import Mapping as MappingOf
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hygrokf.live.table_reader import TableReader

POLICIES = ("Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss")
MODES = ("SignAndEncrypt", "Sign")
FILES = ("certificate", "key", "server_certificate")
SECURITY_KEYS = ("security", "policy", "mode", *FILES, "user", "password_file", "password_env")
"""Keys of a `[[source]]` table that are read here."""


@dataclass(frozen=True)
class Security:
    """Messages are signed or encrypted, between this client's key pair and one server's certificate (all DER).

    `application_uri` is the name that the client's certificate is made for, `valid_until` when it ends [s].
    """

    policy: str
    mode: str
    certificate: bytes = field(repr=False)
    key: bytes = field(repr=False)
    server_certificate: bytes = field(repr=False)
    application_uri: str
    valid_until: float


@dataclass(frozen=True)
class User:
    """Who signs on."""

    name: str
    password: str = field(repr=False)


def security_of(
    table: MappingOf[str, object], where: str, host: str, folder: Path, reader: TableReader
) -> tuple[Security | None, User | None]:
    """Security and user of a `[[source]]` table; what is wrong with them goes to `reader`.

    None: a plain connection, which other hosts than this one need `security = "none"` for; nobody by name.
    """
    stated = [key for key in ("policy", "mode", *FILES) if key in table]
    plain = reader.text(table, "security", where)
    if plain not in ("", "none"):
        reader.faults.append(f'{where}: security must be "none" where it is stated, found {plain!r}')
    if plain == "none" and stated:
        reader.faults.append(
            f'{where}: security = "none" contradicts {", ".join(stated)}: leave out one or the other'
        )
    security = _security(table, where, folder, reader) if stated and plain != "none" else None
    if not stated and plain != "none" and not is_this_machine(host):
        reader.faults.append(
            f"{where}: a connection to another host needs {', '.join(FILES)}; "
            'state security = "none" where it shall be readable and open to change on its way'
        )
    user = _user(table, where, folder, reader)
    if user is not None and not stated and not is_this_machine(host):
        reader.faults.append(
            f"{where}: a password to another host needs {', '.join(FILES)}: it would be sent readable"
        )
    return security, user


def is_this_machine(host: str) -> bool:
    """Whether a host is reached without leaving this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _security(
    table: MappingOf[str, object], where: str, folder: Path, reader: TableReader
) -> Security | None:
    before = len(reader.faults)
    policy = reader.text(table, "policy", where, POLICIES[0])
    mode = reader.text(table, "mode", where, MODES[0])
    for name, value, known in (("policy", policy, POLICIES), ("mode", mode, MODES)):
        if value not in known:
            reader.faults.append(f"{where}: {name} must be one of {', '.join(known)}, found {value!r}")
    missing = [key for key in FILES if not reader.text(table, key, where)]
    if missing:
        reader.faults.append(
            f"{where}: {', '.join(missing)} missing: a secured connection needs {', '.join(FILES)}"
        )
    try:
        from cryptography.hazmat.primitives import serialization
    except ImportError:
        reader.faults.append(f"{where}: certificates need cryptography: pip install 'hygrokf[opcua]'")
        return None
    own = _read(table, "certificate", where, folder, reader, _certificate)
    key = _read(table, "key", where, folder, reader, _key)
    server = _read(table, "server_certificate", where, folder, reader, _certificate)
    uri = "" if own is None else _application_uri(own)
    if own is not None:
        if not uri:
            reader.faults.append(
                f"{where}: certificate: expected a URI among its alternative names, found none: servers refuse it"
            )
        if key is not None and own.public_key() != key.public_key():
            reader.faults.append(f"{where}: certificate and key do not belong together")
    if len(reader.faults) > before:
        return None
    der = serialization.Encoding.DER
    return Security(
        policy,
        mode,
        own.public_bytes(der),
        key.private_bytes(der, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()),
        server.public_bytes(der),
        uri,
        own.not_valid_after_utc.timestamp(),
    )


def _read(
    table: MappingOf[str, object], name: str, where: str, folder: Path, reader: TableReader, read: Callable
) -> Any:
    """What `read` makes of the file that a key names; None where it is missing or nothing can be made of it."""
    stated = table.get(name)
    if not isinstance(stated, str) or not stated:
        return None
    try:
        return read((folder / stated).read_bytes())
    except OSError as fault:
        reader.faults.append(f"{where}: {name}: {folder / stated}: {fault.strerror}")
    except (ValueError, TypeError):
        kind = "a private RSA key without a password" if name == "key" else "an RSA certificate"
        reader.faults.append(f"{where}: {name}: {folder / stated}: expected {kind}, as PEM or DER")
    return None


def _certificate(content: bytes) -> Any:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import rsa

    pem = b"-----BEGIN" in content
    found = x509.load_pem_x509_certificate(content) if pem else x509.load_der_x509_certificate(content)
    if not isinstance(found.public_key(), rsa.RSAPublicKey):
        raise ValueError("not RSA")
    return found


def _key(content: bytes) -> Any:
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import rsa

    pem = b"-----BEGIN" in content
    load = serialization.load_pem_private_key if pem else serialization.load_der_private_key
    found = load(content, None)
    if not isinstance(found, rsa.RSAPrivateKey):
        raise ValueError("not RSA")
    return found


def _application_uri(certificate: Any) -> str:
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ""
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")


def _user(table: MappingOf[str, object], where: str, folder: Path, reader: TableReader) -> User | None:
    name = reader.text(table, "user", where)
    file, variable = reader.text(table, "password_file", where), reader.text(table, "password_env", where)
    if "password" in table:
        reader.faults.append(
            f"{where}: a password does not belong in this file: put it into a file of its own and state password_file, "
            "or into an environment variable and state password_env"
        )
        return None
    if file and variable:
        reader.faults.append(f"{where}: state password_file or password_env, not both")
    if bool(name) != bool(file or variable):
        reader.faults.append(f"{where}: user and its password_file or password_env belong together")
    password = ""
    if file:
        try:
            password = (folder / file).read_text(encoding="utf-8").rstrip("\r\n")
        except (OSError, UnicodeDecodeError) as fault:
            reason = fault.strerror if isinstance(fault, OSError) else "no text in UTF-8"
            reader.faults.append(f"{where}: password_file: {folder / file}: {reason}")
            return None
        if not password:
            reader.faults.append(f"{where}: password_file: {folder / file} is empty")
    elif variable:
        password = os.environ.get(variable, "")
        if not password:
            reader.faults.append(
                f"{where}: password_env: the environment has no variable of that name, or an empty one"
            )
    return User(name, password) if name and password else None
