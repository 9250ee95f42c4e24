"""Assign columns to signals by their names and readings, with the runners-up; and infer from the values of a
column its unit, the place of measurement and the rated power of a turbine."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from hygrokf.data.numbers import POLES, flag_word
from hygrokf.data.probes import copies, probe_of, temperatures_of
from hygrokf.data.quality import BAD, UNSTATED_VOCABULARY, QualityVocabulary, drafted
from hygrokf.data.record import Series
from hygrokf.data.signals import (
    HUMIDITIES,
    SIGNALS,
    SWITCHED,
    fitting_units,
    share_in_range,
    to_si,
    unit_mistaken,
)
from hygrokf.data.timestamps import HOUR_S
from hygrokf.drafting.layout import Export
from hygrokf.drafting.stamps import ExportClock, clock_of
from hygrokf.drafting.vocabulary import NamedColumn, name_says, place_of, words_of


@dataclass(frozen=True)
class Hourly:
    """Hourly means of a column, to compare columns of different clocks.

    hour: (N,) number of the hour since 1970, increasing. value: (N,).
    """

    hour: np.ndarray
    value: np.ndarray

    def beside(self, other: Hourly) -> tuple[np.ndarray, np.ndarray]:
        """Values of this column and of another column in the hours that both have."""
        _, here, there = np.intersect1d(self.hour, other.hour, return_indices=True)
        return self.value[here], other.value[there]


def unit_by_values(values: np.ndarray, signal: str, stated: str | None) -> tuple[str, str | None]:
    """The unit of a column, and a doubt where only the readings determine it or they contradict the header.

    values: (N,) as in the file. signal: of the table. stated: a name in `UNITS`, or None.
    """
    finite = values[np.isfinite(values)]
    units = fitting_units(signal)
    if stated in units:
        if not len(finite) or unit_mistaken(values, stated, signal) is None:
            return stated, None
        better_units = [
            candidate
            for candidate in units
            if candidate != stated and unit_mistaken(values, candidate, signal) is None
        ]
        if better_units:
            return better_units[0], f"the header says {stated}, but the readings fit {better_units[0]}"
        return stated, f"the readings do not fit the unit {stated} of the header"
    ranked = list(dict.fromkeys((SIGNALS[signal].display, *units)))
    if not len(finite):
        return ranked[0], "the column holds no readings"
    if signal.endswith("_power"):
        highest = float(np.quantile(np.abs(finite), 0.995))
        unit = "MW" if highest < 20.0 else "kW" if highest < 30e3 else "W"
        return unit, f"the header states no unit; readings up to {highest:.4g} fit {unit}"
    if signal == "rain":
        unit = "1" if float(np.max(finite)) <= 1.0 else "mm"
        return unit, f"the header states no unit; readings up to {np.max(finite):.4g} fit {unit}"
    fits = [
        candidate
        for candidate in ranked
        if unit_mistaken(values, candidate, signal) is None
        and share_in_range(finite, candidate, signal) > 0.9
    ]
    if not fits:
        return ranked[0], "the header states no unit and the readings fit none"
    if SIGNALS[signal].dimension == "temperature" and fits[0] == "degC" and np.quantile(finite, 0.95) < 60.0:
        return "degC", None
    alternative = (
        f", perhaps {fits[1]}"
        if len(fits) > 1 and SIGNALS[signal].dimension in ("temperature", "angle")
        else ""
    )
    doubt = f"the header states no unit; the readings fit {fits[0]}{alternative}"
    return fits[0], doubt if alternative else None


def reason_impossible(values: np.ndarray, unit: str, signal: str) -> str | None:
    """Why a column cannot hold a signal although its unit fits; None where it can."""
    finite = values[np.isfinite(values)]
    if len(finite) < (3 if signal in SWITCHED else 20):
        return "hardly any readings"
    if np.ptp(finite) == 0.0:
        return f"all readings are {finite[0]:g}"
    if (
        signal == "wind_direction"
        and unit == "deg"
        and len(finite) > 1000
        and np.quantile(finite, 0.999) < 300.0
    ):
        return f"readings reach {finite.max():g}, less than a whole turn of 360 deg"
    share_inside = share_in_range(finite, unit, signal)
    doubt = f"{100 * (1 - share_inside):.0f} % of the readings are out of the physical range"
    return doubt if share_inside < 0.7 else None


def like_ambient(column: Hourly, others: list[Hourly]) -> float:
    """Likeness of a temperature to the outside air's, 0 to 1: colder than the other temperatures, with a
    wider range and a daily course."""
    if len(column.value) < 24:
        return 0.0
    pairs = map(column.beside, others)
    colder_shares = [float(np.mean(inside < outside)) for inside, outside in pairs if len(inside) > 24]
    is_wider = [_spread(column) > _spread(other) for other in others if len(other.value) > 24]
    coldness = float(np.mean(colder_shares)) if colder_shares else 0.5
    wideness = float(np.mean(is_wider)) if is_wider else 0.5
    days = np.floor(column.hour / 24.0)
    _, day_index = np.unique(days, return_inverse=True)
    spread_of_days = float(np.std(np.bincount(day_index, column.value) / np.bincount(day_index)))
    # outside, the daily mean varies by several kelvins within weeks
    return (0.45 * coldness + 0.3 * wideness + 0.25 * daily_share(column)) * min(spread_of_days / 2.5, 1.0)


def like_cabinet(column: Hourly, ambient: Hourly | None, power: Hourly | None) -> float:
    """Likeness of a temperature to a closed cabinet's, 0 to 1: warmer than the outside air, and correlated
    with the outside temperature and with the power."""
    if ambient is None:
        return 0.5
    inside, outside = column.beside(ambient)
    if len(inside) < 24:
        return 0.3
    score = 0.4 * float(np.mean(inside > outside)) + 0.3 * max(_correlation(inside, outside), 0.0)
    if power is not None:
        excess, load = column.beside(power)
        score += 0.3 * max(_correlation(excess, load), 0.0)
    return score


def follows_rather(column: Hourly, one: Hourly, other: Hourly) -> bool:
    """Whether the column minus series `one` varies less than the column minus series `other`, over a day or
    more."""
    spreads = []
    for series in (one, other):
        own_values, other_values = column.beside(series)
        spreads.append(float(np.std(own_values - other_values)) if len(own_values) >= 24 else math.nan)
    return spreads[0] < spreads[1]


def daily_share(column: Hourly) -> float:
    """Share of the variance within days that the mean course of the day explains, 0 to 1."""
    day = np.floor(column.hour / 24.0)
    _, day_index = np.unique(day, return_inverse=True)
    within = column.value - (np.bincount(day_index, column.value) / np.bincount(day_index))[day_index]
    hour_of_day = np.mod(column.hour, 24).astype(int)
    course = np.bincount(hour_of_day, within, 24) / np.maximum(np.bincount(hour_of_day, minlength=24), 1)
    total = float(np.var(within))
    return min(float(np.var(course[hour_of_day])) / total, 1.0) if total > 0.0 else 0.0


def rated_power(values: np.ndarray, unit: str) -> float | None:
    """Rated power [kW] by the plateau that the power does not exceed; None where there is no plateau.

    values: [unit] (N,).  A plateau holds at least 0.5 % of the readings within 2 % of the 99.8th
    percentile, and at least 1.5 times as many readings as the 4 % below.
    """
    power = to_si(values[np.isfinite(values)], unit, "active_power") / 1e3
    if len(power) < 100:
        return None
    top = float(np.quantile(power, 0.998))
    is_at_plateau = (power > 0.98 * top) & (power < 1.02 * top)
    is_below = (power > 0.94 * top) & (power <= 0.98 * top)
    if top <= 0.0 or is_at_plateau.mean() < 0.005 or is_at_plateau.sum() < 1.5 * is_below.sum():
        return None
    return float(f"{np.median(power[is_at_plateau]):.3g}")


def _spread(column: Hourly) -> float:
    return float(np.subtract(*np.quantile(column.value, (0.95, 0.05))))


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    if len(one) < 24 or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])


SURE_SCORE = 0.8
"""Score from which a name needs no confirmation."""
OUTSIDE = 0.45
"""Score from which readings alone may be those of the outside air."""
NEEDED_SCORE = 0.3
"""Score from which a signal that a model needs is read, with its doubts."""
USED = 0.7
"""Score from which a signal that no model needs is read without an edit."""
_FILLERS = (-99.0, -99.9, -999.0, -999.9, -9999.0, -99999.0, 9999.0, 99999.0)
_NO_UNIT_HERE = re.compile(r" (mm hg|mmhg|inhg|in hg|torr|psi|knots|kt|mph|km h|ft) ")
COPIED = tuple(f"{place}_{one}" for place in ("cabinet", "ambient") for one in ("temperature", *HUMIDITIES))
"""Signals of the ambient air whose column may repeat the cabinet's readings, and their counterparts."""


