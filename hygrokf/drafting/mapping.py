"""Which column holds which signal: by its name and by what its readings do, with the runners-up; and what the
values of a column say: its unit, the place where it is measured, the rated power of a turbine."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from hygrokf.data.numbers import POLES, flag_word
from hygrokf.data.probes import copies, probe_of, temperatures_of
from hygrokf.data.quality import BAD, UNSTATED, QualityVocabulary, drafted
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
        """Values of the common hours of this column and of another one."""
        _, here, there = np.intersect1d(self.hour, other.hour, return_indices=True)
        return self.value[here], other.value[there]


def unit_by_values(values: np.ndarray, signal: str, stated: str | None) -> tuple[str, str | None]:
    """The unit of a column, and a doubt where the readings alone decide or contradict.

    values: (N,) as in the file. signal: of the table. stated: a name in `UNITS`, or None.
    """
    finite = values[np.isfinite(values)]
    units = fitting_units(signal)
    if stated in units:
        if not len(finite) or unit_mistaken(values, stated, signal) is None:
            return stated, None
        better = [one for one in units if one != stated and unit_mistaken(values, one, signal) is None]
        if better:
            return better[0], f"the header says {stated}, but the readings fit {better[0]}"
        return stated, f"the readings do not fit the unit {stated} of the header"
    ranked = list(dict.fromkeys((SIGNALS[signal].display, *units)))
    if not len(finite):
        return ranked[0], "the column holds no readings"
    if signal.endswith("_power"):
        high = float(np.quantile(np.abs(finite), 0.995))
        unit = "MW" if high < 20.0 else "kW" if high < 30e3 else "W"
        return unit, f"the header states no unit; readings up to {high:.4g} fit {unit}"
    if signal == "rain":
        unit = "1" if float(np.max(finite)) <= 1.0 else "mm"
        return unit, f"the header states no unit; readings up to {np.max(finite):.4g} fit {unit}"
    fits = [
        one
        for one in ranked
        if unit_mistaken(values, one, signal) is None and share_in_range(finite, one, signal) > 0.9
    ]
    if not fits:
        return ranked[0], "the header states no unit and the readings fit none"
    if SIGNALS[signal].dimension == "temperature" and fits[0] == "degC" and np.quantile(finite, 0.95) < 60.0:
        return "degC", None
    other = (
        f", perhaps {fits[1]}"
        if len(fits) > 1 and SIGNALS[signal].dimension in ("temperature", "angle")
        else ""
    )
    return fits[0], f"the header states no unit; the readings fit {fits[0]}{other}" if other else None


def impossible(values: np.ndarray, unit: str, signal: str) -> str | None:
    """Why readings cannot be those of a signal, although its unit fits; None where they can."""
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
    inside = share_in_range(finite, unit, signal)
    return (
        f"{100 * (1 - inside):.0f} % of the readings are out of the physical range" if inside < 0.7 else None
    )


def like_ambient(column: Hourly, others: list[Hourly]) -> float:
    """How much a temperature looks like that of the outside air, 0 to 1: colder than the other temperatures,
    with a wider range and a daily course."""
    if len(column.value) < 24:
        return 0.0
    colder = [float(np.mean(mine < its)) for mine, its in map(column.beside, others) if len(mine) > 24]
    wider = [_spread(column) > _spread(one) for one in others if len(one.value) > 24]
    cold = float(np.mean(colder)) if colder else 0.5
    wide = float(np.mean(wider)) if wider else 0.5
    days = np.floor(column.hour / 24.0)
    _, place = np.unique(days, return_inverse=True)
    weather = float(np.std(np.bincount(place, column.value) / np.bincount(place)))
    # outside, the mean of the day wanders by several kelvins within weeks
    return (0.45 * cold + 0.3 * wide + 0.25 * daily_share(column)) * min(weather / 2.5, 1.0)


def like_cabinet(column: Hourly, ambient: Hourly | None, power: Hourly | None) -> float:
    """How much a temperature looks like that of a closed cabinet, 0 to 1: warmer than outside, moving with
    the outside air and with the power."""
    if ambient is None:
        return 0.5
    mine, outside = column.beside(ambient)
    if len(mine) < 24:
        return 0.3
    score = 0.4 * float(np.mean(mine > outside)) + 0.3 * max(_correlation(mine, outside), 0.0)
    if power is not None:
        excess, load = column.beside(power)
        score += 0.3 * max(_correlation(excess, load), 0.0)
    return score


def follows_rather(column: Hourly, one: Hourly, other: Hourly) -> bool:
    """Whether differences from one series vary less than those from another, over a day or more."""
    spreads = []
    for series in (one, other):
        mine, its = column.beside(series)
        spreads.append(float(np.std(mine - its)) if len(mine) >= 24 else math.nan)
    return spreads[0] < spreads[1]


def daily_share(column: Hourly) -> float:
    """Share of the variance within days that the mean course of the day explains, 0 to 1."""
    day = np.floor(column.hour / 24.0)
    _, place = np.unique(day, return_inverse=True)
    within = column.value - (np.bincount(place, column.value) / np.bincount(place))[place]
    clock = np.mod(column.hour, 24).astype(int)
    course = np.bincount(clock, within, 24) / np.maximum(np.bincount(clock, minlength=24), 1)
    total = float(np.var(within))
    return min(float(np.var(course[clock])) / total, 1.0) if total > 0.0 else 0.0


def rated_power(values: np.ndarray, unit: str) -> float | None:
    """Rated power by the plateau at which the power stops [kW]; None where there is no plateau.

    values: [unit] (N,).  A plateau holds at least 0.5 % of the readings within 2 % of the 99.8th
    percentile, and half as many again as the 4 % below.
    """
    power = to_si(values[np.isfinite(values)], unit, "active_power") / 1e3
    if len(power) < 100:
        return None
    top = float(np.quantile(power, 0.998))
    at = (power > 0.98 * top) & (power < 1.02 * top)
    below = (power > 0.94 * top) & (power <= 0.98 * top)
    if top <= 0.0 or at.mean() < 0.005 or at.sum() < 1.5 * below.sum():
        return None
    return float(f"{np.median(power[at]):.3g}")


def _spread(column: Hourly) -> float:
    return float(np.subtract(*np.quantile(column.value, (0.95, 0.05))))


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    if len(one) < 24 or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])


SURE = 0.8
"""Score from which a name needs no confirmation."""
OUTSIDE = 0.45
"""Score from which readings alone may be those of the outside air."""
NEEDED = 0.3
"""Score from which a signal that a model needs is read, with its doubts."""
USED = 0.7
"""Score from which a signal that no model needs is read without an edit."""
_FILLERS = (-99.0, -99.9, -999.0, -999.9, -9999.0, -99999.0, 9999.0, 99999.0)
_NO_UNIT_HERE = re.compile(r" (mm hg|mmhg|inhg|in hg|torr|psi|knots|kt|mph|km h|ft) ")
COPIED = tuple(f"{place}_{one}" for place in ("cabinet", "ambient") for one in ("temperature", *HUMIDITIES))
"""Signals of which one column may pass for the cabinet's and for the air outside."""


