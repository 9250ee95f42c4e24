"""The form of a case, in a file or in the arguments of a call: its keys, their types, and where each is stated."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from hygrokf.cases.keys import Statement, expect_known_keys, stated_number, stated_positive, stated_text
from hygrokf.cases.weather_form import StatedWeather, stated_weather
from hygrokf.data.record import HOLDS, Site
from hygrokf.data.signals import SIGNALS, Signal, difference_to_si, fitting_units, unit_fault
from hygrokf.data.timestamps import duration, moment, signed_duration, stamp_text
from hygrokf.errors import suggestion

STAMPS = ("instant", "start", "middle", "end")
"""What a stamp marks: an instant, or a place in the interval that was averaged over."""

_CASE_KEYS = ("name", "rated_power_kW", "site", "source", "identification")
SITE_KEYS = ("latitude_deg", "longitude_deg", "altitude_m")
IDENTIFICATION_KEYS = ("until", "start")
SOURCE_KEYS = (
    "file",
    "time",
    "timezone",
    "stamp",
    "interval",
    "hold",
    "clock_uncertainty",
    "clock_correction",
    "separator",
    "decimal",
    "comment",
    "missing",
    "time_format",
    "ignore_offset",
    "compare",
    "signals",
)


@dataclass(frozen=True)
class ColumnSetting:
    """What may be stated of one signal beside its column and unit: all that it takes for one more is its row below.

    key: as stated. field: of `Series`, which takes the number. read: the number from what is stated; raises ValueError.
    to_si: (number, unit of the column, signal) -> number as the field has it.
    """

    key: str
    field: str
    read: Callable[[Any], float]
    to_si: Callable[[float, str, Signal], float]


def _size(value: Any) -> float:
    """A difference that is stated in the unit of the column."""
    size = stated_number(value)
    if size is None or size < 0.0:
        raise ValueError(f"expected a number ≥ 0 in the unit of the column, found {value!r}")
    return size


def _as_stated(number: float, unit: str, signal: Signal) -> float:
    """A number that has nothing to do with the unit of the column."""
    return number


COLUMN_SETTINGS = (
    ColumnSetting("accuracy", "accuracy", _size, difference_to_si),
    ColumnSetting("resolution", "resolution", _size, difference_to_si),
    ColumnSetting("response_time", "response_time_s", duration, _as_stated),
)
_COLUMN_KEYS = ("column", "unit", *(one.key for one in COLUMN_SETTINGS))


@dataclass(frozen=True)
class StatedColumn:
    """One signal of a source, as the case states it.

    signal: its row of the signal table. column: its name in the table. unit: of the column.
    settings: [SI] further arguments of its `Series`, of those in `COLUMN_SETTINGS`.
    """

    signal: Signal
    column: str
    unit: str
    settings: Mapping[str, float]


@dataclass(frozen=True)
class StatedSource:
    """One [[source]] of the case file, or one frame.

    file: relative to the case file, or the name of the frame. time: column of the stamps. columns: one for each signal.
    stamp: one of `STAMPS`. interval_s: [s] averaged over, or None: the step.
    hold: "linear", "zero-order" or None: as the stamp has it.
    clock_uncertainty_s: [s]. clock_correction_s: [s] added to the stamps. reading: further arguments of `hygrokf.data.table_readers.read_table`.
    compare: whether it is only held against the other sources.
    """

    file: str
    time: str
    columns: tuple[StatedColumn, ...]
    stamp: str
    interval_s: float | None
    hold: str | None
    clock_uncertainty_s: float | None
    clock_correction_s: float
    reading: dict[str, Any]
    compare: bool = False


@dataclass(frozen=True)
class StatedCase:
    """What a case states, as far as it is sound.

    name: of the enclosure. site: or None. rated_power_W: [W] or None.
    start_s, until_s: [s] limits of the identification period since 1970-01-01T00:00Z, or None.
    sources: that can be read. weather: sources that are weather files.
    declared: every signal named by a source that is used, with the number of its source.
    lines: where a key is stated.
    """

    name: str
    site: Site | None
    rated_power_W: float | None
    start_s: float | None
    until_s: float | None
    sources: tuple[StatedSource, ...]
    declared: dict[str, int]
    lines: Statement
    weather: tuple[StatedWeather, ...] = ()


def stated_case(content: dict[str, Any], lines: Statement, name: str) -> tuple[StatedCase, list[str]]:
    """What a case states, and every fault of its form.

    content: the parsed TOML, or the same made of arguments. lines: where its keys are stated. name: of the enclosure,
        where none is stated.
    """
    faults: list[str] = []
    expect_known_keys(content, _CASE_KEYS, "", lines, None, faults)
    name = stated_text(content, "name", lines, None, faults) or name
    site = _site(content.get("site"), lines, faults)
    rated = stated_positive(content, "rated_power_kW", lines, None, faults)
    start_s, until_s = _periods(content.get("identification"), lines, faults)
    sources, weather, declared = _sources(content.get("source"), site, lines, faults)
    case = StatedCase(
        name,
        site,
        None if rated is None else 1e3 * rated,
        start_s,
        until_s,
        tuple(sources),
        declared,
        lines,
        tuple(weather),
    )
    return case, faults


def _site(table: Any, lines: Statement, faults: list[str]) -> Site | None:
    if table is None:
        return None
    if not isinstance(table, dict):
        faults.append(f"{lines.at(None, 'site')}: expected a table {lines.table('site')}, found {table!r}")
        return None
    before = len(faults)
    expect_known_keys(table, SITE_KEYS, f" in {lines.table('site')}", lines, None, faults)
    for key in SITE_KEYS[:2]:
        if key not in table:
            faults.append(f"{lines.at(None, 'site')}: {lines.table('site')} needs {key}")
    numbers: dict[str, Any] = {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_m": None}
    for key in SITE_KEYS:
        if key in table:
            number = stated_number(table[key])
            if number is None:
                faults.append(f"{lines.at(None, key)}: {key} must be a number, found {table[key]!r}")
            else:
                numbers[key] = number
    try:
        site = Site(**numbers)
    except ValueError as outside:
        faults.append(f"{lines.at(None, 'latitude_deg', 'site')}: {outside}")
    return site if len(faults) == before else None


def _periods(table: Any, lines: Statement, faults: list[str]) -> tuple[float | None, float | None]:
    """Start and end of the identification period [s]."""
    if table is None:
        return None, None
    if not isinstance(table, dict):
        faults.append(f"{lines.name}: expected a table {lines.table('identification')}, found {table!r}")
        return None, None
    expect_known_keys(table, IDENTIFICATION_KEYS, f" in {lines.table('identification')}", lines, None, faults)
    moments: dict[str, float | None] = {"start": None, "until": None}
    for key in moments:
        if key in table:
            try:
                moments[key] = moment(table[key])
            except ValueError as wrong:
                faults.append(f"{lines.at(None, key)}: {key}: {wrong}")
    start_s, until_s = moments["start"], moments["until"]
    if start_s is not None and until_s is not None and start_s >= until_s:
        faults.append(
            f"{lines.at(None, 'start')}: start {stamp_text(start_s)} must be before until "
            f"{stamp_text(until_s)}"
        )
        return None, None
    return start_s, until_s


def _sources(
    tables: Any, site: Site | None, lines: Statement, faults: list[str]
) -> tuple[list[StatedSource], list[StatedWeather], dict[str, int]]:
    """The sources that can be read, weather files apart, and every signal named with the number of its source."""
    declared: dict[str, int] = {}
    compared: dict[str, int] = {}
    if not tables:
        faults.append(f"{lines.name}: names no source; expected one [[source]] for each file")
        return [], [], declared
    if not isinstance(tables, list) or not all(isinstance(one, dict) for one in tables):
        faults.append(f"{lines.at(None, 'source')}: write [[source]] with two brackets")
        tables = [tables] if isinstance(tables, dict) else []
    sources, weather = [], []
    for block, table in enumerate(tables):
        if "format" in table:
            found = stated_weather(table, site, lines, block, faults)
            weather += [] if found is None else [found]
            continue
        columns = _columns(table.get("signals"), lines, block, faults)
        before = compared if table.get("compare") is True else declared
        for name in table["signals"] if isinstance(table.get("signals"), dict) else ():
            if name in before and name in SIGNALS:
                other = lines.at(before[name], name).split(", ")[-1]
                faults.append(
                    f"{lines.at(block, name)}: {lines.signal(name)} is named a second time (first: "
                    f"{other}); a record has one series of a signal"
                    + (
                        ": to compare the two, state compare = true in one of the sources"
                        * (before is declared)
                    )
                )
            before.setdefault(name, block)
        source = _source(table, columns, lines, block, faults)
        if source is not None:
            sources.append(source)
    return sources, weather, declared


def _columns(table: Any, lines: Statement, block: int, faults: list[str]) -> tuple[StatedColumn, ...]:
    if not isinstance(table, dict) or not table:
        faults.append(
            f"{lines.at(block)}: this source names no signal; expected such as "
            'signals.cabinet_temperature = { column = "…", unit = "degC" }'
        )
        return ()
    columns = []
    for name, entry in table.items():
        where = lines.at(block, name)
        if name not in SIGNALS:
            faults.append(
                f'{where}: unknown signal "{name}"{suggestion(name, SIGNALS)}'
                " (docs/signals.md lists them all)"
            )
            continue
        if not isinstance(entry, dict):
            faults.append(f'{where}: {name} must be {{ column = "…", unit = "…" }}')
            continue
        before = len(faults)
        expect_known_keys(entry, _COLUMN_KEYS, f" in signals.{name}", lines, block, faults)
        for key in ("column", "unit"):
            value = entry.get(key)
            if not isinstance(value, str) or (key == "column" and not value):
                needed = f"{where}: {lines.signal(name)} needs {key}"
                needed += "" if value is None else f" as text, found {value!r}"
                if key == "unit":
                    needed += f"; units that fit: {', '.join(fitting_units(name))}"
                faults.append(needed)
        if isinstance(entry.get("unit"), str):
            wrong = unit_fault(entry["unit"], name)
            if wrong is not None:
                faults.append(f"{where}: {wrong}")
        settings = {}
        for one in COLUMN_SETTINGS:
            if one.key in entry:
                try:
                    settings[one] = one.read(entry[one.key])
                except ValueError as wrong:
                    faults.append(f"{where}: {one.key}: {wrong}")
        if len(faults) == before:
            row, unit = SIGNALS[name], entry["unit"]
            in_si = {one.field: one.to_si(number, unit, row) for one, number in settings.items()}
            columns.append(StatedColumn(row, entry["column"], unit, in_si))
    return tuple(columns)


def _source(
    table: dict[str, Any],
    columns: tuple[StatedColumn, ...],
    lines: Statement,
    block: int,
    faults: list[str],
) -> StatedSource | None:
    expect_known_keys(table, SOURCE_KEYS, " in [[source]]", lines, block, faults)
    words = {
        key: stated_text(table, key, lines, block, faults)
        for key in (
            "file",
            "time",
            "timezone",
            "time_format",
            "comment",
            "separator",
            "decimal",
        )
    }
    for key in ("file", "time"):
        if key not in table:
            faults.append(f"{lines.at(block)}: this source needs {key}")
    for key in ("separator", "comment", "decimal"):
        word = words[key]
        if word is not None and len(word) != 1:
            faults.append(f'{lines.at(block, key)}: {key} must be one character, found "{word}"')
            words[key] = None
    separator, decimal = words["separator"] or ",", words["decimal"] or "."
    if separator == decimal:
        faults.append(
            f"{lines.at(block, 'decimal', 'separator')}: separator and decimal are both "
            f'"{decimal}"; state another one of the two'
        )
    choices = {}
    for key, allowed in (("stamp", STAMPS), ("hold", HOLDS)):
        choice = choices[key] = stated_text(table, key, lines, block, faults)
        if choice is not None and choice not in allowed:
            faults.append(
                f"{lines.at(block, key)}: {key} must be one of {', '.join(allowed)}, found "
                f'"{choice}"{suggestion(choice, allowed)}'
            )
            choices[key] = None
    lengths: dict[str, float | None] = {"interval": None, "clock_uncertainty": None, "clock_correction": None}
    for key in lengths:
        if key in table:
            try:
                lengths[key] = (signed_duration if key == "clock_correction" else duration)(table[key])
            except ValueError as wrong:
                faults.append(f"{lines.at(block, key)}: {key}: {wrong}")
    stamp = choices["stamp"] or "instant"
    if lengths["interval"] is not None and stamp == "instant" and choices["hold"] != "zero-order":
        faults.append(
            f"{lines.at(block, 'interval')}: an interval needs to know where in it the stamp is: "
            'state stamp = "start", "middle" or "end"'
        )
    if lengths["interval"] == 0.0:
        faults.append(f"{lines.at(block, 'interval')}: interval must be longer than 0")
        lengths["interval"] = None
    missing = table.get("missing", [])
    if not isinstance(missing, list) or not all(isinstance(one, str) for one in missing):
        faults.append(
            f'{lines.at(block, "missing")}: missing must be a list of texts such as ["error"], '
            f"found {missing!r}"
        )
        missing = []
    ignore = table.get("ignore_offset", False)
    if not isinstance(ignore, bool):
        faults.append(
            f"{lines.at(block, 'ignore_offset')}: ignore_offset must be true or false, found {ignore!r}"
        )
    elif ignore and words["timezone"] is None:
        faults.append(
            f"{lines.at(block, 'ignore_offset')}: ignore_offset = true needs the timezone of the clock"
        )
    compare = table.get("compare", False)
    if not isinstance(compare, bool):
        faults.append(f"{lines.at(block, 'compare')}: compare must be true or false, found {compare!r}")
    if words["file"] is None or words["time"] is None:
        return None
    return StatedSource(
        file=words["file"],
        time=words["time"],
        columns=columns,
        stamp=stamp,
        interval_s=lengths["interval"],
        hold=choices["hold"],
        clock_uncertainty_s=lengths["clock_uncertainty"],
        clock_correction_s=lengths["clock_correction"] or 0.0,
        reading={
            "timezone": words["timezone"],
            "separator": separator,
            "decimal": decimal,
            "comment": words["comment"],
            "missing": tuple(missing),
            "time_format": words["time_format"],
            "ignore_offset": ignore is True and words["timezone"] is not None,
        },
        compare=compare is True,
    )
