"""A case file drafted from exports: what was found, its doubts as comments, all columns that are left.

Exports are brought into the form that a case can name: one turbine, one column a quantity, one column of
stamps.
"""

from __future__ import annotations

import json
import os
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.files import DRAFT_DOUBT, write_text_whole
from hygrokf.data.input_paths import on_change
from hygrokf.data.quality import quality_columns
from hygrokf.data.readings import detect_resolution
from hygrokf.data.signals import SIGNALS, to_si
from hygrokf.data.timestamps import summer_time_holes
from hygrokf.drafting.layout import Export, is_value, read_export
from hygrokf.drafting.mapping import DraftedSignal, LeftColumn, Source, assigned, rated_power, source_of
from hygrokf.drafting.stamps import as_text, sun_remark, time_columns, time_of_day
from hygrokf.drafting.vocabulary import name_says, words_of
from hygrokf.errors import HygrokfError, suggestion
from hygrokf.physics.holds import LINEAR
from hygrokf.texts.record import DoubtCode
from hygrokf.texts.wording import duration_text, stamp_text
from hygrokf.weather.archive import contents
from hygrokf.weather.reading import form_of

if TYPE_CHECKING:
    import pandas


_TURBINE = re.compile(r"turbine|wtg| wec | wea |anlage|asset|device|station|maschine| unit id | plant ")
_TAG = re.compile(
    r" tag|signal|variable|entity|channel|kanal|messstelle|parameter| point| sensor|quantity|groesse|^ name $"
)
_VALUE = re.compile(r"value|wert|reading|messwert| state ")
_UNIT = re.compile(r"^ (unit|units|einheit) $")
_LOGGER_QUANTITIES = 3
"""Temperature, humidity and dew point: a logger has no more."""
_LABEL = re.compile(
    r"(?:^|[ _.\-])((?:wtg|wt|wea|wec|turbine|t|w|k|r)[ _\-]?0*\d{1,5})(?=[ _.\-]|$)", re.IGNORECASE
)


# -- exports in a form that a case can name ------------------------------------------------------------------
def prepared(export: Export, turbine: str | None) -> Export:
    """An export that a case can name, after selection of one turbine and reordering of its cells.

    turbine: to select, or None for the first.  Its `changes` say why a copy is needed.  Raises TableFault.
    """
    column, hours = time_columns(export)
    export = _one_turbine(export, column, hours, turbine)
    if hours is not None:
        of_day, ends = time_of_day(export.cells[hours])
        joined = export.cells[column].str.cat(of_day, sep=" ")
        cells = export.cells.drop(columns=[column, hours])
        column = "time_end" if ends else "time"
        named = cells.assign(**{column: joined})[[column, *cells]]
        export = _with(export, named, "date and time in two columns")
    export = _wide(export, column)
    text, was = as_text(export.cells[column])
    if was is not None:
        export = _with(export, export.cells.assign(**{column: text}), f"stamps in {was}")
    if not column.strip():
        cells = export.cells.rename(columns={column: "time"})
        export, column = _with(export, cells, "a column of stamps without a name"), "time"
    header = dict(zip(export.cells, export.names, strict=False))
    marks = quality_columns(list(export.cells), [one for one in export.cells if one != column]).values()
    if not export.changes and any(export.names.count(header.get(one, one)) > 1 for one in marks):
        export = _with(export, export.cells, "several columns of one name")
    return _one_label(replace(export, column=column), turbine)


def joined(exports: list[Export]) -> list[Export]:
    """Exports, those with the same columns joined to one: files of consecutive months or years."""
    import pandas as pd

    result: list[Export] = []
    for export in exports:
        same = [n for n, one in enumerate(result) if _continues(one, export)]
        if not same or export.changes:
            result.append(export)
            continue
        before = result[same[0]]
        cells = pd.concat([before.cells, export.cells], ignore_index=True)
        change = f"joined with {export.file.name}"
        missing = tuple(dict.fromkeys((*before.missing, *export.missing)))
        result[same[0]] = replace(before, cells=cells, missing=missing, changes=(*before.changes, change))
    return result