@dataclass(frozen=True)
class DraftedSignal:
    """A column that may hold a signal, or in a draft the column of a signal.

    file: path in the case. score: 0 to 1. why: in words. doubts: to confirm. active: whether the case reads
    it; else it is commented out. compare: whether it is only compared with another source.
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
    vocabulary: QualityVocabulary = UNSTATED
    quality_doubts: tuple[str, ...] = ()
    sun: str | None = None

    def hourly(self, column: str) -> Hourly:
        """Hourly means of a column."""
        time, values = self.clock.time, self.values[column]
        good = np.isfinite(time) & np.isfinite(values)
        hours, place = np.unique(np.floor(time[good] / HOUR_S), return_inverse=True)
        return Hourly(hours, np.bincount(place, values[good]) / np.maximum(np.bincount(place), 1))


def source_of(export: Export, path: str) -> Source:
    """An export with its clock, its numbers and what its names say; path: in the case.

    Means over intervals are told by their names, or by what they are of.
    """
    cells, column, values = export.cells, export.column, dict[str, np.ndarray]()
    given = {name: cells[name].notna().sum() for name in cells}
    for name in (one for one in cells if one != column and given[one] >= 2):
        numbers, _ = export.read(name)
        if np.isfinite(numbers).sum() > 0.5 * given[name]:
            values[name] = numbers
    marks = {name: list(cells[name].dropna().unique()) for name in cells}
    quality, vocabulary, statements = drafted(marks, values)
    doubts = tuple(one.text for one in statements)
    values = {name: one for name, one in values.items() if name not in quality.values()}
    for name, of in quality.items():
        bad = cells[of].map(vocabulary.judge) == BAD
        values[name] = np.where(bad, np.nan, values[name])
    headers = zip(cells, export.names, strict=False)
    several = {name for name, header in headers if export.names.count(header) > 1}
    # nothing but one number that stands for no reading
    known = {name: one[np.isfinite(one)] for name, one in values.items()}
    empty = {name for name, one in known.items() if len(one) and np.ptp(one) == 0.0 and one[0] in _FILLERS}
    empty |= {name for name in cells if not given[name]}
    values = {
        name: one
        for name, one in values.items()
        if name not in empty and (name not in several or export.changes)
    }
    units = dict(zip(cells.columns, export.units, strict=True))
    named = {name: _said(export, name, units[name]) for name in values}
    left = {
        name: "no readings" if name in empty else "text" for name in cells if name not in (*values, column)
    }
    left |= {name: "several columns have this name" for name in left if name in several}
    left |= {of: f'quality of "{name}"' for name, of in quality.items()}
    operation = any(one.signal in ("active_power", "wind_speed", "rotor_speed") for one in named.values())
    averaged = any(re.search(r" (avg|ave|mean|mittel\w*) ", one.words) for one in named.values())
    reanalysis = any("ERA5" in one.why for one in named.values())
    clock = clock_of(export, (operation or averaged) and not reanalysis)
    return Source(path, export, clock, values, named, left, quality, vocabulary, doubts)


def _said(export: Export, name: str, unit: str) -> NamedColumn:
    """What a column's name says; that of a flag, with the word that its 1 means too."""
    bare = name.replace(export.label, "", 1)
    said, word = name_says(bare, unit), flag_word(export.cells[name])
    return name_says(f"{bare} {word}", unit) if word and not said.signal else said


