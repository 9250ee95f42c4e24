"""A user's own causes: loaded from a file or an installed package, checked, and registered.

A file is executed: load only files that you trust.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from functools import wraps
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.library import LIBRARY, Cause
from hygrokf.discovery.plugin_validation import declared_faults, exception_text, form_faults, is_feature
from hygrokf.errors import HygrokfError
from hygrokf.modelling.registry import Origin, admit, origins, withdraw

GROUP = "hygrokf.causes"
"""Entry points of this group name a `Cause`, or a module with causes at its top level."""
_adopted: dict[str, Cause] = {}


class LibraryFault(HygrokfError):
    """Causes that cannot be used; `faults` lists every reason, the message all of them."""

    def __init__(self, faults: Iterable[str]) -> None:
        self.faults = tuple(faults)
        count = f"{len(self.faults)} fault{'s' if len(self.faults) != 1 else ''}"
        listed = (f"  {number}. {fault}" for number, fault in enumerate(self.faults, 1))
        super().__init__("\n".join([f"library of causes: {count}", *listed]))


# -- registration --------------------------------------------------------------------------------------------
def adopt(causes: Iterable[Cause]) -> None:
    """Check causes that bring mechanisms or features, and register these in the package's tables.

    Causes that are registered already are left alone.  Raises LibraryFault that lists all faults.
    """
    causes = list(causes)
    new = [c for c in causes if (c.mechanisms or c.features) and _adopted.get(c.name) is not c]
    faults = _duplicates([("", c) for c in causes])
    faults += [fault for cause in new for fault in _registered(cause, cause, _origin_in_python(cause))]
    if faults:
        raise LibraryFault(faults)


def _registered(cause: Cause, guarded: Cause, origin: Origin) -> list[str]:
    """Faults of a cause; a cause without faults is registered, with the functions of `guarded`."""
    faults = declared_faults(cause)
    if not faults:
        names = {*cause.mechanisms, *cause.features}
        for name in [n for n, old in _adopted.items() if names & {*old.mechanisms, *old.features}]:
            del _adopted[name]  # these functions replace its own
        admit(cause.mechanisms, cause.features, origin)
        faults = form_faults(cause)
        if faults:
            withdraw(names)
        else:
            admit(guarded.mechanisms, guarded.features, origin)
            _adopted[cause.name] = guarded
    return [f"cause {cause.name!r}: {fault}" for fault in faults]


def origins_of(cause: Cause) -> dict[str, dict[str, str]]:
    """Origin of every mechanism and feature that an adopted cause brings."""
    return origins((*cause.mechanisms, *cause.features))


def _origin_in_python(cause: Cause) -> dict[str, str]:
    """Origin of a cause that was made in Python: the file of its first function, else the module."""
    functions = [*_mapping(cause.mechanisms).values()]
    functions += [pair[0] for pair in _mapping(cause.features).values() if is_feature(pair)]
    try:
        file = Path(inspect.getsourcefile(inspect.unwrap(functions[0])) or "")
        return {"file": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
    except (IndexError, TypeError, OSError):
        return {"python": str(getattr(functions[0] if functions else None, "__module__", "?"))}


def _mapping(value: object) -> Settings:
    """The value where it is a mapping, else an empty mapping; `declared_faults` reports other values."""
    return value if isinstance(value, Mapping) else {}


def _duplicates(pairs: Sequence[tuple[str, Cause]]) -> list[str]:
    """Names of causes that two causes share, and of mechanisms and features that are not the same
    function."""
    faults: list[str] = []
    seen: dict[tuple[bool, str], Any] = {}
    for source, cause in pairs:
        brought = [("cause", cause.name, cause)]
        brought += [("mechanism", name, one) for name, one in _mapping(cause.mechanisms).items()]
        brought += [("feature", name, one) for name, one in _mapping(cause.features).items()]
        for kind, name, one in brought:
            before, where = seen.setdefault((kind == "cause", name), (one, source))
            if before is not one:
                places = " and ".join(dict.fromkeys(p for p in (where, source) if p))
                faults.append(
                    f"{places + ': ' if places else ''}two have the {kind} name {name!r}; rename one"
                )
    return faults


# -- from files and packages ---------------------------------------------------------------------------------
def load_library(*files: str | Path, installed: bool = False) -> tuple[Cause, ...]:
    """Read a user's causes from Python files.

    files: each defines one `Cause` or several at its top level (`cause_of` makes them).
    installed: also from installed packages, by their entry points.

    Returns the causes, in the order of the files, for the `library` of `discover`.  Their mechanisms are
    registered, so that `read_fit` reads models with them.
    Raises LibraryFault that lists all faults of all files.
    """
    faults: list[str] = []
    found: list[tuple[str, Cause, Cause, Origin]] = []
    paths = list(dict.fromkeys(Path(file).resolve() for file in files))
    for path in paths:
        try:
            causes, origin = _causes_in(path)
            found += [(path.name, cause, _guarded(cause, path), origin) for cause in causes]
        except LibraryFault as fault:
            faults += [f"{path.name}: {one}" for one in fault.faults]
    for entry in entry_points(group=GROUP) if installed else ():
        label, origin = _origin_of(entry)
        try:
            found += [(label, cause, _guarded(cause), origin) for cause in _causes_of(entry)]
        except LibraryFault as fault:
            faults += [f"{label}: {one}" for one in fault.faults]
    faults += _duplicates([(source, cause) for source, cause, *_ in found])
    for source, cause, guarded, origin in found:
        faults += [f"{source}: {fault}" for fault in _registered(cause, guarded, origin)]
    if faults:
        raise LibraryFault(faults)
    return tuple(guarded for _, _, guarded, _ in found)


def _causes_in(path: Path) -> tuple[list[Cause], Origin]:
    """Causes at the top level of a Python file, and its origin."""
    try:
        content = path.read_bytes()
    except OSError as fault:
        raise LibraryFault([f"expected a Python file, cannot read it: {fault.strerror}"]) from None
    sha256 = hashlib.sha256(content).hexdigest()
    module = ModuleType(f"hygrokf_library_{path.stem}_{sha256[:8]}")
    module.__file__ = str(path)
    try:
        code = compile(content, str(path), "exec")
    except (SyntaxError, ValueError) as fault:
        line, reason = getattr(fault, "lineno", None), getattr(fault, "msg", None) or fault
        where = f" in line {line}" if line else ""
        raise LibraryFault([f"expected a Python file, found {reason}{where}"]) from None
    sys.modules[module.__name__] = module  # dataclasses look their module up
    try:
        with redirect_stdout(sys.stderr):  # its prints must not mix with --json
            exec(code, module.__dict__)
    except KeyboardInterrupt:
        raise
    except BaseException as fault:  # also SystemExit
        advice = "; a library is one file: install what it imports" if isinstance(fault, ImportError) else ""
        raise LibraryFault([f"cannot be run: {exception_text(fault, str(path))}{advice}"]) from fault
    return _causes_at_top(module), {"file": path.name, "sha256": sha256}


def _causes_at_top(module: object) -> list[Cause]:
    found = {id(one): one for one in vars(module).values() if isinstance(one, Cause)}
    own = [one for one in found.values() if all(one is not known for known in LIBRARY)]
    if not own:
        text = "expected a hygrokf.Cause at the top level, found none: NAME = hygrokf.cause_of(…), "
        raise LibraryFault([text + "docs/how_to/own_cause.md"])
    return own


def _causes_of(entry: EntryPoint) -> list[Cause]:
    try:
        with redirect_stdout(sys.stderr):
            loaded = entry.load()
    except KeyboardInterrupt:
        raise
    except BaseException as fault:
        raise LibraryFault([f"cannot be loaded: {exception_text(fault)}; fix or uninstall it"]) from fault
    if isinstance(loaded, Cause):
        return [loaded]
    if isinstance(loaded, ModuleType):
        return _causes_at_top(loaded)
    raise LibraryFault([f"expected a Cause or a module with causes, found {loaded!r}"])


def _origin_of(entry: EntryPoint) -> tuple[str, Origin]:
    name, version = (entry.dist.name, entry.dist.version) if entry.dist else (entry.value, "?")
    return f"package {name} (entry point {entry.name})", {"package": name, "version": version}


def _guarded(cause: Cause, file: Path | None = None) -> Cause:
    """The cause with functions whose exceptions are reported as faults of its file, not of the package."""
    place = file.name if file else "a package"

    def guard(function: Callable[..., Any], what: str) -> Callable[..., Any]:
        @wraps(function)
        def called(*arguments: object, **settings: object) -> object:
            try:
                return function(*arguments, **settings)
            except Exception as fault:
                text = exception_text(fault, str(file) if file else None)
                raise LibraryFault([f"{place}: cause {cause.name!r}: {what} fails: {text}"]) from fault

        return called

    return replace(
        cause,
        forms=guard(cause.forms, "forms"),
        features={
            name: (guard(pair[0], f"feature {name!r}"), pair[1]) if is_feature(pair) else pair
            for name, pair in _mapping(cause.features).items()
        },
    )