def same_layout(exports: list[Export]) -> list[str]:
    """Faults of exports that have the columns and the stamps of another one: they are of another turbine.

    Two loggers of one make have them too: they read little else than temperature and humidity.
    """
    faults = []
    for number, export in enumerate(exports):
        said = [name_says(name, unit) for name, unit in zip(export.names, export.units, strict=True)]
        readings = [one for one in said if one.quantity or one.signal]
        power = any("power" in one.signal for one in readings)
        logger = len(readings) <= _LOGGER_QUANTITIES and not power
        for before in exports[:number]:
            if before.names == export.names and not logger:
                faults.append(
                    f"{export.file}: expected one turbine, found the columns and stamps of "
                    f"{before.file} again; draft one case for each turbine"
                )
    return faults


def _continues(before: Export, export: Export) -> bool:
    """Whether an export has the columns of another one and hardly any of its stamps."""
    if before.names != export.names or before.decimal != export.decimal:
        return False
    stamps, _ = time_columns(export)
    return float(export.cells[stamps].isin(set(before.cells[stamps])).mean()) < 0.1


def _with(
    export: Export, cells: pandas.DataFrame, change: str, units: dict[str, str] | None = None
) -> Export:
    """An export with other cells, and why."""
    old = dict(zip(export.cells.columns, export.units, strict=True)) | (units or {})
    names = tuple(map(str, cells.columns))
    of_names = tuple(old.get(name, "") for name in names)
    return replace(export, cells=cells, names=names, units=of_names, changes=(*export.changes, change))


def _selected(export: Export, names: list[str], turbine: str | None, where: str) -> Export:
    """An export of several turbines with one of them chosen, by default the first, with a doubt.  Raises
    TableFault."""
    chosen = names[0] if turbine is None else turbine
    if chosen not in names:
        found = f"{', '.join(names[:20])}{suggestion(chosen, names)}"
        raise TableFault(f'{where}: expected the turbine "{chosen}", found {found}')
    if turbine is None:
        rest = ", ".join(names[1:8]) + (" …" if len(names) > 8 else "")
        doubt = f'turbine "{chosen}" is the first of {len(names)} ({rest}): --turbine selects another one'
        export = replace(export, doubts=(*export.doubts, doubt))
    return replace(export, turbine=chosen)


def _one_turbine(export: Export, column: str, hours: str | None, turbine: str | None) -> Export:
    """The rows of one turbine, where a column names several."""
    cells = export.cells
    keys = [one for one in cells if one not in (column, hours) and _TURBINE.search(words_of(one))]
    for key in keys:
        names = list(cells[key].dropna().unique())
        stamps = [column] if hours is None else [column, hours]
        if not 2 <= len(names) <= 1000 or cells.duplicated(stamps).mean() < 0.3:
            continue
        export = _selected(export, names, turbine, f'column "{key}"')
        rows = cells[cells[key] == export.turbine].drop(columns=[key]).reset_index(drop=True)
        return _with(export, rows, f'rows of turbine "{export.turbine}" alone')
    alone = turbine is not None and any(cells[key].nunique() == 1 for key in keys)
    return replace(export, turbine=turbine) if alone else export


