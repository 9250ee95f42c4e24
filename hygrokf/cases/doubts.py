"""Doubts about a record; a doubt is no fault."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hygrokf.cases.alternatives import Readings, alternative_readings, solar_lag
from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.input_paths import centred, on_change
from hygrokf.data.prepared import PreparedRecord, prepare
from hygrokf.data.probes import copies
from hygrokf.data.readings import out_of_range, range_statement
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import HUMIDITIES, signal_named, unit_mistaken
from hygrokf.data.timestamps import DAY_S, MINUTE_S, modal_step
from hygrokf.physics.holds import LINEAR
from hygrokf.texts.record_codes import DoubtCode, RecordCode, period
from hygrokf.texts.statement import Statement, unique
from hygrokf.weather.clock_comparison import (
    FEWEST_COMPARED_D,
    NOT_COMPARED,
    TOLERANCE_S,
    ClockError,
    alignments,
    clock_doubts,
    clock_errors,
)

_SHORT_RECORD_D = 14.0
_SHORT_VALIDATION_D = 7.0
_MANY_LOST = 0.03
"""[1] share of readings without known inputs above which a doubt is raised."""
_OLDEST_S = 10 * 365.25 * DAY_S
"""[s] earliest plausible reading: no turbine of the seventies had a logger."""
IDENTIFIABLE = tuple(f"cabinet_{kind}" for kind in ("temperature", *HUMIDITIES))
"""Signals of the cabinet that can identify a model."""


def all_doubts(
    record: Record, clocks: Sequence[ClockError] | None = None, read: Readings | None = None
) -> tuple[Statement, ...]:
    """All doubts about a record and its sources for comparison.

    clocks, read: clock errors and alternative readings, if already known.
    """
    record = prepare(record)
    if clocks is None:
        clocks = clock_errors(alignments(record))
    is_southern = record.site is not None and record.site.latitude_deg < 0.0
    readings = alternative_readings(record) if read is None else read
    return (
        *clock_doubts(clocks, is_southern),
        *_doubts_of_comparison(record, clocks),
        *record.doubts,
        *(finding.doubt() for finding in readings.findings),
        *_doubts_of_readings(record),
        *_doubts_of_gaps(record),
        *_doubts_of_periods(record),
        *_doubts_of_power(record),
        *_doubts_of_climate(record),
        *_doubts_of_clocks(record),
    )


def _doubts_of_comparison(record: Record, clocks: Sequence[ClockError]) -> Iterator[Statement]:
    """Files for comparison that share too little time with the sources that are used."""
    compared = {alignment.signal for error in clocks for alignment in error.alignments}
    files: dict[str, list[str]] = {}
    for series in record.compared:
        if series.signal in record and series.signal not in (*compared, *NOT_COMPARED):
            files.setdefault(series.file, []).append(series.signal)
    for file, signals in files.items():
        yield DoubtCode.NOT_COMPARED(file=file, signals=tuple(signals), fewest_d=FEWEST_COMPARED_D)


def _doubts_of_readings(record: Record) -> Iterator[Statement]:
    """Doubts about readings of a record made from series; `read_case` and `read_frames` refuse or mask such
    readings."""
    for series in (*record.series, *record.compared):
        row = signal_named(series.signal)
        is_outside = out_of_range(series)
        doubt = unit_mistaken(series.value, row.unit, row)
        if series.hold == LINEAR and series.resolution and on_change(*series.known, series.resolution):
            yield DoubtCode.ONLY_ON_CHANGE(signal=series.signal)
        if doubt is None and is_outside.any():
            doubt = range_statement(DoubtCode.OUT_OF_RANGE, series, is_outside)
        if doubt is not None:
            yield doubt
    if record.start_s < _OLDEST_S:
        yield DoubtCode.BEGINS_TOO_EARLY(start=record.start_s)
    yield from no_overlap(record.series)


def no_overlap(series: Sequence[Series]) -> list[Statement]:
    """Doubts about sources that share no time with the cabinet's readings."""
    spans = {item.signal: (item.time[0] - item.interval_s, item.time[-1]) for item in series if len(item)}
    cabinet = {signal: span for signal, span in spans.items() if signal in IDENTIFIABLE}
    if not cabinet:
        return []
    first = min(span[0] for span in cabinet.values())
    last = max(span[1] for span in cabinet.values())
    without_overlap: dict[tuple[str, float, float], list[str]] = {}
    for item in series:
        if item.signal in cabinet or item.signal not in spans:
            continue
        start, end = spans[item.signal]
        if start > last or end < first:
            without_overlap.setdefault((item.file if item.source else "", start, end), []).append(item.signal)
    return [
        DoubtCode.NO_OVERLAP(
            signals=tuple(signals), file=(RecordCode.IN_FILE(file=file),) if file else (),
            period=period(start, end), of_cabinet=period(first, last),
        )
        for (file, start, end), signals in without_overlap.items()
    ]  # fmt: skip