@dataclass(frozen=True)
class DraftedSignal:
    """A column that may hold a signal, or in a draft the column of a signal.

    file: path in the case. score: 0 to 1. why: in words. doubts: to confirm. active: whether the case reads
    the column; otherwise its line is a comment. compare: whether it is only compared with another source.
    """

    signal: str
    file: str
    column: str
    unit: str
    score: float
    why: str
    doubts: tuple[str, ...] = ()
    active: bool = False
    compare: bool = False

    @property
    def key(self) -> Key:
        return self.file, self.column


@dataclass(frozen=True)
class LeftColumn:
    """A column without a signal, and why."""

    file: str
    column: str
    why: str


Key: TypeAlias = tuple[str, str]
"""A column: the path of its source in the case, and its name."""


@dataclass(frozen=True)
class Source:
    """An export whose columns are numbers.

    path: in the case. values: column -> readings (N,), without those of bad quality. named: column -> what
    its name says. left: column -> why it holds no signal. quality: column -> column of its quality.
    vocabulary: of these. quality_doubts: about them. sun: what the irradiance says of the clock.
    """

    path: str
    export: Export
    clock: ExportClock
    values: dict[str, np.ndarray]
    named: dict[str, NamedColumn]
    left: dict[str, str] = field(default_factory=dict)
    quality: dict[str, str] = field(default_factory=dict)
    vocabulary: QualityVocabulary = UNSTATED_VOCABULARY
    quality_doubts: tuple[str, ...] = ()
    sun: str | None = None

    def hourly(self, column: str) -> Hourly:
        """Hourly means of a column."""
        time, values = self.clock.time, self.values[column]
        is_known = np.isfinite(time) & np.isfinite(values)
        hours, hour_index = np.unique(np.floor(time[is_known] / HOUR_S), return_inverse=True)
        return Hourly(
            hours, np.bincount(hour_index, values[is_known]) / np.maximum(np.bincount(hour_index), 1)
        )


