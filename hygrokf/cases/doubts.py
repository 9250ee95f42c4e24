"""Doubts about a record, one sentence each; a doubt is no fault."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hygrokf.cases.alternatives import Readings, alternative_readings, solar_lag
from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.input_paths import ON_CHANGE, centred, on_change
from hygrokf.data.prepared import PreparedRecord, prepare
from hygrokf.data.probes import copies
from hygrokf.data.readings import out_of_range, range_sentence
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import HUMIDITIES, signal_named, unit_mistaken
from hygrokf.data.timestamps import DAY_S, modal_step
from hygrokf.modelling.design import PARTS
from hygrokf.physics.holds import LINEAR
from hygrokf.texts.wording import duration_text, period_text, stamp_text
from hygrokf.weather.clocks import (
    FEWEST_D,
    NOT_COMPARED,
    TOLERANCE_S,
    ClockError,
    alignments,
    clock_errors,
    clock_sentences,
)

_SHORT_RECORD_D = 14.0
_SHORT_VALIDATION_D = 7.0
_MANY_LOST = 0.03
"""[1] share of readings without known inputs that is worth a doubt."""
_OLDEST_S = 10 * 365.25 * DAY_S
"""[s] earliest plausible reading: no turbine of the seventies had a logger."""
IDENTIFIABLE = tuple(f"cabinet_{kind}" for kind in ("temperature", *HUMIDITIES))
"""Signals of the cabinet that can identify a model."""


class Doubt(str):
    """A sentence of doubt about a record, with the time constants ("thermal", "hygric") that it concerns."""

    touches: tuple[str, ...]

    def __new__(cls, text: str, *touches: str) -> Doubt:
        made = super().__new__(cls, text)
        made.touches = touches
        return made


def doubted(said: Sequence[str]) -> dict[str, list[str]]:
    """The doubts about each time constant."""
    return {
        part: [str(one) for one in said if isinstance(one, Doubt) and part in one.touches] for part in PARTS
    }


def all_doubts(
    record: Record, clocks: Sequence[ClockError] | None = None, read: Readings | None = None
) -> tuple[str, ...]:
    """Doubts about the compared sources and about the record, one sentence each; a doubt is no fault.

    clocks, read: clock errors and alternative readings, if already known.
    """
    record = prepare(record)
    if clocks is None:
        clocks = clock_errors(alignments(record))
    south = record.site is not None and record.site.latitude_deg < 0.0
    found = alternative_readings(record) if read is None else read
    return (
        *(Doubt(one, *PARTS) for one in clock_sentences(clocks, south)),
        *_uncompared(record, clocks),
        *record.doubts,
        *(Doubt(one.sentence(), *PARTS) for one in found.findings),
        *_doubts_of_readings(record),
        *_doubts_of_gaps(record),
        *_doubts_of_periods(record),
        *_doubts_of_power(record),
        *_doubts_of_climate(record),
        *_doubts_of_clocks(record),
    )


def _uncompared(record: Record, clocks: Sequence[ClockError]) -> Iterator[str]:
    """Files for comparison that share too little time with the sources that are used."""
    done = {one.signal for error in clocks for one in error.alignments}
    files: dict[str, list[str]] = {}
    for one in record.compared:
        if one.signal in record and one.signal not in (*done, *NOT_COMPARED):
            files.setdefault(one.file, []).append(one.signal)
    for file, signals in files.items():
        yield (
            f"{file} cannot be compared ({', '.join(signals)}): fewer than {FEWEST_D:g} days in common with "
            "the source that is used"
        )


def _doubts_of_readings(record: Record) -> Iterator[str]:
    """Doubts about readings of a record made from series; `read_case` and `read_frames` refuse or mask such
    readings."""
    for series in (*record.series, *record.compared):
        row = signal_named(series.signal)
        outside = out_of_range(series)
        words = unit_mistaken(series.value, row.unit, row)
        if series.hold == LINEAR and series.resolution and on_change(*series.known, series.resolution):
            yield f"{series.signal} {ON_CHANGE}"
        if words is None and outside.any():
            words = f"{range_sentence(series, outside)}; read_case and read_frames mask such readings"
        if words is not None:
            yield Doubt(words, *told_by(series.signal))
    if record.start_s < _OLDEST_S:
        yield (
            f"the readings begin on {stamp_text(record.start_s)}: are the times seconds since "
            "1970-01-01T00:00Z, or since the start of the record?"
        )
    yield from no_overlap(record.series)


def told_by(signal: str) -> tuple[str, ...]:
    """The time constants that depend on a signal."""
    if "humidity" in signal or "dew_point" in signal:
        return PARTS[1:]
    return PARTS if signal.endswith("_temperature") else PARTS[:1] if signal == "active_power" else ()


def no_overlap(series: Sequence[Series]) -> list[str]:
    """Sources that share no time with the cabinet's readings, one sentence each."""
    spans = {one.signal: (one.time[0] - one.interval_s, one.time[-1]) for one in series if len(one)}
    cabinet = {signal: span for signal, span in spans.items() if signal in IDENTIFIABLE}
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
            where = f" in {one.file}" * bool(one.source)
            apart.setdefault(f"{where} ({period_text(start, end)})", []).append(one.signal)
    return [
        f"no overlap: {', '.join(signals)}{where} and the cabinet's readings "
        f"({period_text(first, last)}) share no time; check the sources, and zone and offset of "
        "their stamps"
        for where, signals in apart.items()
    ]


