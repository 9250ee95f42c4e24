"""The form of a case, in a file or in the arguments of a call: keys, types, and the place of each key."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from hygrokf.data.columns import Notation
from hygrokf.data.numbers import POLES, Meaning
from hygrokf.data.quality import UNSTATED_VOCABULARY, QualityVocabulary, StatedQuality, stated_vocabulary
from hygrokf.data.record import Provenance, Site
from hygrokf.data.signals import SIGNALS, Signal, difference_to_si, fitting_units, unit_fault
from hygrokf.data.timestamps import duration, moment, signed_duration
from hygrokf.data.toml_form import Place, across, entry_name, read_form, setting
from hygrokf.errors import suggestion
from hygrokf.physics.holds import HOLDS, MEAN, PREVIOUS, hold_named
from hygrokf.texts.wording import stamp_text
from hygrokf.weather.reading import TYPICAL, WEATHER_FORMATS

STAMPS = ("instant", "start", "middle", "end")
"""Meanings of a stamp: an instant, or a position in the averaging interval."""


def stated_signal(name: object) -> Signal:
    """A row of the table of signals.  Raises ValueError."""
    if not isinstance(name, str) or name not in SIGNALS:
        near = suggestion(str(name), SIGNALS)
        raise ValueError(f'unknown signal "{name}"{near} (docs/reference/signals.md lists them all)')
    return SIGNALS[name]


def _size(value: Any) -> float:
    """A difference in the unit of the readings."""
    is_size = isinstance(value, (int, float)) and not isinstance(value, bool) and 0.0 <= value < float("inf")
    if not is_size:
        raise ValueError(f"expected a number ≥ 0 in the unit of the readings, found {value!r}")
    return float(value)


def longest_hold(value: Any) -> float:
    """The age [s] up to which a value holds: a duration, or ∞ for "connected".  Raises ValueError."""
    if value == "connected":
        return math.inf
    try:
        return duration(value)
    except ValueError as fault:
        raise ValueError(f'{fault}; "connected" holds a value while the connection lasts') from None


def _losses(value: Any) -> tuple[tuple[float, float], ...]:
    """Spans (start, end) [s] of a list of pairs of stamps.  Raises ValueError."""
    if not isinstance(value, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in value):
        raise ValueError(f"expected pairs of stamps such as [[START, END], …], found {value!r}")
    spans = tuple((moment(start), moment(end)) for start, end in value)
    edges = [edge for span in spans for edge in span]
    if edges != sorted(set(edges)):
        raise ValueError(f"expected pairs of stamps in the order of time, without overlap, found {value!r}")
    return spans


HOLD_HELP = f"how values continue: {', '.join(HOLDS)}; by default by stamp and signal"
LONGEST_HELP = 'age up to which a value holds, or "connected"; by default three usual intervals'


@dataclass(frozen=True, kw_only=True)
class StatedSensor:
    """Keys that describe the readings of a signal, in a case and in a tracker's file."""

    signal: Signal
    unit: str = setting(help="the unit of the readings")
    accuracy: float | None = setting(None, "95 % accuracy of the sensor [its unit]", read=_size)
    resolution: float | None = setting(None, "spacing of the readings [its unit]", read=_size)
    response_time_s: float | None = setting(
        None, "time in which the sensor covers 63 % of a step", read=duration
    )

    one: str | None = setting(None, "the text of a flag that is 1", choices=POLES)

    @across("unit", "signal")
    def unit_of_signal(self) -> str | None:
        return unit_fault(self.unit, self.signal.name)

    @property
    def meaning(self) -> Meaning:
        """What texts of this signal stand for."""
        return Meaning(self.signal.name, self.unit, self.one or "")

    @property
    def settings(self) -> dict[str, float]:
        """The optional arguments of a `Series` [SI] that are stated."""
        arguments = {"response_time_s": self.response_time_s}
        for name in ("accuracy", "resolution"):
            size = getattr(self, name)
            arguments[name] = None if size is None else difference_to_si(size, self.unit, self.signal)
        return {name: value for name, value in arguments.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class StatedColumn(StatedSensor):
    """One signal of a source."""

    signal: Signal = entry_name(stated_signal)
    unit: str = setting(
        help="the unit of the readings",
        lacking=lambda place: f"one of {', '.join(fitting_units(str(place.path[-1])))}",
    )
    column: str = setting(help="its name in the table")
    quality: str | None = setting(None, 'column of its quality, "" if it has none', empty=True)


@dataclass(frozen=True)
class StatedSource(Notation):
    """One [[source]] of the case file, or one frame."""

    file: str = setting(help="path, relative to the case file; the name of a frame")
    time: str = setting(help="column of the stamps")
    stamp: str = setting("instant", "an instant, or a position in the interval", choices=STAMPS)
    interval_s: float | None = setting(
        None, "length averaged over; by default the step", read=duration, above=0.0, expected="longer than 0"
    )
    hold: str | None = setting(None, HOLD_HELP, read=hold_named)
    longest_hold_s: float | None = setting(None, LONGEST_HELP, read=longest_hold, above=0.0)
    lost: tuple[tuple[float, float], ...] = setting(
        (), "spans in which its connection was lost, with held values unknown", read=_losses
    )
    clock_uncertainty_s: float | None = setting(None, "standard uncertainty of the clock", read=duration)
    clock_correction_s: float = setting(0.0, "added to the stamps", read=signed_duration)
    vocabulary: QualityVocabulary = setting(
        UNSTATED_VOCABULARY, "of quality, or its good marks", read=stated_vocabulary
    )
    use_uncertain: bool = setting(True, "use readings of uncertain quality")
    compare: bool = setting(False, "only compare with the other sources")
    signals: Mapping[str, StatedColumn] = setting(dict, "signals and their columns")

    @across("decimal", "separator", "thousands")
    def different_marks(self) -> str | None:
        marks = {"separator": self.separator, "thousands": self.thousands}
        repeated = next((name for name, mark in marks.items() if mark and mark == self.decimal), None)
        return repeated and f'{repeated} and decimal are both "{self.decimal}"; change one of the two'

    @across("interval", "stamp", "hold")
    def place_in_interval(self) -> str | None:
        if self.stamp != "instant":
            return 'hold = "previous" is for stamp = "instant"' if self.hold == PREVIOUS else None
        if self.interval_s is None and self.hold != MEAN:
            return None
        return 'a mean needs to know where in it the stamp is: state stamp = "start", "middle" or "end"'

    @across("ignore_offset", "timezone")
    def clock(self) -> str | None:
        lacks_zone = self.ignore_offset and self.timezone is None
        return "ignore_offset = true needs the timezone of the clock" if lacks_zone else None

    @across("signals")
    def any_signal(self) -> str | None:
        if self.signals:
            return None
        return (
            "this source names no signal; expected such as "
            'signals.cabinet_temperature = { column = "…", unit = "degC" }'
        )

    @property
    def columns(self) -> tuple[StatedColumn, ...]:
        """The signals whose column and unit are valid."""
        named = (column for column in self.signals.values() if column.column)
        return tuple(column for column in named if unit_fault(column.unit, column.signal.name) is None)

    @property
    def meanings(self) -> dict[str, Meaning]:
        """Columns to read, and what their texts stand for."""
        return {column.column: column.meaning for column in self.columns}

    @property
    def quality(self) -> StatedQuality:
        """What the source states about the quality of its readings."""
        columns = {column.column: column.quality for column in self.columns}
        return StatedQuality(columns, self.vocabulary, self.use_uncertain)


@dataclass(frozen=True)
class StatedWeather:
    """One [[source]] of the case file that is a weather file, with a format in place of columns."""

    OF: ClassVar = " in a [[source]] with format"
    REFUSED: ClassVar = {
        "signals": "a source with format supplies all signals of its file; remove signals",
        "time": "a source with format needs no time; remove it",
    }
    file: str = setting(help="path, relative to the case file")
    format: str = setting(
        help="of the weather file", choices=WEATHER_FORMATS, remedy="a table of columns needs no format"
    )
    year: int | None = setting(None, "of a typical year", least=1900, most=2200)
    altitude_m: float | None = setting(
        None, "of the weather; by default as in its file", least=-500.0, most=9000.0
    )
    to_site_altitude: bool = setting(False, "convert the weather to the altitude of the site")
    lapse_rate_K_per_km: float | None = setting(
        None, "of the air between; by default 6.5", least=-20.0, most=20.0
    )
    clock_correction_s: float = setting(0.0, "added to the stamps", read=signed_duration)
    clock_uncertainty_s: float | None = setting(None, "standard uncertainty of the clock", read=duration)
    compare: bool = setting(False, "only compare with the other sources")

    @across("year", "format")
    def stamps(self) -> str | None:
        if self.year is None or self.format in TYPICAL:
            return None
        return "year is for typical years (epw, try); this file has its own stamps"

    @across("lapse_rate_K_per_km", "to_site_altitude")
    def use_of_lapse_rate(self) -> str | None:
        if self.lapse_rate_K_per_km is None or self.to_site_altitude:
            return None
        return "lapse_rate_K_per_km is used with to_site_altitude = true only"

    @property
    def lapse_rate(self) -> float:
        """[K/m]"""
        return 1e-3 * (6.5 if self.lapse_rate_K_per_km is None else self.lapse_rate_K_per_km)


@dataclass(frozen=True)
class StatedPeriod:
    """The identification period, from its start to its end [s since 1970-01-01T00:00Z]."""

    until_s: float | None = setting(None, "end; by default that of the record", read=moment)
    start_s: float | None = setting(None, "by default the start of the record", read=moment)

    @across("start", "until")
    def order(self) -> str | None:
        if self.start_s is None or self.until_s is None or self.start_s < self.until_s:
            return None
        return f"start {stamp_text(self.start_s)} must be before until {stamp_text(self.until_s)}"


@dataclass(frozen=True)
class CaseForm:
    """A case as its file states it."""

    name: str | None = setting(None, "of the enclosure; by default the file's name")
    rated_power_kW: float | None = setting(None, "of the turbine", above=0.0)
    provenance: Provenance = setting(Provenance.MEASURED, "of the readings", choices=tuple(Provenance))
    site: Site | None = setting(None, "location of the enclosure")
    source: tuple[Mapping[str, Any], ...] = setting((), "one for each file")
    identification: StatedPeriod = setting(StatedPeriod, "identification period")

    @property
    def rated_power_W(self) -> float | None:
        """[W]"""
        return None if self.rated_power_kW is None else 1e3 * self.rated_power_kW


@dataclass(frozen=True)
class StatedCase:
    """A case with its sources.

    sources: tables that can be read. weather: weather files that can be read. declared: every signal of a
    source that is used, with the number of the source. place: of the file or call in messages.
    """

    form: CaseForm
    sources: tuple[StatedSource, ...]
    weather: tuple[StatedWeather, ...]
    declared: dict[str, int]
    place: Place


def stated_case(content: dict[str, Any], place: Place) -> StatedCase:
    """The statements of a case; the faults of its form are added to those of `place`.

    content: the parsed TOML, or the equivalent made from arguments. place: of the case in messages.
    """
    form = read_form(CaseForm, content, place)
    if not content.get("source"):
        place.fault("names no source; expected one [[source]] for each file")
    tables: dict[int, StatedSource] = {}
    weather: list[StatedWeather] = []
    for block, table in enumerate(form.source):
        table_place = place.inside("source", block)
        if "format" not in table:
            tables[block] = read_form(StatedSource, table, table_place)
            continue
        weather.append(read_form(StatedWeather, table, table_place))
        if weather[-1].to_site_altitude and (form.site is None or form.site.altitude_m is None):
            table_place.fault("to_site_altitude needs altitude_m in [site]", "to_site_altitude")
    declared = _declared(tables, place)
    sources = tuple(source for source in tables.values() if source.file and source.time)
    readable = tuple(source for source in weather if source.file and source.format)
    return StatedCase(form, sources, readable, declared, place)


def _declared(tables: Mapping[int, StatedSource], place: Place) -> dict[str, int]:
    """Every signal of a source that is used, with the number of the source."""
    declared: dict[str, int] = {}
    compared: dict[str, int] = {}

    def entry(block: int, name: str) -> Place:
        return place.inside("source", block).inside("signals", entry=name)

    for block, source in tables.items():
        for name in source.signals:
            named = compared if source.compare else declared
            if name in named:
                remedy = ": to compare the two, state compare = true in one of the sources"
                entry(block, name).fault(
                    f"{name} is named a second time (first: {entry(named[name], name).at()}); a record has "
                    f"one series of a signal{remedy * (named is declared)}"
                )
            named.setdefault(name, block)
    return declared