def _wide(export: Export, column: str) -> Export:
    """One column a tag, from rows of stamp, tag and value; units of a column of units."""
    cells = export.cells
    rest = [one for one in cells if one != column]
    sample = {one: cells[one].dropna().iloc[:500] for one in rest}
    unit = next((one for one in rest if _UNIT.match(words_of(one))), None)
    numbers = [one for one in rest if len(sample[one]) and sample[one].map(is_value).mean() > 0.9]
    values = [one for one in numbers if _VALUE.search(words_of(one))] or (
        numbers if len(numbers) == 1 else []
    )
    if not values:
        return export
    quality = quality_columns(list(cells), values[:1]).get(values[0])
    tags = [one for one in rest if one not in (*numbers, unit, quality) and 2 <= cells[one].nunique() <= 500]
    tags.sort(key=lambda one: _TAG.search(words_of(one)) is None)
    tagged = bool(tags) and (
        cells[column].duplicated().mean() >= 0.3
        # each tag has stamps of its own where a row comes when its value changes
        or (len(numbers) == 1 and _TAG.search(words_of(tags[0])) and _VALUE.search(words_of(values[0])))
    )
    if not tagged:
        if unit is None or cells[unit].nunique() != 1:
            return export
        units = tuple(
            str(cells[unit].dropna().iloc[0]) if name == values[0] else given
            for name, given in zip(cells, export.units, strict=True)
        )
        return replace(export, units=units)
    tag = tags[0]
    rows = cells.dropna(subset=[tag, column])
    if rows[column].str.match(r"\d{4}-").all():
        rows = rows.sort_values(column, kind="stable")
    how = {"index": column, "columns": tag, "aggfunc": "first", "sort": False}
    table = rows.pivot_table(values=values[0], **how)
    if quality is not None:
        table = table.join(rows.pivot_table(values=quality, **how).add_suffix(" quality"))
    units_of = {} if unit is None else rows.dropna(subset=[unit]).groupby(tag)[unit].first().to_dict()
    table = table.reset_index().rename_axis(columns=None)
    return _with(export, table.where(table.notna(), None), "one row a value", units_of)


def _one_label(export: Export, turbine: str | None) -> Export:
    """The columns of one turbine, where the names of columns hold several."""
    cells = export.cells
    labels = {one: found[1] for one in cells if one != export.column and (found := _LABEL.search(one))}
    stems: dict[str, list[str]] = {}
    for name, label in labels.items():
        stem = name.replace(label, "", 1).strip(" _.-")
        if re.search(r"[A-Za-z]", stem):
            stems.setdefault(stem, []).append(label)
    names = list(dict.fromkeys(label for found in stems.values() if len(found) > 1 for label in found))
    if not names:
        return export
    before = export.turbine
    export = _selected(export, names, turbine, "names of columns")
    chosen = export.turbine or ""
    kept = [one for one in cells if labels.get(one) not in names or labels[one] == chosen]
    units = tuple(given for one, given in zip(cells, export.units, strict=True) if one in kept)
    # nothing moves in the file: the case names the columns of one turbine
    return replace(export, cells=cells[kept], units=units, label=chosen, turbine=before or chosen)


_WIDTH = 100


# -- the draft -----------------------------------------------------------------------------------------------
class DraftFault(HygrokfError):
    """Exports that no case can be drafted from; the message holds every reason."""


@dataclass(frozen=True)
class Draft:
    """A drafted case.

    case: path of the case file. copies: tables written beside it. doubts: of the clocks, of the selection
    and, from `hygrokf init`, of the readings.
    lacks: signals that a fit needs or would miss and that no export holds, in words.
    """

    case: str
    copies: tuple[str, ...]
    signals: tuple[DraftedSignal, ...]
    left: tuple[LeftColumn, ...]
    doubts: tuple[str, ...]
    lacks: tuple[str, ...]


@dataclass(frozen=True)
class Weather:
    """A weather file: its path in the case, its `format`, and whether it is a typical year."""

    file: str
    format: str
    typical: bool = False


