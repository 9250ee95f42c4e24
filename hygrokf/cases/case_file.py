"""The case file: which files, columns, units and clocks make up a record."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from hygrokf.cases.doubts import IDENTIFIABLE, no_overlap, power_beside_rated
from hygrokf.cases.form import StatedCase, StatedSource, StatedWeather, stated_case
from hygrokf.data.columns import FileColumns, TableFault
from hygrokf.data.files import DRAFT_DOUBT
from hygrokf.data.input_paths import on_change
from hygrokf.data.probes import copies, temperatures_of
from hygrokf.data.readings import detect_resolution, mask, order_readings
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SWITCHED, difference_to_si, to_si, unit_mistaken
from hygrokf.data.table_readers import read_table
from hygrokf.data.timestamps import modal_step, summer_time_holes
from hygrokf.data.toml_form import FormFault, Place, lines_of, read_toml
from hygrokf.physics.holds import LINEAR, MEAN, PREVIOUS
from hygrokf.texts.record import DoubtCode, RecordCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import duration_text, period_text, stamp_text
from hygrokf.weather.joining import follows, join_records
from hygrokf.weather.reading import read_weather_file


class CaseFault(FormFault):
    """A case that cannot be read; `faults` lists every reason, the message contains all of them."""


def read_case(path: str | os.PathLike[str], *, cabinet: bool = True, ambient: bool = True) -> Record:
    """Read the record that a case file describes, in SI units and UTC, with doubtful readings masked.

    path: the TOML file; the files that it names are relative to it.
        docs/reference/case_file.md describes its form.
    cabinet: whether a cabinet signal to identify is required; False for drivers alone.
    ambient: whether an ambient temperature is required; False for a power alone.

    Returns the record; its `warnings` list what was masked or repaired, and doubts of a draft that are open.
    Raises CaseFault with all faults of the case file and of every source.
    """
    file = Path(path)
    try:
        text, content = read_toml(file, CaseFault)
    except CaseFault as fault:
        other = _other_than_case(file)
        raise CaseFault(file, [other] if other else fault.faults) from None
    case = stated_case({"name": file.stem, **content}, Place(file=file.name, lines=lines_of(text)))

    def table(source: StatedSource) -> FileColumns:
        return read_table(file.parent / source.file, source.meanings, source.time, source, source.quality)

    def weather(stated: StatedWeather) -> Record:
        return _weather(stated, file.parent, case)

    record = record_of(case, table, str(path), weather=weather, cabinet=cabinet, ambient=ambient)
    return dataclasses.replace(record, warnings=(*_open_doubts(file.name, text), *record.warnings))


_REMARK = re.compile(r"#(?!\s?(\[|[\w.\"'-]+\s*=))")
"""A comment that is no table or key of TOML taken out of force."""


def _open_doubts(name: str, text: str) -> tuple[str, ...]:
    """A warning about the doubts of a draft that stand above lines in force, with their line numbers."""
    lines = [one.strip() for one in text.splitlines()]
    found = []
    for number, line in enumerate(lines, 1):
        below = next((one for one in lines[number:] if one and not _REMARK.match(one)), "#")
        if line.startswith(DRAFT_DOUBT) and not below.startswith("#"):
            found.append(str(number))
    if not found:
        return ()
    one_or_more = f"a doubt of its draft is open, line {found[0]}"
    if len(found) > 1:
        one_or_more = f"{len(found)} doubts of its draft are open, lines {', '.join(found)}"
    return (f'{name}: {one_or_more}: settle what is doubted, then delete the comment "{DRAFT_DOUBT}…"',)


def record_of(
    case: StatedCase,
    table: Callable[[StatedSource], FileColumns],
    head: str,
    *,
    weather: Callable[[StatedWeather], Record] | None = None,
    cabinet: bool,
    ambient: bool,
) -> Record:
    """Record of a stated case, from files or frames: units in SI, clocks in UTC, doubtful readings masked.

    case: as stated. table: reads a source; raises TableFault. head: first words of a CaseFault's message.
    weather: reads a weather file, for cases that name any; raises TableFault.
    cabinet, ambient: as for `read_case`.

    Raises CaseFault with all faults.
    """
    faults = [*case.place.faults, *_undeclared(case, cabinet, ambient)]
    period = case.form.identification
    series: list[Series] = []
    compared: list[Series] = []
    warnings: list[str] = []
    files: dict[str, str] = {}
    headers: dict[str, tuple[str, ...]] = {}
    doubts: list[Statement] = []
    whole = True
    for source in case.sources:
        try:
            read = table(source)
        except TableFault as broken:
            faults += [f"{source.file}: {fault}" for fault in broken.faults]
            whole = False
            continue
        headers[source.file] = read.header
        if read.sha256:
            files[source.file] = read.sha256
        found, said, wrong = _source_series(source, read, case.form.rated_power_W)
        warnings += [f"{source.file}: {one}" for one in said]
        doubts += _quality_doubts(source, read)
        faults += [f"{source.file}: {one}" for one in wrong]
        (compared if source.compare else series).extend(found)
        whole = whole and not wrong
    reads: list[tuple[StatedWeather, Record]] = []
    if weather is not None:
        reads, said, wrong = _weathers(case, weather)
        warnings += said
        faults += wrong
        whole = whole and not wrong
    for stated, brought in reads:
        files.update(brought.files)
        used = set(case.declared) | {one.signal for one in series}
        series += [one for one in brought.series if not stated.compare and one.signal not in used]
        compared += [one for one in brought.series if stated.compare or one.signal in used]
    unique = {one.signal: one for one in series}
    second = {one.signal: one for one in reversed(compared)}
    merged = tuple(unique.values())
    faults += [one.text for one in (*no_overlap(merged), *copies(merged))]
    record = Record(
        case.form.name or "record",
        merged,
        case.form.site,
        case.form.rated_power_W,
        warnings=tuple(warnings),
        compared=tuple(second.values()),
        doubts=(*doubts, *_split_probes(case, headers)),
        provenance=case.form.provenance,
    )
    if whole and series:
        faults += _period_faults(record, case)
    if faults:
        raise CaseFault(head, faults)
    record = dataclasses.replace(record, until_s=period.until_s, files=tuple(files.items()))
    if period.start_s is not None:
        record = record.window(period.start_s, math.inf)
    raw, record = record, mask(record)
    faults = _emptied(raw, record, cabinet, ambient)
    if faults:
        raise CaseFault(head, faults)
    return record


def _quality_doubts(source: StatedSource, read: FileColumns) -> Iterator[Statement]:
    """Doubts about the marks of quality beside a source's readings."""
    for one in source.columns:
        if one.column in read.judged and (doubt := read.judged[one.column].doubt):
            yield DoubtCode.QUALITY_DOUBTED(signal=one.signal.name, file=source.file, doubt=doubt)


