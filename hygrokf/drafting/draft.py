"""A case file drafted from exports."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.files import write_text_whole
from hygrokf.data.signals import to_si
from hygrokf.data.timestamps import summer_time_holes
from hygrokf.drafting.behaviour import rated_power
from hygrokf.drafting.case_text import Contents, Weather, case_text, lacking
from hygrokf.drafting.layout import Export, read_export
from hygrokf.drafting.mapping import Assigned, Source, assigned, source_of
from hygrokf.drafting.reshape import joined, prepared, same_layout
from hygrokf.drafting.stamps import noon_of, sun_remark
from hygrokf.errors import HygrokfError
from hygrokf.weather.archive import contents
from hygrokf.weather.reading import weather_form


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
    faults = _copies_among(exports, out)
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
    return _written(sources, found, left, weather, out, site)


def _is_typical_year(file: Path, form: str) -> bool:
    """Whether the months of a weather file are of different years, or of none.  Raises TableFault."""
    if form != "epw":
        return form == "try"
    lines = b"\n".join(one.data for one in contents(file)[0] if one.kind == "epw").splitlines()
    return len({line.split(b",")[0] for line in lines[8:] if line.count(b",") > 20}) > 1


def _copies_among(exports: Sequence[Path], out: Path) -> list[str]:
    """Faults of exports that the copies of this draft would replace: they are those of an earlier draft."""
    return [
        f"{one}: expected an export, found the name of the copy of {other.name} for {out.name}; "
        "leave it out, or remove it"
        for one in exports
        for other in exports
        if one.resolve() == (out.parent / f"{out.stem}_{other.name.split('.')[0]}.csv").resolve()
    ]


def _written(
    sources: list[Source],
    found: list[Assigned],
    left: dict[tuple[int, str], str],
    weather: list[Weather],
    out: Path,
    site: tuple[float, float] | None,
) -> Draft:
    """The draft, after its case file and the copies of tables are written."""
    copies: list[Path] = []
    placed: list[Source] = []
    for number, source in enumerate(sources):
        path = source.export.file
        export = source.export
        if export.changes:
            path = _copy_name(path, out, copies)
            copies.append(path)
            export = replace(export, separator=";" if export.decimal == "," else ",", comment=None)
            text = export.cells.to_csv(index=False, sep=export.separator, lineterminator="\n")
            write_text_whole(path, text)
        said = (*source.said, *_offset_doubt(source), *_zone_doubt(source, sources))
        sun = _sun(number, source, found, site)
        placed.append(replace(source, export=export, path=_relative(path, out), said=said, sun=sun))
    rated, largest = _power(sources, found)
    name = next((one.turbine for one in sources if one.turbine), None) or _name(sources, out)
    contents = Contents(
        name, tuple(placed), tuple(found), left, tuple(weather), rated, largest, site
    )
    write_text_whole(out, case_text(contents))
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
            for one in found
        ),
        tuple(LeftColumn(placed[number].path, column, why) for (number, column), why in left.items()),
        tuple(
            f"{one.path}: {doubt}"
            for one in placed
            for doubt in (*one.clock.doubts, *one.said, *one.quality_doubts)
        ),
        lacking(contents),
    )


def _copy_name(file: Path, out: Path, copies: list[Path]) -> Path:
    """Where the copy of an export goes; exports of one name in two folders get two copies."""
    stem = f"{out.stem}_{file.name.split('.')[0]}"
    names = (f"{stem}.csv", *(f"{stem}_{number}.csv" for number in range(2, len(copies) + 2)))
    return next(path for path in (out.parent / name for name in names) if path not in copies)


def _offset_doubt(source: Source) -> tuple[str, ...]:
    """Doubts of a clock whose offsets contradict its stamps."""
    if source.clock.timezone is not None:
        return ()
    time = source.clock.time
    return summer_time_holes(np.sort(time[np.isfinite(time)]))


def _zone_doubt(source: Source, sources: list[Source]) -> tuple[str, ...]:
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


def _sun(number: int, source: Source, found: list[Assigned], site: tuple[float, float] | None) -> str | None:
    for one in found:
        if one.best.source == number and one.best.signal == "global_horizontal_irradiance":
            noon = noon_of(source.clock.time, source.values[one.best.column])
            return sun_remark(noon, None if site is None else site[1])
    return None


def _name(sources: list[Source], out: Path) -> str:
    return sources[0].export.file.name.split(".")[0] if sources else out.stem


def _relative(file: Path, out: Path) -> str:
    """Path of a file as the case names it."""
    return Path(os.path.relpath(file.absolute(), out.absolute().parent)).as_posix()
