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
from hygrokf.texts.record_codes import DoubtCode, RecordCode
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
        other = _not_a_case(file)
        raise CaseFault(file, [other] if other else fault.faults) from None
    case = stated_case({"name": file.stem, **content}, Place(file=file.name, lines=lines_of(text)))

    def table(source: StatedSource) -> FileColumns:
        return read_table(file.parent / source.file, source.meanings, source.time, source, source.quality)

    def weather(stated: StatedWeather) -> Record:
        return _weather_record(stated, file.parent, case)

    record = stated_record(case, table, str(path), weather=weather, cabinet=cabinet, ambient=ambient)
    return dataclasses.replace(record, warnings=(*_open_doubts(file.name, text), *record.warnings))


_REMARK = re.compile(r"#(?!\s?(\[|[\w.\"'-]+\s*=))")
"""A comment in words, not a TOML table or key that is commented out."""


def _open_doubts(name: str, text: str) -> tuple[str, ...]:
    """The warning that names the lines of a draft's doubts about settings that are not commented out."""
    lines = [line.strip() for line in text.splitlines()]
    numbers = []
    for number, line in enumerate(lines, 1):
        next_line = next((below for below in lines[number:] if below and not _REMARK.match(below)), "#")
        if line.startswith(DRAFT_DOUBT) and not next_line.startswith("#"):
            numbers.append(str(number))
    if not numbers:
        return ()
    open_doubts = f"a doubt of its draft is open, line {numbers[0]}"
    if len(numbers) > 1:
        open_doubts = f"{len(numbers)} doubts of its draft are open, lines {', '.join(numbers)}"
    return (f'{name}: {open_doubts}: check the doubted setting, then delete the comment "{DRAFT_DOUBT}…"',)


def stated_record(
    case: StatedCase,
    table: Callable[[StatedSource], FileColumns],
    head: str,
    *,
    weather: Callable[[StatedWeather], Record] | None = None,
    cabinet: bool,
    ambient: bool,
) -> Record:
    """Make the record of a stated case from files or frames: SI units, UTC, doubtful readings masked.

    case: as stated. table: reads a source; raises TableFault. head: first words of a CaseFault's message.
    weather: reads a weather file, for cases that name any; raises TableFault.
    cabinet, ambient: as for `read_case`.

    Raises CaseFault with all faults.
    """
    faults = [*case.place.faults, *_declaration_faults(case, cabinet, ambient)]
    period = case.form.identification
    series: list[Series] = []
    compared: list[Series] = []
    warnings: list[str] = []
    files: dict[str, str] = {}
    headers: dict[str, tuple[str, ...]] = {}
    doubts: list[Statement] = []
    all_read = True
    for source in case.sources:
        try:
            read = table(source)
        except TableFault as broken:
            faults += [f"{source.file}: {fault}" for fault in broken.faults]
            all_read = False
            continue
        headers[source.file] = read.header
        if read.sha256:
            files[source.file] = read.sha256
        source_series, source_warnings, source_faults = _source_series(source, read, case.form.rated_power_W)
        warnings += [f"{source.file}: {warning}" for warning in source_warnings]
        doubts += _quality_doubts(source, read)
        faults += [f"{source.file}: {fault}" for fault in source_faults]
        (compared if source.compare else series).extend(source_series)
        all_read = all_read and not source_faults
    reads: list[tuple[StatedWeather, Record]] = []
    if weather is not None:
        reads, weather_warnings, weather_faults = _weather_records(case, weather)
        warnings += weather_warnings
        faults += weather_faults
        all_read = all_read and not weather_faults
    for stated, weather_record in reads:
        files.update(weather_record.files)
        used = set(case.declared) | {item.signal for item in series}
        series += [item for item in weather_record.series if not stated.compare and item.signal not in used]
        compared += [item for item in weather_record.series if stated.compare or item.signal in used]
    by_signal = {item.signal: item for item in series}
    compared_by_signal = {item.signal: item for item in reversed(compared)}
    merged = tuple(by_signal.values())
    faults += [doubt.text for doubt in (*no_overlap(merged), *copies(merged))]
    record = Record(
        case.form.name or "record",
        merged,
        case.form.site,
        case.form.rated_power_W,
        warnings=tuple(warnings),
        compared=tuple(compared_by_signal.values()),
        doubts=(*doubts, *_split_probes(case, headers)),
        provenance=case.form.provenance,
    )
    if all_read and series:
        faults += _period_faults(record, case)
    if faults:
        raise CaseFault(head, faults)
    record = dataclasses.replace(record, until_s=period.until_s, files=tuple(files.items()))
    if period.start_s is not None:
        record = record.window(period.start_s, math.inf)
    raw, record = record, mask(record)
    faults = _faults_of_mask(raw, record, cabinet, ambient)
    if faults:
        raise CaseFault(head, faults)
    return record