def draft_case(
    exports: Sequence[Path],
    out: Path,
    *,
    turbine: str | None = None,
    site: tuple[float, float] | None = None,
) -> Draft:
    """Draft a case file from exports and write it, with copies of those tables that a case cannot name.

    exports: CSV, Parquet or Excel files, and weather files. out: the case file; copies go
        beside it.
    turbine: of exports that hold several. site: latitude and longitude [deg].

    Raises DraftFault with the faults of all exports.
    """
    # the copies of this draft would replace exports that are copies of an earlier one
    faults = [
        f"{one}: expected an export, found the name of the copy of {other.name} for {out.name}; "
        "leave it out, or remove it"
        for one in exports
        for other in exports
        if one.resolve() == (out.parent / f"{out.stem}_{other.name.split('.')[0]}.csv").resolve()
    ]
    tables: list[Export] = []
    weather: list[Weather] = []
    for file in exports:
        try:
            kind = form_of(file)
            if kind is not None:
                weather.append(Weather(_relative(file, out), kind, _is_typical_year(file, kind)))
            else:
                tables.append(read_export(file))
        except TableFault as broken:
            faults += [fault if str(file) in fault else f"{file}: {fault}" for fault in broken.faults]
    together = joined(tables)
    faults += same_layout(together)
    sources: list[Source] = []
    copies: list[Path] = []
    for export in together:
        try:
            export = prepared(export, turbine)
            if export.changes:
                copies.append(_copy_name(export.file, out, copies))
            named = copies[-1] if export.changes else export.file
            sources.append(source_of(export, _relative(named, out)))
        except TableFault as broken:
            faults += [f"{export.file}: {fault}" for fault in broken.faults]
    if turbine is not None and not faults and not any(one.export.turbine for one in sources):
        faults.append(
            f"--turbine {turbine}: expected an export of several turbines, found none; leave it out"
        )
    if faults:
        raise DraftFault("\n".join(faults))
    found, left = assigned({one.path: one for one in sources})
    sources = [_noted(one, sources, found, site) for one in sources]
    changed = [one.export for one in sources if one.export.changes]
    for copy, export in zip(copies, changed, strict=True):
        text = export.cells.to_csv(index=False, sep=export.separator, lineterminator="\n")
        write_text_whole(copy, text)
    doubts = (
        f"{one.path}: {doubt}"
        for one in sources
        for doubt in (*one.clock.doubts, *one.export.doubts, *one.quality_doubts)
    )
    lacks = _lacking(found, bool(weather))
    made = Draft(str(out), tuple(map(str, copies)), tuple(found), tuple(left), tuple(doubts), lacks)
    write_text_whole(out, "\n".join((*_lines(made, sources, weather, site), "")))
    return made


def _is_typical_year(file: Path, form: str) -> bool:
    """Whether the months of a weather file are of different years, or of none.  Raises TableFault."""
    if form != "epw":
        return form == "try"
    lines = b"\n".join(one.data for one in contents(file)[0] if one.kind == "epw").splitlines()
    return len({line.split(b",")[0] for line in lines[8:] if line.count(b",") > 20}) > 1


def _noted(
    source: Source,
    sources: Sequence[Source],
    found: Sequence[DraftedSignal],
    site: tuple[float, float] | None,
) -> Source:
    """A source with the doubts of its clock beside others and the sun's remark, in the form of its copy."""
    export, time = source.export, source.clock.time
    doubts = (*export.doubts, *_zone_doubt(source, sources))
    if source.clock.timezone is None:  # its offsets may contradict its stamps
        doubts = (*doubts, *summer_time_holes(np.sort(time[np.isfinite(time)])))
    export = replace(export, doubts=doubts)
    if export.changes:
        export = replace(export, separator=";" if export.decimal == "," else ",", comment=None)
    light = (one for one in found if (one.file, one.signal) == (source.path, "global_horizontal_irradiance"))
    column = next((one.column for one in light), None)
    sun = None if column is None else sun_remark(time, source.values[column], site and site[1])
    return replace(source, export=export, sun=sun)


def _copy_name(file: Path, out: Path, copies: list[Path]) -> Path:
    """Where the copy of an export goes; exports of one name in two folders get two copies."""
    stem = f"{out.stem}_{file.name.split('.')[0]}"
    names = (f"{stem}.csv", *(f"{stem}_{number}.csv" for number in range(2, len(copies) + 2)))
    return next(path for path in (out.parent / name for name in names) if path not in copies)


def _zone_doubt(source: Source, sources: Sequence[Source]) -> tuple[str, ...]:
    """A doubt of an assumed zone where other exports state theirs."""
    stated = {
        one.clock.timezone: one.export.file.name
        for one in sources
        if one.clock.timezone not in (None, source.clock.timezone) and not one.clock.zone_assumed
    }
    if not source.clock.zone_assumed or not stated:
        return ()
    others = ", ".join(f'{file} is at "{zone}"' for zone, file in stated.items())
    return (f"{others}: state this file's zone if it is not {source.clock.timezone}; a wrong one shifts it",)


