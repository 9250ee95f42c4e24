"""The case file: which files, columns, units and clocks make up a record."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hygrokf.checks import mask
from hygrokf.masks import detect_resolution, order_readings
from hygrokf.readers import Table, TableFault, read_table
from hygrokf.record import HOLDS, Record, Series, Site
from hygrokf.signals import (
    SIGNALS,
    Signal,
    difference_to_si,
    fitting_units,
    in_words,
    suggestion,
    to_si,
    unit_fault,
)
from hygrokf.stamps import (
    duration,
    duration_text,
    modal_step,
    moment,
    period_text,
    stamp_text,
    summer_time_holes,
)

STAMPS = ("instant", "start", "middle", "end")
"""What a stamp marks: an instant, or a place in the interval that was averaged over."""

_CASE_KEYS = ("name", "rated_power_kW", "site", "source", "identification")
_SITE_KEYS = ("latitude_deg", "longitude_deg", "altitude_m")
_IDENTIFICATION_KEYS = ("until", "start")
_SOURCE_KEYS = (
    "file",
    "time",
    "timezone",
    "stamp",
    "interval",
    "hold",
    "clock_uncertainty",
    "separator",
    "decimal",
    "comment",
    "missing",
    "time_format",
    "ignore_offset",
    "signals",
)
_COLUMN_KEYS = ("column", "unit", "accuracy", "resolution")
_IDENTIFIABLE = (
    "cabinet_temperature",
    "cabinet_relative_humidity",
    "cabinet_absolute_humidity",
    "cabinet_dew_point_temperature",
)


class CaseFault(Exception):
    """A case that cannot be read; `faults` lists every reason, the message all of them."""

    def __init__(self, case: str, faults: Iterable[str]) -> None:
        self.faults = tuple(faults)
        count = f"{len(self.faults)} fault{'s' if len(self.faults) != 1 else ''}"
        listed = (f"  {number}. {fault}" for number, fault in enumerate(self.faults, 1))
        super().__init__("\n".join([f"{case}: {count}", *listed]))


@dataclass(frozen=True)
class _Column:
    """One signal of a source, as the case file states it; numbers in the column's own unit."""

    signal: Signal
    column: str
    unit: str
    accuracy: float | None
    resolution: float | None


@dataclass(frozen=True)
class _Source:
    """One [[source]] of the case file."""

    file: str
    time: str
    columns: tuple[_Column, ...]
    stamp: str
    interval_s: float | None
    hold: str | None
    clock_uncertainty_s: float
    reading: dict[str, Any]


def read_case(path: str | os.PathLike[str], *, cabinet: bool = True) -> Record:
    """Record of a case file: sources read, units in SI, clocks in UTC, doubtful readings masked.

    path: the TOML file; the files it names are relative to it. docs/case_file.md has its form.
    cabinet: whether there must be a cabinet signal to identify; False for drivers alone.

    What was masked or repaired is in the record's `warnings`.
    Raises CaseFault with all faults of the case file and of every source.
    """
    file = Path(path)
    text, content = _case_text(file)
    faults: list[str] = []
    lines = _Lines(file.name, text)
    _unknown_keys(content, _CASE_KEYS, "", lines, None, faults)
    name = _text(content, "name", lines, None, faults) or file.stem
    site = _site(content.get("site"), lines, faults)
    rated_W = _positive(content, "rated_power_kW", lines, None, faults)
    rated_W = None if rated_W is None else 1e3 * rated_W
    start_s, until_s = _periods(content.get("identification"), lines, faults)
    sources, declared = _sources(content.get("source"), lines, faults)
    if "ambient_temperature" not in declared:
        faults.append(
            f"{file.name}: no source names signals.ambient_temperature, the input that no model "
            "goes without"
        )
    if cabinet and not any(signal in declared for signal in _IDENTIFIABLE):
        faults.append(
            f"{file.name}: nothing in the cabinet to identify; expected one of signals."
            f"{', signals.'.join(_IDENTIFIABLE)}"
        )

    series: list[Series] = []
    warnings: list[str] = []
    provenance: dict[str, str] = {}
    whole = True
    for source in sources:
        try:
            table = read_table(
                file.parent / source.file,
                [one.column for one in source.columns],
                source.time,
                **source.reading,
            )
        except TableFault as broken:
            faults += [f"{source.file}: {fault}" for fault in broken.faults]
            whole = False
            continue
        provenance[source.file] = table.sha256
        found, said, wrong = _source_series(source, table, rated_W)
        warnings += [f"{source.file}: {one}" for one in said]
        faults += [f"{source.file}: {one}" for one in wrong]
        series += found
        whole = whole and not wrong
    unique = {one.signal: one for one in series}
    faults += _overlap_faults(tuple(unique.values()))
    record = Record(name, tuple(unique.values()), site, rated_W, None, tuple(warnings))
    if whole and series:
        faults += _period_faults(record, start_s, until_s, lines)
    if faults:
        raise CaseFault(str(path), faults)
    record = dataclasses.replace(
        record, until_s=until_s, provenance=tuple(provenance.items())
    )
    if start_s is not None:
        record = record.window(start_s, math.inf)
    record = mask(record)
    faults = _emptied(record, cabinet)
    if faults:
        raise CaseFault(str(path), faults)
    return record


