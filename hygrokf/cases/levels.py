"""Other units, columns and decimal marks of a record's files, by the levels that are usual in enclosures.

A linear model is the same in another unit, but levels are not: an enclosure is as warm as outside or some
kelvins warmer, and holds about as much vapour.  Where columns are exchanged the lag models tell, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hygrokf.data.ambient import place_absolute_humidity
from hygrokf.data.clocks import Shift
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SIGNALS, from_si, to_si
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K


@dataclass(frozen=True)
class Alternative:
    """Another reading of a record's files.

    kind: "clock", "summer_time", "unit", "columns" or "decimal". name: what would be wrong, in words. line:
    what corrects it in the case file. signals: those that it changes. reading: the record read so. shifts: of
    the stamps, for a clock.
    """

    kind: str
    name: str
    line: str
    signals: tuple[str, ...]
    reading: Callable[[Record], Record]
    shifts: tuple[Shift, ...] = ()


@dataclass(frozen=True)
class _Scale:
    """A row of the table: readings of a quantity that are `words`.

    called, unit: as declared, and what they are, `factor` times as many. line: the key that corrects it.
    """

    kind: str
    words: str
    line: str
    quantity: str
    called: str
    unit: str
    factor: float = 1.0


_SCALES = (
    _Scale("unit", "in °F, called °C", 'unit = "degF"', "temperature", "degC", "degF"),
    _Scale("unit", "in °C, called °F", 'unit = "degC"', "temperature", "degF", "degC"),
    _Scale("unit", "in K, called °C", 'unit = "K"', "temperature", "degC", "K"),
    _Scale("unit", "in °C, called K", 'unit = "degC"', "temperature", "K", "degC"),
    _Scale("unit", "fractions, called per cent", 'unit = "1"', "relative_humidity", "%", "1"),
    _Scale("unit", "per cent, called fractions", 'unit = "%"', "relative_humidity", "1", "%"),
    *(
        _Scale("decimal", "read with the wrong decimal mark", 'decimal = "," or "."', *shown, 0.1**digits)
        for shown in (("temperature", "degC", "degC"), ("relative_humidity", "%", "%"))
        for digits in (1, 2)
    ),
)
_PLACES = (("cabinet",), ("ambient",), ("cabinet", "ambient"))
_EXCHANGES = (
    (("cabinet_temperature", "ambient_temperature"),),
    (("cabinet_relative_humidity", "ambient_relative_humidity"),),
    (
        ("cabinet_temperature", "ambient_temperature"),
        ("cabinet_relative_humidity", "ambient_relative_humidity"),
    ),
    (("cabinet_temperature", "cabinet_relative_humidity"),),
    (("ambient_temperature", "ambient_relative_humidity"),),
)


def value_alternatives(record: Record) -> tuple[Alternative, ...]:
    """The rows of units, decimal marks and exchanged columns that a record has the signals for."""
    made = []
    for scale in _SCALES:
        for places in _PLACES:
            signals = tuple(f"{place}_{scale.quantity}" for place in places)
            words = f"{' and '.join(signals)} {'seem' if len(signals) > 1 else 'seems'} {scale.words}"
            made.append(Alternative(scale.kind, words, scale.line, signals, partial(_scaled, signals, scale)))
    for pairs in _EXCHANGES:
        words = " and ".join(f"{a} and {b}" for a, b in pairs)
        signals = tuple(name for pair in pairs for name in pair)
        line = "exchange their columns"
        made.append(
            Alternative("columns", f"{words} seem exchanged", line, signals, partial(_exchanged, pairs))
        )
    return tuple(one for one in made if all(name in record for name in one.signals))


def _scaled(signals: Sequence[str], scale: _Scale, record: Record) -> Record:
    """Raises ValueError where readings cannot be so: a decimal mark that was lost leaves whole numbers."""
    changed = []
    for one in (record[signal] for signal in signals):
        called = from_si(one.value, scale.called, one.signal)
        if scale.kind == "decimal" and np.nanmax(np.abs(called - np.round(called)), initial=0.0) > 1e-6:
            raise ValueError(f"{one.signal} has fractions")
        changed.append(replace(one, value=to_si(scale.factor * called, scale.unit, one.signal)))
    return record.replace_series(*changed)


def _exchanged(pairs: Sequence[tuple[str, str]], record: Record) -> Record:
    def taken(signal: str, other: str) -> Series:
        numbers = from_si(record[other].value, SIGNALS[other].display, other)
        return replace(record[other], signal=signal, value=to_si(numbers, SIGNALS[signal].display, signal))

    both = (one for pair in pairs for one in (pair, pair[::-1]))
    return record.replace_series(*(taken(*one) for one in both))


def surprise(record: Record) -> float:
    """How unusual the levels of a record are: half the sum of squares of their distances from usual bands.

    Bands and scales are those of attics, greenhouses, rooms, boxes outdoors and turbines: a cabinet 0 … 10 K
    warmer than outside (12 K above, 2 K below), vapour within a factor of 1.35 of that outside (as much
    again), outside −5 … 25 °C (6 K) and 2 … 15 g/m³ (a factor of 1.5).
    """
    inside, outside = (_mean(record, f"{place}_temperature") for place in ("cabinet", "ambient"))
    vapours = (place_absolute_humidity(record, place) for place in ("cabinet", "ambient"))
    ln_inside, ln_outside = (
        np.nan if one is None or not len(one.known[1]) else np.log(max(one.known[1].mean(), 1e-9))
        for one in vapours
    )
    bands = (
        (inside - outside, 0.0, 10.0, 2.0, 12.0),
        (ln_inside - ln_outside, -0.3, 0.3, 0.3, 0.3),
        (outside - ZERO_CELSIUS_K, -5.0, 25.0, 6.0, 6.0),
        (ln_outside, np.log(2e-3), np.log(15e-3), 0.4, 0.4),
    )
    return sum(
        0.5 * max((low - value) / below, (value - high) / above, 0.0) ** 2
        for value, low, high, below, above in bands
        if np.isfinite(value)
    )


def _mean(record: Record, signal: str) -> float:
    known = record[signal].known[1] if signal in record else ()
    return float(np.mean(known)) if len(known) else np.nan