def _relative(file: Path, out: Path) -> str:
    """Path of a file as the case names it."""
    return Path(os.path.relpath(file.absolute(), out.absolute().parent)).as_posix()


# --- the text of the case --------------------------------------------------------------------


def _lacking(found: Sequence[DraftedSignal], weather: bool) -> tuple[str, ...]:
    """What a fit needs or would miss, and no active signal of the draft holds."""
    signals = {one.signal for one in found if one.active and not one.compare}
    lacks = []
    if not weather and "ambient_temperature" not in signals:
        lacks.append("no ambient temperature was found, and every model needs it: add its export")
    if not any(one.startswith("cabinet_") for one in signals):
        lacks.append("no reading of the cabinet was found; `hygrokf fit` needs one: add its export")
    humid = {one.partition("_")[0] for one in signals if "humidity" in one or "dew_point" in one}
    if "cabinet" in humid and "ambient" not in humid and not weather:
        lacks.append("no humidity of the air outside was found, which the hygric model needs: add its export")
    if "active_power" not in signals:
        lacks.append(
            "no active power was found: the whole record would count as standstill; add its export, "
            "or name its column"
        )
    return tuple(lacks)


def _lines(
    draft: Draft,
    sources: Sequence[Source],
    weather: Sequence[Weather],
    site: tuple[float, float] | None,
) -> Iterator[str]:
    yield "# Drafted by `hygrokf init` from the exports below. Check what is marked `doubt`, then run"
    yield "# `hygrokf check` on this file. docs/reference/case_file.md describes all keys."
    name = next((one.export.turbine for one in sources if one.export.turbine), None)
    first = sources[0].export.file.name.split(".")[0] if sources else Path(draft.case).stem
    yield f"name = {_text(name or first)}"
    for one in draft.signals:
        if one.signal == "active_power" and one.active and not one.compare:
            values = next(source.values[one.column] for source in sources if source.path == one.file)
            rated_kW = rated_power(values, one.unit)
            if rated_kW is not None:
                yield f"rated_power_kW = {rated_kW:g}  # where the power stops rising; see the type plate"
                continue
            high = np.quantile(to_si(values[np.isfinite(values)], one.unit, one.signal), 0.999) / 1e3
            yield from _doubt(f"the power shows no plateau; its largest readings are {high:.4g} kW")
            yield "# rated_power_kW = "
    yield ""
    if site is None:
        yield "# [site]  # gives the height of the sun, and the pressure of the air by altitude_m"
        yield "# latitude_deg = "
        yield "# longitude_deg = "
    else:
        yield "[site]"
        yield f"latitude_deg = {site[0]:g}"
        yield f"longitude_deg = {site[1]:g}"
    for lack in draft.lacks:
        yield from ("", *_doubt(lack))
    for source in sources:
        for compare in (False, True):
            lines = [one for one in draft.signals if (one.file, one.compare) == (source.path, compare)]
            if any(one.active for one in lines):
                yield from ("", *_source(draft, source, lines, compare))
            elif not compare:
                yield from ("", f"# {source.path}: no signal was recognised; its columns:")
                yield from _left(draft, source)
    times = [one.clock.time[np.isfinite(one.clock.time)] for one in sources]
    for of_weather in weather:
        yield from ("", "[[source]]", f"file = {_text(of_weather.file)}", f'format = "{of_weather.format}"')
        if of_weather.typical:
            yield from _doubt("a typical year has no calendar year of its own: the year that it stands for")
            # the calendar year in the middle of the exports
            yield f"year = {stamp_text(float(np.median(times[0])))[:4] if times else 2019}"
    if sources:
        start, end = float(min(map(np.min, times))), float(max(map(np.max, times)))
        yield from ("", "# [identification]  # the readings after `until` are kept to validate the model")
        yield f'# until = "{stamp_text(86400.0 * round((start + 0.7 * (end - start)) / 86400.0))}"'


