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
from hygrokf.data.input_paths import ON_CHANGE, on_change
from hygrokf.data.readings import detect_resolution
from hygrokf.data.signals import SIGNALS, to_si
from hygrokf.data.timestamps import duration_text, stamp_text, summer_time_holes
from hygrokf.drafting.layout import Export, read_export
from hygrokf.drafting.mapping import Assigned, Source, assigned, rated_power, source_of
from hygrokf.drafting.reshape import joined, prepared, same_layout
from hygrokf.drafting.stamps import sun_remark
from hygrokf.errors import HygrokfError
from hygrokf.physics.holds import LINEAR
from hygrokf.weather.archive import contents
from hygrokf.weather.reading import weather_form

_WIDTH = 100


class DraftFault(HygrokfError):
    """Exports that no case can be drafted from; the message holds every reason."""


@dataclass(frozen=True)
class DraftedSignal:
    """A signal of the draft.

    file: path in the case. score: 0 to 1. active: whether the case reads it; else it is commented out.
    compare: whether it is only compared with another source.
    """

    signal: str
    file: str
    column: str
    unit: str
    score: float
    active: bool
    compare: bool
    doubts: tuple[str, ...]


@dataclass(frozen=True)
class LeftColumn:
    """A column without a signal, and why."""

    file: str
    column: str
    why: str


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


@dataclass(frozen=True)
class Contents:
    """All that a drafted case says.

    name: of the enclosure. rated_kW: by the plateau of the power [kW], None where there is none.
    power_kW: its largest readings [kW], None where no power was found.
    site: latitude and longitude [deg], or None.
    """

    name: str
    sources: tuple[Source, ...]
    found: tuple[Assigned, ...]
    left: dict[tuple[int, str], str]
    weather: tuple[Weather, ...]
    rated_kW: float | None
    power_kW: float | None
    site: tuple[float, float] | None


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
            kind = weather_form(file)
            if kind is not None:
                weather.append(Weather(_relative(file, out), kind, _is_typical_year(file, kind)))
            else:
                tables.append(read_export(file))
        except TableFault as broken:
            faults += [fault if str(file) in fault else f"{file}: {fault}" for fault in broken.faults]
    together = joined(tables)
    faults += same_layout(together)
    sources: list[Source] = []
    for export in together:
        try:
            ready, column, chosen, doubts = prepared(export, turbine)
            sources.append(replace(source_of(ready, column), said=doubts, turbine=chosen))
        except TableFault as broken:
            faults += [f"{export.file}: {fault}" for fault in broken.faults]
    if turbine is not None and not faults and not any(one.turbine for one in sources):
        faults.append(
            f"--turbine {turbine}: expected an export of several turbines, found none; leave it out"
        )
    if faults:
        raise DraftFault("\n".join(faults))
    found, left = assigned(sources)
    name = next((one.turbine for one in sources if one.turbine), None)
    name = name or (sources[0].export.file.name.split(".")[0] if sources else out.stem)
    power = _power(sources, found)
    return _written(Contents(name, tuple(sources), tuple(found), left, tuple(weather), *power, site), out)


def _is_typical_year(file: Path, form: str) -> bool:
    """Whether the months of a weather file are of different years, or of none.  Raises TableFault."""
    if form != "epw":
        return form == "try"
    lines = b"\n".join(one.data for one in contents(file)[0] if one.kind == "epw").splitlines()
    return len({line.split(b",")[0] for line in lines[8:] if line.count(b",") > 20}) > 1


