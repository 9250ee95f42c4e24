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

    path: the TOML file; the files that it names are relative to it. docs/reference/case_file.md describes its
        form.
    cabinet: whether a cabinet signal to identify is required; False for drivers alone.
    ambient: whether an ambient temperature is required; False for a power alone.

    Returns the record; its `warnings` list what was masked or repaired, and doubts of a draft that are open.
    Raises CaseFault with all faults of the case file and of every source.
    """
    file = Path(path)
    try:
        text, content = read_toml(file, CaseFault)
    except CaseFault as fault:
        fault_of_other_file = _not_a_case(file)
        raise CaseFault(file, [fault_of_other_file] if fault_of_other_file else fault.faults) from None
    case = stated_case({"name": file.stem, **content}, Place(file=file.name, lines=lines_of(text)))

    def table(source: StatedSource) -> FileColumns:
        """Read the columns of one source."""
        return read_table(file.parent / source.file, source.meanings, source.time, source, source.quality)

    def weather(stated: StatedWeather) -> Record:
        """Read one weather file."""
        return _weather_record(stated, file.parent, case)

    record = stated_record(case, table, str(path), weather=weather, cabinet=cabinet, ambient=ambient)
    return dataclasses.replace(record, warnings=(*_open_doubts(file.name, text), *record.warnings))


_REMARK = re.compile(r"#(?!\s?(\[|[\w.\"'-]+\s*=))")
"""A comment in words, not a TOML table or key that is commented out."""


def _open_doubts(name: str, text: str) -> tuple[str, ...]:
    """Return a warning that names the lines of a draft's open doubts; empty without any.

    A doubt is open if the setting below it is not commented out.
    """
    stripped_lines = [line.strip() for line in text.splitlines()]
    doubted_lines = []
    for line_number, line in enumerate(stripped_lines, 1):
        next_line = next(
            (
                following_line
                for following_line in stripped_lines[line_number:]
                if following_line and not _REMARK.match(following_line)
            ),
            "#",
        )
        if line.startswith(DRAFT_DOUBT) and not next_line.startswith("#"):
            doubted_lines.append(str(line_number))
    if not doubted_lines:
        return ()
    open_doubts = f"a doubt of its draft is open, line {doubted_lines[0]}"
    if len(doubted_lines) > 1:
        open_doubts = f"{len(doubted_lines)} doubts of its draft are open, lines {', '.join(doubted_lines)}"
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

    case: as stated.  table: reads a source; raises TableFault.  head: first words of a CaseFault's message.
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
            columns = table(source)
        except TableFault as broken:
            faults += [f"{source.file}: {fault}" for fault in broken.faults]
            all_read = False
            continue
        headers[source.file] = columns.header
        if columns.sha256:
            files[source.file] = columns.sha256
        result = _source_series(source, columns, case.form.rated_power_W)
        source_series, source_warnings, source_faults = result
        warnings += [f"{source.file}: {warning}" for warning in source_warnings]
        doubts += _quality_doubts(source, columns)
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
    """Yield the doubts about the marks of quality in a source."""
    for column in source.columns:
        if column.column in read.judged and (doubt := read.judged[column.column].doubt):
            yield DoubtCode.QUALITY_DOUBTED(signal=column.signal.name, file=source.file, doubt=doubt)


def _split_probes(case: StatedCase, headers: Mapping[str, tuple[str, ...]]) -> Iterator[Statement]:
    """Yield doubts about places whose humidity and temperature come from different probes.

    headers: names of all columns of each file.
    """
    column_of_signal = {
        column.signal.name: (source.file, column.column)
        for source in reversed(case.sources)
        if not source.compare
        for column in source.columns
    }
    for place in ("cabinet", "ambient"):
        temperature, humidity = (
            column_of_signal.get(f"{place}_temperature"),
            column_of_signal.get(f"{place}_relative_humidity"),
        )
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
    """Return the faults of a case that lacks the signals a model needs."""
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
    """Read the weather files of a case; files that continue each other are joined.

    Returns the sources with their records, warnings and faults.
    """
    sources_and_records: list[tuple[StatedWeather, Record]] = []
    warnings: list[str] = []
    faults: list[str] = []
    for weather_source in case.weather:
        try:
            weather_record = weather(weather_source)
        except TableFault as broken:
            faults += [f"{weather_source.file}: {fault}" for fault in broken.faults]
            continue
        warnings += [f"{weather_source.file}: {warning}" for warning in weather_record.warnings]
        weather_record = dataclasses.replace(weather_record, warnings=())
        for index, (earlier_stated, earlier_record) in enumerate(sources_and_records):
            # such as one file a year, each continuing the previous one
            if (earlier_stated.format, earlier_stated.compare) == (
                weather_source.format,
                weather_source.compare,
            ) and follows(earlier_record, weather_record):
                try:
                    merged = join_records((earlier_record, weather_record), earlier_record.name)
                except TableFault as broken:
                    faults += [
                        f"{earlier_stated.file} and {weather_source.file}: {fault}" for fault in broken.faults
                    ]
                    break
                warnings += [
                    f"{earlier_stated.file} and {weather_source.file}: {warning}"
                    for warning in merged.warnings
                ]
                sources_and_records[index] = (earlier_stated, dataclasses.replace(merged, warnings=()))
                break
        else:
            sources_and_records.append((weather_source, weather_record))
    return sources_and_records, warnings, faults


_TABLES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".nc", ".xlsx")


def _not_a_case(file: Path) -> str:
    """Return the fault of a file that is no case, with what it seems to be (a result, JSON or a table); "" if
    unclear."""
    description = "a table, expected a case file that names it" * (
        file.suffix.lower() in _TABLES and file.is_file()
    )
    with suppress(OSError, ValueError, RecursionError):
        if isinstance(content := json.loads(file.read_bytes()), dict):
            result = {"design", "parameters"} <= set(content)
            description = f"{'a result of `hygrokf fit`' if result else 'JSON'}, expected a case file"
    return f"is {description} (docs/reference/case_file.md)" if description else ""


def _weather_record(source: StatedWeather, folder: Path, case: StatedCase) -> Record:
    """Return the record of a weather file, with sources named as in the case file."""
    weather = read_weather_file(
        folder / source.file,
        source.format,
        site=case.form.site,
        year=source.year,
        altitude_m=source.altitude_m,
        to_site_altitude=source.to_site_altitude,
        lapse_rate=source.lapse_rate,
    )
    file_name = Path(source.file).name
    return dataclasses.replace(
        weather,
        series=tuple(
            dataclasses.replace(
                series,
                time=series.time + source.clock_correction_s,
                clock_uncertainty_s=source.clock_uncertainty_s,
                source=source.file + series.source.removeprefix(file_name),
            )
            for series in weather.series
        ),
        files=tuple((source.file, digest) for _, digest in weather.files),
    )


def _source_series(
    source: StatedSource, table: FileColumns, rated_W: float | None
) -> tuple[list[Series], list[str], list[str]]:
    """Return the series of a source, with warnings and faults; rated_W: rated power or None."""
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
    step, regular_share = modal_step(time)
    for column in source.columns:
        rows = has_reading[column.column] if is_row_per_reading else slice(None)
        stamps, readings = time[rows], values[column.column][rows]
        step, regular_share = modal_step(stamps)
        mistake = unit_mistaken(readings, column.unit, column.signal)
        if mistake is None and column.signal.name == "active_power" and rated_W is not None:
            power_W = to_si(readings[np.isfinite(readings)], column.unit, column.signal)
            ratio, explanation = power_beside_rated(power_W, rated_W)
            if ratio > 10.0:
                mistake = RecordCode.POWER_IN_OTHER_UNIT(unit=column.unit, beside=explanation)
        if mistake is not None:
            faults.append(f'column "{column.column}": {mistake.text}')
            continue
        hold = source.hold or (column.signal.hold_of_instants if source.stamp == "instant" else MEAN)
        interval_s = source.interval_s
        if interval_s is None and (source.stamp != "instant" or hold == MEAN):
            if not regular_share >= 0.5:
                steps = "there is only one stamp"
                if math.isfinite(step):
                    steps = f"only {100 * regular_share:.0f} % of the steps are {duration_text(step)}"
                faults.append(
                    f"the stamps do not show the length of the averaging interval ({steps}): "
                    'state it, such as interval = "10min"'
                )
                break
            interval_s = step
        interval_s = interval_s or 0.0
        shift_s = {"instant": 0.0, "start": interval_s, "middle": 0.5 * interval_s, "end": 0.0}[source.stamp]
        if hold == LINEAR and source.stamp != "instant":
            # a mean that is joined by straight lines is placed in the middle of its interval
            shift_s -= 0.5 * interval_s
        moved = stamps + source.clock_correction_s + shift_s
        settings: dict[str, Any] = dict(column.settings)
        if "resolution" not in settings:
            settings["resolution"] = difference_to_si(detect_resolution(readings), column.unit, column.signal)
        if hold == PREVIOUS:
            until_next = column.signal.name in SWITCHED and on_change(stamps, readings)
            settings["longest_hold_s"] = source.longest_hold_s or (math.inf if until_next else None)
            settings["lost"] = source.lost
        try:
            series.append(
                Series(
                    column.signal.name,
                    moved,
                    to_si(readings, column.unit, column.signal),
                    hold,
                    interval_s if hold == MEAN else 0.0,
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
    """Return the faults of an identification period that begins or ends outside of the record."""
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
    """Return the faults of needed signals of which the mask left no reading; raw: the record before the
    mask."""
    faults = []
    needed = [("ambient_temperature",)] * ambient + [IDENTIFIABLE] * cabinet
    for alternatives in needed:
        present_signals = [signal for signal in alternatives if signal in record]
        if not any(np.isfinite(record[signal].value).any() for signal in present_signals):
            listed = (
                ", ".join(present_signals if alternatives is IDENTIFIABLE else alternatives) or "the cabinet"
            )
            series = tuple(raw[signal] for signal in present_signals)
            only_needed = dataclasses.replace(raw, series=series, compared=(), warnings=())
            mask_warnings = mask(only_needed).warnings
            reason = f": {'; '.join(mask_warnings)}" if mask_warnings else "; the columns hold no number"
            faults.append(f"no reading of {listed} can be used{reason}")
    return faults
