"""Registration of mechanisms and features that users bring, with their origin.

A design stores its mechanisms and features by name, so that reading it requires the same ones.  An origin
says where they come from: {"file": name, "sha256": hash}, {"package": name, "version": version}, or
{"python": module} for those defined in a session without a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from hygrokf.data.signals import SIGNALS
from hygrokf.modelling.derived_inputs import FEATURES
from hygrokf.physics.holds import hold_named
from hygrokf.physics.mechanisms import LIBRARY, Factory
from hygrokf.physics.model import Feature

Origin = Mapping[str, str]

_PACKAGE = frozenset({*LIBRARY, *FEATURES, *SIGNALS})
_origins: dict[str, Origin] = {}
"""Origins of the mechanisms and features that users brought, by name."""


def is_package_mechanism(name: str, factory: Factory) -> bool:
    """Whether this factory is the package's own of that name."""
    return name in _PACKAGE and LIBRARY.get(name) is factory


def is_package_feature(name: str, feature: Feature) -> bool:
    """Whether this feature is the package's own of that name."""
    return name in _PACKAGE and FEATURES.get(name) == feature


def name_faults(mechanisms: Iterable[str], features: Iterable[str]) -> list[str]:
    """Faults of names that the package already uses, and of one name used for a mechanism and a feature."""
    mechanisms, features = list(mechanisms), list(features)
    faults = [
        f"{kind} {name!r}: the package has a mechanism, feature or signal of that name; choose another name"
        for kind, names in (("mechanism", mechanisms), ("feature", features))
        for name in names
        if name in _PACKAGE
    ]
    both = sorted(set(mechanisms) & set(features))
    return faults + [f"{name!r} names a mechanism and a feature; choose two names" for name in both]


def admit(mechanisms: Mapping[str, Factory], features: Mapping[str, Feature], origin: Origin) -> None:
    """Add factories and features to the package's tables, replacing those that a user brought before.

    Raises ValueError for names of the package, and for unknown holds.
    """
    faults = name_faults(mechanisms, features)
    if faults:
        raise ValueError("; ".join(faults))
    held = {name: (function, hold_named(hold)) for name, (function, hold) in features.items()}
    withdraw((*mechanisms, *features))
    LIBRARY.update(mechanisms)
    FEATURES.update(held)
    _origins.update({name: dict(origin) for name in (*mechanisms, *features)})


def withdraw(names: Iterable[str]) -> None:
    """Remove from the tables what a user brought under these names."""
    for name in names:
        if _origins.pop(name, None) is not None:  # the package's own names never stand there
            LIBRARY.pop(name, None)
            FEATURES.pop(name, None)


def origins(names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Origins of those mechanisms and features that a user brought."""
    return {name: dict(_origins[name]) for name in names if name in _origins}


def origin_text(origin: Origin) -> str:
    """An origin in words."""
    if "file" in origin:
        return f"{origin['file']} (SHA-256 {origin['sha256'][:12]}…)"
    if "package" in origin:
        return f"the package {origin['package']} {origin['version']}"
    return f"a Python session (module {origin.get('python', '?')})"


def absent(stored: Mapping[str, Origin]) -> list[str]:
    """Sentences about mechanisms and features of users that a stored design needs and that are missing or
    differ here."""
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
        return f"pass the file as it was then: --library {origin['file']}"
    if "package" in origin:
        return "install that version"
    return "register the cause there before reading the fit"
