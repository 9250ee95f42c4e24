"""Measured data: series of readings, each on its own clock, in SI units."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from itertools import pairwise
from numbers import Real
from typing import TYPE_CHECKING, Self

import numpy as np

from hygrokf.data.result_file import utc_index, with_units
from hygrokf.data.signals import LARGEST_FRACTION, SIGNALS, Signal, better_units
from hygrokf.data.timestamps import EARLIEST_S, LATEST_S
from hygrokf.data.toml_form import setting
from hygrokf.errors import suggestion
from hygrokf.physics.holds import LINEAR, MEAN, PREVIOUS, hold_named
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Digest, ReaderText, Source
from hygrokf.texts.wording import duration_text, stamp_text

if TYPE_CHECKING:
    from pandas import DataFrame

BY_SIGNAL = "by the signal"
"""Hold of a series that states none: "mean" for means, else that of its signal's instants."""
USUAL_STEPS, AGE_STEPS = 11, 3.0
"""A value holds for AGE_STEPS times the median of the last USUAL_STEPS steps before it.  Only earlier steps
count, since a live tracker knows no later ones."""


@dataclass(frozen=True)
class Series:
    """The readings of one signal, at their own times.

    signal: a name of the signal table.
    time: [s] (T,) since 1970-01-01T00:00Z, strictly increasing; for means the END of the interval.
    value: [SI unit of the signal table] (T,); NaN = missing.
    hold: "previous": a value holds from its time on, until the next one or `longest_hold_s`; "mean": over
        (time - interval_s, time]; "linear": joined by straight lines. By default that of means with an
        interval, else `Signal.hold_of_instants`. "zoh" and "foh" are previous and linear.
    interval_s: [s] averaging interval; 0 for instants.
    resolution: [SI unit] spacing of the readings' grid; 0 where no grid was detected.
    accuracy: [SI unit] stated 95 % accuracy of the sensor; None: the signal table's default.
    clock_uncertainty_s: [s] stated standard uncertainty of the source's clock; None: not stated.
    source: file and column, such as 'scada.csv, column "P"'.
    height_m: [m] height above ground of a wind whose file states it; None: not known.
    response_time_s: [s] stated time constant of the sensor; None: not stated.
    longest_hold_s: [s] age at which a held value becomes unknown (∞: never); None: three usual intervals.
    lost: [s] spans (start, end), in order, in which the connection was lost: the last value before a span is
        unknown within it.
    saturated: readings that were masked because a humidity sensor was at its ceiling.

    The arrays are copied and made read-only. Raises ValueError that lists everything wrong.
    """

    signal: str
    time: np.ndarray
    value: np.ndarray
    hold: str = BY_SIGNAL
    interval_s: float = 0.0
    resolution: float = 0.0
    accuracy: float | None = None
    clock_uncertainty_s: float | None = None
    source: str = ""
    height_m: float | None = None
    response_time_s: float | None = None
    longest_hold_s: float | None = None
    lost: tuple[tuple[float, float], ...] = ()
    saturated: int = 0

    def __post_init__(self) -> None:
        """Check all fields and make the arrays read-only; raises ValueError that lists every fault."""
        faults: list[str] = []
        signal_row = SIGNALS.get(self.signal)
        if signal_row is None:
            faults.append(f'unknown signal "{self.signal}"{suggestion(self.signal, SIGNALS)}')
        time = _float_array("time", self.time, _SECONDS, faults)
        value = _float_array(
            "value", self.value, "numbers" if signal_row is None else f"numbers in {signal_row.unit}", faults
        )
        if time is not None and value is not None:
            faults += _reading_faults(time, value, signal_row)
        if self.hold == BY_SIGNAL:
            hold = (
                MEAN
                if self.interval_s > 0.0
                else LINEAR
                if signal_row is None
                else signal_row.hold_of_instants
            )
            object.__setattr__(self, "hold", hold)
        try:
            object.__setattr__(self, "hold", hold_named(self.hold))
            if (self.hold == MEAN) != (self.interval_s > 0.0):
                found_text = f"found hold {self.hold} and {self.interval_s} s"
                faults.append(f"expected hold mean together with interval_s > 0 only, {found_text}")
        except ValueError as fault:
            faults.append(str(fault))
        if self.longest_hold_s is not None and not self.longest_hold_s > 0.0:
            faults.append(f"longest_hold_s must be a number > 0 or None, found {self.longest_hold_s}")
        span_edges = [edge for span in self.lost for edge in span]
        if any(not before < after for before, after in pairwise(span_edges)):
            faults.append(f"lost must be spans (start, end) in order, found {self.lost}")
        for name in ("interval_s", "resolution", "accuracy", "clock_uncertainty_s", "response_time_s"):
            number = getattr(self, name)
            or_none = " or None" if name not in ("interval_s", "resolution") else ""
            if not (number is None and or_none) and not (math.isfinite(number) and number >= 0.0):
                faults.append(f"{name} must be a finite number ≥ 0{or_none}, found {number}")
        if self.height_m is not None and not (math.isfinite(self.height_m) and self.height_m > 0):
            faults.append(f"height_m must be a finite number > 0 or None, found {self.height_m}")
        if faults:
            raise ValueError(f"series {self.signal}: " + "; ".join(faults))
        assert time is not None and value is not None  # a missing array has been reported as a fault
        for name, array in (("time", time), ("value", value)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        """Return the number of stamps, T."""
        return len(self.time)

    def __eq__(self, other: object) -> bool:
        """Compare all fields; NaN equals NaN."""
        # the generated comparison would fail on the truth value of an array
        if not isinstance(other, Series):
            return NotImplemented
        return all(
            np.array_equal(getattr(self, field.name), getattr(other, field.name), equal_nan=True)
            if field.name in ("time", "value")
            else getattr(self, field.name) == getattr(other, field.name)
            for field in dataclasses.fields(self)
        )

    # Python's own way to make a class unhashable, which type checkers do not know of a base with a hash
    __hash__ = None  # type: ignore[assignment]

    @property
    def file(self) -> str:
        """The file of `source`, or the name of the signal where there is no source."""
        return self.source.split(", ")[0] or self.signal

    @property
    def missing(self) -> np.ndarray:
        """(T,) True where a reading is missing."""
        return np.isnan(self.value)

    @cached_property
    def known(self) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and values of the readings that are not missing."""
        is_present = ~self.missing
        return (
            (self.time, self.value) if is_present.all() else (self.time[is_present], self.value[is_present])
        )

    @cached_property
    def held_s(self) -> np.ndarray:
        """Longest time [s] for which each known reading holds, from its stamp on."""
        time, _ = self.known
        longest_s = np.full(len(time), math.inf if self.longest_hold_s is None else self.longest_hold_s)
        if self.longest_hold_s is None and len(time) > 1:
            steps = np.concatenate([np.full(USUAL_STEPS - 1, np.nan), np.diff(time)])
            windows = np.lib.stride_tricks.sliding_window_view(steps, USUAL_STEPS)
            longest_s[1:] = AGE_STEPS * np.nanmedian(windows, axis=1)
        return longest_s

    @cached_property
    def held(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times [s] from which a value holds, the values, and how long [s] each holds at most.

        They are those of the known readings.  A loss of the connection ends the last value; it holds again
        once the connection is regained, if it is not too old by then.
        """
        (time, value), longest_s = self.known, self.held_s
        for lost_s, regained_s in self.lost:
            last_before = int(np.searchsorted(time, lost_s)) - 1
            if last_before < 0:
                continue
            continues = regained_s < min(
                [time[last_before] + longest_s[last_before], *time[last_before + 1 : last_before + 2]]
            )
            remaining_s = longest_s[last_before] - (regained_s - time[last_before]) if continues else 0.0
            longest_s = np.append(
                longest_s[:last_before],
                [min(longest_s[last_before], lost_s - time[last_before]), *longest_s[last_before + 1 :]],
            )
            if continues:
                time, value, longest_s = (
                    np.insert(array, last_before + 1, inserted)
                    for array, inserted in (
                        (time, regained_s),
                        (value, value[last_before]),
                        (longest_s, remaining_s),
                    )
                )
        return time, value, longest_s

    def held_at(self, time: np.ndarray) -> np.ndarray:
        """Return the held values at other times [s].

        NaN before the first reading, where the latest one is too old, and while the connection is lost.
        """
        start_times, value, longest_s = self.held
        latest = np.searchsorted(start_times, time, side="right") - 1
        return np.where(
            (latest >= 0) & (time - start_times[latest] <= longest_s[latest]), value[latest], np.nan
        )

    def window(self, start_s: float, end_s: float) -> Series | None:
        """Return the readings with start_s ≤ time ≤ end_s [s], preceded by the value held at start_s.

        None where the window has neither.
        """
        first_index = np.searchsorted(self.time, start_s, side="left")
        end_index = np.searchsorted(self.time, end_s, side="right")
        time, value = self.time[first_index:end_index], self.value[first_index:end_index]
        if self.hold == PREVIOUS and len(self.known[0]) and start_s not in time[:1] and start_s < end_s:
            held_value = self.held_at(np.array([start_s]))
            if np.isfinite(held_value[0]):
                time, value = np.append(start_s, time), np.append(held_value, value)
        return dataclasses.replace(self, time=time, value=value) if len(time) else None

    def to_frame(self) -> DataFrame:
        """Return the readings as a pandas frame over time in UTC, in a column named after the signal.

        `attrs["units"]` is what `read_frames` takes as `units`; `attrs["interval_s"]` [s] that of means,
        which stand at the end of their interval.
        """
        from pandas import DataFrame

        frame = with_units(
            DataFrame({self.signal: self.value}, index=utc_index(self.time)),
            {self.signal: SIGNALS[self.signal].unit},
        )
        frame.attrs["interval_s"] = self.interval_s
        return frame

    @cached_property
    def steps_s(self) -> np.ndarray:
        """Time steps [s] between readings that are not missing, in ascending order."""
        time, _ = self.known
        return np.sort(time[1:] - time[:-1])


_SECONDS = "seconds since 1970-01-01T00:00Z as numbers"


def _reading_faults(time: np.ndarray, value: np.ndarray, signal_row: Signal | None) -> list[str]:
    """Return the faults of times (T,) [s] and readings (T,); signal_row: of the signal table, or None."""
    faults = []
    if time.ndim != 1 or time.shape != value.shape:
        faults.append(
            f"time and value must be arrays of one dimension and one length, "
            f"found shapes {time.shape} and {value.shape}"
        )
    elif not (np.isfinite([*time[:1], *time[-1:]]).all() and (time[1:] > time[:-1]).all()):
        # increasing times between finite ends are finite
        if not np.isfinite(time).all():
            faults.append("every time must be a finite number of seconds")
        else:
            first_wrong = int(np.argmax(time[1:] <= time[:-1])) + 1
            faults.append(f"time must increase strictly; reading {first_wrong} does not")
    elif len(time) and not (EARLIEST_S < time[0] and time[-1] < LATEST_S):
        faults.append(_seconds_fault(time))
    if np.isinf(value).any():
        faults.append("value must be finite, or NaN where a reading is missing")
    elif signal_row is not None and (unit_fault := _unit_fault(value, signal_row)):
        faults.append(unit_fault)
    return faults


def _float_array(name: str, given: object, expected: str, faults: list[str]) -> np.ndarray | None:
    """Return a copy of an array as floating-point numbers; otherwise add a fault and return None.

    Dates are refused: as plain numbers they would count nanoseconds or microseconds without a zone.
    """
    if isinstance(given, np.ma.MaskedArray):
        given = np.ma.filled(given.astype(float), np.nan)
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "mM":
            return array.astype(float)
        type_found = array.dtype.name
    except (TypeError, ValueError):
        not_numbers = (
            (item for item in given if not isinstance(item, Real))
            if isinstance(given, Iterable)
            else (given,)
        )
        type_found = type(next(iter(not_numbers), given)).__name__
    remedy = _REMEDIES[name]
    faults.append(
        f"{name}: expected {expected}, found {type_found}; convert, such as {remedy}, or pass a frame to "
        "hygrokf.read_frames"
    )
    return None


_REMEDIES = {
    "time": '(index - pandas.Timestamp("1970-01-01", tz="UTC")).total_seconds()',
    "value": "column.to_numpy(float, na_value=numpy.nan)",
}


def _seconds_fault(time: np.ndarray) -> str:
    """Return the fault of times (T,) beyond the accepted range, with the unit that they seem to be in."""
    for factor, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")):
        if 0.0 < time[0] / factor and time[-1] / factor < LATEST_S:
            remedy = f"they would fit as {unit}: divide them by {factor:g}"
            break
    else:
        remedy = "correct them"
    return f"time: expected seconds since 1970-01-01T00:00Z, found {time[0]:.6g} … {time[-1]:.6g}; {remedy}"


def _unit_fault(value: np.ndarray, signal_row: Signal) -> str | None:
    """Return the fault of readings (T,) that are certainly in another unit than the signal's, or None.

    That is: most readings lie outside the physical range, and would lie within it in the other unit.
    Constant readings are not judged, since a dead sensor may show them.
    """
    in_range = (value >= signal_row.low) & (value <= signal_row.high)
    if not len(value) or 2 * np.count_nonzero(in_range) >= len(value):
        return None
    finite_values = value[np.isfinite(value)]
    if (
        not len(finite_values)
        or 2 * np.count_nonzero(in_range) >= len(finite_values)
        or np.ptp(finite_values) == 0.0
    ):
        return None
    if signal_row.unit == "1" and np.median(finite_values) <= LARGEST_FRACTION:
        return None
    fitting = better_units(finite_values, signal_row.unit, signal_row)
    if not fitting:
        return None
    expected_unit = "fractions (unit 1)" if signal_row.unit == "1" else signal_row.unit
    return (
        f"value: expected {expected_unit}, found readings of about {np.median(finite_values):.4g}, which "
        f"would fit as {' or '.join(fitting)}; convert them, such as "
        f'hygrokf.data.signals.to_si(value, "{fitting[0]}", "{signal_row.name}"), '
        "or state the unit to hygrokf.read_frames"
    )


@dataclass(frozen=True)
class Site:
    """Location of the enclosure.  Raises ValueError outside of the ranges below."""

    latitude_deg: float = setting(help="north positive")
    longitude_deg: float = setting(help="east positive, -180…360")
    altitude_m: float | None = setting(None, "above sea level")

    def __post_init__(self) -> None:
        """Check the ranges; raises ValueError that lists every fault."""
        limits = (
            ("latitude_deg", self.latitude_deg, -90.0, 90.0),
            ("longitude_deg", self.longitude_deg, -180.0, 360.0),
            ("altitude_m", self.altitude_m, -500.0, 9000.0),
        )
        faults = [
            f"{name} must lie within {low:g} … {high:g}, found {number}"
            for name, number, low, high in limits
            if number is not None and not low <= number <= high
        ]
        if faults:
            raise ValueError("site: " + "; ".join(faults))


class Provenance(StrEnum):
    """How the readings came about; every result states it.

    Simulated: a model computed the readings in the cabinet from measured weather or operation.  Synthetic: a
        computer made all readings.
    """

    MEASURED = "measured"
    SIMULATED = "simulated"
    SYNTHETIC = "synthetic"

    @classmethod
    def _missing_(cls, value: object) -> Provenance:
        """Raise ValueError that lists the provenances."""
        raise ValueError(f"provenance must be one of {', '.join(cls)}, found {value!r}")


def least_measured(provenances: Iterable[Provenance]) -> Provenance:
    """Return the provenance of a result of several records: measured only if all of them are measured."""
    return max(provenances, key=list(Provenance).index, default=Provenance.MEASURED)


@dataclass(frozen=True)
class Record:
    """All series of one enclosure, never resampled onto a common grid.

    name: name of the enclosure.
    series: one for each signal.
    site: location, or None.
    rated_power_W: [W] rated power, or None.
    until_s: [s] end of the identification period since 1970-01-01T00:00Z; None: the whole record.
    warnings: one sentence for each thing that was masked or repaired.
    files: (file name, SHA-256) of every file read.
    compared: series of a second source, one for each signal.  No fit uses them: `check` compares them with
        the record's series of the same signals, which reveals wrong clocks.
    doubts: about how the record was put together; `check` adds them to its own doubts.
    provenance: measured, simulated or synthetic, as stated.

    Raises ValueError for a signal that occurs twice among the series, or twice among those compared, and for
    another provenance.
    """

    name: str
    series: tuple[Series, ...]
    site: Site | None = None
    rated_power_W: float | None = None
    until_s: float | None = None
    warnings: tuple[ReaderText, ...] = ()
    files: tuple[tuple[Source, Digest], ...] = ()
    compared: tuple[Series, ...] = ()
    doubts: tuple[Statement, ...] = ()
    provenance: Provenance = Provenance.MEASURED

    def __post_init__(self) -> None:
        """Check all fields; raises ValueError."""
        for name in ("series", "compared", "warnings", "files", "doubts"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        object.__setattr__(self, "provenance", Provenance(self.provenance))
        compared_signals = [series.signal for series in self.compared]
        repeated = sorted(
            {name for names in (self.signals, compared_signals) for name in names if names.count(name) > 1}
        )
        if repeated:
            raise ValueError(f"record {self.name}: more than one series of {', '.join(repeated)}")
        if self.until_s is not None and not (
            isinstance(self.until_s, Real) and EARLIEST_S < self.until_s < LATEST_S
        ):
            raise ValueError(
                f"record {self.name}: until_s must be a number of seconds since 1970-01-01T00:00Z, "
                f"found {self.until_s!r}"
            )
        if self.rated_power_W is not None and not 0.0 < self.rated_power_W < math.inf:
            raise ValueError(
                f"record {self.name}: rated_power_W must be a number above 0, found {self.rated_power_W}"
            )

    @cached_property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals in the record."""
        return tuple(series.signal for series in self.series)

    def __repr__(self) -> str:
        """Return name, span and signals, a line each."""
        lines = []
        for series in self.series:
            step_text = duration_text(float(np.median(series.steps_s))) if len(series.steps_s) else "–"
            unit, count = SIGNALS[series.signal].unit, len(series.known[0])
            lines.append(f"  {series.signal} [{unit}]: {count} readings, every {step_text}")
        until = "" if self.until_s is None else f", identification until {stamp_text(self.until_s)}"
        span = f"{stamp_text(self.start_s)} … {stamp_text(self.end_s)}{until}" if lines else "no series"
        return "\n".join([f"Record {self.name}: {span}", *shortened(lines)])

    def __contains__(self, signal: object) -> bool:
        """Whether the record has a signal."""
        return signal in self.signals

    def __getitem__(self, signal: str) -> Series:
        """Return the series of a signal.  Raises KeyError with the names of the existing ones."""
        for series in self.series:
            if series.signal == signal:
                return series
        raise KeyError(
            f"record {self.name} has no {signal}; it has {', '.join(self.signals) or 'no signals'}"
        )

    @property
    def start_s(self) -> float:
        """Start of the earliest reading [s], for means the start of its interval; NaN if empty."""
        starts = [series.time[0] - series.interval_s for series in self.series if len(series)]
        return float(min(starts)) if starts else math.nan

    @property
    def end_s(self) -> float:
        """Time of the latest reading [s]; NaN if empty."""
        ends = [series.time[-1] for series in self.series if len(series)]
        return float(max(ends)) if ends else math.nan

    def window(self, start_s: float, end_s: float) -> Self:
        """Return the record with the readings in start_s ≤ time ≤ end_s [s].

        A mean belongs to the window that contains the end of its interval.  Series without a reading in the
        window are left out.  `until_s` is kept where it lies inside the window.
        """
        if not start_s <= end_s:
            raise ValueError(f"window: start {start_s} must not be after end {end_s}")
        series, compared = (
            tuple(
                series_in_window
                for series in group
                if (series_in_window := series.window(start_s, end_s)) is not None
            )
            for group in (self.series, self.compared)
        )
        inside = self.until_s is not None and start_s < self.until_s < end_s
        until_s = self.until_s if inside else None
        return dataclasses.replace(self, series=series, compared=compared, until_s=until_s)

    def to_frames(self) -> dict[str, DataFrame]:
        """Return every series as a pandas frame of its own, by signal, as `read_frames` takes them."""
        return {series.signal: series.to_frame() for series in self.series}

    def identification(self) -> Self:
        """Return the identification period: readings up to and including `until_s`."""
        if self.until_s is None:
            return self
        return self.window(-math.inf, self.until_s)

    def validation(self) -> Self:
        """Return the validation period: readings after `until_s`; no series if there is no such period."""
        if self.until_s is None:
            return dataclasses.replace(self, series=())
        return self.window(float(np.nextafter(self.until_s, math.inf)), math.inf)

    def replace_series(self, *changed: Series, warnings: tuple[str, ...] = ()) -> Self:
        """Return the record with some series replaced by others of the same signals.

        changed: the new series.  warnings: sentences to add to the record's own.
        Raises KeyError for a signal that the record does not have.
        """
        by_signal = {series.signal: series for series in changed}
        for signal in by_signal:
            self[signal]  # raises KeyError
        return dataclasses.replace(
            self,
            series=tuple(by_signal.get(series.signal, series) for series in self.series),
            warnings=self.warnings + warnings,
        )


LINES = 10
"""Most lines of a list in the `repr` of an object."""


def shortened(lines: Sequence[str]) -> list[str]:
    """Return the lines, or the first `LINES` − 1 of them and a line that says how many were left out."""
    left_out_count = len(lines) - LINES + 1
    return list(lines) if left_out_count < 2 else [*lines[: LINES - 1], f"  … and {left_out_count} more"]


def kind_of(given: object) -> str:
    """Return what an object is, in words for a message, such as "a pandas frame"."""
    if isinstance(given, (str, os.PathLike)):
        return f"the path {os.fspath(given)!r}"
    if _is_frame(given):
        return "a pandas frame"
    if isinstance(given, Mapping) and any(map(_is_frame, given.values())):
        return "pandas frames"
    type_name = type(given).__name__
    return "nothing" if given is None else f"{'an' if type_name[0] in 'AEIOUaeiou' else 'a'} {type_name}"


def maker_of(given: object, fit: bool = False) -> str:
    """Return the call that makes a Record (or, with `fit`, a Fit) from a path or from frames; "" for anything
    else."""
    if isinstance(given, (str, os.PathLike)):
        path = f"({os.fspath(given)!r})"
        return f"read_fit{path} reads a Fit" if fit else f"read_case{path} makes a Record of a case file"
    if _is_frame(given) or (isinstance(given, Mapping) and any(map(_is_frame, given.values()))):
        return f"read_frames(frames, units=…) makes a Record{', identify a Fit of it' if fit else ''}"
    return ""


def expect_record(given: object, verb: str) -> Record:
    """Return `given` if it is a Record.  Raises ValueError that names the call which makes one.

    verb: name of the calling function.
    """
    if isinstance(given, Record):
        return given
    maker = maker_of(given) or "read_case makes one of a case file, read_frames one of pandas frames"
    raise ValueError(f"{verb}: expected a Record, found {kind_of(given)}; {maker}")


def _is_frame(given: object) -> bool:
    """Whether an object looks like a pandas frame."""
    return hasattr(given, "columns") and hasattr(given, "index")