def _split_probes(case: StatedCase, headers: Mapping[str, tuple[str, ...]]) -> Iterator[Statement]:
    """Doubts of places whose humidity is of one probe and whose temperature of another one."""
    used = {
        column.signal.name: (source.file, column.column)
        for source in reversed(case.sources)
        if not source.compare
        for column in source.columns
    }
    for place in ("cabinet", "ambient"):
        warm, moist = used.get(f"{place}_temperature"), used.get(f"{place}_relative_humidity")
        if warm is None or moist is None:
            continue
        file = moist[0]
        own = temperatures_of(moist[1], headers.get(file, ()))
        if len(own) == 1 and warm != (file, own[0]):
            yield DoubtCode.OTHER_PROBE(
                temperature=f"{place}_temperature", temperature_file=warm[0], temperature_column=warm[1],
                humidity=f"{place}_relative_humidity", humidity_file=file, humidity_column=moist[1],
                own=own[0],
            )  # fmt: skip


def _undeclared(case: StatedCase, cabinet: bool, ambient: bool) -> list[str]:
    """Faults of a case that lacks the signals a model needs."""
    name, faults = case.place.file, []
    unheard = "ambient_temperature" not in case.declared and all(one.compare for one in case.weather)
    if ambient and unheard:
        faults.append(f"{name}: no source names ambient_temperature, the input that every model needs")
    if cabinet and not any(one in case.declared for one in IDENTIFIABLE):
        faults.append(
            f"{name}: nothing in the cabinet to identify; expected one of {', '.join(IDENTIFIABLE)}"
        )
    return faults


