"""A case file drafted from exports: what was found, its doubts as comments, all columns that are left."""

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
from hygrokf.drafting.mapping import DraftedSignal, LeftColumn, Source, assigned, rated_power, source_of
from hygrokf.drafting.reshape import joined, prepared, same_layout
from hygrokf.drafting.stamps import sun_remark
from hygrokf.errors import HygrokfError
from hygrokf.physics.holds import LINEAR
from hygrokf.texts.record import DoubtCode
from hygrokf.texts.wording import duration_text, stamp_text
from hygrokf.weather.archive import contents
from hygrokf.weather.reading import form_of

_WIDTH = 100


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
