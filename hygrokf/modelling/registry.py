"""Mechanisms and features that users bring: taken into the tables of the package in this one place, with their origin.

A design names its mechanisms and features, so whoever reads a stored one needs the same ones again.  An origin says where
they come from: {"file": name, "sha256": hash}, {"package": name, "version": version}, or {"python": module} for what was
made in a session without a file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from hygrokf.data.signals import SIGNALS
from hygrokf.modelling.derived_inputs import FEATURES
from hygrokf.physics.mechanisms import LIBRARY
from hygrokf.physics.model import Mechanism

Factory = Callable[..., Mechanism]
Feature = tuple[Callable, str]
Origin = Mapping[str, str]

_PACKAGE = frozenset({*LIBRARY, *FEATURES, *SIGNALS})
_origins: dict[str, Origin] = {}
_TABLES: tuple[tuple[str, dict], ...] = (("mechanisms", LIBRARY), ("features", FEATURES))
_held: dict[str, dict] = {"mechanisms": {}, "features": {}}


def name_faults(mechanisms: Iterable[str], features: Iterable[str]) -> list[str]:
    """Names that are taken: those of the package's mechanisms, features and signals, and one for two things."""
    mechanisms, features = list(mechanisms), list(features)
    faults = [
        f"{kind} {name!r}: the package has a mechanism, feature or signal of that name; choose another one"
        for kind, names in (("mechanism", mechanisms), ("feature", features))
        for name in names
        if name in _PACKAGE
    ]
    both = sorted(set(mechanisms) & set(features))
    return faults + [f"{name!r} names a mechanism and a feature; choose two names" for name in both]


def admit(mechanisms: Mapping[str, Factory], features: Mapping[str, Feature], origin: Origin) -> None:
    """Take factories and features into the package's tables; what a user brought before gives way to its new form.

    Raises ValueError for names of the package.
    """
    faults = name_faults(mechanisms, features)
    if faults:
        raise ValueError("; ".join(faults))
    withdraw((*mechanisms, *features))
    LIBRARY.update(mechanisms)
    FEATURES.update(features)
    for kind, brought in (("mechanisms", mechanisms), ("features", features)):
        _held[kind].update(brought)
    _origins.update({name: dict(origin) for name in (*mechanisms, *features)})


def withdraw(names: Iterable[str]) -> None:
    """Take out of the tables what a user brought under these names."""
    for name in names:
        if _origins.pop(name, None) is not None:
            for kind, table in _TABLES:
                if _held[kind].pop(name, None) is not None:
                    del table[name]


def origins(names: Iterable[str]) -> dict[str, dict]:
    """Origin of every one of these mechanisms and features that a user brought."""
    return {name: dict(_origins[name]) for name in names if name in _origins}


def origin_text(origin: Origin) -> str:
    """Where something comes from, in words."""
    if "file" in origin:
        return f"{origin['file']} (SHA-256 {origin['sha256'][:12]}…)"
    if "package" in origin:
        return f"the package {origin['package']} {origin['version']}"
    return f"a Python session (module {origin.get('python', '?')})"


def absent(stored: Mapping[str, Origin]) -> list[str]:
    """What a stored design has of users and what is not here as it was, one sentence for each origin."""
    wanted: dict[str, list[str]] = {}
    for name, origin in stored.items():
        here = _origins.get(name)
        if here is not None and ("python" in origin or dict(here) == dict(origin)):
            continue
        found = "found none of that name" if here is None else f"found that of {origin_text(here)}"
        wanted.setdefault(f"of {origin_text(origin)}, {found}; {_remedy(origin)}", []).append(name)
    return [f"the model needs {', '.join(names)} {text}" for text, names in wanted.items()]


def _remedy(origin: Origin) -> str:
    if "file" in origin:
        return f"name the file as it was then: --library {origin['file']}"
    if "package" in origin:
        return "install that version"
    return "adopt the cause there before the fit is read"
