"""How often a wrong clock, unit or column of a simulated record is named, and how often one that is right:
docs/validation/safe_conclusions.md.

Plants are those of tests/other_make; each record is moved by whole days so that summer time begins or ends
within its middle third.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from other_make import ROWS, make_plant
from other_make.as_record import to_record

from hygrokf.cases.alternatives import NAMED_SHIFT, Readings, alternative_readings
from hygrokf.data.record import Record
from hygrokf.data.shared_clocks import Shift, shifted
from hygrokf.data.timestamps import DAY_S, HOUR_S, summer_time
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.record_codes import RecordCode
from validation.counts import markdown
from validation.frame import Claim

DAYS = 60.0
SOURCES = ("cabinet.csv", "ambient.csv", "scada.csv")
SHIFTS_H = {"+1 h": 1.0, "-1 h": -1.0, "+2 h": 2.0, "-2 h": -2.0, "+5.5 h": 5.5, "summer": -1.0}
KINDS = ("instants", "means10")
CLOSE_S = 900.0
"""[s] by which a named correction may differ from the true one."""


def _fahrenheit(record: Record, *signals: str) -> Record:
    return record.replace_series(
        *(
            replace(record[name], value=1.8 * (record[name].value - ZERO_CELSIUS_K) + 32.0 + ZERO_CELSIUS_K)
            for name in signals
        )
    )


def _exchanged(record: Record, one: str, other: str, factor: float = 1.0, offset: float = 0.0) -> Record:
    """Two columns exchanged; other = factor · one + offset in their SI units where these differ."""
    first, second = record[one], record[other]
    return record.replace_series(
        replace(second, signal=one, value=(second.value - offset) / factor),
        replace(first, signal=other, value=factor * first.value + offset),
    )


INSIDE, OUTSIDE, HUMIDITY = "cabinet_temperature", "ambient_temperature", "cabinet_relative_humidity"
VALUES: dict[str, tuple[RecordCode, Callable[[Record], Record]]] = {
    "°F inside": (RecordCode.STATE_UNIT, lambda record: _fahrenheit(record, INSIDE)),
    "°F outside": (RecordCode.STATE_UNIT, lambda record: _fahrenheit(record, OUTSIDE)),
    "°F everywhere": (RecordCode.STATE_UNIT, lambda record: _fahrenheit(record, INSIDE, OUTSIDE)),
    "temperatures exchanged": (
        RecordCode.EXCHANGE_COLUMNS,
        lambda record: _exchanged(record, INSIDE, OUTSIDE),
    ),
    "temperature and humidity exchanged": (
        RecordCode.EXCHANGE_COLUMNS,
        lambda record: _exchanged(record, INSIDE, HUMIDITY, 0.01, -0.01 * ZERO_CELSIUS_K),
    ),
}
"""Fault -> code of the line that corrects it, and the record with the fault."""


def turning(record: Record, seed: int) -> Record:
    """The record moved by whole days so that summer time begins or ends within its middle third."""
    days = np.arange(record.start_s, record.start_s + 400.0 * DAY_S, DAY_S)
    turns = days[1:][np.diff(summer_time(days).astype(int)) != 0]
    place = np.random.default_rng([seed, 8]).uniform(1 / 3, 2 / 3) * DAYS * DAY_S
    moved = DAY_S * round((turns[seed % 2] - place - record.start_s) / DAY_S)
    return record.replace_series(*(replace(one, time=one.time + moved) for one in record.series))


def _record(seed: int, kind: str) -> Record:
    """The record of a plant as its loggers wrote it."""
    return turning(to_record(make_plant(seed, ROWS[kind], DAYS)), seed)


def one(variant: str, seed: int) -> dict:
    """What is named in the right records and, but for the variant `right`, in each wrong one."""
    return right(seed) if variant == "right" else wrong(seed)


def right(seed: int) -> dict:
    """What is named in the right records, with instants and with ten-minute means."""
    line: dict = {}
    for kind in KINDS:
        record = _record(seed, kind)
        begun = time.process_time()
        line[f"{kind}, right"] = _said(alternative_readings(record))
        line[f"{kind}, CPU [s]"] = time.process_time() - begun
    return line


def wrong(seed: int) -> dict:
    """What is named in the right record and in each wrong one, with instants and with ten-minute means."""
    line = right(seed)
    for kind in KINDS:
        right_record = _record(seed, kind)
        for source in SOURCES:
            for name, hours in SHIFTS_H.items():
                fault = Shift(source, HOUR_S * hours, summer=name == "summer")
                found = alternative_readings(shifted(right_record, fault))
                line[f"{kind}, {source}, {name}"] = _corrects(found, fault), _said(found)
        for name, (wanted, spoil) in VALUES.items():
            try:
                found = alternative_readings(spoil(right_record))
            except ValueError:
                line[f"{kind}, {name}"] = True, ["refused as a series"]
                continue
            corrected = wanted in [finding.alternative.line.code for finding in found.findings]
            line[f"{kind}, {name}"] = corrected, _said(found)
    return line


def _said(found: Readings) -> list[str]:
    return [f"{one.verdict}: {one.alternative.mistake}" for one in found.findings]


def _corrects(found: Readings, fault: Shift) -> bool:
    """Whether one clock is named, in the source that has the fault, and by its size in winter and summer."""
    if [one.verdict for one in found.findings] != [NAMED_SHIFT]:
        return False
    shifts = found.findings[0].alternative.shifts
    winter = sum(one.seconds for one in shifts if not one.summer)
    summer = sum(one.seconds for one in shifts)
    true = (0.0 if fault.summer else -fault.seconds, -fault.seconds)
    close = all(abs(a - b) <= CLOSE_S for a, b in zip((winter, summer), true, strict=True))
    return close and {one.source for one in shifts} == {fault.source}


def table(lines: Sequence[Mapping]) -> str:
    """What is named in right records, and of each fault the records in which it is."""
    parts = [f"{len(lines)} plants, {DAYS:.0f} days"]
    spoilt = [line for line in lines if line["variant"] == "wrong"]
    for kind in KINDS:
        named = [said for line in lines for said in line[f"{kind}, right"]]
        cpu = np.median([line[f"{kind}, CPU [s]"] for line in lines])
        parts.append(f"{kind}: named in right records: {len(named)} {named}; CPU {cpu:.2f} s (median)")
        if spoilt:
            rows = [
                (source, *(_counted(spoilt, f"{kind}, {source}, {name}") for name in SHIFTS_H))
                for source in SOURCES
            ]
            parts.append(markdown((kind, *SHIFTS_H), rows))
            parts.append("\n".join(f"- {name}: {_counted(spoilt, f'{kind}, {name}')}" for name in VALUES))
    return "\n\n".join(parts)


def _counted(lines: Sequence[Mapping], cell: str) -> str:
    return f"{sum(line[cell][0] for line in lines)} of {len(lines)}"


CLAIM = Claim("clocks", {"wrong": range(60100, 60120), "right": range(60200, 60300)}, one, table)
