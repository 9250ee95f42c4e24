"""The library: the mechanisms and derived inputs (features) that models are made of, and the causes that
`discover` tries.

A `Library` is immutable.  `LIBRARY` holds the package's mechanisms, features and causes; `with_causes` and
`with_mechanisms` return a library that also has those of a user, each with its origin: {"file": name,
"sha256": hash}, {"package": name, "version": version}, or {"python": module} if it has no file.  A design
stores the names of its mechanisms and features, so that reading it requires a library that has them.
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
    """Mechanisms, features and causes; two libraries may use the same name for different things.

    mechanisms: name → factory.  features: name → (function, hold).  causes: in the order in which `discover`
    tries them.  origins: of the mechanisms and features that a user added, by name.
    """

    mechanisms: Mapping[str, Factory]
    features: Mapping[str, Feature]
    causes: tuple[Cause, ...] = ()
    origins: Mapping[str, Origin] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("mechanisms", "features", "origins"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __repr__(self) -> str:
        """Number of mechanisms, names of the causes, and names of what a user added."""
        causes = ", ".join(cause.name for cause in self.causes) or "none"
        user_part = f"; of your own: {', '.join(self.origins)}" if self.origins else ""
        return f"Library of {len(self.mechanisms)} mechanisms and the causes {causes}{user_part}"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only what a user added to the package's library.  Causes are left out, since no model reads
        them and their forms are closures."""
        user_definitions = [
            {name: definition for name, definition in definitions.items() if name in self.origins}
            for definitions in (self.mechanisms, self.features)
        ]
        return _unpickle, (*user_definitions, dict(self.origins))

    @property
    def own(self) -> tuple[Cause, ...]:
        """The causes that are not the package's."""
        return tuple(cause for cause in self.causes if cause not in CAUSES)

    def cause(self, name: str) -> Cause:
        """The cause with a name.  Raises KeyError that lists the names of all causes."""
        for cause in self.causes:
            if cause.name == name:
                return cause
        raise KeyError(f"no cause {name!r}; the library has {', '.join(known.name for known in self.causes)}")

    def only(self, *names: str) -> Library:
        """The library with these causes alone, in this order.  Raises KeyError for unknown causes."""
        return replace(self, causes=tuple(map(self.cause, names)))

    def with_causes(self, *causes: Cause, origin: Origin | None = None) -> Library:
        """The library with further causes, and with the mechanisms and features of these causes.

        causes: of `cause_of`, or a `Cause`; causes that the library has already are ignored.
        origin: of the causes; by default the Python file or module of each.

        `discover` and `load_library` test the causes before any work.  Raises LibraryFault for names in use.
        """
        new_causes = [cause for cause in causes if cause not in self.causes]
        faults = duplicates([("", cause) for cause in (*self.causes, *new_causes)])
        library = self
        for cause in new_causes:
            cause_faults = name_faults(mapping(cause.mechanisms), mapping(cause.features))
            try:
                library = library.joined(cause, origin or origin_in_python(cause))
            except ValueError as fault:  # an unknown hold
                cause_faults.append(str(fault))
            faults += [f"cause {cause.name!r}: {fault}" for fault in cause_faults]
        if faults:
            raise LibraryFault(faults)
        return library

    def joined(self, cause: Cause, origin: Origin) -> Library:
        """The library with one further cause, without a check of its names."""
        return replace(
            self._with_definitions(mapping(cause.mechanisms), mapping(cause.features), origin),
            causes=(*self.causes, cause),
        )

    def with_mechanisms(self, *factories: Factory, features: Mapping[str, Feature] | None = None) -> Library:
        """The library with further mechanisms, and with features that drive them.

        factories: of the mechanisms, each named as its mechanism.
        features: name → (function(record, time), hold).

        Raises ValueError for names of the package, and for unknown holds.
        """
        mechanisms = {factory.__name__: factory for factory in factories}
        faults = name_faults(mechanisms, features or {})
        if faults:
            raise ValueError("; ".join(faults))
        return self._with_definitions(mechanisms, features or {}, {"python": factories[0].__module__})

    def _with_definitions(
        self, mechanisms: Mapping[str, Factory], features: Mapping[str, Any], origin: Origin
    ) -> Library:
        """The library with further mechanisms and features, all of one origin."""
        with_hold = {
            name: (pair[0], hold_named(pair[1])) for name, pair in features.items() if is_feature(pair)
        }
        return replace(
            self,
            mechanisms={**self.mechanisms, **mechanisms},
            features={**self.features, **with_hold},
            origins={**self.origins, **{name: dict(origin) for name in (*mechanisms, *with_hold)}},
        )

    def absent(self, stored: Mapping[str, Origin]) -> list[str]:
        """Sentences about a user's mechanisms and features that a stored design needs and that this library
        lacks, or has from another origin.

        stored: origins by name.
        """
        names_by_text: dict[str, list[str]] = {}
        for name, origin in stored.items():
            origin_here = self.origins.get(name)
            if origin_here is not None and ("python" in origin or dict(origin_here) == dict(origin)):
                continue
            difference = (
                "found none of that name"
                if origin_here is None
                else f"found that of {_origin_text(origin_here)}"
            )
            names_by_text.setdefault(
                f"of {_origin_text(origin)}, {difference}; {_remedy(origin)}", []
            ).append(name)
        return [f"the model needs {', '.join(names)} {text}" for text, names in names_by_text.items()]


