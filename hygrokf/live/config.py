"""The tracker's file, `track.toml`: turbines, mapping of payloads, sources, store, page."""

from __future__ import annotations

import datetime
import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Any

from hygrokf.cases.form import HOLD_HELP, LONGEST_HELP, STAMPS, StatedSensor, longest_hold, stated_signal
from hygrokf.data.numbers import stated_marks
from hygrokf.data.quality import UNSTATED_VOCABULARY, QualityVocabulary, stated_vocabulary
from hygrokf.data.record import Site
from hygrokf.data.result_file import ResultFault
from hygrokf.data.signals import SWITCHED, Signal
from hygrokf.data.timestamps import EXCEL, duration, time_format_fault, zone_in_header, zone_named
from hygrokf.data.toml_form import (
    FormFault,
    Place,
    across,
    entry_name,
    lines_of,
    read_form,
    read_toml,
    setting,
)
from hygrokf.errors import suggestion
from hygrokf.identification.fit import Fit, read_fit
from hygrokf.identification.verdict import inherited
from hygrokf.live.condition import Surface
from hygrokf.live.forecast import LIMIT, heating_sd
from hygrokf.live.notification.channel import Channel
from hygrokf.live.notification.transports import channel_of
from hygrokf.live.plan import LATENESS_S, TRACKED_PROPERTIES, Plan, SignalReporting, plan
from hygrokf.live.properties import standard_errors
from hygrokf.live.sources.local import FileForm, InputForm
from hygrokf.live.sources.opcua import OpcUaForm
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import JSON, PAYLOAD_FORMATS, PLAIN
from hygrokf.live.sources.payload_values import RECEIVED, Clock, alternatives, path_fault, pattern_fault
from hygrokf.live.sources.postgres_source import PostgresForm
from hygrokf.live.sources.sparkplug import MqttForm
from hygrokf.live.sources.stream import SourceKeys, Stream
from hygrokf.live.storage.postgres import SCHEMES, url_fault
from hygrokf.live.turbine import STALE_S, Turbine
from hygrokf.live.web.page_settings import PAGE_ADDRESS, PageSettings, page_settings
from hygrokf.modelling.library import LIBRARY, Library
from hygrokf.physics.holds import MEAN, PREVIOUS, hold_named

PATHS = ("turbine", "time", "quality", "tag", "value")
"""Keys of [mapping] that are paths in a payload."""
ON_CHANGE = ("mqtt", "opc.tcp:")
"""Beginnings of the URLs of sources that report a value only when it changes."""
SAMPLE = datetime.datetime(2026, 11, 23, 17, 48)
"""A time whose parts all differ, to test whether a strptime format keeps all of them."""


def texts(value: object) -> tuple[str, ...]:
    """Convert a list to a tuple of texts.  Raises ValueError."""
    if not isinstance(value, list):
        raise ValueError(f"expected a list, found {value!r}")
    return tuple(str(item) for item in value)


def _time_form(value: object) -> str:
    """Check a strptime format, which must hold date and time to the minute; "" stands for ISO 8601.  Raises
    ValueError."""
    if value in ("", EXCEL):
        return str(value)
    if isinstance(value, str):
        if fault := time_format_fault(value):
            raise ValueError(fault)
        try:
            parsed = datetime.datetime.strptime(SAMPLE.astimezone().strftime(value), value)
            if parsed.replace(tzinfo=None) == SAMPLE:
                return value
        except ValueError:
            pass
    example = '"%d.%m.%Y %H:%M:%S"'
    raise ValueError(f"expected a strptime form of date and time such as {example}, found {value!r}")