def _weathers(
    case: StatedCase, weather: Callable[[StatedWeather], Record]
) -> tuple[list[tuple[StatedWeather, Record]], list[str], list[str]]:
    """Records of the weather files, with consecutive files joined; warnings; faults."""
    reads: list[tuple[StatedWeather, Record]] = []
    warnings: list[str] = []
    faults: list[str] = []
    for stated in case.weather:
        try:
            read = weather(stated)
        except TableFault as broken:
            faults += [f"{stated.file}: {fault}" for fault in broken.faults]
            continue
        warnings += [f"{stated.file}: {one}" for one in read.warnings]
        read = dataclasses.replace(read, warnings=())
        for place, (before, earlier) in enumerate(reads):
            # such as one file a year, each continuing the previous one
            if (before.format, before.compare) == (stated.format, stated.compare) and follows(earlier, read):
                try:
                    made = join_records((earlier, read), earlier.name)
                except TableFault as broken:
                    faults += [f"{before.file} and {stated.file}: {fault}" for fault in broken.faults]
                    break
                warnings += [f"{before.file} and {stated.file}: {one}" for one in made.warnings]
                reads[place] = (before, dataclasses.replace(made, warnings=()))
                break
        else:
            reads.append((stated, read))
    return reads, warnings, faults


_TABLES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".nc", ".xlsx")


def _other_than_case(file: Path) -> str:
    """The likely kind of a file that is not TOML, a result or a table; empty where it is unclear."""
    kind = "a table, expected a case file that names it" * (file.suffix.lower() in _TABLES and file.is_file())
    with suppress(OSError, ValueError, RecursionError):
        if isinstance(held := json.loads(file.read_bytes()), dict):
            result = {"design", "parameters"} <= set(held)
            kind = f"{'a result of `hygrokf fit`' if result else 'JSON'}, expected a case file"
    return f"is {kind} (docs/reference/case_file.md)" if kind else ""


def _weather(stated: StatedWeather, folder: Path, case: StatedCase) -> Record:
    """The record of a weather file, with sources named as in the case file."""
    read = read_weather_file(
        folder / stated.file,
        stated.format,
        site=case.form.site,
        year=stated.year,
        altitude_m=stated.altitude_m,
        to_site_altitude=stated.to_site_altitude,
        lapse_rate=stated.lapse_rate,
    )
    name = Path(stated.file).name
    return dataclasses.replace(
        read,
        series=tuple(
            dataclasses.replace(
                one,
                time=one.time + stated.clock_correction_s,
                clock_uncertainty_s=stated.clock_uncertainty_s,
                source=stated.file + one.source.removeprefix(name),
            )
            for one in read.series
        ),
        files=tuple((stated.file, digest) for _, digest in read.files),
    )


