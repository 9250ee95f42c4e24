"""The library: the mechanisms and derived inputs (features) that models are made of, and the causes that
`discover` tries.

A `Library` is a value.  `LIBRARY` holds the package's own; `with_causes` and `with_mechanisms` give a new one
with those of a user, each with its origin: {"file": name, "sha256": hash}, {"package": name, "version":
version}, or {"python": module} for those defined in a session without a file.  A design stores its mechanisms
and features by name, so that reading it requires a library with the same ones.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hygrokf.data.signals import SIGNALS
from hygrokf.errors import HygrokfError
from hygrokf.modelling.causes import forms
from hygrokf.modelling.causes.cause import Cause
from hygrokf.modelling.derived_inputs import FEATURES
from hygrokf.physics.holds import hold_named
from hygrokf.physics.mechanisms import MECHANISMS, Factory
from hygrokf.physics.model import Feature

Origin = Mapping[str, str]


class LibraryFault(HygrokfError):
    """Causes that cannot be used; `faults` lists every reason, the message all of them."""

    def __init__(self, faults: Iterable[str]) -> None:
        self.faults = tuple(faults)
        count = f"{len(self.faults)} fault{'s' if len(self.faults) != 1 else ''}"
        listed = (f"  {number}. {fault}" for number, fault in enumerate(self.faults, 1))
        super().__init__("\n".join([f"library of causes: {count}", *listed]))


@dataclass(frozen=True, eq=False, repr=False)
class Library:
    """Mechanisms, features and causes; two libraries may use one name for different things.

    mechanisms: name → factory.  features: name → (function, hold).  causes: in the order in which `discover`
    tries them.  origins: of the mechanisms and features that a user brought, by name.
    """

    mechanisms: Mapping[str, Factory]
    features: Mapping[str, Feature]
    causes: tuple[Cause, ...] = ()
    origins: Mapping[str, Origin] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("mechanisms", "features", "origins"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __repr__(self) -> str:
        """Its causes, and what a user brought."""
        causes = ", ".join(one.name for one in self.causes) or "none"
        own = f"; of your own: {', '.join(self.origins)}" if self.origins else ""
        return f"Library of {len(self.mechanisms)} mechanisms and the causes {causes}{own}"

    def __reduce__(self) -> tuple[Any, ...]:
        """How to pickle a library: what a user brought to the package's own.  Causes stay behind, as no model
        reads them and their forms are closures."""
        own = [{n: one for n, one in kind.items() if n in self.origins}
               for kind in (self.mechanisms, self.features)]  # fmt: skip
        return _unpickled, (*own, dict(self.origins))

    @property
    def own(self) -> tuple[Cause, ...]:
        """The causes that are not the package's."""
        return tuple(one for one in self.causes if one not in CAUSES)

    def cause(self, name: str) -> Cause:
        """The cause of that name.  Raises KeyError with the names of all."""
        for cause in self.causes:
            if cause.name == name:
                return cause
        raise KeyError(f"no cause {name!r}; the library has {', '.join(c.name for c in self.causes)}")

    def only(self, *names: str) -> Library:
        """The library with these causes alone, in this order.  Raises KeyError for unknown ones."""
        return replace(self, causes=tuple(map(self.cause, names)))

    def with_causes(self, *causes: Cause, origin: Origin | None = None) -> Library:
        """The library with further causes, and the mechanisms and features that they bring.

        causes: of `cause_of`, or a `Cause`; those that it has already change nothing.
        origin: where they are from; by default the Python file or module of each.

        `discover` and `load_library` try them before any work.  Raises LibraryFault for names that are taken.
        """
        new = [one for one in causes if one not in self.causes]
        faults = duplicates([("", one) for one in (*self.causes, *new)])
        made = self
        for one in new:
            named = name_faults(mapping(one.mechanisms), mapping(one.features))
            try:
                made = made.joined(one, origin or origin_in_python(one))
            except ValueError as fault:  # an unknown hold
                named.append(str(fault))
            faults += [f"cause {one.name!r}: {fault}" for fault in named]
        if faults:
            raise LibraryFault(faults)
        return made

    def joined(self, cause: Cause, origin: Origin) -> Library:
        """The library with one further cause, whose names are not looked at."""
        return replace(
            self._holding(mapping(cause.mechanisms), mapping(cause.features), origin),
            causes=(*self.causes, cause),
        )

    def with_mechanisms(
        self, *factories: Factory, features: Mapping[str, Feature] | None = None
    ) -> Library:
        """The library with further mechanisms, and features by which they are driven.

        factories: of the mechanisms, each of the name of its mechanism.
        features: name → (function(record, time), hold).

        Raises ValueError for names of the package, and for unknown holds.
        """
        mechanisms = {one.__name__: one for one in factories}
        faults = name_faults(mechanisms, features or {})
        if faults:
            raise ValueError("; ".join(faults))
        return self._holding(mechanisms, features or {}, {"python": factories[0].__module__})

    def _holding(
        self, mechanisms: Mapping[str, Factory], features: Mapping[str, Any], origin: Origin
    ) -> Library:
        held = {n: (pair[0], hold_named(pair[1])) for n, pair in features.items() if is_feature(pair)}
        return replace(
            self,
            mechanisms={**self.mechanisms, **mechanisms},
            features={**self.features, **held},
            origins={**self.origins, **{name: dict(origin) for name in (*mechanisms, *held)}},
        )

    def absent(self, stored: Mapping[str, Origin]) -> list[str]:
        """Sentences about mechanisms and features of users that a stored design needs and that are missing or
        differ here.

        stored: their origins by name.
        """
        wanted: dict[str, list[str]] = {}
        for name, origin in stored.items():
            here = self.origins.get(name)
            if here is not None and ("python" in origin or dict(here) == dict(origin)):
                continue
            found = "found none of that name" if here is None else f"found that of {_origin_text(here)}"
            wanted.setdefault(f"of {_origin_text(origin)}, {found}; {_remedy(origin)}", []).append(name)
        return [f"the model needs {', '.join(names)} {text}" for text, names in wanted.items()]


