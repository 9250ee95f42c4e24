"""Checks of a user's cause: its sentences and names, its variants, and that it is nested in the base models.

Everything is tried on a small record with every signal of the table (30 days, hourly, made of sines).  At the
null value of a mechanism the free run of the extended model must be that of the base; away from it the free
run must change.
"""

from __future__ import annotations

import functools
import math
import re
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import SIGNALS
from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.cause import Cause, Variant
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.library import LIBRARY
from hygrokf.discovery.submodel import HYGRIC, THERMAL, Submodel
from hygrokf.engine.timeline import Timeline
from hygrokf.errors import suggestion
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.modelling.derived_inputs import FEATURES, feature_faults
from hygrokf.modelling.design import CASCADE, HOLDS, design, extended
from hygrokf.modelling.inputs import prepare_run
from hygrokf.modelling.registry import name_faults
from hygrokf.physics.holds import hold_named
from hygrokf.physics.mechanisms import FURTHER, LOGGED
from hygrokf.physics.mechanisms import LIBRARY as MECHANISMS
from hygrokf.physics.model import SUMS, Mechanism

SAME = 1e-5
"""[1] largest difference of two free runs that count as equal, as a share of the spread of the base's;
sub-steps may differ."""
DAYS = 30
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
    """A record with every signal: sines of many periods in ordinary ranges.

    The door is open too seldom to be an input of the base model; otherwise no opening would be left to find.
    """
    hour = np.arange(24 * DAYS + 1.0)
    series = []
    for place, signal in enumerate(SIGNALS.values()):
        low, high = _RANGES.get(signal.name, _RANGES[signal.unit])
        wave = 0.35 * np.sin(2.0 * np.pi * hour / 24.0 + place)
        value = low + (high - low) * (0.5 + wave + 0.15 * np.sin(2.0 * np.pi * hour / (31.0 + 3.0 * place)))
        if signal.name == "preheating":
            value = (value > 0.9).astype(float)
        if signal.name == "door_open":
            value = (np.arange(len(value)) % 200 == 100).astype(float)
        if signal.name == "active_power":
            value = np.maximum(value, 0.0)
        series.append(Series(signal.name, 1.6e9 + 3600.0 * hour, value, source="trial record"))
    return Record("trial record", tuple(series), Site(55.0, 8.0, 0.0), rated_power_W=2e6)


@lru_cache(maxsize=1)
def trial_baseline() -> Baseline:
    """Both submodels of the base model on the trial record, at their start values: nothing is estimated."""
    record = trial_record()
    submodels = {}
    for name, kind in ((THERMAL, THERMAL), (HYGRIC, CASCADE)):
        base = design(record, kind=kind)
        run = prepare_run(base, record)
        values = {p.name: p.start for p in base.model.parameters}
        objective = Likelihood(base.model, run.timeline).value(values)
        submodels[name] = Submodel(name, record, base, run, values, objective, True)
    return Baseline(record, submodels)


# -- faults, before anything is registered ------------------------------------------------------------------
def form_faults(cause: Cause) -> list[str]:
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
    if cause.name in {own.name for own in LIBRARY}:
        faults.append("the package has a cause of that name; choose another name")
    if not callable(cause.variants):
        faults.append(f"variants: expected a function of a baseline, found {cause.variants!r}")
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
        if name in HOLDS and name not in {*FEATURES, *SIGNALS}:
            faults.append(
                f"feature {name!r}: the base models have an input of that name; choose another name"
            )
    for name, factory in cause.mechanisms.items():
        faults += _factory_faults(name, factory, cause.features)
    return faults


def is_feature(pair: object) -> bool:
    """Whether it is (function, hold)."""
    return isinstance(pair, tuple) and len(pair) == 2 and callable(pair[0])