def _unpickle(
    mechanisms: Mapping[str, Factory], features: Mapping[str, Feature], origins: Mapping[str, Origin]
) -> Library:
    """The package's library with a user's definitions (`Library.__reduce__`)."""
    if not origins:
        return LIBRARY
    definitions = {**LIBRARY.mechanisms, **mechanisms}, {**LIBRARY.features, **features}
    return Library(*definitions, origins=origins)


# -- names ---------------------------------------------------------------------------------------------------
def is_feature(pair: object) -> bool:
    """Whether an object is a pair (function, hold)."""
    return isinstance(pair, tuple) and len(pair) == 2 and callable(pair[0])


def mapping(value: object) -> forms.Settings:
    """The value if it is a mapping, else an empty mapping: the test of a cause reports other values."""
    return value if isinstance(value, Mapping) else {}


def name_faults(mechanisms: Iterable[str], features: Iterable[str]) -> list[str]:
    """Faults of names that the package already uses, and of names used for a mechanism and a feature."""
    mechanisms, features = list(mechanisms), list(features)
    taken = {*LIBRARY.mechanisms, *LIBRARY.features, *SIGNALS}
    faults = [
        f"{kind} {name!r}: the package has a mechanism, feature or signal of that name; choose another name"
        for kind, names in (("mechanism", mechanisms), ("feature", features))
        for name in names
        if name in taken
    ]
    shared = sorted(set(mechanisms) & set(features))
    return faults + [f"{name!r} names a mechanism and a feature; choose two names" for name in shared]


def duplicates(pairs: Iterable[tuple[str, Cause]]) -> list[str]:
    """Faults of names that two causes share, or two different mechanisms or features.

    pairs: (file or package, cause).
    """
    faults: list[str] = []
    first_by_name: dict[tuple[bool, str], Any] = {}
    for source, cause in pairs:
        definitions = [("cause", cause.name, cause)]
        definitions += [
            ("mechanism", name, definition) for name, definition in mapping(cause.mechanisms).items()
        ]
        definitions += [("feature", name, definition) for name, definition in mapping(cause.features).items()]
        for kind, name, definition in definitions:
            earlier, earlier_source = first_by_name.setdefault((kind == "cause", name), (definition, source))
            if earlier is not definition:
                places = " and ".join(dict.fromkeys(p for p in (earlier_source, source) if p))
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
    """What a user has to do for a definition of this origin."""
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
"""The package's causes.  A new one is a line here: with forms in `modelling.causes.forms` where a mechanism
of `physics.mechanisms` has its effect, else with a module of `modelling.causes` for mechanism and forms."""


def _of_package() -> Library:
    library = Library(MECHANISMS, FEATURES)
    for cause in CAUSES:
        library = library.joined(cause, {})
    return replace(library, origins={})


LIBRARY = _of_package()
"""The package's mechanisms, features and causes."""
