"""A user's own causes: loaded from a file or an installed package into a library, and tried.

A file is executed: load only files that you trust.  The checks cover sentences, names and forms, and whether
a cause is nested in the base models.  They use a small record with every signal (30 days, hourly, made of
sines).  At the null value of a mechanism the extended model must give the simulation of the base; at other
values the simulation must change.
"""

from __future__ import annotations

import functools
import hashlib
import math
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import SIGNALS
from hygrokf.discovery.estimate import Calibration
from hygrokf.discovery.scene import Scene, scene_of
from hygrokf.discovery.screening import added, start_values, widened
from hygrokf.discovery.simulator import Simulator
from hygrokf.discovery.starting_model import base_designs
from hygrokf.errors import suggestion
from hygrokf.modelling.causes.cause import Cause
from hygrokf.modelling.causes.forms import Form, Ground, ground_of
from hygrokf.modelling.derived_inputs import FEATURES, feature_faults
from hygrokf.modelling.design import INPUT_HOLDS
from hygrokf.modelling.library import (
    CAUSES,
    LIBRARY,
    Library,
    LibraryFault,
    Origin,
    duplicates,
    is_feature,
    mapping,
    name_faults,
)
from hygrokf.physics.holds import hold_named
from hygrokf.physics.mechanisms import FURTHER, LOGGED
from hygrokf.physics.model import SUMS, Mechanism

ENTRY_POINTS = "hygrokf.causes"
"""Entry points of this group name a `Cause`, or a module with causes at its top level."""
SAME_SIMULATION = 1e-5
"""[1] largest difference of two equal simulations, as a share of the standard deviation of the base's."""
TRIAL_DAYS = 30
IDENTIFIER = re.compile(r"[a-z][a-z0-9_]*")
_RANGES: Mapping[str, tuple[float, float]] = {
    "K": (278.0, 293.0), "1": (0.0, 1.0), "Pa": (9.8e4, 1.02e5), "W": (0.0, 2e4), "kg/m3": (5e-3, 9e-3),
    "m/s": (0.0, 15.0), "W/m2": (0.0, 800.0), "rad": (0.0, 6.0), "rad/s": (0.0, 1.5),
    "cabinet_temperature": (290.0, 303.0), "cabinet_relative_humidity": (0.25, 0.6),
    "ambient_relative_humidity": (0.5, 0.95), "active_power": (-1e6, 2e6), "rain": (0.0, 4.0),
}  # fmt: skip
"""Range of a signal of the trial record, by its name or its unit [SI unit]."""


# -- a record to try causes on ------------------------------------------------------------------------------
def trial_record() -> Record:
    """A record with every signal, of two clocks: sines of many periods in ordinary ranges."""
    hour = np.arange(24 * TRIAL_DAYS + 1.0)
    series = []
    for place, signal in enumerate(SIGNALS.values()):
        low, high = _RANGES.get(signal.name, _RANGES[signal.unit])
        wave = 0.35 * np.sin(2.0 * np.pi * hour / 24.0 + place)
        value = low + (high - low) * (0.5 + wave + 0.15 * np.sin(2.0 * np.pi * hour / (31.0 + 3.0 * place)))
        if signal.name in ("preheating", "door_open"):
            value = (value > 0.9).astype(float)
        if signal.name == "active_power":
            value = np.maximum(value, 0.0)
        source = "cabinet" if signal.name.startswith("cabinet_") else "plant"
        series.append(Series(signal.name, 1.6e9 + 3600.0 * hour, value, source=source))
    return Record("trial record", tuple(series), Site(55.0, 8.0, 0.0), rated_power_W=2e6)


@lru_cache(maxsize=2)
def trial_estimate(library: Library = LIBRARY) -> Calibration:
    """The base model on the trial record at its start values, without estimation."""
    record = trial_record()
    heat, vapour = base_designs(record, library)
    simulator = Simulator(scene_of(record, heat, vapour), heat, vapour)
    theta = simulator.vector({p.name: p.start for p in simulator.parameters})
    simulated = {q: simulator.simulated(theta[:, None], q)[:, 0] for q in simulator.scene.readings}
    return Calibration(simulator, {}, theta, {}, simulated)