@dataclass(frozen=True, kw_only=True)
class SignalForm(StatedSensor):
    """A row of [mapping.signals]."""

    field: str = entry_name()
    signal: Signal = setting(help="a signal of docs/reference/signals.md", read=stated_signal)
    stamp: str = setting(
        "instant", "what the time stamp marks: an instant, or a part of the interval", choices=STAMPS
    )
    interval_s: float = setting(0.0, "averaging interval of a mean", read=duration)
    hold: str | None = setting(None, HOLD_HELP, read=hold_named)
    longest_hold_s: float | None = setting(None, LONGEST_HELP, read=longest_hold, above=0.0)
    scale: float = setting(
        1.0, "factor of the number in the payload", fits=bool, expected="a number other than 0"
    )
    offset: float = setting(0.0, "added to the scaled number [unit]")

    @across("stamp", "interval")
    def mean(self) -> str | None:
        if (self.stamp == "instant") == (self.interval_s == 0.0):
            return None
        return 'a mean needs both: stamp = "start", "middle" or "end", and interval'

    @across("hold", "stamp", "interval")
    def hold_of_stamp(self) -> str | None:
        if self.hold is None or (self.hold == MEAN) == (self.stamp != "instant"):
            return None
        return (
            f'hold = "{self.hold}" contradicts stamp = "{self.stamp}": a mean needs hold = "mean" and a stamp'
        )

    def to_field(self) -> Field:
        """Return the field of payloads that the row configures."""
        hold = self.hold or (MEAN if self.interval_s > 0 else self.signal.hold)
        form = SignalReporting(hold, self.interval_s, **self.settings, longest_hold_s=self.longest_hold_s)
        return Field(self.signal.name, self.unit, form, self.stamp, self.scale, self.offset, self.one or "")


@dataclass(frozen=True)
class MappingForm:
    """The table [mapping]."""

    format: str = setting(
        JSON, "format of payloads that are texts, not rows of a table", choices=PAYLOAD_FORMATS
    )
    records: str = setting("", "path to the objects that hold the values")
    turbine: str = setting("turbine", "field with the turbine's name", empty=True)
    time: str = setting("time", "field with the time")
    timezone: datetime.tzinfo | None = setting(None, "time zone of stamps without an offset", read=zone_named)
    time_format: str = setting("", "strptime format of stamps that are not ISO 8601", read=_time_form)
    quality: str = setting("", "field with the quality of the values")
    vocabulary: QualityVocabulary = setting(
        UNSTATED_VOCABULARY, "vocabulary of the quality, or a list of its good marks", read=stated_vocabulary
    )
    good: QualityVocabulary | None = setting(
        None, "marks of good quality, instead of a vocabulary", read=stated_vocabulary
    )
    use_uncertain: bool = setting(True, "whether readings of uncertain quality are used")
    tag: str = setting("", "field with the name of the value, if each record is one reading")
    value: str = setting("", "field with the value, if each record is one reading")
    tag_pattern: str = setting("", "pattern of the tags or, without tag, of the names of the fields")
    decimal: str | None = setting(None, "decimal mark of numbers in texts", choices=(".", ","))
    signals: Mapping[str, SignalForm] = setting(dict, "field of a payload → its signal")

    @across("tag", "value")
    def one_reading(self) -> str | None:
        if bool(self.tag) == bool(self.value):
            return None
        return "tag and value belong together: state both or neither"

    @across(*PATHS)
    def paths(self) -> Iterator[str]:
        for key in PATHS:
            fault = path_fault(getattr(self, key), *((RECEIVED,) if key == "time" else ()))
            if fault is not None:
                yield f"{key}: {fault}"

    @across("records")
    def path_of_records(self) -> str | None:
        steps = self.records.split(".")
        if not self.records or (all(steps) and "{" not in self.records):
            return None
        return f'records: expected names separated by points, "*" for any name, found {self.records!r}'

    @across("tag_pattern", "turbine")
    def pattern(self) -> str | None:
        fault = pattern_fault(self.tag_pattern) if self.tag_pattern else None
        return None if fault is None else f"tag_pattern: {fault}"

    @across("format", "time")
    def time_of_plain(self) -> str | None:
        if self.format != PLAIN or any("{" in path for path in alternatives(self.time)):
            return None
        return f'a plain value has no field {self.time!r}: state time = "{RECEIVED}", the time of arrival'

    @across("signals")
    def rows(self) -> Iterator[str]:
        name_by_signal: dict[str, str] = {}
        for name, row in self.signals.items():
            signal = row.signal.name
            if signal in name_by_signal:
                yield f"{name} and {name_by_signal[signal]} are both {signal}: keep one of them"
            name_by_signal[signal] = name

    def to_mapping(self) -> PayloadMapping:
        """Return the mapping, without rows that have faults, and without turbines yet."""
        usable = {name: row for name, row in self.signals.items() if row.signal and not row.unit_of_signal()}
        zone = zone_in_header(self.time) if self.timezone is None else None
        return PayloadMapping(
            {name: row.to_field() for name, row in usable.items()},
            turbine=self.turbine,
            time=self.time,
            quality=self.quality,
            tag=self.tag,
            value=self.value,
            vocabulary=self.good or self.vocabulary,
            use_uncertain=self.use_uncertain,
            form=self.format,
            records=self.records,
            tag_pattern="" if pattern_fault(self.tag_pattern) else self.tag_pattern,
            clock=Clock(self.timezone if zone is None else zone_named(zone), self.time_format),
            marks=stated_marks(self.decimal, None),
        )