def _doubts_of_gaps(record: PreparedRecord) -> Iterator[str]:
    """Readings of the cabinet that no fit uses, because the air outside is unknown at their time."""
    outside = {"temperature": record["ambient_temperature"]} if "ambient_temperature" in record else {}
    vapour = record.ambient_vapour if outside else None
    outside |= {} if vapour is None else {"humidity": vapour}
    for signal in (one for one in IDENTIFIABLE if one in record):
        time = record[signal].known[0]
        lost, gaps = np.zeros(len(time), dtype=bool), list[str]()
        for kind, series in outside.items():
            known = series.known[0]
            gap = np.isnan(at_times(series, time, bridge_h(series, AMBIENT_BRIDGE_H)))
            gap &= (time >= known[0]) & (time <= known[-1]) if len(known) else False
            lost, gaps = lost | gap, [*gaps, kind] if gap.any() else gaps
        if lost.sum() > _MANY_LOST * len(time):
            yield (
                f"{lost.sum()} of the {len(time)} readings of {signal} are not used: the ambient "
                f"{' and '.join(gaps)} is unknown then, in gaps too long to bridge"
            )


def _doubts_of_periods(record: Record) -> Iterator[str]:
    days = (record.end_s - record.start_s) / DAY_S
    if not days >= _SHORT_RECORD_D:
        yield (
            f"short record: {days:.1f} days; below {_SHORT_RECORD_D:.0f} days weather and "
            "operation hardly vary, and bounds will be wide"
        )
    if record.until_s is None:
        yield (
            "no validation period: every score will be computed on the fitted data; state "
            "[identification] until"
        )
    elif not record.start_s < record.until_s < record.end_s:
        yield (
            f"until = {stamp_text(record.until_s)} is outside of the record "
            f"({period_text(record.start_s, record.end_s)})"
        )
    else:
        for name, part in (("identification", record.identification()), ("validation", record.validation())):
            length = (part.end_s - part.start_s) / DAY_S
            if not length >= _SHORT_VALIDATION_D:
                yield f"short {name} period: {length:.1f} days"


def power_beside_rated(power_W: np.ndarray, rated_W: float) -> tuple[float, str]:
    """The 99.5 % quantile of power readings over the rated power, NaN without any; and in words."""
    high = float(np.quantile(power_W, 0.995)) if len(power_W) else np.nan
    times = high / rated_W
    return times, f"reaches {high / 1e3:.4g} kW, {times:.3g} times the rated {rated_W / 1e3:g} kW"


