"""Alternative readings of a record's files, and those that the record prefers to what is declared.

Clocks are scored by the lag models of the cabinet (`lag_model`), every shift of every source at once; units,
columns and decimal marks by levels, and by the lag models where these tell.  A linear model is the same in
another unit, but levels are not: an enclosure is as warm as outside or some kelvins warmer, and holds about
as much vapour.  A row is named where it beats the declaration beyond chance.

The models know one lag.  Where a cabinet seems to follow its surroundings too late, a chain of lags explains
it as well as a clock does, so a second witness is needed: power, whose steps are sharp, vapour, which has a
lag of its own, or the sun.  Where a cabinet seems to lead its surroundings, none is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hygrokf.data.input_paths import centred
from hygrokf.data.prepared import PreparedRecord, prepare
from hygrokf.data.record import Record, Series
from hygrokf.data.shared_clocks import Shift, in_america, shifted, sources
from hygrokf.data.signals import SIGNALS, from_si, to_si
from hygrokf.data.timestamps import DAY_S, modal_step, summer_time
from hygrokf.estimation.lag_model import (
    LAGS_H,
    LARGEST_SHIFT,
    QUARTER_S,
    Move,
    Relation,
    fit_autoregression,
    fit_without_shift,
    relations,
    shift_logliks,
)
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.record_codes import DoubtCode, RecordCode
from hygrokf.texts.statement import Statement, Value
from hygrokf.weather.clock_comparison import TOLERANCE_S, pace, rounded, season_remedy, state_correction

LEAST_S = 2700.0
"""[s] smaller shifts are no clock's: response times, or the sun on a sensor."""
OF_STEP = 0.85
"""Shift, as a share of a step or interval, that the place of a stamp in it can look like."""
APART = 4
"""Quarters of an hour between a shift and those that it must beat."""
SEPARATION = 5.0
"""Standard errors, by days, by which a clock must win: hundreds of shifts are tried, with a rough model."""
BEHIND = 3.0
"""Standard errors by which another source must lose for one clock alone to be named."""
WITNESS = 12.0
"""[ln L] by which a witness must prefer the shift."""
ODDS = 8.0
"""[ln L] by which a unit, a column or a decimal mark must win."""
SYSTEMATIC = 6.0
"""[ln L] that the lag models may add to levels at most: no enclosure is as simple as they are."""
FEWEST_SHIFTED_D = 14
"""Days to which a shift must apply; it must win in each quarter of them."""
NAMED_SHIFT, WALL, EITHER = "named", "clock_or_wall", "either_clock"


@dataclass(frozen=True)
class Alternative:
    """Another reading of a record's files.

    mistake: what would be wrong. line: what corrects it in the case file. signals: those that it changes.
    reading: the record read so. shifts: of the stamps, for a clock.
    """

    mistake: Statement
    line: Statement
    signals: tuple[str, ...]
    reading: Callable[[Record], Record]
    shifts: tuple[Shift, ...] = ()


@dataclass(frozen=True)
class PreferredAlternative:
    """An alternative that the record prefers to what is declared.

    gain: [ln L] ahead of the declaration. witnesses: what shows it. verdict: "named"; "clock_or_wall": a
    chain of lags explains it as well; "either_clock": so does the `rival`.
    """

    alternative: Alternative
    gain: float
    witnesses: tuple[str, ...] = ()
    verdict: str = NAMED_SHIFT
    rival: Alternative | None = None

    def doubt(self) -> Statement:
        """The finding, with the line that corrects it."""
        one, other = self.alternative, self.rival
        code = DoubtCode.CLOCK_OR_WALL if self.verdict == WALL else DoubtCode.READ_OTHERWISE
        values: dict[str, Value] = {"mistake": one.mistake, "remedy": one.line, "evidence": ()}
        if self.witnesses:
            values["evidence"] = (RecordCode.WITNESSED(witnesses=self.witnesses, gain=self.gain),)
        if self.verdict != WALL and other is not None:
            return DoubtCode.EITHER_CLOCK(**values, other_mistake=other.mistake, other_remedy=other.line)
        return code(**values)


@dataclass(frozen=True)
class Readings:
    """What a record says of its alternative readings, and what it cannot tell."""

    findings: tuple[PreferredAlternative, ...] = ()
    untold: tuple[Statement, ...] = ()