def _source(draft: Draft, source: Source, lines: Sequence[DraftedSignal], compare: bool) -> Iterator[str]:
    clock, export = source.clock, source.export
    finite = clock.time[np.isfinite(clock.time)]
    gone = 1.0 - len(np.unique(finite)) / max(1.0, np.ptp(finite) / clock.step_s + 1.0)
    zone = "" if clock.timezone is None else " by its own clock"
    span = f"{stamp_text(finite.min()).rstrip('Z')} to {stamp_text(finite.max()).rstrip('Z')}{zone}"
    yield f"# {len(finite)} rows, {span}, step {duration_text(clock.step_s)}" + (
        f", {100 * gone:.0f} % of the rows missing" if gone > 0.01 else ""
    )
    yield "[[source]]"
    if export.changes:
        yield from _comment(
            f"# a copy of {export.file.name}, in a form that a case can name: {'; '.join(export.changes)}"
        )
    yield f"file = {_text(source.path)}"
    yield f"time = {_text(clock.column)}"
    if clock.time_format is not None:
        yield f"time_format = {_text(clock.time_format)}"
    for remark in filter(None, (*clock.remarks, source.sun)):
        yield from _comment(f"# {remark}")
    for doubt in () if compare else (*clock.doubts, *export.doubts):
        yield from _doubt(doubt)
    if clock.timezone is not None:
        yield f"timezone = {_text(clock.timezone)}"
    if clock.stamp != "instant":
        yield f"stamp = {_text(clock.stamp)}"
    usual = {"separator": ",", "decimal": ".", "thousands": "", "comment": None}
    stated = {name: getattr(export, name) for name in usual}
    yield from (f"{name} = {_text(one)}" for name, one in stated.items() if one != usual[name])
    texts = set().union(*(export.read(one.column)[1] for one in lines))
    if len(texts) > 8:
        yield from _doubt(f"{len(texts)} different texts among the readings are taken as missing")
    if export.missing or texts:
        yield f"missing = {json.dumps(sorted(texts.union(export.missing)), ensure_ascii=False)}"
    for doubt in () if compare else source.quality_doubts:
        yield from _doubt(doubt)
    if source.vocabulary.name and any(one.column in source.quality for one in lines):
        yield f"vocabulary = {_text(source.vocabulary.name)}"
    if compare:
        yield "compare = true  # only compared with the source above that has the same signal"
    for one in lines:
        yield from _signal(source, one)
    if not compare:
        yield from _left(draft, source)


def _signal(source: Source, one: DraftedSignal) -> Iterator[str]:
    for doubt in one.doubts:
        yield from _doubt(doubt)
    values = source.values[one.column]
    resolution = detect_resolution(values)
    lines = source.clock.stamp == "instant" and SIGNALS[one.signal].hold_of_instants == LINEAR
    if lines and resolution and on_change(source.clock.time, values, resolution):
        yield from _doubt(DoubtCode.ONLY_ON_CHANGE(signal=one.signal).text)
    note = one.why + (f"; readings in steps of {resolution:g}" if resolution else "")
    quality = f", quality = {_text(source.quality.get(one.column, ''))}" * (one.column in source.quality)
    entry = f"signals.{one.signal} = {{ column = {_text(one.column)}, unit = {_text(one.unit)}{quality} }}"
    yield f"{'' if one.active else '# '}{entry}  # {note}"


def _left(draft: Draft, source: Source) -> Iterator[str]:
    rest = [f"{one.column} ({one.why})" for one in draft.left if one.file == source.path]
    if rest:
        yield from _comment("# not used: " + ", ".join(rest))


def _text(text: str) -> str:
    """A TOML string."""
    return json.dumps(text, ensure_ascii=False)


def _doubt(text: str) -> list[str]:
    return _comment(f"{DRAFT_DOUBT}{text}")


def _comment(text: str) -> list[str]:
    """Lines of a comment; no text of a file can end it."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return textwrap.wrap(
        plain, _WIDTH, subsequent_indent="#   ", break_long_words=False, break_on_hyphens=False
    )