def trial_ground() -> Ground:
    """The ground (record and base designs) for which causes give their forms on the trial record."""
    simulator = trial_estimate().simulator
    return ground_of(simulator.scene.record, simulator.heat, simulator.vapour)


# -- faults of what it states --------------------------------------------------------------------------------
def declared_faults(cause: Cause) -> list[str]:
    """Faults of a cause's sentences, names, factories and features."""
    faults = [
        f"{word}: expected a sentence, found {getattr(cause, word)!r}"
        for word in ("meaning", "remedy", "separate_by")
        if not isinstance(getattr(cause, word), str) or not getattr(cause, word).strip()
    ]
    if not isinstance(cause.name, str) or not IDENTIFIER.fullmatch(cause.name):
        faults.append(
            f"name: expected an identifier in small letters such as damp_wall, found {cause.name!r}"
        )
    if cause.name in {known.name for known in CAUSES}:
        faults.append("the package has a cause of that name; choose another name")
    odd = [word for word in ("mechanisms", "features") if not isinstance(getattr(cause, word), Mapping)]
    if odd:
        return faults + [
            f"{word}: expected a mapping of names, found {getattr(cause, word)!r}" for word in odd
        ]
    faults += name_faults(cause.mechanisms, cause.features)
    for name, pair in cause.features.items():
        if not is_feature(pair):
            faults.append(f"feature {name!r}: expected (function(record, time), hold), found {pair!r}")
        else:
            try:
                hold_named(pair[1])
            except ValueError as fault:
                faults.append(f"feature {name!r}: {fault}")
        if name in INPUT_HOLDS and name not in {*FEATURES, *SIGNALS}:
            faults.append(
                f"feature {name!r}: the base models have an input of that name; choose another name"
            )
    for name, factory in cause.mechanisms.items():
        faults += _factory_faults(name, factory, cause.features)
    return faults


def _factory_faults(
    name: str, factory: Callable[..., Mechanism], features: Mapping[str, object]
) -> Iterator[str]:
    try:
        mechanism = factory()
    except Exception as fault:
        yield f"mechanism {name!r}: its factory, called without arguments, fails: {exception_text(fault)}"
        return
    if not isinstance(mechanism, Mechanism) or mechanism.name != name:
        found = f"one named {mechanism.name!r}" if isinstance(mechanism, Mechanism) else repr(mechanism)
        yield f"mechanism {name!r}: expected its factory to return a Mechanism of that name, found {found}"
        return
    absent = [feature for feature in mechanism.features if feature not in features]
    if absent:
        yield (
            f"mechanism {name!r}: expected its features {', '.join(absent)} in features= of the Cause too, "
            "found none there; state them, or make the cause with cause_of"
        )
    known_names = {*INPUT_HOLDS, *features, *mechanism.features}
    for signal in mechanism.inputs:
        if signal not in known_names:
            yield (
                f"mechanism {name!r}: unknown input {signal!r}: no signal and no feature"
                f"{suggestion(signal, known_names)}"
            )
    package_names = _package_names()
    taken = sorted({*(p.name for p in mechanism.parameters), *mechanism.states} & package_names)
    if taken:
        yield (
            f"mechanism {name!r}: the package has parameters or states named {', '.join(taken)}; rename them"
        )
    if not mechanism.null:
        yield (
            f"mechanism {name!r}: expected a parameter with a null value at which it has no effect, found "
            "none; give one of its parameters null=0.0"
        )
    for p in mechanism.parameters:
        if p.null is not None and not (p.lower <= p.null <= p.upper or (p.positive and p.null == 0.0)):
            yield f"mechanism {name!r}: the null value {p.null:g} of {p.name} is outside of its bounds"
        if not p.meaning or not p.unit:
            yield f"mechanism {name!r}: the parameter {p.name} needs a unit and a meaning"