def source_mappings(
    common: MappingForm, stated: object, sources: Sequence[Mapping[str, object]], place: Place
) -> tuple[PayloadMapping, ...]:
    """Return the mapping of each [[source]]: the common one, with keys replaced by those of [source.mapping].

    common: the common table [mapping], whose faults `place` has already.  stated: the same as in the file.
    """
    common_faults = {_without_place(fault) for fault in place.faults}
    common_table = stated if isinstance(stated, Mapping) else {}
    forms = []
    for number, source in enumerate(sources):
        own_table, inside, form = source.get("mapping"), place.inside("source", number), common
        if isinstance(own_table, Mapping):
            own_place = replace(inside.inside("mapping"), faults=[])
            form = read_form(MappingForm, {**common_table, **own_table}, own_place)
            place.faults.extend(
                fault for fault in own_place.faults if _without_place(fault) not in common_faults
            )
        elif own_table is not None:
            inside.fault(f"mapping must be a table [source.mapping], found {own_table!r}")
        forms.append(form)
    if not all(form.signals for form in forms or [common]):
        place.inside("mapping").fault(
            "no signals: add [mapping.signals] with rows such as "
            'Tcab = { signal = "cabinet_temperature", unit = "degC" }'
        )
    return tuple(form.to_mapping() for form in forms)


def _without_place(fault: str) -> str:
    """Return the message of a fault of a mapping without the name of its table."""
    return fault.partition("mapping")[2].lstrip("] ")


def expect_one_place(
    mappings: Iterable[PayloadMapping], sources: Sequence[Mapping[str, Any]], place: Place
) -> None:
    """Report at `place` each tag of a server or file that two [[source]] tables read as different signals."""
    first_readers: dict[tuple[str, ...], tuple[str, int]] = {}  # address -> meaning, number of the source
    for number, (mapping, source) in enumerate(zip(mappings, sources, strict=True)):
        nodes, topics = source.get("nodes"), source.get("topics")
        tags: dict[tuple[str, ...], str] = {}
        for name, field_ in mapping.fields.items():
            for topic in topics if isinstance(topics, list) else [""]:
                tags[str(topic), name] = field_.signal
        if isinstance(nodes, Mapping):
            tags = {
                (name,): f"{mapping.fields[node['field']].signal} of {node.get('turbine')}"
                for name, node in nodes.items()
                if isinstance(node, Mapping) and node.get("field") in mapping.fields
            }
        for tag, meaning in tags.items():
            address = (str(source.get("url")), str(source.get("query")), str(source.get("weather")), *tag)
            first_meaning, first_number = first_readers.setdefault(address, (meaning, number))
            if first_meaning != meaning:
                first_place = place.inside("source", first_number).at()
                place.inside("source", number).fault(
                    f"{tag[-1]} of {address[0]} is {meaning} here and {first_meaning} in {first_place}: a "
                    "tag has one meaning; keep the right one"
                )


def source_forms(
    mappings: Iterable[PayloadMapping], sources: Sequence[Mapping[str, object]], place: Place
) -> dict[str, SignalReporting]:
    """Return signal → how its sources report it; all sources except weather forecasts must report it alike.

    By default a switched signal of a source that reports changes is held while the source is connected.
    """
    forms: dict[str, SignalReporting] = {}
    switched_on_change: set[str] = set()
    for number, mapping in enumerate(mappings):
        if number < len(sources) and sources[number].get("weather") is True:
            continue
        for name, field_ in mapping.fields.items():
            if forms.setdefault(field_.signal, field_.form) != field_.form:
                place.inside("source", number).fault(
                    f"mapping: {name} is {field_.signal} of another interval, accuracy, resolution or "
                    "response time than that of an earlier source; state the same in both"
                )
            if str(sources[number].get("url")).startswith(ON_CHANGE) and field_.signal in SWITCHED:
                switched_on_change.add(field_.signal)
    for signal in switched_on_change:
        if forms[signal].hold == PREVIOUS and forms[signal].longest_hold_s is None:
            forms[signal] = replace(forms[signal], longest_hold_s=math.inf)
    return forms