def _doubts_of_power(record: Record) -> Iterator[str]:
    if "active_power" not in record:
        yield "no active power: the whole record counts as standstill"
        return
    power = record["active_power"]
    there = power.value[~power.missing]
    if not len(there):
        yield "active power has no reading: the whole record counts as standstill"
        return
    standstill = float(np.mean(there <= 0.0))
    if np.median(there) < 0.0 and -there.min() > 2.0 * max(there.max(), 0.0):
        yield Doubt(
            f"active power is negative for {100 * standstill:.0f} % of its readings and hardly "
            "ever positive: is the sign reversed (feed-in is positive)?",
            "thermal",
        )
    elif standstill < 0.01:
        yield (
            f"no standstill: {100 * standstill:.1f} % of the power readings are ≤ 0, so standstill "
            "cannot be identified apart from operation"
        )
    elif standstill > 0.9:
        yield f"hardly any operation: {100 * standstill:.0f} % of the power readings are ≤ 0"
    if record.rated_power_W is None:
        yield "no rated power: stationary periods cannot be found; state rated_power_kW"
    else:
        times, words = power_beside_rated(there, record.rated_power_W)
        if times > 1.3 or 0.0 < times < 0.3:
            yield f"active power {words}: are its unit and the rated power right?"
    for signal in record.signals:
        if signal.startswith("cabinet_") and len(record[signal]):
            time = record[signal].time
            covered = np.mean((time >= power.time[0] - power.interval_s) & (time <= power.time[-1]))
            if covered < 0.5:
                yield f"active power covers only {100 * covered:.0f} % of the period of {signal}"
            break


def _doubts_of_climate(record: PreparedRecord) -> Iterator[str]:
    humid = any(f"cabinet_{kind}" in record for kind in HUMIDITIES)
    if "cabinet_temperature" not in record and not humid:
        yield "no cabinet signal: nothing can be identified or scored"
    elif "cabinet_temperature" not in record:
        yield "no cabinet temperature: the thermal model cannot be identified"
    elif not humid:
        yield "no cabinet humidity: only the thermal model can be identified"
    if humid and not any(f"ambient_{kind}" in record for kind in HUMIDITIES):
        yield "no ambient humidity: the hygric model has no input"
    for one in record.series:
        if one.missing.mean() > 0.3:
            yield f"{one.signal}: {100 * one.missing.mean():.0f} % of its readings are missing"
    if "ambient_temperature" in record:
        step, _ = modal_step(record["ambient_temperature"].time)
        if step >= 3600.0:
            yield (
                f"ambient temperature every {duration_text(step)} only: the cabinet's "
                "response to it (rho) will hardly be resolved"
            )
    inside, outside = (
        record[name] if name in record else None for name in ("cabinet_temperature", "ambient_temperature")
    )
    pair = _pair(inside, outside)
    if pair is not None and (colder := np.mean(pair[1] - pair[0])) > 2.0:
        yield Doubt(
            f"the cabinet is {colder:.1f} K colder than outside on average: are the columns swapped?", *PARTS
        )
    for series, words in copies(record.series):
        yield Doubt(words, *told_by(series.signal))
    pair = _pair(record.cabinet_vapour, record.ambient_vapour)
    if pair is not None:
        factor = float(np.mean(pair[0]) / np.mean(pair[1]))
        if not 0.7 <= factor <= 1.3:
            yield Doubt(
                f"absolute humidity in the cabinet is {factor:.2f} times that outside on average: "
                "a source or sink of vapour, a sensor error, or the wrong column",
                "hygric",
            )


def _pair(one: Series | None, other: Series | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Values of one series and of the other at the same times, over their common span."""
    if one is None or other is None:
        return None
    (time, value), known = centred(one).known, centred(other).known
    common = (time >= known[0][0]) & (time <= known[0][-1]) if len(known[0]) else np.zeros(len(time), bool)
    return (value[common], np.interp(time[common], *known)) if common.any() else None


def _doubts_of_clocks(record: Record) -> Iterator[str]:
    irregular: dict[str, None] = {}
    for series in record.series:
        step, regular = modal_step(series.time)
        if len(series) > 2 and regular < 0.9 and series.longest_hold_s is None:
            text = f"{100 * regular:.0f} % of the steps are {duration_text(step)}"
            irregular[f"irregular steps in {series.file}: only {text}"] = None
    yield from irregular
    lag = solar_lag(record)
    if lag is not None and abs(lag) > TOLERANCE_S:
        direction = "after" if lag > 0 else "before"
        correction = f"{-15 * round(lag / 900.0):+d}min"
        yield Doubt(
            f"the sun's radiation is centred {abs(lag) / 60:.0f} min {direction} solar noon at "
            "the site: wrong zone, wrong stamp (start, middle, end) or wrong longitude? If the clock is "
            f'wrong, state clock_correction = "{correction}" in that source',
            *PARTS,
        )