@dataclass(frozen=True)
class _Shift:
    """A correction of a source's stamps [quarters of an hour], `more` of them in summer, and its gain.

    between: [quarters of an hour] from the best shift of the grid to the top of the parabola through it.
    """

    source: str
    quarters: int
    more: int = 0
    gain: float = 0.0
    between: float = 0.0

    @property
    def seasons(self) -> tuple[int, int]:
        """The corrections in winter and in summer."""
        return self.quarters, self.quarters + self.more


@dataclass(frozen=True)
class _Scan:
    """ln L of all shifts in one relation; `days` (N,) counts days from the record's first."""

    relation: Relation
    summer: np.ndarray
    days: np.ndarray
    logliks: Mapping[Move, np.ndarray]

    def move(self, source: str) -> tuple[frozenset[str], int]:
        """The inputs that move with a source; for the cabinet's source all others, the other way (−1)."""
        inputs = frozenset(s for s, clock in self.relation.sources.items() if clock == source)
        own = source == self.relation.source
        return (frozenset(self.relation.inputs) - inputs, -1) if own else (inputs, 1)

    def gains(self, inputs: frozenset[str], sign: int, more: int = 0) -> np.ndarray:
        """Gain in ln L (K,) of each shift."""
        there = self.logliks.get((inputs, sign * more))
        if there is None:
            return np.zeros(2 * LARGEST_SHIFT + 1)
        return there.max(axis=1)[::sign] - self.logliks[inputs, 0][LARGEST_SHIFT].max()

    def by_day(self, shift: _Shift, count: int) -> np.ndarray:
        """ln L (count,) of each day with a shift, its parameters estimated anew."""
        inputs, sign = self.move(shift.source)
        move, quarters = (inputs, sign * shift.more), sign * shift.quarters
        if move not in self.logliks:  # nothing of this relation moves
            move, quarters = next(one for one in self.logliks if one[1] == 0), 0
        lag_h = LAGS_H[int(self.logliks[move][LARGEST_SHIFT + quarters].argmax())]
        each = fit_autoregression(self.relation, lag_h, move, quarters, self.summer)[1]
        return np.bincount(self.days, each, minlength=count)

    def days_apart(self, one: _Shift, other: _Shift, count: int) -> np.ndarray:
        """Whether two shifts differ on a day (count,) that is compared."""
        winter, summer = (
            a != b or (a != 0 and one.source != other.source)
            for a, b in zip(one.seasons, other.seasons, strict=True)
        )
        apart = np.where(self.summer, summer, winter) & self.relation.rows
        return np.bincount(self.days, apart, minlength=count) > 0.0


def alternative_readings(record: Record) -> Readings:
    """The clock and the other reading that a record prefers to what is declared, if any."""
    record = prepare(record)
    found = relations(record)
    if not found:
        return Readings(_values(record), (RecordCode.CLOCKS_TOO_SHORT(),))
    scans = [_scanned(one, record) for one in found]
    clocks, untold = _clocks(record, scans, solar_lag(record))
    return Readings((*clocks, *_values(record)), untold)


