"""Alternative interpretations of a record's files (clocks, units, columns, decimal marks), and those that the
record prefers to what the case declares.

Clocks are scored by the lag models of the cabinet (`lag_model`), with every shift of every source.  Units,
columns and decimal marks are scored by the levels of the readings, and by the lag models where these are
informative.  A linear model fits equally well in another unit, but levels do not: an enclosure is as warm as
outside or some kelvins warmer, and holds about as much vapour.  An alternative is named if it beats the
declaration beyond chance.

The lag models have a single lag.  If a cabinet seems to follow its surroundings too late, several lags in
series explain that as well as a wrong clock does.  A second witness is then needed: power, whose steps are
sharp; vapour, which has its own lag; or the sun.  If a cabinet seems to lead its surroundings, no second
witness is needed.
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
"""[s] smallest shift that is taken for a clock error; smaller ones may be response times, or the sun on a
sensor."""
OF_STEP = 0.85
"""Largest shift, as a share of a step or interval, that the position of stamps within it could explain."""
APART = 4
"""Smallest distance, in quarters of an hour, of the other shifts that a shift must beat."""
SEPARATION = 5.0
"""Standard errors (over days) by which a clock shift must win; it is large because hundreds of shifts are
tried with a rough model."""
BEHIND = 3.0
"""Standard errors by which a shift of another source must lose; otherwise both clocks are named."""
WITNESS = 12.0
"""[ln L] by which one kind of evidence must prefer the shift to count as a witness."""
ODDS = 8.0
"""[ln L] by which another unit, column or decimal mark must win."""
SYSTEMATIC = 6.0
"""[ln L] that the lag models may add to the evidence of levels at most, since no enclosure is as simple as
they are."""
FEWEST_SHIFTED_D = 14
"""Fewest days to which a shift must apply; it must win in each quarter of them."""
NAMED_SHIFT, WALL, EITHER = "named", "clock_or_wall", "either_clock"


@dataclass(frozen=True)
class Alternative:
    """Another interpretation of a record's files, such as a clock that is an hour off or another unit.

    mistake: what would be wrong.  line: what would correct it in the case file.  signals: those that change.
    reading: makes the record under this interpretation.  shifts: of the stamps, for a clock.
    """

    mistake: Statement
    line: Statement
    signals: tuple[str, ...]
    reading: Callable[[Record], Record]
    shifts: tuple[Shift, ...] = ()


@dataclass(frozen=True)
class PreferredAlternative:
    """An alternative that explains the record better than what the case declares.

    gain: [ln L] over the declaration.  witnesses: what supports it.
    verdict: "named"; "clock_or_wall" if a chain of lags explains it as well; "either_clock" if the `rival`
        does.
    """

    alternative: Alternative
    gain: float
    witnesses: tuple[str, ...] = ()
    verdict: str = NAMED_SHIFT
    rival: Alternative | None = None

    def doubt(self) -> Statement:
        """Return the finding as a doubt, with the line that would correct it."""
        alternative, rival = self.alternative, self.rival
        code = DoubtCode.CLOCK_OR_WALL if self.verdict == WALL else DoubtCode.READ_OTHERWISE
        values: dict[str, Value] = {
            "mistake": alternative.mistake,
            "remedy": alternative.line,
            "evidence": (),
        }
        if self.witnesses:
            values["evidence"] = (RecordCode.WITNESSED(witnesses=self.witnesses, gain=self.gain),)
        if self.verdict != WALL and rival is not None:
            return DoubtCode.EITHER_CLOCK(**values, other_mistake=rival.mistake, other_remedy=rival.line)
        return code(**values)


@dataclass(frozen=True)
class Readings:
    """What a record shows about its interpretation: the alternatives it prefers, and what it cannot
    decide."""

    findings: tuple[PreferredAlternative, ...] = ()
    untold: tuple[Statement, ...] = ()


@dataclass(frozen=True)
class _Shift:
    """A correction of a source's stamps in quarters of an hour, with `more` in summer, and its gain in ln L.

    between: [quarters of an hour] distance from this grid point to the maximum of a parabola through it.
    """

    source: str
    quarters: int
    more: int = 0
    gain: float = 0.0
    between: float = 0.0

    @property
    def seasons(self) -> tuple[int, int]:
        """Corrections in winter and in summer [quarters of an hour]."""
        return self.quarters, self.quarters + self.more


@dataclass(frozen=True)
class _Scan:
    """ln L of all clock shifts in one lag model.

    days: (N,) day of each row, counted from the record's first.  logliks: by inputs and extra shift in
        summer.
    """

    relation: Relation
    summer: np.ndarray
    days: np.ndarray
    logliks: Mapping[Move, np.ndarray]

    def move(self, source: str) -> tuple[frozenset[str], int]:
        """Return the inputs that a source's clock moves, and the sign of the move.

        For the cabinet's own source these are all other inputs, moved the other way (−1).
        """
        inputs = frozenset(signal for signal, clock in self.relation.sources.items() if clock == source)
        is_own_source = source == self.relation.source
        return (frozenset(self.relation.inputs) - inputs, -1) if is_own_source else (inputs, 1)

    def gains(self, inputs: frozenset[str], sign: int, more: int = 0) -> np.ndarray:
        """Return the gain in ln L (K,) of each shift, over no shift."""
        logliks_of_move = self.logliks.get((inputs, sign * more))
        if logliks_of_move is None:
            return np.zeros(2 * LARGEST_SHIFT + 1)
        return logliks_of_move.max(axis=1)[::sign] - self.logliks[inputs, 0][LARGEST_SHIFT].max()

    def by_day(self, shift: _Shift, count: int) -> np.ndarray:
        """Return ln L (count,) of each day under a shift, with the model's parameters fitted again."""
        inputs, sign = self.move(shift.source)
        move, quarters = (inputs, sign * shift.more), sign * shift.quarters
        if move not in self.logliks:  # nothing of this relation moves
            move, quarters = next(candidate for candidate in self.logliks if candidate[1] == 0), 0
        lag_h = LAGS_H[int(self.logliks[move][LARGEST_SHIFT + quarters].argmax())]
        loglik_of_rows = fit_autoregression(self.relation, lag_h, move, quarters, self.summer)[1]
        return np.bincount(self.days, loglik_of_rows, minlength=count)

    def days_apart(self, first: _Shift, second: _Shift, count: int) -> np.ndarray:
        """Return (count,) whether two shifts differ on a day that is compared."""
        winter, summer = (
            first_shift != second_shift or (first_shift != 0 and first.source != second.source)
            for first_shift, second_shift in zip(first.seasons, second.seasons, strict=True)
        )
        differs = np.where(self.summer, summer, winter) & self.relation.rows
        return np.bincount(self.days, differs, minlength=count) > 0.0


