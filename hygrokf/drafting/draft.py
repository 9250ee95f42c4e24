"""Draft a case file from exports: the signals found, doubts about them as comments, and all unused columns.

Exports are converted to a form that a case can read: one turbine, one column for each quantity, and one
column of stamps.  A draft's `doubts` are choices that a person has to confirm.
"""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.files import DRAFT_DOUBT, write_text_whole
from hygrokf.data.input_paths import on_change
from hygrokf.data.readings import detect_resolution
from hygrokf.data.signals import SIGNALS, to_si
from hygrokf.data.timestamps import summer_time_holes
from hygrokf.drafting.layout import Export, read_export
from hygrokf.drafting.mapping import DraftedSignal, LeftColumn, Source, assign_signals, rated_power, source_of
from hygrokf.drafting.prepared_exports import join_exports, prepare_export, same_layout_faults
from hygrokf.drafting.stamps import sun_remark
from hygrokf.errors import HygrokfError
from hygrokf.physics.holds import LINEAR
from hygrokf.texts.record_codes import DoubtCode
from hygrokf.texts.wording import duration_text, stamp_text
from hygrokf.weather.archive import contents
from hygrokf.weather.reading import weather_format


class DraftFault(HygrokfError):
    """Exports that no case can be drafted from; the message holds every reason."""


@dataclass(frozen=True)
class Draft:
    """A drafted case: its file, copies of tables, signals with their columns, and columns left without a
    signal.

    doubts: choices that a person has to confirm.  lacks: sentences about signals that no export holds.
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

    exports: CSV, Parquet or Excel files, and weather files.
    out: the case file; copies go beside it.
    turbine: of exports that hold several.  site: latitude and longitude [deg].

    Raises DraftFault with the faults of all exports.
    """
    # a copy of this draft must not overwrite an export that is a copy of an earlier draft
    faults = [
        f"{file}: expected an export, found the name of the copy of {other.name} for {out.name}; "
        "leave it out, or remove it"
        for file in exports
        for other in exports
        if file.resolve() == (out.parent / f"{out.stem}_{other.name.split('.')[0]}.csv").resolve()
    ]
    tables: list[Export] = []
    weather: list[Weather] = []
    for file in exports:
        try:
            kind = weather_format(file)
            if kind is not None:
                weather.append(Weather(_relative(file, out), kind, _is_typical_year(file, kind)))
            else:
                tables.append(read_export(file))
        except TableFault as broken:
            faults += [fault if str(file) in fault else f"{file}: {fault}" for fault in broken.faults]
    joined_tables = join_exports(tables)
    faults += same_layout_faults(joined_tables)
    sources: list[Source] = []
    copies: list[Path] = []
    for export in joined_tables:
        try:
            export = prepare_export(export, turbine)
            if export.changes:
                copies.append(_copy_name(export.file, out, copies))
            case_file = copies[-1] if export.changes else export.file
            sources.append(source_of(export, _relative(case_file, out)))
        except TableFault as broken:
            faults += [f"{export.file}: {fault}" for fault in broken.faults]
    if turbine is not None and not faults and not any(source.export.turbine for source in sources):
        faults.append(
            f"--turbine {turbine}: expected an export of several turbines, found none; leave it out"
        )
    if faults:
        raise DraftFault("\n".join(faults))
    signals, unused = assign_signals({source.path: source for source in sources})
    sources = [_with_clock_doubts(source, sources, signals, site) for source in sources]
    changed = [source.export for source in sources if source.export.changes]
    for copy, export in zip(copies, changed, strict=True):
        text = export.cells.to_csv(index=False, sep=export.separator, lineterminator="\n")
        write_text_whole(copy, text)
    doubts = (
        f"{source.path}: {doubt}"
        for source in sources
        for doubt in (*source.clock.doubts, *source.export.doubts, *source.quality_doubts)
    )
    lacks = _missing_signals(signals, bool(weather))
    draft = Draft(str(out), tuple(map(str, copies)), tuple(signals), tuple(unused), tuple(doubts), lacks)
    write_text_whole(out, "\n".join((*_lines(draft, sources, weather, site), "")))
    return draft


def _is_typical_year(file: Path, form: str) -> bool:
    """Whether a weather file is a typical year: its months are of different years, or have no year.  Raises
    TableFault."""
    if form != "epw":
        return form == "try"
    lines = b"\n".join(content.data for content in contents(file)[0] if content.kind == "epw").splitlines()
    return len({line.split(b",")[0] for line in lines[8:] if line.count(b",") > 20}) > 1


def _with_clock_doubts(
    source: Source,
    sources: Sequence[Source],
    signals: Sequence[DraftedSignal],
    site: tuple[float, float] | None,
) -> Source:
    """Return a source with doubts about its time zone and a remark on the sun, prepared for its copy if it
    needs one."""
    export, time = source.export, source.clock.time
    doubts = (*export.doubts, *_zone_doubt(source, sources))
    if source.clock.timezone is None:  # the offsets of stamps may contradict the clock's summer time
        doubts = (*doubts, *summer_time_holes(np.sort(time[np.isfinite(time)])))
    export = replace(export, doubts=doubts)
    if export.changes:
        export = replace(export, separator=";" if export.decimal == "," else ",", comment=None)
    irradiance = (source.path, "global_horizontal_irradiance")
    column = next((signal.column for signal in signals if (signal.file, signal.signal) == irradiance), None)
    sun_text = None if column is None else sun_remark(time, source.values[column], site and site[1])
    return replace(source, export=export, sun=sun_text)