def _quality_doubts(source: StatedSource, read: FileColumns) -> Iterator[Statement]:
    """Doubts about the marks of quality beside a source's readings."""
    for column in source.columns:
        if column.column in read.judged and (doubt := read.judged[column.column].doubt):
            yield DoubtCode.QUALITY_DOUBTED(signal=column.signal.name, file=source.file, doubt=doubt)


def _split_probes(case: StatedCase, headers: Mapping[str, tuple[str, ...]]) -> Iterator[Statement]:
    """Doubts about places whose humidity and temperature come from different probes."""
    used = {
        column.signal.name: (source.file, column.column)
        for source in reversed(case.sources)
        if not source.compare
        for column in source.columns
    }
    for place in ("cabinet", "ambient"):
        temperature, humidity = used.get(f"{place}_temperature"), used.get(f"{place}_relative_humidity")
        if temperature is None or humidity is None:
            continue
        file = humidity[0]
        candidates = temperatures_of(humidity[1], headers.get(file, ()))
        if len(candidates) == 1 and temperature != (file, candidates[0]):
            yield DoubtCode.OTHER_PROBE(
                temperature=f"{place}_temperature",
                temperature_file=temperature[0], temperature_column=temperature[1],
                humidity=f"{place}_relative_humidity", humidity_file=file, humidity_column=humidity[1],
                own=candidates[0],
            )  # fmt: skip


def _declaration_faults(case: StatedCase, cabinet: bool, ambient: bool) -> list[str]:
    """Faults of a case that lacks the signals a model needs."""
    name, faults = case.place.file, []
    has_no_ambient = "ambient_temperature" not in case.declared and all(
        stated.compare for stated in case.weather
    )
    if ambient and has_no_ambient:
        faults.append(f"{name}: no source names ambient_temperature, the input that every model needs")
    if cabinet and not any(signal in case.declared for signal in IDENTIFIABLE):
        faults.append(
            f"{name}: nothing in the cabinet to identify; expected one of {', '.join(IDENTIFIABLE)}"
        )
    return faults


def _weather_records(
    case: StatedCase, weather: Callable[[StatedWeather], Record]
) -> tuple[list[tuple[StatedWeather, Record]], list[str], list[str]]:
    """Records of the weather files, with consecutive files joined, warnings and faults."""
    reads: list[tuple[StatedWeather, Record]] = []
    warnings: list[str] = []
    faults: list[str] = []
    for stated in case.weather:
        try:
            read = weather(stated)
        except TableFault as broken:
            faults += [f"{stated.file}: {fault}" for fault in broken.faults]
            continue
        warnings += [f"{stated.file}: {warning}" for warning in read.warnings]
        read = dataclasses.replace(read, warnings=())
        for place, (earlier_stated, earlier_record) in enumerate(reads):
            # such as one file a year, each continuing the previous one
            if (earlier_stated.format, earlier_stated.compare) == (stated.format, stated.compare) and follows(
                earlier_record, read
            ):
                try:
                    merged = join_records((earlier_record, read), earlier_record.name)
                except TableFault as broken:
                    faults += [f"{earlier_stated.file} and {stated.file}: {fault}" for fault in broken.faults]
                    break
                warnings += [
                    f"{earlier_stated.file} and {stated.file}: {warning}" for warning in merged.warnings
                ]
                reads[place] = (earlier_stated, dataclasses.replace(merged, warnings=()))
                break
        else:
            reads.append((stated, read))
    return reads, warnings, faults


_TABLES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".nc", ".xlsx")


def _not_a_case(file: Path) -> str:
    """What a file that is not TOML seems to be (a result, JSON or a table), as a fault; "" if unclear."""
    kind = "a table, expected a case file that names it" * (file.suffix.lower() in _TABLES and file.is_file())
    with suppress(OSError, ValueError, RecursionError):
        if isinstance(content := json.loads(file.read_bytes()), dict):
            result = {"design", "parameters"} <= set(content)
            kind = f"{'a result of `hygrokf fit`' if result else 'JSON'}, expected a case file"
    return f"is {kind} (docs/reference/case_file.md)" if kind else ""