def _source_series(
    source: StatedSource, table: FileColumns, rated_W: float | None
) -> tuple[list[Series], list[str], list[str]]:
    """Series of a source; warnings; faults."""
    warnings = list(table.warnings)
    time, values, said = order_readings(table.time, table.values)
    if not table.summer_time:
        warnings += summer_time_holes(np.sort(table.time))
    warnings += said
    faults: list[str] = []
    found = []
    given = {name: np.isfinite(one) for name, one in values.items()}
    single = np.sum([*given.values()], axis=0) == 1
    # where readings come one by one, each in a row of its own, an empty cell is no missing reading
    apart = len(given) > 1 and all(np.sum(single & one) > 0.9 * np.sum(one) for one in given.values())
    step, regular = modal_step(time)
    for one in source.columns:
        rows = given[one.column] if apart else slice(None)
        own, raw = time[rows], values[one.column][rows]
        step, regular = modal_step(own)
        wrong = unit_mistaken(raw, one.unit, one.signal)
        if wrong is None and one.signal.name == "active_power" and rated_W is not None:
            power_W = to_si(raw[np.isfinite(raw)], one.unit, one.signal)
            times, beside = power_beside_rated(power_W, rated_W)
            if times > 10.0:
                wrong = RecordCode.POWER_IN_OTHER_UNIT(unit=one.unit, beside=beside)
        if wrong is not None:
            faults.append(f'column "{one.column}": {wrong.text}')
            continue
        hold = source.hold or (one.signal.hold_of_instants if source.stamp == "instant" else MEAN)
        length = source.interval_s
        if length is None and (source.stamp != "instant" or hold == MEAN):
            if not regular >= 0.5:
                steps = "there is only one stamp"
                if math.isfinite(step):
                    steps = f"only {100 * regular:.0f} % of the steps are {duration_text(step)}"
                faults.append(
                    f"the stamps do not show the length of the averaging interval ({steps}): "
                    'state it, such as interval = "10min"'
                )
                break
            length = step
        length = length or 0.0
        shift = {"instant": 0.0, "start": length, "middle": 0.5 * length, "end": 0.0}[source.stamp]
        if hold == LINEAR and source.stamp != "instant":
            # a mean that is joined by straight lines is placed in the middle of its interval
            shift -= 0.5 * length
        moved = own + source.clock_correction_s + shift
        settings: dict[str, Any] = dict(one.settings)
        if "resolution" not in settings:
            settings["resolution"] = difference_to_si(detect_resolution(raw), one.unit, one.signal)
        if hold == PREVIOUS:
            until_next = one.signal.name in SWITCHED and on_change(own, raw)
            settings["longest_hold_s"] = source.longest_hold_s or (math.inf if until_next else None)
            settings["lost"] = source.lost
        try:
            found.append(
                Series(
                    one.signal.name,
                    moved,
                    to_si(raw, one.unit, one.signal),
                    hold,
                    length if hold == MEAN else 0.0,
                    clock_uncertainty_s=source.clock_uncertainty_s,
                    source=f'{source.file}, column "{one.column}"',
                    **settings,
                )
            )
        except ValueError as impossible:
            faults.append(f'column "{one.column}": {impossible}')
    if source.interval_s is not None and source.interval_s > 1.5 * step:
        warnings.append(
            f"interval = {duration_text(source.interval_s)} is longer than the step of "
            f"{duration_text(step)}: means of overlapping intervals are not independent readings"
        )
    return found, warnings, faults


def _period_faults(record: Record, case: StatedCase) -> list[str]:
    faults = []
    period = case.form.identification
    for key, value in (("start", period.start_s), ("until", period.until_s)):
        if value is not None and not record.start_s < value < record.end_s:
            where = case.place.inside("identification").at(key)
            faults.append(
                f"{where}: {key} = {stamp_text(value)} is outside of the record "
                f"({period_text(record.start_s, record.end_s)})"
            )
    return faults


def _emptied(raw: Record, record: Record, cabinet: bool, ambient: bool) -> list[str]:
    """Faults of a record that has no readings left, of the `raw` ones, of signals a model needs."""
    faults = []
    needed = [("ambient_temperature",)] * ambient + [IDENTIFIABLE] * cabinet
    for signals in needed:
        there = [signal for signal in signals if signal in record]
        if not any(np.isfinite(record[signal].value).any() for signal in there):
            named = ", ".join(there if signals is IDENTIFIABLE else signals) or "the cabinet"
            series = tuple(raw[one] for one in there)
            alone = dataclasses.replace(raw, series=series, compared=(), warnings=())
            said = mask(alone).warnings
            why = f": {'; '.join(said)}" if said else "; the columns hold no number"
            faults.append(f"no reading of {named} can be used{why}")
    return faults