@lru_cache(maxsize=1)
def _package_names() -> frozenset[str]:
    """Parameters and states of the base models and of the package's further mechanisms."""
    models = [m for design in trial_estimate().simulator.designs for m in design.model.mechanisms]
    factories = [factory for cause in CAUSES for factory in cause.mechanisms.values()]
    models += [factory() for factory in (*LOGGED, *FURTHER, *factories)]
    return frozenset(name for m in models for name in (*(p.name for p in m.parameters), *m.states))


# -- faults of its forms -------------------------------------------------------------------------------------
def form_faults(cause: Cause, library: Library) -> list[str]:
    """Faults of a cause's forms on the trial record: names, values, equations, nesting.

    library: with the mechanisms and features of the cause.
    """
    try:
        forms = list(cause.forms(trial_ground()))
    except Exception as fault:
        return [f"forms fails on a record with every signal: {exception_text(fault)}"]
    if not forms:
        return [
            "forms gives none on a record with every signal (30 days, hourly); expected at least one there"
        ]
    faults = []
    for form in forms:
        if not isinstance(form, Form) or form.cause != cause.name:
            faults.append(f"forms: expected Form objects of the cause {cause.name}, found {form!r}")
        else:
            faults += [f"form {form.code or 'as given'!r}: {fault}" for fault in _faults_of(form, library)]
    return list(dict.fromkeys(faults))


def _faults_of(form: Form, library: Library) -> list[str]:
    trial = trial_estimate(library)
    faults = [f"feature {fault}" for s in form.grid for fault in feature_faults(s.features, library.features)]
    faults += [
        f"unknown mechanism {name!r}: name one of the package, or add it to the cause's mechanisms"
        for name, _ in (*form.heat, *form.vapour)
        if name not in library.mechanisms
    ]
    if not form.grid:
        faults.append("expected a grid of at least one Setting, found none")
    faults += [
        f"steps: expected a setting of a feature in every point of the grid, found {key!r} of {name!r}"
        for name, key in form.steps
        if not form.clock and any(key not in s.features.get(name, {}) for s in form.grid)
    ]
    if faults or not (form.heat or form.vapour):
        return faults
    try:
        wider = widened(trial, form, form.grid[0])
        own_parameters = {p.name: p for p in added(trial, wider)}
        unknown = sorted({*form.limits, *(name for s in form.grid for name in s.values)} - set(wider.names))
        if unknown:
            faults.append(
                f"values of unknown parameters {', '.join(unknown)}; "
                f"it has {', '.join(sorted(own_parameters))}"
            )
        faults += _nesting_faults(trial, wider, form, start_values(trial, wider, form.grid[0]))
    except Exception as fault:
        faults.append(exception_text(fault))
    return faults


def _nesting_faults(
    trial: Calibration, wider: Simulator, form: Form, start: Mapping[str, float]
) -> Iterator[str]:
    """Faults of a form that is not nested in the base, or does not change the simulation of the base."""
    own_parameters = added(trial, wider)
    null = {p.name: p.null for p in own_parameters if p.null is not None}
    changed = {p.name: _away(p.start, p.lower, p.upper, p.positive) for p in own_parameters}
    for values in ({**start, **null}, {**start, **changed, **null}):
        deviation = max(_deviations(trial, wider, values).values())
        if not deviation <= SAME_SIMULATION:
            null_values = ", ".join(f"{name} = {value:g}" for name, value in null.items())
            differs = f"differs by {100.0 * deviation:.3g} % of its spread"
            yield (
                f"expected the base model at the null value ({null_values}), found a simulation that "
                f"{differs if deviation < math.inf else 'is not finite'}; every effect must vanish there"
            )
            return
    with_effect = {**start, **{name: changed[name] for name in null}}
    waved = replace(wider, scene=_with_waves(wider), _cells={})
    without_effect = replace(trial, simulated=_simulated(waved, {**start, **null}))
    changes = _deviations(without_effect, waved, with_effect)
    for quantity, mechanisms in (("temperature", form.heat), ("vapour", form.vapour)):
        if mechanisms and not changes[quantity] < math.inf:
            yield (
                f"the simulated {quantity} is not finite near the start values; check divisions, logarithms "
                "and bounds"
            )
        elif mechanisms and changes[quantity] <= 1e-3 * SAME_SIMULATION:
            yield (
                f"it changes nothing in the simulated {quantity}, whatever its parameters; contribute to one "
                f"of {', '.join(SUMS)}"
            )