def _copy_name(file: Path, out: Path, copies: list[Path]) -> Path:
    """Return the path of the copy of an export; it is unique where two exports have the same name."""
    stem = f"{out.stem}_{file.name.split('.')[0]}"
    names = (f"{stem}.csv", *(f"{stem}_{number}.csv" for number in range(2, len(copies) + 2)))
    return next(path for path in (out.parent / name for name in names) if path not in copies)


def _zone_doubt(source: Source, sources: Sequence[Source]) -> tuple[str, ...]:
    """Return a doubt about a source's assumed time zone where other exports state theirs."""
    file_of_zone = {
        other.clock.timezone: other.export.file.name
        for other in sources
        if other.clock.timezone not in (None, source.clock.timezone) and not other.clock.zone_assumed
    }
    if not source.clock.zone_assumed or not file_of_zone:
        return ()
    listed = ", ".join(f'{file} is at "{zone}"' for zone, file in file_of_zone.items())
    zone = source.clock.timezone
    return (f"{listed}: state this file's zone if it is not {zone}; a wrong zone shifts all its readings",)


def _relative(file: Path, out: Path) -> str:
    """Return the path of a file as the case names it."""
    return Path(os.path.relpath(file.absolute(), out.absolute().parent)).as_posix()


# --- the text of the case --------------------------------------------------------------------
_COMMENT_WIDTH = 100


def _missing_signals(signals: Sequence[DraftedSignal], weather: bool) -> tuple[str, ...]:
    """Return sentences about signals that a fit needs or would profit from, and that the draft does not
    have."""
    names = {signal.signal for signal in signals if signal.active and not signal.compare}
    sentences = []
    if not weather and "ambient_temperature" not in names:
        sentences.append("no ambient temperature was found, and every model needs it: add its export")
    if not any(name.startswith("cabinet_") for name in names):
        sentences.append("no reading of the cabinet was found; `hygrokf fit` needs one: add its export")
    humid_places = {name.partition("_")[0] for name in names if "humidity" in name or "dew_point" in name}
    if "cabinet" in humid_places and "ambient" not in humid_places and not weather:
        sentences.append(
            "no humidity of the air outside was found, which the hygric model needs: add its export"
        )
    if "active_power" not in names:
        sentences.append(
            "no active power was found: the whole record would count as standstill; add its export, "
            "or name its column"
        )
    return tuple(sentences)


def _lines(
    draft: Draft,
    sources: Sequence[Source],
    weather: Sequence[Weather],
    site: tuple[float, float] | None,
) -> Iterator[str]:
    """Yield the lines of the drafted case file."""
    yield "# Drafted by `hygrokf init` from the exports below. Check what is marked `doubt`, then run"
    yield "# `hygrokf check` on this file. docs/reference/case_file.md describes all keys."
    name = next((source.export.turbine for source in sources if source.export.turbine), None)
    name_of_first = sources[0].export.file.name.split(".")[0] if sources else Path(draft.case).stem
    yield f"name = {_toml_string(name or name_of_first)}"
    for signal in draft.signals:
        if signal.signal == "active_power" and signal.active and not signal.compare:
            values = next(source.values[signal.column] for source in sources if source.path == signal.file)
            rated_kW = rated_power(values, signal.unit)
            if rated_kW is not None:
                yield f"rated_power_kW = {rated_kW:g}  # where the power stops rising; see the type plate"
                continue
            highest_kW = (
                np.quantile(to_si(values[np.isfinite(values)], signal.unit, signal.signal), 0.999) / 1e3
            )
            yield from _doubt(f"the power shows no plateau; its largest readings are {highest_kW:.4g} kW")
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
            source_and_compare = (source.path, compare)
            signals = [
                signal for signal in draft.signals if (signal.file, signal.compare) == source_and_compare
            ]
            if any(signal.active for signal in signals):
                yield from ("", *_source_lines(draft, source, signals, compare))
            elif not compare:
                yield from ("", f"# {source.path}: no signal was recognised; its columns:")
                yield from _unused_lines(draft, source)
    finite_times = [source.clock.time[np.isfinite(source.clock.time)] for source in sources]
    for weather_file in weather:
        quoted_file = _toml_string(weather_file.file)
        yield from ("", "[[source]]", f"file = {quoted_file}", f'format = "{weather_file.format}"')
        if weather_file.typical:
            yield from _doubt("a typical year has no calendar year: state the year of the other files")
            # the calendar year in the middle of the exports
            yield f"year = {stamp_text(float(np.median(finite_times[0])))[:4] if finite_times else 2019}"
    if sources:
        start_s, end_s = float(min(map(np.min, finite_times))), float(max(map(np.max, finite_times)))
        yield from ("", "# [identification]  # the readings after `until` are kept to validate the model")
        yield f'# until = "{stamp_text(86400.0 * round((start_s + 0.7 * (end_s - start_s)) / 86400.0))}"'