def _written(case: Contents, out: Path) -> Draft:
    """The draft, after its case file and the copies of tables are written."""
    copies: list[Path] = []
    placed: list[Source] = []
    for number, source in enumerate(case.sources):
        export, path = source.export, source.export.file
        if export.changes:
            path = _copy_name(path, out, copies)
            copies.append(path)
            export = replace(export, separator=";" if export.decimal == "," else ",", comment=None)
            text = export.cells.to_csv(index=False, sep=export.separator, lineterminator="\n")
            write_text_whole(path, text)
        said = (*source.said, *_zone_doubt(source, case.sources))
        if source.clock.timezone is None:  # its offsets may contradict its stamps
            time = source.clock.time
            said = (*source.said, *summer_time_holes(np.sort(time[np.isfinite(time)])))
        sun = None
        for one in (one.best for one in case.found if one.best.source == number):
            if one.signal == "global_horizontal_irradiance":
                sun = sun_remark(source.clock.time, source.values[one.column], case.site and case.site[1])
                break
        placed.append(replace(source, export=export, path=_relative(path, out), said=said, sun=sun))
    case = replace(case, sources=tuple(placed))
    write_text_whole(out, "\n".join((*_lines(case), "")))
    return Draft(
        str(out),
        tuple(map(str, copies)),
        tuple(
            DraftedSignal(
                one.best.signal,
                placed[one.best.source].path,
                one.best.column,
                one.best.unit,
                one.best.score,
                one.active,
                one.compare,
                one.doubts,
            )
            for one in case.found
        ),
        tuple(LeftColumn(placed[number].path, column, why) for (number, column), why in case.left.items()),
        tuple(
            f"{one.path}: {doubt}"
            for one in placed
            for doubt in (*one.clock.doubts, *one.said, *one.quality_doubts)
        ),
        _lacking(case),
    )


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


def _power(sources: list[Source], found: list[Assigned]) -> tuple[float | None, float | None]:
    """Rated power by the plateau, and the largest readings of the power [kW]."""
    for one in found:
        if one.best.signal == "active_power" and one.active and not one.compare:
            values = sources[one.best.source].values[one.best.column]
            shown = to_si(values[np.isfinite(values)], one.best.unit, "active_power") / 1e3
            return rated_power(values, one.best.unit), float(np.quantile(shown, 0.999))
    return None, None


def _relative(file: Path, out: Path) -> str:
    """Path of a file as the case names it."""
    return Path(os.path.relpath(file.absolute(), out.absolute().parent)).as_posix()


# --- the text of the case --------------------------------------------------------------------


def _lacking(case: Contents) -> tuple[str, ...]:
    """What a fit needs or would miss, and no active signal of the draft holds."""
    signals = {one.best.signal for one in case.found if one.active and not one.compare}
    lacks = []
    if not case.weather and "ambient_temperature" not in signals:
        lacks.append("no ambient temperature was found, and every model needs it: add its export")
    if not any(one.startswith("cabinet_") for one in signals):
        lacks.append("no reading of the cabinet was found; `hygrokf fit` needs one: add its export")
    humid = {one.partition("_")[0] for one in signals if "humidity" in one or "dew_point" in one}
    if "cabinet" in humid and "ambient" not in humid and not case.weather:
        lacks.append("no humidity of the air outside was found, which the hygric model needs: add its export")
    if "active_power" not in signals:
        lacks.append(
            "no active power was found: the whole record would count as standstill; add its export, "
            "or name its column"
        )
    return tuple(lacks)