def source_of(export: Export, path: str) -> Source:
    """An export with its clock, its numbers and the meaning of its names; path: in the case.

    Readings count as means over intervals where a name says so, or where the export has signals of operation.
    """
    cells, column, values = export.cells, export.column, dict[str, np.ndarray]()
    counts = {name: cells[name].notna().sum() for name in cells}
    for name in (name for name in cells if name != column and counts[name] >= 2):
        numbers, _ = export.read(name)
        if np.isfinite(numbers).sum() > 0.5 * counts[name]:
            values[name] = numbers
    texts = {name: list(cells[name].dropna().unique()) for name in cells}
    quality, vocabulary, statements = drafted(texts, values)
    doubts = tuple(statement.text for statement in statements)
    values = {name: array for name, array in values.items() if name not in quality.values()}
    for name, quality_column in quality.items():
        bad = cells[quality_column].map(vocabulary.judge) == BAD
        values[name] = np.where(bad, np.nan, values[name])
    headers = zip(cells, export.names, strict=False)
    repeated = {name for name, header in headers if export.names.count(header) > 1}
    # columns of one constant number that codes a missing reading hold nothing
    finite = {name: array[np.isfinite(array)] for name, array in values.items()}
    empty = {
        name for name, array in finite.items() if len(array) and np.ptp(array) == 0.0 and array[0] in _FILLERS
    }
    empty |= {name for name in cells if not counts[name]}
    values = {
        name: array
        for name, array in values.items()
        if name not in empty and (name not in repeated or export.changes)
    }
    units = dict(zip(cells.columns, export.units, strict=True))
    named = {name: _read_name(export, name, units[name]) for name in values}
    left = {
        name: "no readings" if name in empty else "text" for name in cells if name not in (*values, column)
    }
    left |= {name: "several columns have this name" for name in left if name in repeated}
    left |= {quality_column: f'quality of "{name}"' for name, quality_column in quality.items()}
    is_operation = any(n.signal in ("active_power", "wind_speed", "rotor_speed") for n in named.values())
    has_averages = any(re.search(r" (avg|ave|mean|mittel\w*) ", n.words) for n in named.values())
    is_reanalysis = any("ERA5" in n.why for n in named.values())
    clock = clock_of(export, (is_operation or has_averages) and not is_reanalysis)
    return Source(path, export, clock, values, named, left, quality, vocabulary, doubts)