def assigned(sources: Mapping[str, Source]) -> tuple[list[DraftedSignal], list[LeftColumn]]:
    """The column of every signal found, and why each other column holds none; sources: by path."""

    def series(one: DraftedSignal | None) -> Hourly | None:
        return None if one is None else sources[one.file].hourly(one.column)

    sure = [one for source in sources.values() for one in _by_name(source)]
    ambient = _best(sure, "ambient_temperature")
    open_temperatures = _unplaced(sources, "temperature")
    guesses: list[DraftedSignal] = [*_by_file(sources, open_temperatures)]
    placed = {one.key for one in guesses}
    open_temperatures = [one for one in open_temperatures if one not in placed]
    if ambient is None and not any(one.signal == "ambient_temperature" for one in guesses):
        guesses += _ambient_by_values(sources, open_temperatures, sure)
    ambient = ambient or _best(guesses, "ambient_temperature")
    outside, load = series(ambient), series(_best(sure, "active_power"))
    for file, column in open_temperatures:
        if ambient is not None and ambient.key == (file, column):
            continue
        source = sources[file]
        likeness = like_cabinet(source.hourly(column), outside, load)
        air = 0.04 if " air " in source.named[column].words else 0.0
        score = round(0.2 + 0.4 * likeness + air, 3)
        guesses.append(_candidate(source, "cabinet_temperature", column, score, "by its readings"))
    inside = series(_best(sure, "cabinet_temperature"))
    if inside is not None and outside is not None:
        guesses += _of_the_cabinet(sources, inside, outside)
    guesses += _companions(sources, _chosen([*sure, *guesses]))
    found = _paired(sources, _checked([*sure, *guesses], sources))
    return _settled(sources, _of_their_own(sources, found))


def _by_name(source: Source) -> list[DraftedSignal]:
    found = []
    for column, named in source.named.items():
        if not named.signal:
            continue
        if _NO_UNIT_HERE.search(words_of(column)):
            source.left[column] = f"may be {named.signal}, in a unit that a case does not know: convert it"
            continue
        found.append(_candidate(source, named.signal, column, named.score, named.why))
    return found


def _candidate(source: Source, signal: str, column: str, score: float, why: str) -> DraftedSignal:
    unit, doubt = unit_by_values(source.values[column], signal, source.named[column].unit)
    return DraftedSignal(signal, source.path, column, unit, score, why, () if doubt is None else (doubt,))


def _unplaced(sources: Mapping[str, Source], quantity: str) -> list[Key]:
    """Columns of a quantity whose place their names do not tell."""
    return [
        (file, column)
        for file, source in sources.items()
        for column, named in source.named.items()
        if named.quantity == quantity and not named.signal and not named.place
    ]