def _unpickled(
    mechanisms: Mapping[str, Factory], features: Mapping[str, Feature], origins: Mapping[str, Origin]
) -> Library:
    if not origins:
        return LIBRARY
    own = {**LIBRARY.mechanisms, **mechanisms}, {**LIBRARY.features, **features}
    return Library(*own, origins=origins)


# -- names ---------------------------------------------------------------------------------------------------
def is_feature(pair: object) -> bool:
    """Whether it is (function, hold)."""
    return isinstance(pair, tuple) and len(pair) == 2 and callable(pair[0])


def mapping(value: object) -> forms.Settings:
    """The value where it is a mapping, else an empty mapping; the trial of a cause reports other values."""
    return value if isinstance(value, Mapping) else {}


def name_faults(mechanisms: Iterable[str], features: Iterable[str]) -> list[str]:
    """Faults of names that the package already uses, and of one name used for a mechanism and a feature."""
    mechanisms, features = list(mechanisms), list(features)
    taken = {*LIBRARY.mechanisms, *LIBRARY.features, *SIGNALS}
    faults = [
        f"{kind} {name!r}: the package has a mechanism, feature or signal of that name; choose another name"
        for kind, names in (("mechanism", mechanisms), ("feature", features))
        for name in names
        if name in taken
    ]
    both = sorted(set(mechanisms) & set(features))
    return faults + [f"{name!r} names a mechanism and a feature; choose two names" for name in both]


def duplicates(pairs: Iterable[tuple[str, Cause]]) -> list[str]:
    """Names of causes that two causes share, and of mechanisms and features that are not the same function.

    pairs: (file or package, cause).
    """
    faults: list[str] = []
    seen: dict[tuple[bool, str], Any] = {}
    for source, cause in pairs:
        brought = [("cause", cause.name, cause)]
        brought += [("mechanism", name, one) for name, one in mapping(cause.mechanisms).items()]
        brought += [("feature", name, one) for name, one in mapping(cause.features).items()]
        for kind, name, one in brought:
            before, where = seen.setdefault((kind == "cause", name), (one, source))
            if before is not one:
                places = " and ".join(dict.fromkeys(p for p in (where, source) if p))
                faults.append(
                    f"{places + ': ' if places else ''}two have the {kind} name {name!r}; rename one"
                )
    return faults