def _case_text(file: Path) -> tuple[str, dict[str, Any]]:
    """Text and content of the case file."""
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        near = (
            [one.name for one in file.parent.glob("*.toml")]
            if file.parent.is_dir()
            else []
        )
        raise CaseFault(
            str(file), [f"no such case file{suggestion(file.name, near)}"]
        ) from None
    except OSError as refused:
        raise CaseFault(
            str(file), [f"cannot be read: {refused.strerror or refused}"]
        ) from None
    except UnicodeDecodeError:
        raise CaseFault(
            str(file), ["expected TOML text in UTF-8, found other bytes"]
        ) from None
    try:
        return text, tomllib.loads(text.replace("\r\n", "\n"))
    except tomllib.TOMLDecodeError as wrong:
        found = re.search(r"\(at line (\d+), column (\d+)\)", str(wrong))
        where = f"line {found[1]}, column {found[2]}: " if found else ""
        reason = re.sub(r"\s*\(at [^)]*\)", "", str(wrong))
        raise CaseFault(str(file), [f"{where}not valid TOML: {reason}"]) from None


class _Lines:
    """Finds the line of the case file on which a key stands, so that faults can name it."""

    def __init__(self, name: str, text: str) -> None:
        self.name = name
        self.lines = [line.split("#")[0] for line in text.splitlines()]
        heads = [
            number
            for number, line in enumerate(self.lines)
            if re.match(r"\s*\[\[\s*source\s*\]\]", line)
        ]
        ends = [
            next(
                (
                    other
                    for other in range(head + 1, len(self.lines))
                    if re.match(r"\s*\[(?!\s*source\s*\.)", self.lines[other])
                ),
                len(self.lines),
            )
            for head in heads
        ]
        self.blocks = list(zip(heads, ends, strict=True))

    def at(self, block: int | None, *keys: str) -> str:
        """ "case.toml, line 7", or the file's name alone where the line is not found.

        block: number of the [[source]], or None for the rest of the file.
        keys: the first of these that stands on a line gives the line.
        """
        inside = [
            number for first, last in self.blocks for number in range(first, last)
        ]
        if block is None:
            numbers = [
                number for number in range(len(self.lines)) if number not in set(inside)
            ]
        elif block < len(self.blocks):
            numbers = list(range(*self.blocks[block]))
        else:
            numbers = list(range(len(self.lines)))
        for key in keys:
            pattern = re.compile(
                rf"(?<![\w.-])(?:signals\.)?[\"']?{re.escape(key)}[\"']?\s*[.=\]]"
            )
            for number in numbers:
                if pattern.search(self.lines[number]):
                    return f"{self.name}, line {number + 1}"
        if block is not None and block < len(self.blocks):
            return f"{self.name}, line {self.blocks[block][0] + 1}"
        return self.name