def _doubts_of_gaps(record: PreparedRecord) -> Iterator[Statement]:
    """Doubts that gaps in the ambient series exclude many of the cabinet's readings from a fit."""
    outside_air = {"temperature": record["ambient_temperature"]} if "ambient_temperature" in record else {}
    vapour = record.ambient_vapour if outside_air else None
    outside_air |= {} if vapour is None else {"humidity": vapour}
    for signal in (name for name in IDENTIFIABLE if name in record):
        time = record[signal].known[0]
        is_lost, gaps = np.zeros(len(time), dtype=bool), list[str]()
        for kind, series in outside_air.items():
            times = series.known[0]
            in_gap = np.isnan(at_times(series, time, bridge_h(series, AMBIENT_BRIDGE_H)))
            in_gap &= (time >= times[0]) & (time <= times[-1]) if len(times) else False
            is_lost |= in_gap
            if in_gap.any():
                gaps.append(kind)
        if is_lost.sum() > _MANY_LOST * len(time):
            yield DoubtCode.GAPS_OUTSIDE(
                signal=signal, lost=int(is_lost.sum()), n=len(time), unknown=tuple(gaps)
            )


def _doubts_of_periods(record: Record) -> Iterator[Statement]:
    days = (record.end_s - record.start_s) / DAY_S
    if not days >= _SHORT_RECORD_D:
        yield DoubtCode.SHORT_RECORD(days=days, least=_SHORT_RECORD_D)
    if record.until_s is None:
        yield DoubtCode.NO_VALIDATION_PERIOD()
    elif not record.start_s < record.until_s < record.end_s:
        yield DoubtCode.UNTIL_OUTSIDE(until=record.until_s, period=period(record.start_s, record.end_s))
    else:
        for name, part in (("identification", record.identification()), ("validation", record.validation())):
            length = (part.end_s - part.start_s) / DAY_S
            if not length >= _SHORT_VALIDATION_D:
                yield DoubtCode.SHORT_PERIOD(period=name, days=length)


def power_beside_rated(power_W: np.ndarray, rated_W: float) -> tuple[float, Statement]:
    """The 99.5 % quantile of power readings divided by the rated power (NaN without readings), and the
    statement of this ratio."""
    high = float(np.quantile(power_W, 0.995)) if len(power_W) else np.nan
    ratio = high / rated_W
    return ratio, RecordCode.BESIDE_RATED(high_kW=high / 1e3, times=ratio, rated_kW=rated_W / 1e3)