# -- origins -------------------------------------------------------------------------------------------------
def origin_in_python(cause: Cause) -> dict[str, str]:
    """Origin of a cause that was made in Python: the file of its first function, else the module."""
    functions = [*mapping(cause.mechanisms).values()]
    functions += [pair[0] for pair in mapping(cause.features).values() if is_feature(pair)]
    try:
        file = Path(inspect.getsourcefile(inspect.unwrap(functions[0])) or "")
        return {"file": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
    except (IndexError, TypeError, OSError):
        return {"python": str(getattr(functions[0] if functions else None, "__module__", "?"))}


def _origin_text(origin: Origin) -> str:
    """An origin in words."""
    if "file" in origin:
        return f"{origin['file']} (SHA-256 {origin['sha256'][:12]}…)"
    if "package" in origin:
        return f"the package {origin['package']} {origin['version']}"
    return f"a Python session (module {origin.get('python', '?')})"


def _remedy(origin: Origin) -> str:
    if "file" in origin:
        file = origin["file"]
        return f'pass the file as it was then: --library {file}, in Python library=load_library("{file}")'
    if "package" in origin:
        return "install that version; in Python pass library=load_library(installed=True)"
    return "pass the library that has it, such as library=load_library().with_causes(…)"


# -- the package's own ---------------------------------------------------------------------------------------
CAUSES: tuple[Cause, ...] = (
    Cause(
        "moisture_sorption",
        "hygroscopic material takes up water while the cabinet stands and gives it back on heating",
        "look for polymers, insulation, paper or desiccant in the cabinet; dry or replace them; pre-heat "
        "with ventilation",
        "weigh a piece of the material before and after pre-heating, or log relative humidity close to it",
        forms.sorption,
    ),
    Cause(
        "condensation", "a film forms on a surface colder than the dew point and evaporates later",
        "find and insulate the cold surface; check the drain; keep it above the dew point at standstill",
        "a surface temperature or wetness sensor at the coldest wall",
        forms.condensation,
    ),
    Cause(
        "wall_thermal_mass", "a second thermal mass stores heat beside the converter",
        "none needed; use the extended model", "a temperature sensor on the inner wall",
        forms.wall,
    ),
    Cause(
        "solar_gain", "the sun heats the cabinet or the tower around it",
        "shade or paint the wall; check the ventilation of the tower base",
        "irradiance measured at the tower",
        forms.sun, needs="irradiance or the site",
    ),
    Cause(
        "wind_driven_exchange", "wind drives air through the cabinet",
        "check seals and cable entries on the windward side",
        "wind speed at the tower base; a tracer-gas decay in wind and in calm",
        forms.wind, needs="wind_speed",
    ),
    Cause(
        "exchange_step", "the exchange of air changed at a date",
        "ask what was done on that date: seal, filter, door, cable entry", "a tracer-gas decay now",
        forms.exchange_step,
    ),
    Cause(
        "heat_release_drift", "the heat release drifts with the calendar",
        "check filters, fans and heat exchangers for fouling; compare losses of the converter",
        "heat flow or coolant temperatures",
        forms.heat_drift,
    ),
    Cause(
        "humidity_sensor_drift", "the humidity sensor drifts, or its scale is off",
        "compare the sensor with a reference; replace it", "a second humidity sensor beside it",
        forms.humidity_sensor,
    ),
    Cause(
        "temperature_sensor_offset", "the cabinet's temperature sensor is off by more than its accuracy",
        "compare the sensor with a reference; check its place and its wiring",
        "a second temperature sensor beside it",
        forms.temperature_offset,
    ),
    Cause(
        "clock_shift", "one source's clock is off",
        "set the clock, or state the zone and the stamp of the source",
        "an event that all sources see", forms.clock,
    ),
    Cause(
        "rain_ingress", "rain enters and evaporates",
        "find where the water enters: door, cable entry, roof",
        "a wetness sensor on the floor", forms.rain, needs="rain",
    ),
    Cause(
        "door_opening", "the door stood open", "compare with the log of service visits", "a door contact",
        forms.doors,
    ),
    Cause(
        "dehumidifier", "a drier works above a set-point", "find the drier and its set-point; log its state",
        "current of the drier", forms.drier,
    ),
    Cause(
        "internal_moisture_source", "water evaporates inside",
        "look for leaks of coolant, wet cable ducts, ground water",
        "absolute humidity inside and outside with the cabinet at ambient temperature", forms.source,
    ),
    Cause(
        "ambient_bias", "the ambient series does not describe the air that enters the cabinet",
        "compare the weather series with a sensor at the air inlet", "temperature and humidity at the inlet",
        forms.ambient,
    ),
    Cause(
        "unlogged_heater", "a heater that no signal reports runs",
        "find the heater and its thermostat or humidistat; log its state", "current of the heater",
        forms.heater,
    ),
    Cause(
        "scheduled_heat", "something releases heat at the same hours of every day, or of every workday",
        "look for lamps, timers and people at work in these hours; log the load",
        "current of the equipment that runs in these hours",
        forms.by_the_clock,
    ),
    Cause(
        "cooling_switching", "a fan, a vent or a valve cools the cabinet above a threshold",
        "find the fan, vent or valve and its set-points; log its state", "state of the fan, vent or valve",
        forms.cooling,
    ),
)  # fmt: skip
"""The package's causes; a new one is a module of `modelling.causes` and its line here."""


def _of_package() -> Library:
    made = Library(MECHANISMS, FEATURES)
    for cause in CAUSES:
        made = made.joined(cause, {})
    return replace(made, origins={})


LIBRARY = _of_package()
"""The package's mechanisms, features and causes."""