def _read_name(export: Export, name: str, unit: str) -> NamedColumn:
    """The meaning of a column's name; a flag's name is read together with the word for its 1 if need be."""
    unlabelled = name.replace(export.label, "", 1)
    named, word = name_says(unlabelled, unit), flag_word(export.cells[name])
    return name_says(f"{unlabelled} {word}", unit) if word and not named.signal else named


def assign_signals(sources: Mapping[str, Source]) -> tuple[list[DraftedSignal], list[LeftColumn]]:
    """The signals found with their columns, and the other columns with the reason; sources: by path."""

    def series(candidate: DraftedSignal | None) -> Hourly | None:
        return None if candidate is None else sources[candidate.file].hourly(candidate.column)

    by_name = [candidate for source in sources.values() for candidate in _by_name(source)]
    ambient = _best(by_name, "ambient_temperature")
    open_temperatures = _unplaced(sources, "temperature")
    guesses: list[DraftedSignal] = [*_by_file(sources, open_temperatures)]
    placed = {candidate.key for candidate in guesses}
    open_temperatures = [key for key in open_temperatures if key not in placed]
    if ambient is None and not any(candidate.signal == "ambient_temperature" for candidate in guesses):
        guesses += _ambient_by_values(sources, open_temperatures, by_name)
    ambient = ambient or _best(guesses, "ambient_temperature")
    outside, load = series(ambient), series(_best(by_name, "active_power"))
    for file, column in open_temperatures:
        if ambient is not None and ambient.key == (file, column):
            continue
        source = sources[file]
        likeness = like_cabinet(source.hourly(column), outside, load)
        bonus_of_air = 0.04 if " air " in source.named[column].words else 0.0
        score = round(0.2 + 0.4 * likeness + bonus_of_air, 3)
        guesses.append(_candidate(source, "cabinet_temperature", column, score, "by its readings"))
    inside = series(_best(by_name, "cabinet_temperature"))
    if inside is not None and outside is not None:
        guesses += _cabinet_humidities(sources, inside, outside)
    guesses += _companions(sources, _best_by_column([*by_name, *guesses]))
    candidates = _prefer_probe_temperatures(
        sources, _lower_scores_of_impossible([*by_name, *guesses], sources)
    )
    return _decide(sources, _without_copies(sources, candidates))


def _by_name(source: Source) -> list[DraftedSignal]:
    candidates = []
    for column, named in source.named.items():
        if not named.signal:
            continue
        if _NO_UNIT_HERE.search(words_of(column)):
            source.left[column] = f"may be {named.signal}, in a unit that a case does not know: convert it"
            continue
        candidates.append(_candidate(source, named.signal, column, named.score, named.why))
    return candidates


def _candidate(source: Source, signal: str, column: str, score: float, why: str) -> DraftedSignal:
    unit, doubt = unit_by_values(source.values[column], signal, source.named[column].unit)
    return DraftedSignal(signal, source.path, column, unit, score, why, () if doubt is None else (doubt,))


def _unplaced(sources: Mapping[str, Source], quantity: str) -> list[Key]:
    """Columns of a quantity whose names state no place."""
    return [
        (file, column)
        for file, source in sources.items()
        for column, named in source.named.items()
        if named.quantity == quantity and not named.signal and not named.place
    ]


def _by_file(sources: Mapping[str, Source], columns: list[Key]) -> list[DraftedSignal]:
    """Candidates among the columns of loggers, whose file or folder names the place."""
    candidates = []
    folders = {source.export.file.parent for source in sources.values()}
    for path, column in columns:
        source = sources[path]
        file = source.export.file
        place, score = place_of(words_of(file.name.split(".")[0]))
        if not place and len(folders) > 1:
            place, score = place_of(words_of(file.parent.name))
        is_alone = sum(other == path for other, _ in columns) == 1
        if place in ("cabinet", "ambient", "nacelle", "tower") and is_alone:
            signal = f"{place}_{source.named[column].quantity}"
            candidates.append(
                _candidate(source, signal, column, min(score, SURE_SCORE), "by the name of its file")
            )
    return candidates


def _ambient_by_values(
    sources: Mapping[str, Source], columns: list[Key], sure: list[DraftedSignal]
) -> list[DraftedSignal]:
    """Candidates for the ambient temperature among temperatures without a place, by their likeness to it."""
    hourly_of = {key: sources[key[0]].hourly(key[1]) for key in columns}
    named = [sources[c.file].hourly(c.column) for c in sure if c.signal.endswith("_temperature")]
    candidates = []
    for key in columns if len(columns) + len(named) > 1 else []:
        others = [*(series for other, series in hourly_of.items() if other != key), *named]
        score = round(0.2 + 0.4 * like_ambient(hourly_of[key], others), 3)
        if score >= OUTSIDE:
            why = "by its readings"
            candidates.append(_candidate(sources[key[0]], "ambient_temperature", key[1], score, why))
    return candidates