def _doubts_of_power(record: Record) -> Iterator[Statement]:
    if "active_power" not in record:
        yield DoubtCode.POWER_ABSENT()
        return
    power = record["active_power"]
    readings = power.value[~power.missing]
    if not len(readings):
        yield DoubtCode.POWER_UNREAD()
        return
    standstill = float(np.mean(readings <= 0.0))
    if np.median(readings) < 0.0 and -readings.min() > 2.0 * max(readings.max(), 0.0):
        yield DoubtCode.POWER_NEGATIVE(share=standstill)
    elif standstill < 0.01:
        yield DoubtCode.NO_STANDSTILL(share=standstill)
    elif standstill > 0.9:
        yield DoubtCode.LITTLE_OPERATION(share=standstill)
    if record.rated_power_W is None:
        yield DoubtCode.NO_RATED_POWER()
    else:
        ratio, comparison = power_beside_rated(readings, record.rated_power_W)
        if ratio > 1.3 or 0.0 < ratio < 0.3:
            yield DoubtCode.POWER_BESIDE_RATED(beside=comparison)
    for signal in record.signals:
        if signal.startswith("cabinet_") and len(record[signal]):
            time = record[signal].time
            covered = float(np.mean((time >= power.time[0] - power.interval_s) & (time <= power.time[-1])))
            if covered < 0.5:
                yield DoubtCode.POWER_COVERS_LITTLE(share=covered, signal=signal)
            break


def _doubts_of_climate(record: PreparedRecord) -> Iterator[Statement]:
    humid = any(f"cabinet_{kind}" in record for kind in HUMIDITIES)
    if "cabinet_temperature" not in record and not humid:
        yield DoubtCode.NO_CABINET_SIGNAL()
    elif "cabinet_temperature" not in record:
        yield DoubtCode.NO_CABINET_TEMPERATURE()
    elif not humid:
        yield DoubtCode.NO_CABINET_HUMIDITY()
    if humid and not any(f"ambient_{kind}" in record for kind in HUMIDITIES):
        yield DoubtCode.NO_AMBIENT_HUMIDITY()
    for series in record.series:
        if series.missing.mean() > 0.3:
            yield DoubtCode.MANY_MISSING(signal=series.signal, share=float(series.missing.mean()))
    if "ambient_temperature" in record:
        step, _ = modal_step(record["ambient_temperature"].time)
        if step >= 3600.0:
            yield DoubtCode.AMBIENT_TOO_COARSE(step_s=step)
    inside, outside = (
        record[name] if name in record else None for name in ("cabinet_temperature", "ambient_temperature")
    )
    pair = _pair(inside, outside)
    if pair is not None and (colder := float(np.mean(pair[1] - pair[0]))) > 2.0:
        yield DoubtCode.COLDER_THAN_OUTSIDE(colder_K=colder)
    yield from copies(record.series)
    pair = _pair(record.cabinet_vapour, record.ambient_vapour)
    if pair is not None:
        factor = float(np.mean(pair[0]) / np.mean(pair[1]))
        if not 0.7 <= factor <= 1.3:
            yield DoubtCode.OTHER_VAPOUR(factor=factor)


def _pair(first: Series | None, second: Series | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Values of the first series, and of the second interpolated to their times, over the common span."""
    if first is None or second is None:
        return None
    (time, value), reference = centred(first).known, centred(second).known
    times = reference[0]
    if not len(times):
        return None
    common = (time >= times[0]) & (time <= times[-1])
    return (value[common], np.interp(time[common], *reference)) if common.any() else None


def _doubts_of_clocks(record: Record) -> Iterator[Statement]:
    irregular = []
    for series in record.series:
        step, regular = modal_step(series.time)
        if len(series) > 2 and regular < 0.9 and series.longest_hold_s is None:
            irregular.append(DoubtCode.IRREGULAR_STEPS(file=series.file, share=regular, step_s=step))
    yield from unique(irregular)
    lag = solar_lag(record)
    if lag is not None and abs(lag) > TOLERANCE_S:
        code = DoubtCode.RADIATION_LATE if lag > 0 else DoubtCode.RADIATION_EARLY
        remedy = RecordCode.STATE_CORRECTION(correction=f"{-15 * round(lag / 900.0):+d}min")
        yield code(minutes=abs(lag) / MINUTE_S, remedy=remedy)