def _source_lines(
    draft: Draft, source: Source, signals: Sequence[DraftedSignal], compare: bool
) -> Iterator[str]:
    """Yield the lines of one [[source]]; compare: whether it is only compared with another one."""
    clock, export = source.clock, source.export
    known_times = clock.time[np.isfinite(clock.time)]
    missing_share = 1.0 - len(np.unique(known_times)) / max(1.0, np.ptp(known_times) / clock.step_s + 1.0)
    zone = "" if clock.timezone is None else " by its own clock"
    span = f"{stamp_text(known_times.min()).rstrip('Z')} to {stamp_text(known_times.max()).rstrip('Z')}{zone}"
    yield f"# {len(known_times)} rows, {span}, step {duration_text(clock.step_s)}" + (
        f", {100 * missing_share:.0f} % of the rows missing" if missing_share > 0.01 else ""
    )
    yield "[[source]]"
    if export.changes:
        yield from _comment(
            f"# a copy of {export.file.name}, in a form that a case can name: {'; '.join(export.changes)}"
        )
    yield f"file = {_toml_string(source.path)}"
    yield f"time = {_toml_string(clock.column)}"
    if clock.time_format is not None:
        yield f"time_format = {_toml_string(clock.time_format)}"
    for remark in filter(None, (*clock.remarks, source.sun)):
        yield from _comment(f"# {remark}")
    for doubt in () if compare else (*clock.doubts, *export.doubts):
        yield from _doubt(doubt)
    if clock.timezone is not None:
        yield f"timezone = {_toml_string(clock.timezone)}"
    if clock.stamp != "instant":
        yield f"stamp = {_toml_string(clock.stamp)}"
    defaults = {"separator": ",", "decimal": ".", "thousands": "", "comment": None}
    settings = {name: getattr(export, name) for name in defaults}
    yield from (
        f"{name} = {_toml_string(value)}" for name, value in settings.items() if value != defaults[name]
    )
    not_numbers = set().union(*(export.read(signal.column)[1] for signal in signals))
    if len(not_numbers) > 8:
        yield from _doubt(f"{len(not_numbers)} different texts among the readings are taken as missing")
    if export.missing or not_numbers:
        yield f"missing = {json.dumps(sorted(not_numbers.union(export.missing)), ensure_ascii=False)}"
    for doubt in () if compare else source.quality_doubts:
        yield from _doubt(doubt)
    if source.vocabulary.name and any(signal.column in source.quality for signal in signals):
        yield f"vocabulary = {_toml_string(source.vocabulary.name)}"
    if compare:
        yield "compare = true  # only compared with the source above that has the same signal"
    for signal in signals:
        yield from _signal_lines(source, signal)
    if not compare:
        yield from _unused_lines(draft, source)


def _signal_lines(source: Source, drafted: DraftedSignal) -> Iterator[str]:
    """Yield the lines of one signal with its doubts; it is a comment unless it is active."""
    for doubt in drafted.doubts:
        yield from _doubt(doubt)
    values = source.values[drafted.column]
    resolution = detect_resolution(values)
    is_interpolated = source.clock.stamp == "instant" and SIGNALS[drafted.signal].hold_of_instants == LINEAR
    if is_interpolated and resolution and on_change(source.clock.time, values, resolution):
        yield from _doubt(DoubtCode.ONLY_ON_CHANGE(signal=drafted.signal).text)
    remark = drafted.why + (f"; readings in steps of {resolution:g}" if resolution else "")
    quality_text = f", quality = {_toml_string(source.quality.get(drafted.column, ''))}" * (
        drafted.column in source.quality
    )
    column, unit = _toml_string(drafted.column), _toml_string(drafted.unit)
    entry = f"signals.{drafted.signal} = {{ column = {column}, unit = {unit}{quality_text} }}"
    yield f"{'' if drafted.active else '# '}{entry}  # {remark}"


def _unused_lines(draft: Draft, source: Source) -> Iterator[str]:
    """Yield a comment that lists the columns without a signal."""
    columns = [f"{column.column} ({column.why})" for column in draft.left if column.file == source.path]
    if columns:
        yield from _comment("# not used: " + ", ".join(columns))


def _toml_string(text: str) -> str:
    """Return a text as a TOML string."""
    return json.dumps(text, ensure_ascii=False)


def _doubt(text: str) -> list[str]:
    """Return the lines of a comment that marks a doubt."""
    return _comment(f"{DRAFT_DOUBT}{text}")


def _comment(text: str) -> list[str]:
    """Return the lines of a TOML comment; line breaks in the text become blanks, so that no text ends the
    comment."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return textwrap.wrap(
        plain, _COMMENT_WIDTH, subsequent_indent="#   ", break_long_words=False, break_on_hyphens=False
    )