def _unknown_keys(
    table: dict[str, Any],
    known: tuple[str, ...],
    of: str,
    lines: _Lines,
    block: int | None,
    faults: list[str],
) -> None:
    for key in table:
        if key not in known:
            faults.append(
                f'{lines.at(block, key)}: unknown key "{key}"{of}; expected '
                f"{', '.join(known)}{suggestion(key, known)}"
            )


def _text(
    table: dict[str, Any], key: str, lines: _Lines, block: int | None, faults: list[str]
) -> str | None:
    """A text that may be absent."""
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, str) and value:
        return value
    faults.append(
        f"{lines.at(block, key)}: {key} must be text in quotes, found {value!r}"
    )
    return None


def _number(value: Any) -> float | None:
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not math.isfinite(value)
    ):
        return None
    return float(value)


def _positive(
    table: dict[str, Any], key: str, lines: _Lines, block: int | None, faults: list[str]
) -> float | None:
    if key not in table:
        return None
    number = _number(table[key])
    if number is None or number <= 0.0:
        faults.append(
            f"{lines.at(block, key)}: {key} must be a number above 0, found {table[key]!r}"
        )
        return None
    return number


def _site(table: Any, lines: _Lines, faults: list[str]) -> Site | None:
    if table is None:
        return None
    if not isinstance(table, dict):
        faults.append(
            f"{lines.at(None, 'site')}: expected a table [site], found {table!r}"
        )
        return None
    before = len(faults)
    _unknown_keys(table, _SITE_KEYS, " in [site]", lines, None, faults)
    for key in _SITE_KEYS[:2]:
        if key not in table:
            faults.append(f"{lines.at(None, 'site')}: [site] needs {key}")
    for key, value in table.items():
        if key in _SITE_KEYS and _number(value) is None:
            faults.append(
                f"{lines.at(None, key)}: {key} must be a number, found {value!r}"
            )
    if len(faults) > before:
        return None
    try:
        return Site(**{key: float(value) for key, value in table.items()})
    except ValueError as outside:
        faults.append(f"{lines.at(None, 'site', 'latitude_deg')}: {outside}")
        return None


def _periods(
    table: Any, lines: _Lines, faults: list[str]
) -> tuple[float | None, float | None]:
    """Start and end of the identification period [s]."""
    if table is None:
        return None, None
    if not isinstance(table, dict):
        faults.append(
            f"{lines.name}: expected a table [identification], found {table!r}"
        )
        return None, None
    _unknown_keys(
        table, _IDENTIFICATION_KEYS, " in [identification]", lines, None, faults
    )
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
    tables: Any, lines: _Lines, faults: list[str]
) -> tuple[list[_Source], dict[str, int]]:
    """The sources that can be read, and every signal named with the number of its source."""
    declared: dict[str, int] = {}
    if not tables:
        faults.append(
            f"{lines.name}: names no source; expected one [[source]] for each file"
        )
        return [], declared
    if not isinstance(tables, list) or not all(isinstance(one, dict) for one in tables):
        faults.append(f"{lines.at(None, 'source')}: write [[source]] with two brackets")
        tables = [tables] if isinstance(tables, dict) else []
    sources = []
    for block, table in enumerate(tables):
        columns = _columns(table.get("signals"), lines, block, faults)
        for name in table["signals"] if isinstance(table.get("signals"), dict) else ():
            if name in declared and name in SIGNALS:
                other = lines.at(declared[name], name).split(", ")[-1]
                faults.append(
                    f"{lines.at(block, name)}: signals.{name} is named a second time (first: "
                    f"{other}); a record has one series of a signal"
                )
            declared.setdefault(name, block)
        source = _source(table, columns, lines, block, faults)
        if source is not None:
            sources.append(source)
    return sources, declared