def alternative_readings(record: Record) -> Readings:
    """Return the alternative clock, unit, column or decimal mark that a record prefers, if any."""
    record = prepare(record)
    all_relations = relations(record)
    if not all_relations:
        return Readings(_values(record), (RecordCode.CLOCKS_TOO_SHORT(),))
    scans = [_scanned(relation, record) for relation in all_relations]
    clocks, untold = _clocks(record, scans, solar_lag(record))
    return Readings((*clocks, *_values(record)), untold)


def _scanned(relation: Relation, record: Record) -> _Scan:
    """Compute ln L of all shifts of every source, and of the power alone, in one lag model."""
    summer = summer_time(relation.time, in_america(record))
    quarters_of_rarer_season = (
        min(summer[relation.rows].sum(), (~summer)[relation.rows].sum()) * relation.every
    )
    summer_shifts = (0, -4, 4) if quarters_of_rarer_season >= 3 * 96 else (0,)
    empty_scan = _Scan(relation, summer, np.zeros(0), {})
    source_names = {relation.source, *relation.sources.values()}
    input_groups = {
        _POWER & frozenset(relation.inputs),
        *(empty_scan.move(name)[0] for name in source_names),
    }
    moves: set[Move] = {
        (group, summer_shift) for group in input_groups if group for summer_shift in summer_shifts
    }
    days = (relation.time // DAY_S - record.start_s // DAY_S).astype(int)
    return _Scan(
        relation, summer, days, shift_logliks(relation, fit_without_shift(relation)[0], moves, summer)
    )


_POWER = frozenset({"active_power"})


def _clocks(
    record: Record, scans: Sequence[_Scan], sun_s: float | None
) -> tuple[tuple[PreferredAlternative, ...], tuple[Statement, ...]]:
    """Return the finding about the clock that is wrong, if any, and the sources whose clock cannot be judged.

    sun_s: [s] lag of the radiation behind the sun, or None.
    """
    source_names = [name for name in sources(record) if any(scan.move(name)[0] for scan in scans)]
    light_source = record[_LIGHT].file if sun_s is not None else None
    profiles = {
        (name, summer_shift): np.sum([scan.gains(*scan.move(name), summer_shift) for scan in scans], axis=0)
        for name in source_names
        for summer_shift in (0, -4, 4)
    }
    best_shifts, not_determined = [], []
    for name in source_names:
        profile_keys = [(name, summer_shift) for summer_shift in (0, -4, 4)]
        best_all_year, _, _ = (_highest(profiles[profile_key], *profile_key) for profile_key in profile_keys)
        is_near = np.abs(np.arange(-LARGEST_SHIFT, LARGEST_SHIFT + 1) - best_all_year.quarters) < APART
        if profiles[name, 0][~is_near].max() > best_all_year.gain - WITNESS:
            not_determined.append(RecordCode.CLOCK_UNTOLD(source=name))
        if name != light_source or sun_s is None or abs(sun_s) > TOLERANCE_S:  # the sun knows better
            best_shifts += [_highest(profiles[profile_key], *profile_key) for profile_key in profile_keys]
    for shift in sorted(
        best_shifts, key=lambda candidate: (-round(candidate.gain, 3), candidate.source != light_source)
    )[:3]:
        finding = _judged(
            record, scans, profiles, shift, best_shifts, sun_s if shift.source == light_source else None
        )
        if finding is not None:
            return (finding,), tuple(not_determined)
    return (), tuple(not_determined)


def _highest(profile: np.ndarray, name: str, more: int, apart_from: int | None = None) -> _Shift:
    """Return the shift with the largest gain of a profile (K,).

    apart_from: only shifts at least `APART` quarters from this one count.
    """
    shifts = np.arange(-LARGEST_SHIFT, LARGEST_SHIFT + 1)
    is_allowed = np.ones(len(shifts), bool) if apart_from is None else np.abs(shifts - apart_from) >= APART
    place = int(np.where(is_allowed, profile, -np.inf).argmax())
    before, middle, after = profile[np.clip((place - 1, place, place + 1), 0, len(profile) - 1)]
    bend = before - 2.0 * middle + after
    between = float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0.0 else 0.0
    return _Shift(name, int(shifts[place]), more, float(middle), between)


def _judged(
    record: Record,
    scans: Sequence[_Scan],
    profiles: Mapping[tuple[str, int], np.ndarray],
    shift: _Shift,
    best: Sequence[_Shift],
    sun_s: float | None,
) -> PreferredAlternative | None:
    """Return the finding about a shift that wins beyond chance; None for others.

    profiles: gains (K,) by source and extra shift in summer.  best: the best shifts of all sources.
    """
    profile_key = shift.source, shift.more
    largest = max(shift.seasons, key=abs)
    affected = [
        series
        for series in record.series
        if series.file == shift.source or series.signal.startswith("cabinet_")
    ]
    steps_s = [max(modal_step(series.time)[0], series.interval_s) for series in affected if len(series) > 1]
    if abs(largest) * QUARTER_S < max([LEAST_S, *(OF_STEP * step for step in steps_s)]):
        return None
    rivals = [_Shift(shift.source, 0), _highest(profiles[profile_key], *profile_key, shift.quarters)]
    if shift.more:
        rivals.append(_highest(profiles[shift.source, 0], shift.source, 0))
    if min(_lead(scans, shift, rival) for rival in rivals) < SEPARATION:
        return None
    witnesses = _witnesses(scans, shift, sun_s)
    finding = PreferredAlternative(_clock(record, shift), shift.gain, witnesses)
    moves = [scan.move(shift.source) for scan in scans]
    largest_lag = max(sign * largest for inputs, sign in moves if inputs)
    if largest_lag > 0 and not set(witnesses) - {"temperature"}:
        return replace(finding, verdict=WALL)
    shifts_of_others = [
        other for other in best if other.source != shift.source and "the sun" not in witnesses
    ]
    best_other = max(shifts_of_others, key=lambda other: other.gain, default=None)
    if best_other is not None and _lead(scans, shift, best_other) < BEHIND:
        return replace(finding, verdict=EITHER, rival=_clock(record, best_other))
    return finding


def _lead(scans: Sequence[_Scan], shift: _Shift, rival: _Shift) -> float:
    """Return by how many standard errors a shift beats a rival, over the days on which they differ.

    −inf unless it wins in each quarter of these days.
    """
    count = 1 + max(int(scan.days.max()) for scan in scans)
    differs = np.any([scan.days_apart(shift, rival, count) for scan in scans], axis=0)
    daily_gain = sum(scan.by_day(shift, count) - scan.by_day(rival, count) for scan in scans)[differs]
    if (
        len(daily_gain) < FEWEST_SHIFTED_D
        or min(quarter.sum() for quarter in np.array_split(daily_gain, 4)) <= 0.0
    ):
        return -math.inf
    return _standard_errors(daily_gain)


def _standard_errors(differences: np.ndarray) -> float:
    """Return the sum of daily differences (D,) in standard errors."""
    spread = math.sqrt(len(differences) * differences.var()) if len(differences) else 0.0
    return float(differences.sum()) / spread if spread > 0.0 else 0.0


def _witnesses(scans: Sequence[_Scan], shift: _Shift, sun_s: float | None) -> tuple[str, ...]:
    """Return which kinds of evidence support a shift by themselves: temperature, vapour, power, the sun."""
    witnesses = []
    for scan in scans:
        inputs, sign = scan.move(shift.source)
        for name, group in ((scan.relation.name, inputs), ("power", _POWER & inputs)):
            if group and scan.gains(group, sign, shift.more)[LARGEST_SHIFT + shift.quarters] > WITNESS:
                witnesses.append(name)
    if sun_s is not None and abs(shift.quarters * QUARTER_S + sun_s) <= 2.0 * TOLERANCE_S:
        witnesses.append("the sun")
    return tuple(witnesses)


def _clock(record: Record, shift: _Shift) -> Alternative:
    """Return a clock shift as an alternative, with the line that would correct it."""
    winter = rounded(QUARTER_S * (shift.quarters + shift.between))
    summer = winter + QUARTER_S * shift.more
    is_southern = record.site is not None and record.site.latitude_deg < 0.0
    shifts = [Shift(shift.source, winter)] * (winter != 0.0)
    shifts += [Shift(shift.source, summer - winter, summer=True)] * (shift.more != 0)
    if shift.more:
        mistake = RecordCode.CLOCK_SEEMS_BY_SEASON(
            source=shift.source, winter=pace(winter), summer=pace(summer)
        )
        line = RecordCode.STAMPS_NEED(remedy=season_remedy(winter, summer, is_southern))
    else:
        mistake = RecordCode.CLOCK_SEEMS(source=shift.source, pace=pace(winter))
        line = state_correction(winter)
    signals = sources(record).get(shift.source, ())
    return Alternative(mistake, line, signals, lambda record: shifted(record, *shifts), tuple(shifts))


# -- units, columns, decimal marks ---------------------------------------------------------------------------
def _values(record: PreparedRecord) -> tuple[PreferredAlternative, ...]:
    """Return the unit, column or decimal mark that is far likelier than the declared one, if any."""
    if not {"cabinet_temperature", "ambient_temperature"} <= set(record.signals):
        return ()
    declared_surprise, best = _surprise(record), None
    for alternative in _value_alternatives(record):
        try:
            reinterpreted = alternative.reading(record)
        except ValueError:  # readings that no such signal can have
            continue
        level_gain = declared_surprise - _surprise(prepare(reinterpreted))
        if level_gain <= max(ODDS - SYSTEMATIC, 0.0 if best is None else best.gain - SYSTEMATIC):
            continue
        # how much more the inputs tell of the cabinet in the other reading
        daily_gain = _information(reinterpreted) - _information(record)
        lead = _standard_errors(daily_gain[np.abs(daily_gain) > 1e-9])
        gain = level_gain + math.copysign(min(0.5 * lead**2, SYSTEMATIC), lead)
        if gain >= ODDS and (best is None or gain > best.gain):
            best = PreferredAlternative(alternative, gain, ("levels",))
    return () if best is None else (best,)


def _information(record: Record) -> np.ndarray:
    """Return ln L by day (D,) that the inputs add to the cabinet's own past."""
    daily_gain = np.zeros(int((record.end_s - record.start_s) / DAY_S) + 2)
    for relation in relations(record):
        gain_of_rows = (
            fit_without_shift(relation)[1] - fit_autoregression(replace(relation, inputs={}), LAGS_H[0])[1]
        )
        days = (relation.time // DAY_S - record.start_s // DAY_S).astype(int)
        daily_gain += np.bincount(days, gain_of_rows, minlength=len(daily_gain))
    return daily_gain


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
"""Rows of: the mistake; the setting that corrects it; the quantity; the declared unit; the true unit; the
factor between the numbers."""
_PLACES = (("cabinet",), ("ambient",), ("cabinet", "ambient"))
_AIR = ("cabinet_temperature", "ambient_temperature")
_MOIST = ("cabinet_relative_humidity", "ambient_relative_humidity")
_EXCHANGES = ((_AIR,), (_MOIST,), (_AIR, _MOIST), *((pair,) for pair in zip(_AIR, _MOIST, strict=True)))


def _value_alternatives(record: Record) -> tuple[Alternative, ...]:
    """Return the alternative units, decimal marks and exchanged columns that a record has the signals for."""
    alternatives = []
    for mistake, line, quantity, called, unit, factor in _SCALES:
        for places in _PLACES:
            signals = tuple(f"{place}_{quantity}" for place in places)
            statement_of_mistake = RecordCode.SEEM(signals=signals, count=len(signals), mistake=mistake)
            alternatives.append(
                Alternative(
                    statement_of_mistake, line, signals, partial(_scaled, signals, called, unit, factor)
                )
            )
    for pairs in _EXCHANGES:
        statement_of_mistake = RecordCode.SEEM_EXCHANGED(
            pairs=tuple(RecordCode.PAIR(first=first, second=second) for first, second in pairs)
        )
        signals = tuple(name for pair in pairs for name in pair)
        alternatives.append(
            Alternative(
                statement_of_mistake, RecordCode.EXCHANGE_COLUMNS(), signals, partial(_exchanged, pairs)
            )
        )
    return tuple(
        alternative for alternative in alternatives if all(name in record for name in alternative.signals)
    )


def _scaled(signals: Sequence[str], called: str, unit: str, factor: float, record: Record) -> Record:
    """Return the record with signals read in another unit or with another decimal mark.

    Raises ValueError where readings cannot be so: a lost decimal mark leaves whole numbers.
    """
    changed = []
    for series in (record[signal] for signal in signals):
        declared_values = from_si(series.value, called, series.signal)
        if (
            factor != 1.0
            and np.nanmax(np.abs(declared_values - np.round(declared_values)), initial=0.0) > 1e-6
        ):
            raise ValueError(f"{series.signal} has fractions")
        changed.append(replace(series, value=to_si(factor * declared_values, unit, series.signal)))
    return record.replace_series(*changed)


def _exchanged(pairs: Sequence[tuple[str, str]], record: Record) -> Record:
    """Return the record with pairs of signals exchanged."""

    def exchanged_series(signal: str, other: str) -> Series:
        """Return the numbers of one signal as readings of another."""
        numbers = from_si(record[other].value, SIGNALS[other].display, other)
        return replace(record[other], signal=signal, value=to_si(numbers, SIGNALS[signal].display, signal))

    exchanged = [
        series
        for first, second in pairs
        for series in (exchanged_series(first, second), exchanged_series(second, first))
    ]
    return record.replace_series(*exchanged)


def _surprise(record: PreparedRecord) -> float:
    """Return how unusual the levels of a record are: half the sum of their squared distances from usual
    bands.

    Bands and scales are those of attics, greenhouses, rooms, boxes outdoors and turbines: a cabinet 0 … 10 K
    warmer than outside (12 K above, 2 K below), vapour within a factor of 1.35 of that outside (as much
    again), outside −5 … 25 °C (6 K) and 2 … 15 g/m³ (a factor of 1.5).
    """
    inside, outside = (_mean(record, f"{place}_temperature") for place in ("cabinet", "ambient"))
    vapours = record.cabinet_vapour, record.ambient_vapour
    ln_vapour_inside, ln_vapour_outside = (
        np.nan if series is None or not len(series.known[1]) else np.log(max(series.known[1].mean(), 1e-9))
        for series in vapours
    )
    bands = (
        (inside - outside, 0.0, 10.0, 2.0, 12.0),
        (ln_vapour_inside - ln_vapour_outside, -0.3, 0.3, 0.3, 0.3),
        (outside - ZERO_CELSIUS_K, -5.0, 25.0, 6.0, 6.0),
        (ln_vapour_outside, np.log(2e-3), np.log(15e-3), 0.4, 0.4),
    )
    return sum(
        0.5 * max((lowest - value) / scale_below, (value - highest) / scale_above, 0.0) ** 2
        for value, lowest, highest, scale_below, scale_above in bands
        if np.isfinite(value)
    )


def _mean(record: Record, signal: str) -> float:
    """Return the mean reading of a signal; NaN without readings."""
    known = record[signal].known[1] if signal in record else ()
    return float(np.mean(known)) if len(known) else np.nan


# -- the sun -------------------------------------------------------------------------------------------------
_LIGHT = "global_horizontal_irradiance"


def solar_lag(record: Record) -> float | None:
    """Return by how much [s] the middle of a day's radiation, by its stamps, lags behind solar noon at the
    site.

    None without site or radiation, or with less than 20 days of it.  The equation of time is the usual
    three-term approximation, accurate to a minute.
    """
    if record.site is None or _LIGHT not in record:
        return None
    time, value = centred(record[_LIGHT]).known
    step, _ = modal_step(record[_LIGHT].time)
    if not (len(time) > 100 and step <= 3600.0):
        return None
    year_angle = 2.0 * math.pi * (np.mod(time / DAY_S, 365.2425) - 80.0) / 365.2425
    equation_min = 9.87 * np.sin(2 * year_angle) - 7.53 * np.cos(year_angle) - 1.5 * np.sin(year_angle)
    solar = time + 240.0 * record.site.longitude_deg + 60.0 * equation_min
    day = np.floor(solar / DAY_S).astype(int)
    day -= day.min()
    day_angle = 2.0 * math.pi * (solar / DAY_S - 0.5)
    light = np.fmax(value, 0.0)
    energy, east, north = (
        np.bincount(day, light * weight) for weight in (1.0, np.sin(day_angle), np.cos(day_angle))
    )
    is_complete = (np.bincount(day) >= 0.95 * DAY_S / step) & (energy > 0.0)
    is_complete &= energy > 0.2 * np.median(energy[is_complete]) if is_complete.any() else False
    if is_complete.sum() < 20:
        return None
    # circular within the day: a clock may be wrong by half a day
    mean_angle = math.atan2(east[is_complete].sum(), north[is_complete].sum())
    angle_from_mean = np.arctan2(east[is_complete], north[is_complete]) - mean_angle
    angle_from_mean = np.mod(angle_from_mean + math.pi, 2.0 * math.pi) - math.pi
    lag = np.mod(mean_angle + np.median(angle_from_mean) + math.pi, 2.0 * math.pi) - math.pi
    return float(lag / (2.0 * math.pi) * DAY_S)