def _cabinet_humidities(
    sources: Mapping[str, Source], inside: Hourly, outside: Hourly
) -> list[DraftedSignal]:
    """Humidities without a place whose probe's temperature follows the cabinet temperature of another file
    more closely than the outside temperature."""
    candidates = []
    for file, column in _unplaced(sources, "relative_humidity"):
        source = sources[file]
        probe_temperatures = temperatures_of(column, source.values)
        if len(probe_temperatures) == 1 and follows_rather(
            source.hourly(probe_temperatures[0]), inside, outside
        ):
            why = f'"{probe_temperatures[0]}" follows the cabinet temperature'
            candidates.append(_candidate(source, "cabinet_relative_humidity", column, 0.6, why))
    return candidates


def _companions(sources: Mapping[str, Source], taken: Mapping[Key, DraftedSignal]) -> list[DraftedSignal]:
    """Candidates among humidities and dew points without a place, which take the place of the temperature of
    the same probe or logger; a dew point without a temperature in its file belongs to the weather."""
    companions: list[DraftedSignal] = []
    for quantity in ("relative_humidity", "dew_point_temperature"):
        unplaced = _unplaced(sources, quantity)
        by_file = _by_file(sources, unplaced)
        companions += by_file
        placed = {other.key for other in by_file}
        for file, column in (other for other in unplaced if other not in placed):
            source, is_alone = sources[file], sum(path == file for path, _ in unplaced) == 1
            for other in (other for other in taken.values() if other.file == file):
                place, _, kind = other.signal.rpartition("_")
                is_same_probe = probe_of(other.column)[0] == probe_of(column)[0]
                is_same_logger = is_alone and other.why != "by its name" and place in ("cabinet", "ambient")
                dew_point = other.signal.endswith("point_temperature")
                if kind == "temperature" and not dew_point and (is_same_probe or is_same_logger):
                    score, why = min(other.score, 0.75), f'beside "{other.column}"'
                    companions.append(_candidate(source, f"{place}_{quantity}", column, score, why))
            if quantity == "dew_point_temperature" and not temperatures_of(column, source.values):
                companions.append(_candidate(source, f"ambient_{quantity}", column, 0.85, "by its name"))
    return [other for other in companions if other.signal in SIGNALS]


def _prefer_probe_temperatures(
    sources: Mapping[str, Source], candidates: list[DraftedSignal]
) -> list[DraftedSignal]:
    """Candidates in which a place's temperature is measured by the probe of its humidity, where possible."""
    taken, preferred = _best_by_column(candidates), []
    for humidity in taken.values():
        source, (place, _, quantity) = sources[humidity.file], humidity.signal.rpartition("_relative_")
        probe_temperatures = temperatures_of(humidity.column, source.values) if quantity == "humidity" else []
        signal = f"{place}_temperature"
        temperature = next((candidate for candidate in taken.values() if candidate.signal == signal), None)
        is_single = len(probe_temperatures) == 1
        if not is_single or temperature is None or temperature.key == (humidity.file, probe_temperatures[0]):
            continue
        if source.named[probe_temperatures[0]].signal in ("", signal):
            why = f'of the probe of "{humidity.column}"'
            preferred.append(_candidate(source, signal, probe_temperatures[0], temperature.score, why))
    taken_keys = {candidate.key for candidate in preferred}
    # of equal scores the first one is chosen
    return [*preferred, *(candidate for candidate in candidates if candidate.key not in taken_keys)]


def _without_copies(sources: Mapping[str, Source], candidates: list[DraftedSignal]) -> list[DraftedSignal]:
    """Candidates without ambient columns that repeat the cabinet's readings or are computed from them; `left`
    of their sources gets the reason."""
    while True:
        taken = [c for c in _best_by_column(candidates).values() if c.signal in COPIED]
        copied = copies([_series(sources[c.file], c) for c in taken])
        reasons = {str(statement.values["signal"]): statement.text for statement in copied}
        if not reasons:
            return candidates
        keys = {c.key: reasons[c.signal] for c in taken if c.signal in reasons}
        for (file, column), words in keys.items():
            sources[file].left[column] = words
        candidates = [candidate for candidate in candidates if candidate.key not in keys]