# -- the whole file ------------------------------------------------------------------------------------------
RETENTION_S = 400.0 * 86400.0
LEAST_RETENTION_S = 7.0 * 86400.0
SOURCE_FORMS: Mapping[str, type[SourceKeys]] = {
    "file": FileForm,
    "stdin": InputForm,
    "mqtt": MqttForm,
    "mqtts": MqttForm,
    "opc.tcp": OpcUaForm,
    "postgresql": PostgresForm,
    "postgres": PostgresForm,
}
"""Scheme of a source's URL -> form of its [[source]] table."""


class ConfigFault(FormFault):
    """A tracker's file cannot be used; the message lists every fault on its own line."""

    def __str__(self) -> str:
        return "\n".join(f"{self.file}: {fault}" for fault in self.faults)


@dataclass(frozen=True)
class Config:
    """The configuration of a tracker; `store` is the store's URL."""

    turbines: Mapping[str, Turbine]
    streams: tuple[Stream, ...]
    store: str
    page: PageSettings = field(default_factory=PageSettings)
    retention_s: float = RETENTION_S
    channels: tuple[Channel, ...] = ()


def stream_of(
    table: Mapping[str, object], place: Place, folder: Path, mapping: PayloadMapping
) -> Stream | None:
    """Return the stream of a `[[source]]` table, which is not connected yet; None if the table has faults,
    which are reported at `place`.

    Paths are relative to `folder`.  With `weather = true` the source delivers weather forecasts.
    """
    url = table.get("url")
    scheme = url.partition(":")[0] if isinstance(url, str) else ""
    form_class = SOURCE_FORMS.get(scheme)
    if form_class is None:
        schemes = ", ".join(f"{name}:" if name != "stdin" else name for name in SOURCE_FORMS)
        # the rest of the url may hold a password
        place.fault(f"url must begin with one of {schemes}, found {scheme!r}")
        return None
    own_place = replace(place, faults=[])
    source_form = read_form(form_class, table, own_place, folder=folder)
    stream = source_form.stream(
        replace(mapping, weather=source_form.weather, revision=source_form.revision), own_place
    )
    if stream is not None and source_form.reach_limit_s is not None:
        stream.reach_limit_s = source_form.reach_limit_s
    place.faults.extend(own_place.faults)
    return None if own_place.faults else stream


def _names(value: object) -> dict[str, str]:
    """Check a table of texts.  Raises ValueError."""
    if not isinstance(value, dict) or not all(isinstance(name, str) for name in value.values()):
        raise ValueError(f'expected a table such as {{ TT101 = "Tcab" }}, found {value!r}')
    return value


def store_url(value: object) -> str:
    """Check the URL of a store, which messages never show, because it may hold a password.  Raises
    ValueError."""
    if not isinstance(value, str):
        raise ValueError(f"expected text in quotes, found {value!r}")
    fault = url_fault(value)
    if fault is None and not value.startswith(("sqlite:", *SCHEMES)):
        beginning = repr(value.partition(":")[0])
        fault = f"expected sqlite:PATH or postgresql://USER@HOST/NAME, found one that begins with {beginning}"
    if fault is not None:
        raise ValueError(fault)
    return value


@dataclass(frozen=True)
class SurfaceForm:
    """The table cold_surface of a [[turbine]]."""

    follows: float = setting(
        Surface().follows,
        "share of the cabinet air's temperature [1]; the rest is ambient",
        least=0.0,
        most=1.0,
    )
    offset_K: float = setting(Surface().offset_K, "by how much it is warmer than this mean [K]")


@dataclass(frozen=True)
class SiteForm(Site):
    """The table site of a [[turbine]]; messages do not repeat "site", which their place names already."""

    def __post_init__(self) -> None:
        try:
            super().__post_init__()
        except ValueError as fault:
            raise ValueError(str(fault).removeprefix("site: ")) from None