def _lines(case: Contents) -> Iterator[str]:
    yield "# Drafted by `hygrokf init` from the exports below. Check what is marked `doubt`, then run"
    yield "# `hygrokf check` on this file. docs/reference/case_file.md describes all keys."
    yield f"name = {_text(case.name)}"
    if case.rated_kW is not None:
        yield f"rated_power_kW = {case.rated_kW:g}  # where the power stops rising; see the type plate"
    elif case.power_kW is not None:
        yield from _doubt(f"the power shows no plateau; its largest readings are {case.power_kW:.4g} kW")
        yield "# rated_power_kW = "
    yield ""
    if case.site is None:
        yield "# [site]  # gives the height of the sun, and the pressure of the air by altitude_m"
        yield "# latitude_deg = "
        yield "# longitude_deg = "
    else:
        yield "[site]"
        yield f"latitude_deg = {case.site[0]:g}"
        yield f"longitude_deg = {case.site[1]:g}"
    for lack in _lacking(case):
        yield from ("", *_doubt(lack))
    for number in range(len(case.sources)):
        for compare in (False, True):
            lines = [one for one in case.found if one.best.source == number and one.compare is compare]
            if any(one.active for one in lines):
                yield from ("", *_source(case, number, lines, compare))
            elif not compare:
                yield from ("", f"# {case.sources[number].path}: no signal was recognised; its columns:")
                yield from _left(case, number)
    for weather in case.weather:
        yield from ("", "[[source]]", f"file = {_text(weather.file)}", f'format = "{weather.format}"')
        if weather.typical:
            yield from _doubt("a typical year has no calendar year of its own: the year that it stands for")
            # the calendar year in the middle of the exports
            times = [float(np.nanmedian(one.clock.time)) for one in case.sources]
            yield f"year = {stamp_text(times[0])[:4] if times else 2019}"
    if case.sources:
        known = [one.clock.time[np.isfinite(one.clock.time)] for one in case.sources]
        start, end = float(min(map(np.min, known))), float(max(map(np.max, known)))
        yield from ("", "# [identification]  # the readings after `until` are kept to validate the model")
        yield f'# until = "{stamp_text(86400.0 * round((start + 0.7 * (end - start)) / 86400.0))}"'


def _source(case: Contents, number: int, lines: list[Assigned], compare: bool) -> Iterator[str]:
    source = case.sources[number]
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
    for doubt in () if compare else (*clock.doubts, *source.said):
        yield from _doubt(doubt)
    if clock.timezone is not None:
        yield f"timezone = {_text(clock.timezone)}"
    if clock.stamp != "instant":
        yield f"stamp = {_text(clock.stamp)}"
    usual = {"separator": ",", "decimal": ".", "thousands": "", "comment": None}
    stated = {name: getattr(export, name) for name in usual}
    yield from (f"{name} = {_text(one)}" for name, one in stated.items() if one != usual[name])
    texts = set().union(*(export.read(one.best.column)[1] for one in lines))
    if len(texts) > 8:
        yield from _doubt(f"{len(texts)} different texts among the readings are taken as missing")
    if export.missing or texts:
        yield f"missing = {json.dumps(sorted(texts.union(export.missing)), ensure_ascii=False)}"
    for doubt in () if compare else source.quality_doubts:
        yield from _doubt(doubt)
    if source.vocabulary.name and any(one.best.column in source.quality for one in lines):
        yield f"vocabulary = {_text(source.vocabulary.name)}"
    if compare:
        yield "compare = true  # only compared with the source above that has the same signal"
    for one in lines:
        yield from _signal(source, one)
    if not compare:
        yield from _left(case, number)


def _signal(source: Source, one: Assigned) -> Iterator[str]:
    best = one.best
    for doubt in one.doubts:
        yield from _doubt(doubt)
    values = source.values[best.column]
    resolution = detect_resolution(values)
    lines = source.clock.stamp == "instant" and SIGNALS[best.signal].hold_of_instants == LINEAR
    if lines and resolution and on_change(source.clock.time, values, resolution):
        yield from _doubt(f"{best.signal} {ON_CHANGE}")
    note = best.why + (f"; readings in steps of {resolution:g}" if resolution else "")
    quality = f", quality = {_text(source.quality.get(best.column, ''))}" * (best.column in source.quality)
    entry = f"signals.{best.signal} = {{ column = {_text(best.column)}, unit = {_text(best.unit)}{quality} }}"
    yield f"{'' if one.active else '# '}{entry}  # {note}"


def _left(case: Contents, number: int) -> Iterator[str]:
    rest = [f"{column} ({why})" for (source, column), why in case.left.items() if source == number]
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