def _weather_record(stated: StatedWeather, folder: Path, case: StatedCase) -> Record:
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
                series,
                time=series.time + stated.clock_correction_s,
                clock_uncertainty_s=stated.clock_uncertainty_s,
                source=stated.file + series.source.removeprefix(name),
            )
            for series in read.series
        ),
        files=tuple((stated.file, digest) for _, digest in read.files),
    )


def _source_series(
    source: StatedSource, table: FileColumns, rated_W: float | None
) -> tuple[list[Series], list[str], list[str]]:
    """Series of a source, warnings and faults."""
    warnings = list(table.warnings)
    time, values, order_warnings = order_readings(table.time, table.values)
    if not table.summer_time:
        warnings += summer_time_holes(np.sort(table.time))
    warnings += order_warnings
    faults: list[str] = []
    series = []
    has_reading = {name: np.isfinite(readings) for name, readings in values.items()}
    has_single_reading = np.sum([*has_reading.values()], axis=0) == 1
    # where each row holds a single reading, an empty cell is not a missing reading
    is_row_per_reading = len(has_reading) > 1 and all(
        np.sum(has_single_reading & is_read) > 0.9 * np.sum(is_read) for is_read in has_reading.values()
    )
    step, regular = modal_step(time)
    for column in source.columns:
        rows = has_reading[column.column] if is_row_per_reading else slice(None)
        stamps, raw = time[rows], values[column.column][rows]
        step, regular = modal_step(stamps)
        mistake = unit_mistaken(raw, column.unit, column.signal)
        if mistake is None and column.signal.name == "active_power" and rated_W is not None:
            power_W = to_si(raw[np.isfinite(raw)], column.unit, column.signal)
            ratio, explanation = power_beside_rated(power_W, rated_W)
            if ratio > 10.0:
                mistake = RecordCode.POWER_IN_OTHER_UNIT(unit=column.unit, beside=explanation)
        if mistake is not None:
            faults.append(f'column "{column.column}": {mistake.text}')
            continue
        hold = source.hold or (column.signal.hold_of_instants if source.stamp == "instant" else MEAN)
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
        moved = stamps + source.clock_correction_s + shift
        settings: dict[str, Any] = dict(column.settings)
        if "resolution" not in settings:
            settings["resolution"] = difference_to_si(detect_resolution(raw), column.unit, column.signal)
        if hold == PREVIOUS:
            until_next = column.signal.name in SWITCHED and on_change(stamps, raw)
            settings["longest_hold_s"] = source.longest_hold_s or (math.inf if until_next else None)
            settings["lost"] = source.lost
        try:
            series.append(
                Series(
                    column.signal.name,
                    moved,
                    to_si(raw, column.unit, column.signal),
                    hold,
                    length if hold == MEAN else 0.0,
                    clock_uncertainty_s=source.clock_uncertainty_s,
                    source=f'{source.file}, column "{column.column}"',
                    **settings,
                )
            )
        except ValueError as impossible:
            faults.append(f'column "{column.column}": {impossible}')
    if source.interval_s is not None and source.interval_s > 1.5 * step:
        warnings.append(
            f"interval = {duration_text(source.interval_s)} is longer than the step of "
            f"{duration_text(step)}: means of overlapping intervals are not independent readings"
        )
    return series, warnings, faults


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


def _faults_of_mask(raw: Record, record: Record, cabinet: bool, ambient: bool) -> list[str]:
    """Faults of needed signals of which the mask left no reading; `raw` is the record before the mask."""
    faults = []
    needed = [("ambient_temperature",)] * ambient + [IDENTIFIABLE] * cabinet
    for signals in needed:
        present = [signal for signal in signals if signal in record]
        if not any(np.isfinite(record[signal].value).any() for signal in present):
            named = ", ".join(present if signals is IDENTIFIABLE else signals) or "the cabinet"
            series = tuple(raw[signal] for signal in present)
            only_needed = dataclasses.replace(raw, series=series, compared=(), warnings=())
            mask_warnings = mask(only_needed).warnings
            why = f": {'; '.join(mask_warnings)}" if mask_warnings else "; the columns hold no number"
            faults.append(f"no reading of {named} can be used{why}")
    return faults