@dataclass(frozen=True)
class TurbineForm:
    """A [[turbine]]."""

    name: str = setting(
        help="the name of the turbine",
        fits=lambda name: len(name) <= 100 and name.isprintable(),
        expected="text of 1 to 100 printable characters",
    )
    fit: str = setting(help="its model: fit.json, or the directory with it")
    known_as: tuple[str, ...] | None = setting(None, "names of the turbine in payloads", read=texts)
    names: Mapping[str, Any] = setting(dict, "NAME in its payloads = FIELD of [mapping.signals]", read=_names)
    cold_surface: SurfaceForm = setting(SurfaceForm, "its coldest surface")
    site: SiteForm | None = setting(None, "its site, for models with solar radiation")
    rated_power_kW: float | None = setting(None, "rated power of the turbine [kW]", above=0.0)
    lateness_s: float | None = setting(None, "lateness of its readings, instead of the file's", read=duration)
    humidity_limit: float = setting(LIMIT, "limit of relative humidity in forecasts", above=0.0, most=1.0)
    stale_s: float = setting(
        STALE_S, "age above which data are stale", read=duration, above=0.0, expected="a duration above 0 s"
    )


_RATE = "a rate above 0 and at most 1 a day^0.5"
WanderingForm = make_dataclass(
    "WanderingForm",
    [
        (name, float | None, setting(None, "drift rate per day^0.5", above=0.0, most=1.0, expected=_RATE))
        for name in TRACKED_PROPERTIES
    ],
    frozen=True,
)
"""The table [wandering]: drift rates of the tracked properties."""


@dataclass(frozen=True)
class TrackForm:
    """The tracker's file."""

    store: str = setting("sqlite:live.db", "URL of the store", read=store_url)
    page: Any = setting(PAGE_ADDRESS, "HOST:PORT, or a table")
    lateness_s: float = setting(
        LATENESS_S, "how much older than the newest reading one may be", read=duration
    )
    retention_s: float = setting(
        RETENTION_S,
        "how long history is kept",
        read=duration,
        least=LEAST_RETENTION_S,
        expected="at least 7 d: a restart needs what was read before",
    )
    turbine: tuple[TurbineForm, ...] = setting((), "the turbines")
    mapping: MappingForm = setting(MappingForm, "how payloads are read")
    source: tuple[Mapping[str, Any], ...] = setting((), "sources of payloads")
    wandering: Mapping[str, Any] | None = setting(None, "drift rates of the tracked properties")
    notify: tuple[Mapping[str, Any], ...] = setting((), "channels for notices of alarms")

    @across("turbine")
    def any_turbine(self) -> Iterator[str]:
        if not self.turbine:
            yield 'no turbine: add [[turbine]] with name = "…" and fit = "…/fit.json"'

    @across("source")
    def any_source(self) -> Iterator[str]:
        if not self.source:
            yield 'no source: add [[source]] with url = "file:…" or "stdin"'


def read_config(path: str | os.PathLike[str], library: Library = LIBRARY) -> Config:
    """Read a tracker's file; paths in it are relative to its folder.  Raises ConfigFault.

    library: of the mechanisms that the models may contain.
    """
    file = Path(path)
    text, stated = read_toml(file, ConfigFault)
    place = Place(lines=lines_of(text))
    form = read_form(TrackForm, stated, place)
    mappings = source_mappings(form.mapping, stated.get("mapping"), form.source, place)
    reporting = source_forms(mappings, form.source, place)
    turbines, names = _turbines(form, file.parent, reporting, place, library)
    names_by_turbine = _own_names(
        form.turbine, {name for mapping in mappings for name in mapping.fields}, place
    )
    expect_one_place(mappings, form.source, place)
    streams: list[Stream] = []
    for number, (table, layout) in enumerate(zip(form.source, mappings, strict=True)):
        source_place = place.inside("source", number)
        mapping = replace(layout, turbines=names, names=names_by_turbine)
        source_keys = {key: value for key, value in table.items() if key != "mapping"}
        stream = stream_of(source_keys, source_place, file.parent, mapping)
        if stream is None:
            continue
        if stream.url in [other.url for other in streams]:
            source_place.fault(
                f"{stream.url} is already a source; several sources of one broker need different client_ids"
            )
        streams.append(stream)
    channels = _channels(form, file.parent, place)
    page = page_settings(form.page, file.parent, place)
    if place.faults:
        raise ConfigFault(file.name, place.faults)
    store = form.store
    if store.startswith("sqlite:") and not Path(store.removeprefix("sqlite:")).is_absolute():
        store = f"sqlite:{file.parent / store.removeprefix('sqlite:')}"
    return Config(turbines, tuple(streams), store, page, form.retention_s, channels)