def _simulated(simulator: Simulator, values: Mapping[str, float]) -> dict[str, np.ndarray]:
    theta = simulator.vector(values)[:, None]
    return {q: simulator.simulated(theta, q)[:, 0] for q in simulator.scene.readings}


def _deviations(trial: Calibration, wider: Simulator, values: Mapping[str, float]) -> dict[str, float]:
    """Largest difference of each quantity's simulation from that of the base, as a share of the standard
    deviation of the base's simulation; infinite if a simulation is not finite."""
    simulated, shares = _simulated(wider, values), {}
    for q, base in trial.simulated.items():
        share = float(np.max(np.abs(simulated[q] - base)) / np.std(base))
        shares[q] = share if math.isfinite(share) else math.inf
    return shares


def _with_waves(simulator: Simulator) -> Scene:
    """The scene with waves in place of features that are constant in it, such as a threshold that the trial
    record never reaches."""
    scene, waves = simulator.scene, []
    for design in simulator.designs:
        for name in design.features:
            value = scene.at_edges(name, design)
            if np.ptp(value) == 0.0:
                waves.append((name, design, 0.5 + 0.4 * np.sin(np.arange(len(value)) / 56.0)))
    return scene.with_inputs(waves)


def _away(start: float, lower: float, upper: float, positive: bool) -> float:
    """A value some way from the start, within the bounds."""
    if positive:
        return start * 1.5 if start * 1.5 <= upper else start / 1.5
    step = 0.1 * (min(upper, start + 50.0) - max(lower, start - 50.0))
    return start + step if start + step <= upper else start - step


_PACKAGE = str(Path(__file__).parents[1])
_FUNCTOOLS = functools.__file__
"""File of the frames between the package and a user's code where the package caches a property."""


def exception_text(fault: BaseException, file: str | None = None) -> str:
    """An exception in a user's code as a phrase: its type, its text, and the last line of the code that it
    passed."""
    if isinstance(fault, LibraryFault) and fault.__cause__:  # of a guarded function
        fault = fault.__cause__
    frames = traceback.extract_tb(fault.__traceback__)
    if file:
        inside = [f for f in frames if f.filename == file]
    else:
        inside = [f for f in frames if not f.filename.startswith((_PACKAGE, _FUNCTOOLS))]
    where = f" (line {inside[-1].lineno} of {Path(inside[-1].filename).name})" if inside else ""
    return f"{type(fault).__name__}: {fault}{where}"


# -- a library -----------------------------------------------------------------------------------------------
def expect_usable(library: Library) -> None:
    """Check the user's causes of a library that bring mechanisms or features.

    Raises LibraryFault that lists all faults.
    """
    new = [cause for cause in library.own if cause.mechanisms or cause.features]
    faults = [f"cause {cause.name!r}: {fault}" for cause in new for fault in declared_faults(cause)]
    faults = faults or [
        f"cause {cause.name!r}: {fault}" for cause in new for fault in form_faults(cause, library)
    ]
    if faults:
        raise LibraryFault(faults)