def _factory_faults(
    name: str, factory: Callable[..., Mechanism], features: Mapping[str, object]
) -> Iterator[str]:
    try:
        made = factory()
    except Exception as fault:
        yield f"mechanism {name!r}: its factory, called without arguments, fails: {exception_text(fault)}"
        return
    if not isinstance(made, Mechanism) or made.name != name:
        found = f"one named {made.name!r}" if isinstance(made, Mechanism) else repr(made)
        yield f"mechanism {name!r}: expected its factory to return a Mechanism of that name, found {found}"
        return
    absent = [one for one in made.features if one not in features]
    if absent:
        yield (
            f"mechanism {name!r}: expected its features {', '.join(absent)} in features= of the Cause too, "
            "found none there; state them, or make the cause with cause_of"
        )
    known = {*HOLDS, *features, *made.features}
    for one in made.inputs:
        if one not in known:
            yield (
                f"mechanism {name!r}: unknown input {one!r}: no signal and no feature{suggestion(one, known)}"
            )
    brought = _package_names()
    taken = sorted({*(p.name for p in made.parameters), *made.states} & brought)
    if taken:
        yield (
            f"mechanism {name!r}: the package has parameters or states named {', '.join(taken)}; rename them"
        )
    if not made.null:
        yield (
            f"mechanism {name!r}: expected a parameter with a null value at which it has no effect, found "
            "none; give one of its parameters null=0.0"
        )
    for p in made.parameters:
        if p.null is not None and not (p.lower <= p.null <= p.upper or (p.positive and p.null == 0.0)):
            yield f"mechanism {name!r}: the null value {p.null:g} of {p.name} is outside of its bounds"
        if not p.meaning or not p.unit:
            yield f"mechanism {name!r}: the parameter {p.name} needs a unit and a meaning"


@lru_cache(maxsize=1)
def _package_names() -> frozenset[str]:
    """Parameters and states of the base models and of the package's further mechanisms."""
    submodels = trial_baseline().submodels.values()
    models = [m for submodel in submodels for m in submodel.base.model.mechanisms]
    models += [factory() for factory in (*LOGGED, *FURTHER)]
    return frozenset(name for m in models for name in (*(p.name for p in m.parameters), *m.states))


# -- faults of its variants, with its mechanisms registered -------------------------------------------------
def variant_faults(cause: Cause) -> list[str]:
    """Faults of a cause's variants on the trial baseline: names, start values, equations, nesting."""
    baseline = trial_baseline()
    try:
        variants = list(cause.variants(baseline))
    except Exception as fault:
        return [f"variants fails on a record with every signal: {exception_text(fault)}"]
    if not variants:
        return [
            "variants gives none on a record with every signal (30 days, hourly); expected at least one there"
        ]
    faults = []
    for variant in variants:
        if not isinstance(variant, Variant) or variant.cause != cause.name:
            faults.append(f"variants: expected Variant objects of the cause {cause.name}, found {variant!r}")
        else:
            faults += [f"variant {variant.form!r}: {fault}" for fault in _faults_of(variant, baseline)]
    return list(dict.fromkeys(faults))


def _faults_of(variant: Variant, baseline: Baseline) -> list[str]:
    faults = [f"feature {fault}" for fault in feature_faults(variant.features)]
    for submodel, pairs in variant.additions.items():
        if submodel not in baseline.submodels:
            faults.append(f"submodel {submodel!r}: expected {THERMAL} or {HYGRIC}")
        faults += [
            f"unknown mechanism {name!r}: name one of the package, or add it to the cause's mechanisms"
            for name, _ in pairs
            if name not in MECHANISMS
        ]
    if faults or not variant.additions:
        return faults
    names: set[str] = set()
    for submodel, pairs in variant.additions.items():
        try:
            names |= _nested(baseline.submodels[submodel], pairs, variant.features)
        except _Unnested as fault:
            faults.append(f"{submodel} submodel: {fault}")
        except Exception as fault:
            faults.append(f"{submodel} submodel: {exception_text(fault)}")
    if not faults:
        known = names | {name for submodel in baseline.submodels.values() for name in submodel.values}
        unknown = sorted({name for start in variant.starts for name in start} - known)
        if unknown:
            faults.append(
                f"starts name unknown parameters {', '.join(unknown)}; it has {', '.join(sorted(names))}"
            )
    return faults