def _by_file(sources: Mapping[str, Source], columns: list[Key]) -> list[DraftedSignal]:
    """Columns of loggers, whose place the name of the file tells."""
    found = []
    folders = {source.export.file.parent for source in sources.values()}
    for path, column in columns:
        source = sources[path]
        file = source.export.file
        place, score = place_of(words_of(file.name.split(".")[0]))
        if not place and len(folders) > 1:
            place, score = place_of(words_of(file.parent.name))
        alone = sum(one == path for one, _ in columns) == 1
        if place in ("cabinet", "ambient", "nacelle", "tower") and alone:
            signal = f"{place}_{source.named[column].quantity}"
            found.append(_candidate(source, signal, column, min(score, SURE), "by the name of its file"))
    return found


def _ambient_by_values(
    sources: Mapping[str, Source], columns: list[Key], sure: list[DraftedSignal]
) -> list[DraftedSignal]:
    """Temperatures without a place, by how much they look like that of the outside air."""
    all_of = {one: sources[one[0]].hourly(one[1]) for one in columns}
    named = [sources[one.file].hourly(one.column) for one in sure if one.signal.endswith("_temperature")]
    found = []
    for one in columns if len(columns) + len(named) > 1 else []:
        others = [*(series for key, series in all_of.items() if key != one), *named]
        score = round(0.2 + 0.4 * like_ambient(all_of[one], others), 3)
        if score >= OUTSIDE:
            why = "by its readings"
            found.append(_candidate(sources[one[0]], "ambient_temperature", one[1], score, why))
    return found


def _of_the_cabinet(sources: Mapping[str, Source], inside: Hourly, outside: Hourly) -> list[DraftedSignal]:
    """Humidities without a place whose probe's temperature follows that of the cabinet, which another file
    names, rather than that outside."""
    found = []
    for file, column in _unplaced(sources, "relative_humidity"):
        source = sources[file]
        own = temperatures_of(column, source.values)
        if len(own) == 1 and follows_rather(source.hourly(own[0]), inside, outside):
            why = f'"{own[0]}" follows the cabinet temperature'
            found.append(_candidate(source, "cabinet_relative_humidity", column, 0.6, why))
    return found


def _companions(sources: Mapping[str, Source], taken: Mapping[Key, DraftedSignal]) -> list[DraftedSignal]:
    """Humidities and dew points without a place: that of the temperature of the same probe, or of the same
    logger; a dew point alone in its file is one of the weather."""
    found: list[DraftedSignal] = []
    for quantity in ("relative_humidity", "dew_point_temperature"):
        unplaced = _unplaced(sources, quantity)
        by_file = _by_file(sources, unplaced)
        found += by_file
        done = {one.key for one in by_file}
        for file, column in (one for one in unplaced if one not in done):
            source, alone = sources[file], sum(path == file for path, _ in unplaced) == 1
            for one in (one for one in taken.values() if one.file == file):
                place, _, kind = one.signal.rpartition("_")
                same = probe_of(one.column)[0] == probe_of(column)[0]
                logger = alone and one.why != "by its name" and place in ("cabinet", "ambient")
                dew_point = one.signal.endswith("point_temperature")
                if kind == "temperature" and not dew_point and (same or logger):
                    score, why = min(one.score, 0.75), f'beside "{one.column}"'
                    found.append(_candidate(source, f"{place}_{quantity}", column, score, why))
            if quantity == "dew_point_temperature" and not temperatures_of(column, source.values):
                found.append(_candidate(source, f"ambient_{quantity}", column, 0.85, "by its name"))
    return [one for one in found if one.signal in SIGNALS]


def _paired(sources: Mapping[str, Source], candidates: list[DraftedSignal]) -> list[DraftedSignal]:
    """Candidates in which the temperature of a place is that of its humidity's probe, where it is there."""
    taken, first = _chosen(candidates), []
    for one in taken.values():
        source, (place, _, quantity) = sources[one.file], one.signal.rpartition("_relative_")
        own = temperatures_of(one.column, source.values) if quantity == "humidity" else []
        signal = f"{place}_temperature"
        other = next((c for c in taken.values() if c.signal == signal), None)
        if len(own) != 1 or other is None or other.key == (one.file, own[0]):
            continue
        if source.named[own[0]].signal in ("", signal):
            why = f'of the probe of "{one.column}"'
            first.append(_candidate(source, signal, own[0], other.score, why))
    pairs = {one.key for one in first}
    # of equal scores the first one is chosen
    return [*first, *(one for one in candidates if one.key not in pairs)]