def _scanned(relation: Relation, record: Record) -> _Scan:
    """The shifts of every source, and of the power alone, in one relation."""
    summer = summer_time(relation.time, in_america(record))
    turns = min(summer[relation.rows].sum(), (~summer)[relation.rows].sum()) * relation.every
    extra = (0, -4, 4) if turns >= 3 * 96 else (0,)
    empty = _Scan(relation, summer, np.zeros(0), {})
    names = {relation.source, *relation.sources.values()}
    groups = {_POWER & frozenset(relation.inputs), *(empty.move(name)[0] for name in names)}
    moves: set[Move] = {(group, more) for group in groups if group for more in extra}
    days = (relation.time // DAY_S - record.start_s // DAY_S).astype(int)
    return _Scan(
        relation, summer, days, shift_logliks(relation, fit_without_shift(relation)[0], moves, summer)
    )


_POWER = frozenset({"active_power"})


def _clocks(
    record: Record, scans: Sequence[_Scan], sun_s: float | None
) -> tuple[tuple[PreferredAlternative, ...], tuple[Statement, ...]]:
    """The clock that is wrong, if one is, and the sources whose clock the record cannot tell."""
    names = [name for name in sources(record) if any(scan.move(name)[0] for scan in scans)]
    lit = record[_LIGHT].file if sun_s is not None else None
    profiles = {
        (name, more): np.sum([scan.gains(*scan.move(name), more) for scan in scans], axis=0)
        for name in names
        for more in (0, -4, 4)
    }
    best, untold = [], []
    for name in names:
        rows = [(name, more) for more in (0, -4, 4)]
        steady, _, _ = (_highest(profiles[row], *row) for row in rows)
        near = np.abs(np.arange(-LARGEST_SHIFT, LARGEST_SHIFT + 1) - steady.quarters) < APART
        if profiles[name, 0][~near].max() > steady.gain - WITNESS:
            untold.append(RecordCode.CLOCK_UNTOLD(source=name))
        if name != lit or sun_s is None or abs(sun_s) > TOLERANCE_S:  # the sun knows better
            best += [_highest(profiles[row], *row) for row in rows]
    for shift in sorted(best, key=lambda one: (-round(one.gain, 3), one.source != lit))[:3]:
        finding = _judged(record, scans, profiles, shift, best, sun_s if shift.source == lit else None)
        if finding is not None:
            return (finding,), tuple(untold)
    return (), tuple(untold)


def _highest(profile: np.ndarray, name: str, more: int, apart_from: int | None = None) -> _Shift:
    """The shift of a profile (K,) that gains most, among those at least an hour from another one."""
    shifts = np.arange(-LARGEST_SHIFT, LARGEST_SHIFT + 1)
    open_ = np.ones(len(shifts), bool) if apart_from is None else np.abs(shifts - apart_from) >= APART
    place = int(np.where(open_, profile, -np.inf).argmax())
    before, at, after = profile[np.clip((place - 1, place, place + 1), 0, len(profile) - 1)]
    bend = before - 2.0 * at + after
    between = float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0.0 else 0.0
    return _Shift(name, int(shifts[place]), more, float(at), between)


def _judged(
    record: Record,
    scans: Sequence[_Scan],
    profiles: Mapping[tuple[str, int], np.ndarray],
    shift: _Shift,
    best: Sequence[_Shift],
    sun_s: float | None,
) -> PreferredAlternative | None:
    """The finding of a shift that wins beyond chance, or None."""
    row = shift.source, shift.more
    largest = max(shift.seasons, key=abs)
    own = shift.source
    moving = [one for one in record.series if one.file == own or one.signal.startswith("cabinet_")]
    steps = [max(modal_step(one.time)[0], one.interval_s) for one in moving if len(one) > 1]
    if abs(largest) * QUARTER_S < max([LEAST_S, *(OF_STEP * step for step in steps)]):
        return None
    rivals = [_Shift(shift.source, 0), _highest(profiles[row], *row, shift.quarters)]
    if shift.more:
        rivals.append(_highest(profiles[shift.source, 0], shift.source, 0))
    if min(_lead(scans, shift, rival) for rival in rivals) < SEPARATION:
        return None
    witnesses = _witnesses(scans, shift, sun_s)
    found = PreferredAlternative(_clock(record, shift), shift.gain, witnesses)
    late = max(sign * largest for inputs, sign in (one.move(shift.source) for one in scans) if inputs)
    if late > 0 and not set(witnesses) - {"temperature"}:
        return replace(found, verdict=WALL)
    others = [one for one in best if one.source != shift.source and "the sun" not in witnesses]
    other = max(others, key=lambda one: one.gain, default=None)
    if other is not None and _lead(scans, shift, other) < BEHIND:
        return replace(found, verdict=EITHER, rival=_clock(record, other))
    return found


def _lead(scans: Sequence[_Scan], shift: _Shift, rival: _Shift) -> float:
    """By how many standard errors a shift beats another one over the days on which they differ; −inf unless
    it wins in each quarter of these."""
    count = 1 + max(int(scan.days.max()) for scan in scans)
    apart = np.any([scan.days_apart(shift, rival, count) for scan in scans], axis=0)
    each = sum(scan.by_day(shift, count) - scan.by_day(rival, count) for scan in scans)[apart]
    if len(each) < FEWEST_SHIFTED_D or min(part.sum() for part in np.array_split(each, 4)) <= 0.0:
        return -math.inf
    return _standard_errors(each)


def _standard_errors(each: np.ndarray) -> float:
    """Sum of differences by day (D,) in standard errors."""
    spread = math.sqrt(len(each) * each.var()) if len(each) else 0.0
    return float(each.sum()) / spread if spread > 0.0 else 0.0


def _witnesses(scans: Sequence[_Scan], shift: _Shift, sun_s: float | None) -> tuple[str, ...]:
    """What prefers a shift by itself."""
    found = []
    for scan in scans:
        inputs, sign = scan.move(shift.source)
        for name, group in ((scan.relation.name, inputs), ("power", _POWER & inputs)):
            if group and scan.gains(group, sign, shift.more)[LARGEST_SHIFT + shift.quarters] > WITNESS:
                found.append(name)
    if sun_s is not None and abs(shift.quarters * QUARTER_S + sun_s) <= 2.0 * TOLERANCE_S:
        found.append("the sun")
    return tuple(found)


def _clock(record: Record, shift: _Shift) -> Alternative:
    """The row of a shift, with the line that corrects it."""
    winter = rounded(QUARTER_S * (shift.quarters + shift.between))
    summer = winter + QUARTER_S * shift.more
    south = record.site is not None and record.site.latitude_deg < 0.0
    steps = [Shift(shift.source, winter)] * (winter != 0.0)
    steps += [Shift(shift.source, summer - winter, summer=True)] * (shift.more != 0)
    if shift.more:
        mistake = RecordCode.CLOCK_SEEMS_BY_SEASON(
            source=shift.source, winter=pace(winter), summer=pace(summer)
        )
        line = RecordCode.STAMPS_NEED(remedy=season_remedy(winter, summer, south))
    else:
        mistake = RecordCode.CLOCK_SEEMS(source=shift.source, pace=pace(winter))
        line = state_correction(winter)
    signals = sources(record).get(shift.source, ())
    return Alternative(mistake, line, signals, lambda record: shifted(record, *steps), tuple(steps))


# -- units, columns, decimal marks ---------------------------------------------------------------------------
def _values(record: PreparedRecord) -> tuple[PreferredAlternative, ...]:
    """The reading of other units, columns or decimal marks that is likelier by far, if any."""
    if not {"cabinet_temperature", "ambient_temperature"} <= set(record.signals):
        return ()
    usual, best = _surprise(record), None
    for row in _value_alternatives(record):
        try:
            other = row.reading(record)
        except ValueError:  # readings that no such signal can have
            continue
        levels = usual - _surprise(prepare(other))
        if levels <= max(ODDS - SYSTEMATIC, 0.0 if best is None else best.gain - SYSTEMATIC):
            continue
        # how much more the inputs tell of the cabinet in the other reading
        each = _information(other) - _information(record)
        lead = _standard_errors(each[np.abs(each) > 1e-9])
        gain = levels + math.copysign(min(0.5 * lead**2, SYSTEMATIC), lead)
        if gain >= ODDS and (best is None or gain > best.gain):
            best = PreferredAlternative(row, gain, ("levels",))
    return () if best is None else (best,)


def _information(record: Record) -> np.ndarray:
    """ln L by day (D,) that the inputs add to the cabinet's own past."""
    found = np.zeros(int((record.end_s - record.start_s) / DAY_S) + 2)
    for relation in relations(record):
        told = fit_without_shift(relation)[1] - fit_autoregression(replace(relation, inputs={}), LAGS_H[0])[1]
        days = (relation.time // DAY_S - record.start_s // DAY_S).astype(int)
        found += np.bincount(days, told, minlength=len(found))
    return found


_DEGREES = {"degF": "°F", "degC": "°C", "K": "K"}
_SCALES = (
    *(
        (
            RecordCode.IN_OTHER_UNIT(unit=_DEGREES[unit], called=_DEGREES[called]),
            RecordCode.STATE_UNIT(unit=unit),
            "temperature",
            called,
            unit,
            1.0,
        )
        for unit, called in (("degF", "degC"), ("degC", "degF"), ("K", "degC"), ("degC", "K"))
    ),
    *(
        (mistake(), RecordCode.STATE_UNIT(unit=unit), "relative_humidity", called, unit, 1.0)
        for mistake, called, unit in (
            (RecordCode.FRACTIONS_CALLED_PER_CENT, "%", "1"),
            (RecordCode.PER_CENT_CALLED_FRACTIONS, "1", "%"),
        )
    ),
    *(
        (RecordCode.WRONG_DECIMAL_MARK(), RecordCode.STATE_DECIMAL_MARK(), *shown, 0.1**digits)
        for shown in (("temperature", "degC", "degC"), ("relative_humidity", "%", "%"))
        for digits in (1, 2)
    ),
)
"""A mistake, the key that corrects it; a quantity, the unit that its readings are declared in, the one that
they are in, and how many times as many they are."""
_PLACES = (("cabinet",), ("ambient",), ("cabinet", "ambient"))
_AIR = ("cabinet_temperature", "ambient_temperature")
_MOIST = ("cabinet_relative_humidity", "ambient_relative_humidity")
_EXCHANGES = ((_AIR,), (_MOIST,), (_AIR, _MOIST), *((pair,) for pair in zip(_AIR, _MOIST, strict=True)))


def _value_alternatives(record: Record) -> tuple[Alternative, ...]:
    """The rows of units, decimal marks and exchanged columns that a record has the signals for."""
    made = []
    for mistake, line, quantity, called, unit, factor in _SCALES:
        for places in _PLACES:
            signals = tuple(f"{place}_{quantity}" for place in places)
            what = RecordCode.SEEM(signals=signals, count=len(signals), mistake=mistake)
            made.append(Alternative(what, line, signals, partial(_scaled, signals, called, unit, factor)))
    for pairs in _EXCHANGES:
        what = RecordCode.SEEM_EXCHANGED(pairs=tuple(RecordCode.PAIR(first=a, second=b) for a, b in pairs))
        signals = tuple(name for pair in pairs for name in pair)
        made.append(Alternative(what, RecordCode.EXCHANGE_COLUMNS(), signals, partial(_exchanged, pairs)))
    return tuple(one for one in made if all(name in record for name in one.signals))


def _scaled(signals: Sequence[str], called: str, unit: str, factor: float, record: Record) -> Record:
    """Raises ValueError where readings cannot be so: a decimal mark that was lost leaves whole numbers."""
    changed = []
    for one in (record[signal] for signal in signals):
        shown = from_si(one.value, called, one.signal)
        if factor != 1.0 and np.nanmax(np.abs(shown - np.round(shown)), initial=0.0) > 1e-6:
            raise ValueError(f"{one.signal} has fractions")
        changed.append(replace(one, value=to_si(factor * shown, unit, one.signal)))
    return record.replace_series(*changed)


def _exchanged(pairs: Sequence[tuple[str, str]], record: Record) -> Record:
    def taken(signal: str, other: str) -> Series:
        numbers = from_si(record[other].value, SIGNALS[other].display, other)
        return replace(record[other], signal=signal, value=to_si(numbers, SIGNALS[signal].display, signal))

    both = (one for pair in pairs for one in (pair, pair[::-1]))
    return record.replace_series(*(taken(*one) for one in both))


def _surprise(record: PreparedRecord) -> float:
    """How unusual the levels of a record are: half the sum of squares of their distances from usual bands.

    Bands and scales are those of attics, greenhouses, rooms, boxes outdoors and turbines: a cabinet 0 … 10 K
    warmer than outside (12 K above, 2 K below), vapour within a factor of 1.35 of that outside (as much
    again), outside −5 … 25 °C (6 K) and 2 … 15 g/m³ (a factor of 1.5).
    """
    inside, outside = (_mean(record, f"{place}_temperature") for place in ("cabinet", "ambient"))
    vapours = record.cabinet_vapour, record.ambient_vapour
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


# -- the sun -------------------------------------------------------------------------------------------------
_LIGHT = "global_horizontal_irradiance"


def solar_lag(record: Record) -> float | None:
    """Time from solar noon at the site to the middle of a day's radiation by its stamps [s]; None without
    site or radiation, or with less than 20 days of it.

    The equation of time is the usual three-term approximation, accurate to a minute.
    """
    if record.site is None or _LIGHT not in record:
        return None
    time, value = centred(record[_LIGHT]).known
    step, _ = modal_step(record[_LIGHT].time)
    if not (len(time) > 100 and step <= 3600.0):
        return None
    angle = 2.0 * math.pi * (np.mod(time / DAY_S, 365.2425) - 80.0) / 365.2425
    equation_min = 9.87 * np.sin(2 * angle) - 7.53 * np.cos(angle) - 1.5 * np.sin(angle)
    solar = time + 240.0 * record.site.longitude_deg + 60.0 * equation_min
    day = np.floor(solar / DAY_S).astype(int)
    day -= day.min()
    turn = 2.0 * math.pi * (solar / DAY_S - 0.5)
    light = np.fmax(value, 0.0)
    energy, east, north = (np.bincount(day, light * one) for one in (1.0, np.sin(turn), np.cos(turn)))
    whole = (np.bincount(day) >= 0.95 * DAY_S / step) & (energy > 0.0)
    whole &= energy > 0.2 * np.median(energy[whole]) if whole.any() else False
    if whole.sum() < 20:
        return None
    # circular within the day: a clock may be wrong by half a day
    middle = math.atan2(east[whole].sum(), north[whole].sum())
    apart = np.arctan2(east[whole], north[whole]) - middle
    apart = np.mod(apart + math.pi, 2.0 * math.pi) - math.pi
    lag = np.mod(middle + np.median(apart) + math.pi, 2.0 * math.pi) - math.pi
    return float(lag / (2.0 * math.pi) * DAY_S)