def _series(source: Source, candidate: DraftedSignal) -> Series:
    time, rows = np.unique(source.clock.time, return_index=True)
    is_known = np.isfinite(time)
    value = to_si(source.values[candidate.column], candidate.unit, candidate.signal)[rows]
    where = f'{source.export.file.name}, column "{candidate.column}"'
    return Series(candidate.signal, time[is_known], value[is_known], "linear", source=where)


def _best(candidates: list[DraftedSignal], signal: str) -> DraftedSignal | None:
    of_signal = (candidate for candidate in candidates if candidate.signal == signal)
    return max(of_signal, key=lambda candidate: candidate.score, default=None)


def _best_by_column(candidates: list[DraftedSignal]) -> dict[Key, DraftedSignal]:
    """The best candidate of each column, where no better candidate has the same signal."""
    taken: dict[Key, DraftedSignal] = {}
    signals: set[str] = set()
    for candidate in sorted(candidates, key=lambda candidate: -candidate.score):
        if candidate.signal not in signals and candidate.key not in taken:
            taken[candidate.key] = candidate
            signals.add(candidate.signal)
    return taken


def _lower_scores_of_impossible(
    candidates: list[DraftedSignal], sources: Mapping[str, Source]
) -> list[DraftedSignal]:
    """Candidates, with lower scores where the readings cannot be readings of the signal."""
    checked = []
    for candidate in candidates:
        reason = reason_impossible(
            sources[candidate.file].values[candidate.column], candidate.unit, candidate.signal
        )
        if reason is not None:
            candidate = replace(candidate, score=0.3 * candidate.score, doubts=(*candidate.doubts, reason))
        checked.append(candidate)
    return checked


def _decide(
    sources: Mapping[str, Source], candidates: list[DraftedSignal]
) -> tuple[list[DraftedSignal], list[LeftColumn]]:
    taken = _best_by_column(candidates)
    ambient = next((chosen for chosen in taken.values() if chosen.signal == "ambient_temperature"), None)
    is_turbine = any(chosen.signal == "active_power" for chosen in taken.values())
    signals, used = [], set(taken)
    for chosen in taken.values():
        others = sorted(
            (c for c in candidates if c.signal == chosen.signal and c != chosen), key=lambda c: -c.score
        )
        runners_up = [c for c in others if c.score > chosen.score - 0.15 and c.key not in used]
        second_sources = [c for c in runners_up if c.file != chosen.file and c.score >= SURE_SCORE]
        doubts = [*chosen.doubts]
        if chosen.score < SURE_SCORE:
            doubts.insert(0, f"{chosen.why}, score {chosen.score:.2f}")
        if listed := [
            f'"{c.column}"{f" of {c.file}" * (c.file != chosen.file)} ({c.score:.2f})'
            for c in runners_up
            if c not in second_sources
        ]:
            doubts.append(f"next: {', '.join(listed[:4])}")
        if chosen.signal == "cabinet_temperature" and ambient is not None:
            ambient_hourly = sources[ambient.file].hourly(ambient.column)
            inside, outside = sources[chosen.file].hourly(chosen.column).beside(ambient_hourly)
            share = np.mean(inside > outside) if len(inside) >= 24 else math.nan
            if share < 0.5:
                doubts.append(f"warmer than the ambient temperature in only {100 * share:.0f} % of the hours")
        needed = chosen.signal == "ambient_temperature" or chosen.signal.startswith("cabinet_")
        # among the many temperatures of a turbine, one without a name may be that of any part
        needed = needed and (chosen.score > 0.65 or not is_turbine)
        active = chosen.score >= (NEEDED_SCORE if needed else USED)
        has_poles = flag_word(sources[chosen.file].export.cells[chosen.column]) == POLES[0]
        if has_poles and chosen.signal != "door_open":
            active = False
            doubts.append(f'"open" may be 1 or 0 for {chosen.signal}: state one = "open" or "closed"')
        signals.append(replace(chosen, active=active, doubts=tuple(doubts)))
        for second in second_sources[:1]:
            signals.append(replace(second, active=True, compare=True))
            used.add(second.key)
    left = [
        LeftColumn(file, column, source.left.get(column) or source.named[column].why)
        for file, source in sources.items()
        for column in (*source.values, *source.left)
        if (file, column) not in used
    ]
    return signals, list(dict.fromkeys(left))