def _channels(form: TrackForm, folder: Path, place: Place) -> tuple[Channel, ...]:
    """Return the channels of the [[notify]] tables; report faults at `place`."""
    channels: list[Channel] = []
    turbines = [turbine.name for turbine in form.turbine]
    for number, table in enumerate(form.notify):
        channel_place = place.inside("notify", number)
        channel = channel_of(table, channel_place, folder, turbines)
        if channel is not None and channel.name in [other.name for other in channels]:
            channel_place.fault(f"a second channel is named {channel.name!r}: names must differ")
        elif channel is not None:
            channels.append(channel)
    return tuple(channels)


def _own_names(
    turbines: Sequence[TurbineForm], fields: Collection[str], place: Place
) -> dict[str, dict[str, str]]:
    """Return turbine → its own names of fields; report a field that no mapping has at `place`."""
    for number, turbine in enumerate(turbines):
        for name, field_ in turbine.names.items():
            if field_ not in fields:
                similar = suggestion(field_, fields)
                place.inside("turbine", number).fault(
                    f"names: {name} is {field_!r}, which [mapping.signals] does not have{similar}"
                )
    return {turbine.name: dict(turbine.names) for turbine in turbines if turbine.names}


def _turbines(
    form: TrackForm, folder: Path, forms: Mapping[str, SignalReporting], place: Place, library: Library
) -> tuple[dict[str, Turbine], dict[str, str]]:
    """Return name → turbine, and name in payloads → name of the turbine; report faults at `place`.

    forms: signal → how its sources report it.
    """
    rates = None
    if form.wandering is not None:
        stated = vars(read_form(WanderingForm, form.wandering, place.inside("wandering")))
        rates = {name: rate for name, rate in stated.items() if rate is not None}
    turbines: dict[str, Turbine] = {}
    turbine_by_name: dict[str, str] = {}
    for number, row in enumerate(form.turbine):
        turbine_place = place.inside("turbine", number)
        if row.name in turbines:
            turbine_place.fault(f"a second turbine is named {row.name!r}: names must differ")
        for payload_name in (row.name,) if row.known_as is None else row.known_as:
            if turbine_by_name.setdefault(payload_name, row.name) != row.name:
                turbine_place.fault(
                    f"known_as: {payload_name!r} already stands for {turbine_by_name[payload_name]!r}"
                )
        if not row.fit:
            continue
        turbine = read_turbine(
            folder / row.fit,
            turbine_place,
            library,
            name=row.name,
            forms=forms,
            lateness_s=form.lateness_s if row.lateness_s is None else row.lateness_s,
            wandering=rates,
            site=None if row.site is None else Site(**vars(row.site)),
            rated_power_W=None if row.rated_power_kW is None else 1e3 * row.rated_power_kW,
        )
        if turbine is not None:
            surface = Surface(**vars(row.cold_surface))
            turbines[row.name] = replace(
                turbine, surface=surface, limit=row.humidity_limit, stale_s=row.stale_s
            )
    return turbines, turbine_by_name


def read_turbine(path: Path, place: Place, library: Library, **options: Any) -> Turbine | None:
    """Return a turbine with the model in a file or folder; None, with a fault, if it cannot be used.

    library: of the mechanisms that the model may contain.  options: arguments of `plan`.
    """
    try:
        fit = read_fit(path, library=library)
        return turbine_of(fit, plan(fit, **options))
    except (ResultFault, ValueError, KeyError) as fault:
        place.fault(str(fault))
    except OSError as fault:
        place.fault(f"{path}: {fault.strerror}")
    return None


def turbine_of(fit: Fit, plan_: Plan) -> Turbine:
    """Return a turbine that is tracked by a plan, with standard errors and verdicts of the plan's fit."""
    errors, verdicts = standard_errors(fit), inherited(fit.results)
    return Turbine(plan_, errors=errors, verdicts=verdicts, heating_sd_K=heating_sd(fit))