def _columns(
    table: Any, lines: _Lines, block: int, faults: list[str]
) -> tuple[_Column, ...]:
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
        _unknown_keys(entry, _COLUMN_KEYS, f" in signals.{name}", lines, block, faults)
        for key in ("column", "unit"):
            value = entry.get(key)
            if not isinstance(value, str) or (key == "column" and not value):
                faults.append(
                    f"{where}: signals.{name} needs {key}"
                    + ("" if value is None else f" as text, found {value!r}")
                )
        if isinstance(entry.get("unit"), str):
            wrong = unit_fault(entry["unit"], name)
            if wrong is not None:
                faults.append(f"{where}: {wrong}")
        sizes = {}
        for key in ("accuracy", "resolution"):
            sizes[key] = _number(entry.get(key))
            if key in entry and (sizes[key] is None or sizes[key] < 0.0):
                faults.append(
                    f"{where}: {key} must be a number ≥ 0 in the unit of the column, found "
                    f"{entry[key]!r}"
                )
        if len(faults) == before:
            columns.append(
                _Column(SIGNALS[name], entry["column"], entry["unit"], **sizes)
            )
    return tuple(columns)


def _source(
    table: dict[str, Any],
    columns: tuple[_Column, ...],
    lines: _Lines,
    block: int,
    faults: list[str],
) -> _Source | None:
    _unknown_keys(table, _SOURCE_KEYS, " in [[source]]", lines, block, faults)
    words = {
        key: _text(table, key, lines, block, faults)
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
        if words[key] is not None and len(words[key]) != 1:
            faults.append(
                f'{lines.at(block, key)}: {key} must be one character, found "{words[key]}"'
            )
            words[key] = None
    separator, decimal = words["separator"] or ",", words["decimal"] or "."
    if separator == decimal:
        faults.append(
            f"{lines.at(block, 'decimal', 'separator')}: separator and decimal are both "
            f'"{decimal}"; state another one of the two'
        )
    choices = {}
    for key, allowed in (("stamp", STAMPS), ("hold", HOLDS)):
        choices[key] = _text(table, key, lines, block, faults)
        if choices[key] is not None and choices[key] not in allowed:
            faults.append(
                f"{lines.at(block, key)}: {key} must be one of {', '.join(allowed)}, found "
                f'"{choices[key]}"{suggestion(choices[key], allowed)}'
            )
            choices[key] = None
    lengths: dict[str, float | None] = {"interval": None, "clock_uncertainty": None}
    for key in lengths:
        if key in table:
            try:
                lengths[key] = duration(table[key])
            except ValueError as wrong:
                faults.append(f"{lines.at(block, key)}: {key}: {wrong}")
    stamp = choices["stamp"] or "instant"
    if (
        lengths["interval"] is not None
        and stamp == "instant"
        and choices["hold"] != "zero-order"
    ):
        faults.append(
            f"{lines.at(block, 'interval')}: an interval needs to know where in it the stamp is: "
            'state stamp = "start", "middle" or "end"'
        )
    if lengths["interval"] == 0.0:
        faults.append(f"{lines.at(block, 'interval')}: interval must be longer than 0")
        lengths["interval"] = None
    missing = table.get("missing", [])
    if not isinstance(missing, list) or not all(
        isinstance(one, str) for one in missing
    ):
        faults.append(
            f'{lines.at(block, "missing")}: missing must be a list of texts such as ["error"], '
            f"found {missing!r}"
        )
        missing = []
    ignore = table.get("ignore_offset", False)
    if not isinstance(ignore, bool):
        faults.append(
            f"{lines.at(block, 'ignore_offset')}: ignore_offset must be true or false, found "
            f"{ignore!r}"
        )
    elif ignore and words["timezone"] is None:
        faults.append(
            f"{lines.at(block, 'ignore_offset')}: ignore_offset = true needs the timezone of the "
            "clock"
        )
    if words["file"] is None or words["time"] is None:
        return None
    return _Source(
        file=words["file"],
        time=words["time"],
        columns=columns,
        stamp=stamp,
        interval_s=lengths["interval"],
        hold=choices["hold"],
        clock_uncertainty_s=lengths["clock_uncertainty"] or 0.0,
        reading={
            "timezone": words["timezone"],
            "separator": separator,
            "decimal": decimal,
            "comment": words["comment"],
            "missing": tuple(missing),
            "time_format": words["time_format"],
            "ignore_offset": ignore is True,
        },
    )


def _source_series(
    source: _Source, table: Table, rated_W: float | None
) -> tuple[list[Series], list[str], list[str]]:
    """Series of a source, warnings, faults."""
    warnings = list(table.warnings)
    time, values, said = order_readings(table.time, table.values)
    if not any("summer-time" in one for one in warnings):
        warnings += summer_time_holes(np.sort(table.time))
    warnings += said
    faults: list[str] = []
    step, regular = modal_step(time)
    found = []
    for one in source.columns:
        raw = values[one.column]
        wrong = _unit_mistaken(one, raw)
        if wrong is None and one.signal.name == "active_power" and rated_W is not None:
            wrong, hint = _power_mistaken(one, raw, rated_W)
            warnings += [hint] if hint else []
        if wrong is not None:
            faults.append(f'column "{one.column}": {wrong}')
            continue
        hold = source.hold
        if hold is None:
            # Between two directions the straight line may pass through all of the others.
            turning = one.signal.dimension == "angle"
            hold = (
                "linear" if source.stamp == "instant" and not turning else "zero-order"
            )
        length = source.interval_s
        if length is None and (source.stamp != "instant" or hold == "zero-order"):
            if not regular >= 0.5:
                faults.append(_no_step(source, step, regular))
                break
            length = step
        moved, length = _end_of_interval(time, length or 0.0, source.stamp, hold)
        resolution = (
            detect_resolution(raw) if one.resolution is None else one.resolution
        )
        found.append(
            Series(
                one.signal.name,
                moved,
                to_si(raw, one.unit, one.signal),
                hold,
                length,
                difference_to_si(resolution, one.unit, one.signal),
                None
                if one.accuracy is None
                else difference_to_si(one.accuracy, one.unit, one.signal),
                source.clock_uncertainty_s,
                f'{source.file}, column "{one.column}"',
            )
        )
    if source.interval_s is not None and source.interval_s > 1.5 * step:
        warnings.append(
            f"interval = {duration_text(source.interval_s)} is longer than the step of "
            f"{duration_text(step)}: means of overlapping intervals are no independent readings"
        )
    return found, warnings, faults


def _no_step(source: _Source, step: float, regular: float) -> str:
    found = "there is only one stamp"
    if math.isfinite(step):
        found = f"only {100 * regular:.0f} % of the steps are {duration_text(step)}"
    return (
        f"the length of the interval averaged over is not to be seen from the stamps ({found}): "
        'state it, such as interval = "10min"'
    )


def _end_of_interval(
    time: np.ndarray, length: float, stamp: str, hold: str
) -> tuple[np.ndarray, float]:
    """Times as a Series has them, and the interval's length [s]."""
    shift = {"instant": 0.0, "start": length, "middle": 0.5 * length, "end": 0.0}[stamp]
    if hold == "linear":
        # A mean to be joined by straight lines stands in the middle of its interval.
        return time + (0.0 if stamp == "instant" else shift - 0.5 * length), 0.0
    return time + shift, length


def _unit_mistaken(one: _Column, raw: np.ndarray) -> str | None:
    """Why the readings cannot be in the unit stated, or None."""
    finite = raw[np.isfinite(raw)]
    if not len(finite):
        return None
    row, unit = one.signal, one.unit
    if row.dimension == "fraction" and not row.also:
        plausible = finite[(finite >= 0.0) & (finite <= 110.0)]
        high = float(np.quantile(plausible, 0.995)) if len(plausible) else math.nan
        if unit == "%" and 0.0 < high <= 1.5:
            return (
                f"{row.name} is called %, but its readings reach only {high:.3g}: they look like "
                'fractions; state unit = "1"'
            )
        if unit == "1" and high > 1.5:
            return (
                f"{row.name} is called a fraction (unit 1), but its readings reach {high:.3g}: "
                'they look like per cent; state unit = "%"'
            )
    fits = _share_in_range(finite, unit, row)
    better = [
        other
        for other in fitting_units(row)
        if other != unit and _share_in_range(finite, other, row) > 0.5
    ]
    middle = float(np.median(finite))
    if (
        row.name == "ambient_temperature"
        and unit == "degC"
        and fits > 0.5
        and middle > 45.0
    ):
        fits, better = 0.0, ["degF"]
    if fits >= 0.5 or (fits > 0.0 and not better):
        return None
    limits = f"{in_words(row.low, row)} … {in_words(row.high, row)}"
    hint = f"; they would fit as {' or '.join(better)}" if better else ""
    return (
        f"{row.name} is called {unit}, but its readings (median {middle:.4g}) do not lie within "
        f"{limits}{hint}: correct the unit or the column"
    )


def _share_in_range(values: np.ndarray, unit: str, signal: Signal) -> float:
    converted = to_si(values, unit, signal)
    return float(np.mean((converted >= signal.low) & (converted <= signal.high)))


def _power_mistaken(
    one: _Column, raw: np.ndarray, rated_W: float
) -> tuple[str | None, str | None]:
    """Power that does not go with the rated power: a fault if impossible, a warning if doubtful."""
    finite = to_si(raw[np.isfinite(raw)], one.unit, one.signal)
    if not len(finite):
        return None, None
    high = float(np.quantile(finite, 0.995))
    text = (
        f"{one.signal.name} is called {one.unit} and reaches {high / 1e3:.4g} kW, "
        f"{high / rated_W:.3g} times the rated {rated_W / 1e3:g} kW"
    )
    if high > 10.0 * rated_W:
        return f"{text}: correct its unit or rated_power_kW", None
    if high > 1.3 * rated_W or 1e-4 < high / rated_W < 2e-3:
        return None, f"{text}: are its unit and rated_power_kW right?"
    return None, None


def _overlap_faults(series: tuple[Series, ...]) -> list[str]:
    """Sources that share no time with the cabinet's readings."""
    spans = {
        one.signal: (one.time[0] - one.interval_s, one.time[-1])
        for one in series
        if len(one)
    }
    cabinet = {
        signal: span for signal, span in spans.items() if signal in _IDENTIFIABLE
    }
    if not cabinet:
        return []
    first = min(span[0] for span in cabinet.values())
    last = max(span[1] for span in cabinet.values())
    apart: dict[str, list[str]] = {}
    for one in series:
        if one.signal in cabinet or one.signal not in spans:
            continue
        start, end = spans[one.signal]
        if start > last or end < first:
            file = one.source.split(", column")[0]
            apart.setdefault(f"{file} ({period_text(start, end)})", []).append(
                one.signal
            )
    return [
        f"no overlap: {', '.join(signals)} in {where} and the cabinet's readings "
        f"({period_text(first, last)}) share no time; check the files, and zone and offset of "
        "their stamps"
        for where, signals in apart.items()
    ]


def _period_faults(
    record: Record, start_s: float | None, until_s: float | None, lines: _Lines
) -> list[str]:
    faults = []
    for key, value in (("start", start_s), ("until", until_s)):
        if value is not None and not record.start_s < value < record.end_s:
            faults.append(
                f"{lines.at(None, key)}: {key} = {stamp_text(value)} is outside of the record "
                f"({period_text(record.start_s, record.end_s)})"
            )
    return faults


def _emptied(record: Record, cabinet: bool) -> list[str]:
    """Faults of a record that has no reading left where a model needs some."""
    faults = []
    needed = [("ambient_temperature",)]
    if cabinet:
        needed.append(tuple(signal for signal in _IDENTIFIABLE if signal in record))
    for signals in needed:
        there = [signal for signal in signals if signal in record]
        if not any(np.isfinite(record[signal].value).any() for signal in there):
            named = ", ".join(signals) or "the cabinet"
            said = [
                one
                for one in record.warnings
                if any(one.startswith(s) for s in signals)
            ]
            faults.append(
                f"no reading of {named} can be used"
                + (f": {'; '.join(said)}" if said else "; the columns hold no number")
            )
    return faults