class _Unnested(Exception):
    """A mechanism that is not nested in the base."""


def _nested(
    submodel: Submodel, pairs: tuple[tuple[str, Settings], ...], features: Mapping[str, Settings]
) -> set[str]:
    """Names of the parameters that mechanisms add to a submodel; raises where they are not nested in it."""
    wider = extended(submodel.base, pairs, features=features)
    added = [m for m in wider.model.mechanisms if m.name in {name for name, _ in pairs}]
    own = {p.name: p for m in added for p in m.parameters}
    null = {name: value for m in added for name, value in m.null.items()}
    base = Likelihood(submodel.base.model, submodel.run.timeline)
    made = prepare_run(wider, submodel.record).timeline
    longer = Likelihood(wider.model, made)
    before = base.trace(submodel.values, gain=False).prediction
    scale = np.nanstd(before, axis=0)

    def departure(values: Mapping[str, float], likelihood: Likelihood = longer) -> float:
        """Largest difference of the free runs, as a share of the base's spread."""
        after = likelihood.trace({**submodel.values, **values}, gain=False).prediction
        return float(np.max(np.abs(after - before) / scale))

    start = {name: p.start for name, p in own.items()}
    other = {name: _away(p.start, p.lower, p.upper, p.positive) for name, p in own.items()}
    for given in (start, other):
        found = departure({**given, **null})
        if not found <= SAME:
            at = ", ".join(f"{name} = {value:g}" for name, value in null.items())
            raise _Unnested(
                f"expected the base model at the null value ({at}), found a free run that differs by "
                f"{100.0 * found:.3g} % of its spread; every effect must vanish there"
            )
    acting = {name: value for name, value in other.items() if name in null}
    moved = Likelihood(wider.model, _with_waves(made, features))
    if departure({**start, **acting}, moved) <= 1e-3 * SAME:
        raise _Unnested(
            "it changes nothing in the free run, whatever its parameters; contribute to one of "
            + ", ".join(SUMS)
        )
    value, score = longer.score({**submodel.values, **start, **acting})
    if not (math.isfinite(value) and np.all(np.isfinite(score))):
        raise _Unnested(
            "its likelihood is not finite near the start values; check divisions, logarithms and bounds"
        )
    return set(own)


def _with_waves(made: Timeline, features: Mapping[str, Settings]) -> Timeline:
    """The run with waves for features that are constant in it: a threshold that this record never reaches, a
    late date."""
    u = made.u.copy()
    for column, name in enumerate(made.varying):
        if name in features and np.ptp(u[:, column]) == 0.0:
            u[:, column] = 0.5 + 0.4 * np.sin(np.arange(len(u)) / 7.0)
    return replace(made, u=u)


def _away(start: float, lower: float, upper: float, positive: bool) -> float:
    """A value some way from the start, within the bounds."""
    if positive:
        return start * 1.5 if start * 1.5 <= upper else start / 1.5
    step = 0.1 * (min(upper, start + 50.0) - max(lower, start - 50.0))
    return start + step if start + step <= upper else start - step


_PACKAGE = str(Path(__file__).parents[1])
_FUNCTOOLS = functools.__file__
"""Its frames stand between the package and a user's code where the package caches a property."""


def exception_text(fault: BaseException, file: str | None = None) -> str:
    """An exception in a user's code as a phrase: its kind, its text, and the last line of that code."""
    frames = traceback.extract_tb(fault.__traceback__)
    if file:
        inside = [f for f in frames if f.filename == file]
    else:
        inside = [f for f in frames if not f.filename.startswith((_PACKAGE, _FUNCTOOLS))]
    where = f" (line {inside[-1].lineno} of {Path(inside[-1].filename).name})" if inside else ""
    return f"{type(fault).__name__}: {fault}{where}"