def _of_their_own(sources: Mapping[str, Source], candidates: list[DraftedSignal]) -> list[DraftedSignal]:
    """Candidates without columns of the air outside that repeat the cabinet's own readings, or are computed
    from them; their sources say so."""
    while True:
        taken = [one for one in _chosen(candidates).values() if one.signal in COPIED]
        series = [_series(sources[c.file], c) for c in taken]
        wrong = {str(one.values["signal"]): one.text for one in copies(series)}
        if not wrong:
            return candidates
        keys = {one.key: wrong[one.signal] for one in taken if one.signal in wrong}
        for (file, column), words in keys.items():
            sources[file].left[column] = words
        candidates = [one for one in candidates if one.key not in keys]


def _series(source: Source, one: DraftedSignal) -> Series:
    time, place = np.unique(source.clock.time, return_index=True)
    known = np.isfinite(time)
    value = to_si(source.values[one.column], one.unit, one.signal)[place]
    where = f'{source.export.file.name}, column "{one.column}"'
    return Series(one.signal, time[known], value[known], "linear", source=where)


def _best(candidates: list[DraftedSignal], signal: str) -> DraftedSignal | None:
    return max((one for one in candidates if one.signal == signal), key=lambda one: one.score, default=None)


def _chosen(candidates: list[DraftedSignal]) -> dict[Key, DraftedSignal]:
    """The candidate that takes a column: best first, each signal and each column once."""
    taken: dict[Key, DraftedSignal] = {}
    signals: set[str] = set()
    for one in sorted(candidates, key=lambda one: -one.score):
        if one.signal not in signals and one.key not in taken:
            taken[one.key] = one
            signals.add(one.signal)
    return taken


def _checked(candidates: list[DraftedSignal], sources: Mapping[str, Source]) -> list[DraftedSignal]:
    """Candidates with lower scores where their readings cannot be those of the signal."""
    checked = []
    for one in candidates:
        against = impossible(sources[one.file].values[one.column], one.unit, one.signal)
        if against is not None:
            one = replace(one, score=0.3 * one.score, doubts=(*one.doubts, against))
        checked.append(one)
    return checked


def _settled(
    sources: Mapping[str, Source], candidates: list[DraftedSignal]
) -> tuple[list[DraftedSignal], list[LeftColumn]]:
    taken = _chosen(candidates)
    outside = next((one for one in taken.values() if one.signal == "ambient_temperature"), None)
    turbine = any(one.signal == "active_power" for one in taken.values())
    found, used = [], set(taken)
    for one in taken.values():
        rest = sorted((c for c in candidates if c.signal == one.signal and c != one), key=lambda c: -c.score)
        near = [c for c in rest if c.score > one.score - 0.15 and c.key not in used]
        seconds = [c for c in near if c.file != one.file and c.score >= SURE]
        doubts = [*one.doubts]
        if one.score < SURE:
            doubts.insert(0, f"{one.why}, score {one.score:.2f}")
        if shown := [
            f'"{c.column}"{f" of {c.file}" * (c.file != one.file)} ({c.score:.2f})'
            for c in near
            if c not in seconds
        ]:
            doubts.append(f"next: {', '.join(shown[:4])}")
        if one.signal == "cabinet_temperature" and outside is not None:
            air = sources[outside.file].hourly(outside.column)
            inside, beside = sources[one.file].hourly(one.column).beside(air)
            share = np.mean(inside > beside) if len(inside) >= 24 else math.nan
            if share < 0.5:
                doubts.append(f"warmer than the ambient temperature in only {100 * share:.0f} % of the hours")
        needed = one.signal == "ambient_temperature" or one.signal.startswith("cabinet_")
        # among the many temperatures of a turbine, one without a name may be that of any part
        needed = needed and (one.score > 0.65 or not turbine)
        active = one.score >= (NEEDED if needed else USED)
        poles = flag_word(sources[one.file].export.cells[one.column]) == POLES[0]
        if poles and one.signal != "door_open":
            active = False
            doubts.append(f'"open" may be 1 or 0 for {one.signal}: state one = "open" or "closed"')
        found.append(replace(one, active=active, doubts=tuple(doubts)))
        for second in seconds[:1]:
            found.append(replace(second, active=True, compare=True))
            used.add(second.key)
    left = [
        LeftColumn(file, column, source.left.get(column) or source.named[column].why)
        for file, source in sources.items()
        for column in (*source.values, *source.left)
        if (file, column) not in used
    ]
    return found, list(dict.fromkeys(left))