# -- from files and packages ---------------------------------------------------------------------------------
def load_library(*files: str | Path, installed: bool = False, library: Library = LIBRARY) -> Library:
    """Read a user's causes from Python files.

    files: each defines one `Cause` or several at its top level (`cause_of` makes them).
    installed: also from installed packages, by their entry points.
    library: to which they are added; by default the package's own.

    Returns the library with these causes last, in the order of the files, for `discover`, and for `read_fit`
    of a model with their mechanisms.  Raises LibraryFault that lists all faults of all files.
    """
    faults: list[str] = []
    loaded: list[tuple[str, Cause, Origin]] = []
    paths = list(dict.fromkeys(Path(file).resolve() for file in files))
    for path in paths:
        try:
            causes, origin = _causes_in(path)
            loaded += [(path.name, _guarded(cause, path), origin) for cause in causes]
        except LibraryFault as fault:
            faults += [f"{path.name}: {text}" for text in fault.faults]
    for entry in entry_points(group=ENTRY_POINTS) if installed else ():
        label, origin = _origin_of(entry)
        try:
            loaded += [(label, _guarded(cause), origin) for cause in _causes_of(entry)]
        except LibraryFault as fault:
            faults += [f"{label}: {text}" for text in fault.faults]
    faults += duplicates([(source, cause) for source, cause, _ in loaded])
    declared = [declared_faults(cause) for _, cause, _ in loaded]
    for (_, cause, origin), wrong in zip(loaded, declared, strict=True):
        library = library if wrong else library.joined(cause, origin)
    for (source, cause, _), wrong in zip(loaded, declared, strict=True):
        wrong = wrong or form_faults(cause, library)
        faults += [f"{source}: cause {cause.name!r}: {fault}" for fault in wrong]
    if faults:
        raise LibraryFault(faults)
    return library


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
    except (Exception, SystemExit) as fault:
        advice = "; a library is one file: install what it imports" if isinstance(fault, ImportError) else ""
        raise LibraryFault([f"cannot be run: {exception_text(fault, str(path))}{advice}"]) from fault
    return _causes_at_top(module), {"file": path.name, "sha256": sha256}


def _causes_at_top(module: object) -> list[Cause]:
    causes = {id(value): value for value in vars(module).values() if isinstance(value, Cause)}
    own = [cause for cause in causes.values() if all(cause is not known for known in CAUSES)]
    if not own:
        text = "expected a hygrokf.Cause at the top level, found none: NAME = hygrokf.cause_of(…), "
        raise LibraryFault([text + "docs/how_to/own_cause.md"])
    return own


def _causes_of(entry: EntryPoint) -> list[Cause]:
    try:
        with redirect_stdout(sys.stderr):
            loaded = entry.load()
    except (Exception, SystemExit) as fault:
        raise LibraryFault([f"cannot be loaded: {exception_text(fault)}; fix or uninstall it"]) from fault
    if isinstance(loaded, Cause):
        return [loaded]
    if isinstance(loaded, ModuleType):
        return _causes_at_top(loaded)
    raise LibraryFault([f"expected a Cause or a module with causes, found {loaded!r}"])


def _origin_of(entry: EntryPoint) -> tuple[str, Origin]:
    name, version = (entry.dist.name, entry.dist.version) if entry.dist else (entry.value, "?")
    return f"package {name} (entry point {entry.name})", {"package": name, "version": version}


@dataclass(frozen=True)
class _Guarded:
    """A user's function whose exceptions are faults of its file, not of the package."""

    __wrapped__: Callable[..., Any]
    what: str
    file: Path | None

    def __call__(self, *arguments: object, **settings: object) -> Any:
        try:
            return self.__wrapped__(*arguments, **settings)
        except Exception as fault:
            text = exception_text(fault, str(self.file) if self.file else None)
            place = self.file.name if self.file else "a package"
            raise LibraryFault([f"{place}: {self.what} fails: {text}"]) from fault


def _guarded(cause: Cause, file: Path | None = None) -> Cause:
    """The cause with functions whose exceptions are reported as faults of its file, not of the package."""
    head = f"cause {cause.name!r}:"
    return replace(
        cause,
        forms=_Guarded(lambda ground: list(cause.forms(ground)), f"{head} forms", file),
        features={
            name: (_Guarded(pair[0], f"{head} feature {name!r}", file), pair[1]) if is_feature(pair) else pair
            for name, pair in mapping(cause.features).items()
        },
    )
