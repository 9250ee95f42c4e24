"""Records from pandas frames: each frame is a source, stated with the keys of a case file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from hygrokf.cases.case_file import CaseFault, stated_record
from hygrokf.cases.form import StatedColumn, StatedPeriod, StatedSource, stated_case
from hygrokf.data.columns import HEADER, FileColumns, Places, TableFault, column_fault, frame_table, places_of
from hygrokf.data.quality import StatedQuality
from hygrokf.data.record import Record, Site
from hygrokf.data.signals import SIGNALS, unit_named
from hygrokf.data.timestamps import EXCEL
from hygrokf.data.toml_form import Place, keys_of
from hygrokf.errors import suggestion

if TYPE_CHECKING:
    from datetime import datetime

    import pandas

    Setting: TypeAlias = str | float | bool | Sequence[str] | None
    Settings: TypeAlias = Setting | Mapping[str, Setting] | Mapping[str, Mapping[str, Setting]]

FRAME_KEYS = tuple(
    key for key in keys_of(StatedSource) if key not in ("file", "separator", "comment", "signals")
)
"""Keys of a [[source]] that apply to frames: one value for all frames, or a mapping from the frame's name."""
COLUMN_OPTIONS = {"units": "unit"} | {
    key: key for key in keys_of(StatedColumn) if key not in ("column", "unit")
}
"""Options that map columns, with the corresponding key of a signal in a case file."""
_HEAD = "read_frames"
_PLACES = Places("iloc", lambda rows: [int(row) for row in rows], "")


def read_frames(
    frames: pandas.DataFrame | Mapping[str, pandas.DataFrame] | Sequence[pandas.DataFrame],
    *,
    signals: Mapping[str, str] | Mapping[str, Mapping[str, str]] | None = None,
    units: Mapping[str, str] | Mapping[str, Mapping[str, str]] | None = None,
    name: str = "record",
    site: Site | Mapping[str, float] | None = None,
    rated_power_kW: float | None = None,
    provenance: str | None = None,
    identification: Mapping[str, str | datetime] | None = None,
    cabinet: bool = True,
    ambient: bool = True,
    **settings: Settings,
) -> Record:
    """Read a record from pandas frames; they are checked and masked as `read_case` does with files.

    frames: one DataFrame, or several by name or in a list.  Each is a source with its own clock: its index
        holds the times (a DatetimeIndex, text in ISO 8601, or a PeriodIndex, whose readings are means of the
        periods).
    signals: {column: signal} for columns that are not named after their signal.
    units: {column: unit}, needed for every column that is a signal; docs/reference/signals.md lists both.
        A column may be left out if its frame states the unit in `attrs["units"]`, as the frames of
        `Record.to_frames` do, or in its type (pint).  A unit that contradicts the frame's is a fault.
    name, rated_power_kW, provenance, site, identification: as in a case file, the rated power in [kW], site
        and identification as mappings, such as identification={"until": "2020-12-01T00:00Z"}.
    cabinet, ambient: whether a cabinet signal and an ambient temperature are required; as for `read_case`.
    settings: the further keys of a case file.  Keys of a signal map columns: accuracy={"RH": 2.0},
        resolution, response_time, one, quality={"RH": "RH quality"}. Keys of a source have one value for all
        frames or map the frames' names: timezone, stamp, interval, hold, longest_hold, clock_uncertainty,
        clock_correction, decimal, thousands, missing, time_format, ignore_offset, vocabulary, use_uncertain,
        compare, and time, the column of the times if they are not in the index.

    Where several frames have columns of the same name, nest the mappings from columns in mappings from
    frames: units={"cabinet": {"T": "degC"}, "mast": {"T": "K"}}.

    Returns the record; its `warnings` list what was masked or repaired.
    Raises CaseFault with all faults.
    """
    faults = [
        f'unknown option "{key}"{_advice_on_option(key)}'
        for key in settings
        if key not in FRAME_KEYS and key not in COLUMN_OPTIONS
    ]
    by_name, frame_faults = _frames_by_name(frames)
    if frame_faults:
        raise CaseFault(_HEAD, [*faults, *frame_faults])
    by_frame = {key: settings[key] for key in FRAME_KEYS if settings.get(key) is not None}
    for key, value in by_frame.items():
        if isinstance(value, Mapping):
            faults += _unknown_frames(key, value, by_name)
    options = {**settings, "units": units}
    by_column = {key: _per_frame(key, options.get(key), by_name, faults) for key in COLUMN_OPTIONS}
    signal_of = _per_frame("signals", signals, by_name, faults)
    sources: list[dict[str, Any]] = []
    tables: dict[str, Callable[[StatedSource], FileColumns]] = {}
    for frame_name, frame in by_name.items():
        stated = {
            key: value.get(frame_name) if isinstance(value, Mapping) else value
            for key, value in by_frame.items()
        }
        columns = {key: values[frame_name] for key, values in by_column.items()}
        source = _prepare(frame_name, frame, signal_of[frame_name], columns, stated, faults)
        if source is not None:
            sources.append(source[0])
            tables[frame_name] = source[1]
    if not sources:
        raise CaseFault(_HEAD, faults)
    if isinstance(site, Site):
        site = {key: value for key, value in asdict(site).items() if value is not None}
    keys: dict[str, Any] = {"rated_power_kW": rated_power_kW, "provenance": provenance, "site": site}
    keys |= {"name": name, "source": sources, "identification": identification}
    content = {key: value for key, value in keys.items() if value is not None}
    case = stated_case(content, _FramePlace(file=_HEAD, sources=sources, faults=faults))
    return stated_record(
        case, lambda source: tables[source.file](source), _HEAD, cabinet=cabinet, ambient=ambient
    )


def _advice_on_option(key: str) -> str:
    """The end of an unknown option's message: what to write in its place, or the options there are."""
    for table, form in (("identification", StatedPeriod), ("site", Site)):
        if key in keys_of(form):
            return f': write {table}={{"{key}": …}}'
    if key in keys_of(StatedSource) or key == "format":
        return ": it is for files, which a case file names"
    arguments = ("name", "signals", "units", "site", "rated_power_kW", "provenance", "identification")
    options = (*arguments, *FRAME_KEYS, *COLUMN_OPTIONS, "cabinet", "ambient")
    return suggestion(key, options) or f"; expected {', '.join(dict.fromkeys(options))}"


def _frames_by_name(frames: Any) -> tuple[dict[str, pandas.DataFrame], list[str]]:
    """Frames by name, and the faults of anything that is not a frame."""
    import pandas as pd

    faults = []
    if isinstance(frames, pd.DataFrame):
        candidates: dict[str, Any] = {"frame": frames}
    elif isinstance(frames, Mapping):
        candidates = {str(name): frame for name, frame in frames.items()}
    elif isinstance(frames, list | tuple):
        candidates = {f"frame {number}": frame for number, frame in enumerate(frames, 1)}
    else:
        candidates = {"frame": frames}
    if not candidates:
        faults.append("expected a DataFrame, or several by name, found none")
    by_name = {}
    for name, frame in candidates.items():
        if isinstance(frame, pd.DataFrame):
            if frame.columns.nlevels == 1:
                by_name[name] = frame
            else:
                faults.append(
                    f"{name}: expected one level of column names, found {frame.columns.nlevels}: give each "
                    "column one name"
                )
            continue
        fault = f"{name}: expected a pandas DataFrame, found {type(frame).__module__}.{type(frame).__name__}"
        if isinstance(frame, pd.Series):
            fault += ': make it one with .to_frame("cabinet_temperature"), or what the signal is'
        elif hasattr(frame, "to_pandas"):
            fault += ": pass .to_pandas()"
        faults.append(fault)
    return by_name, faults


def _unknown_frames(
    option: str, stated: Mapping[Any, Any], by_name: Mapping[str, pandas.DataFrame]
) -> list[str]:
    """Faults of an option that names frames which were not given."""
    return [
        f'{option}: no frame is called "{name}" (there are {", ".join(by_name)})'
        + suggestion(str(name), by_name)
        for name in stated
        if name not in by_name
    ]


def _per_frame(
    option: str, stated: Any, by_name: Mapping[str, pandas.DataFrame], faults: list[str]
) -> dict[str, dict[str, Any]]:
    """Column -> value of each frame, from an option {column: value} or {frame: {column: value}}."""
    empty: dict[str, dict[str, Any]] = {name: {} for name in by_name}
    if stated is None:
        return empty
    if not isinstance(stated, Mapping):
        faults.append(f"{option}: expected a mapping from columns, found {stated!r}")
        return empty
    is_nested = [isinstance(value, Mapping) for value in stated.values()]
    if any(is_nested) and not all(is_nested):
        faults.append(f"{option}: expected columns or frames as keys, found both")
        return empty
    if any(is_nested):
        faults += _unknown_frames(option, stated, by_name)
        return empty | {
            name: {str(column): value for column, value in stated[name].items()}
            for name in by_name
            if name in stated
        }
    columns = {str(column): value for column, value in stated.items()}
    columns_of = {name: {str(column) for column in frame.columns} for name, frame in by_name.items()}
    for column in columns:
        if not any(column in names for names in columns_of.values()):
            holder = "the frame has" if len(by_name) == 1 else "the frames have"
            all_columns = list(
                dict.fromkeys(str(label) for frame in by_name.values() for label in frame.columns)
            )
            faults.append(f"{option}: {column_fault(column, all_columns, holder)}")
    return {
        name: {column: value for column, value in columns.items() if column in columns_of[name]}
        for name in by_name
    }


def _prepare(
    name: str,
    frame: pandas.DataFrame,
    signal_of: Mapping[str, Any],
    by_column: Mapping[str, Mapping[str, Any]],
    stated: Mapping[str, Any],
    faults: list[str],
) -> tuple[dict[str, Any], Callable[[StatedSource], FileColumns]] | None:
    """A frame as a source of a case file, and the function that reads it; None if no column is a signal.

    Faults that only frames can have are added to `faults`.
    signal_of: column -> signal. by_column: option -> column -> value. stated: key of a source -> value.
    """
    time = None if stated.get("time") is None else str(stated["time"])
    labels = [str(label) for label in frame.columns]
    stamps, stamps_named, length, frame_faults = _stamps(
        frame, labels, time, stated.get("time_format") == EXCEL
    )
    if length is not None:
        superfluous = [key for key in ("stamp", "interval") if stated.get(key) is not None]
        frame_faults += [
            f"{stamps_named} holds periods, which already give the averaging intervals: remove {key}"
            for key in superfluous
        ]
        stated = {**stated, "stamp": "start", "interval": f"{length:.6f}s"}
    used = {
        label: signal_of.get(label, label)
        for label in labels
        if (label in signal_of or label in SIGNALS) and label != time
    }
    fault_count = len(faults)
    faults += [
        f"{name}: signals: {column_fault(column, labels, 'the frame has')}"
        for column in signal_of
        if column not in labels
    ]
    entries = _entries(name, frame, used, labels, by_column, faults)
    if not used:
        if len(faults) == fault_count:
            shown = ", ".join(f'"{label}"' for label in labels) or "no column"
            faults.append(
                f"{name}: none of its columns is a signal (it has {shown}): call them by signals, or say "
                'which is which, such as signals={"T": "cabinet_temperature"}'
            )
        return None
    source = {
        **{key: value for key, value in stated.items() if value is not None},
        "file": name,
        "time": "index" if time is None else time,
        "separator": "\t",  # a frame has no separator: this one differs from any decimal mark
        "signals": entries,
    }
    quality = StatedQuality({label: name for label, name in by_column["quality"].items() if label in used})
    quality_columns = quality.beside(labels, list(used))
    places = places_of([*used, *quality_columns.values()], labels, "the frame has", frame_faults)
    readings = frame.iloc[:, list(places.values())].copy(deep=False)
    readings.columns = list(places)
    readings.index = range(len(frame))
    readings.attrs = {HEADER: labels}

    def table(stated: StatedSource) -> FileColumns:
        if not len(readings):
            raise TableFault("expected readings, found no row in the frame")
        described = (readings, stated.meanings, stamps, stamps_named, _PLACES)
        return frame_table(*described, stated, stated.quality, quality_columns, frame_faults)

    return source, table


def _entries(
    name: str,
    frame: pandas.DataFrame,
    used: Mapping[str, str],
    labels: Sequence[str],
    by_column: Mapping[str, Mapping[str, Any]],
    faults: list[str],
) -> dict[str, dict[str, Any]]:
    """Signal -> its keys of a case file, with the units that the frame itself states; adds the faults.

    used: column -> signal.  labels: of all columns.  by_column: option -> column -> value.
    """
    entries: dict[str, dict[str, Any]] = {}
    for label, signal in used.items():
        if signal in entries:
            faults.append(
                f'{name}: columns "{entries[signal]["column"]}" and "{label}" are both {signal}; '
                "a record has one series of a signal"
            )
        entries[signal] = {"column": label}
    for option, values in by_column.items():
        for label, value in values.items():
            if label in used:
                entries[used[label]][COLUMN_OPTIONS[option]] = value
            elif label not in labels:
                faults.append(f"{name}: {option}: {column_fault(label, labels, 'the frame has')}")
            else:
                faults.append(
                    f'{name}: {option}: column "{label}" is no signal{suggestion(label, SIGNALS, 1) or ";"} '
                    f'say which signal it holds, such as signals={{"{label}": "cabinet_temperature"}}'
                )
    # what the frame itself states, in `attrs["units"]` or in the type of pint
    attribute = frame.attrs.get("units")
    frame_units = (
        {str(label): str(unit) for label, unit in attribute.items()} if isinstance(attribute, Mapping) else {}
    )
    kinds = {str(label): getattr(kind, "units", None) for label, kind in frame.dtypes.items()}
    frame_units |= {label: f"{unit:~P}" or "1" for label, unit in kinds.items() if unit is not None}
    for label, unit in frame_units.items():
        if label in used:
            stated_unit = entries[used[label]].setdefault("unit", unit_named(unit) or unit)
            if (unit_named(str(stated_unit)) or stated_unit) != (unit_named(unit) or unit):
                faults.append(
                    f'{name}: column "{label}" is in {unit} as the frame itself states, units says '
                    f"{stated_unit}: convert it, or correct one of the two"
                )
    return entries


def _stamps(
    frame: pandas.DataFrame, labels: Sequence[str], time: str | None, serial: bool
) -> tuple[pandas.Series | None, str, float | None, list[str]]:
    """Stamps of the rows, their name in messages, the length of their periods [s] or None, faults.

    serial: whether numbers are Excel's days.
    """
    import pandas as pd

    if time is None:
        place = "the index"
        if frame.index.nlevels > 1:
            levels = ", ".join(str(level) for level in frame.index.names)
            return None, place, None, [
                f"{place} has {frame.index.nlevels} levels ({levels}), expected the times alone: turn the "
                "other levels into columns with .reset_index(level=…), or pass one frame for each of "
                "their values"
            ]  # fmt: skip
        stamps = pd.Series(frame.index)
    else:
        place = f'column "{time}"'
        if labels.count(time) != 1:
            return None, place, None, [column_fault(time, labels, "the frame has")]
        stamps = frame.iloc[:, labels.index(time)].reset_index(drop=True)
    kind = stamps.dtype
    if isinstance(kind, pd.PeriodDtype):
        starts = stamps.dt.start_time
        lengths = np.unique(((stamps + 1).dt.start_time - starts).dropna().dt.total_seconds())
        if len(lengths) <= 1:  # empty where no row has a stamp
            return starts, place, float(lengths[0]) if len(lengths) else None, []
        return None, place, None, [f"{place} holds periods of several lengths, expected one length"]
    if (pd.api.types.is_numeric_dtype(kind) and not serial) or pd.api.types.is_timedelta64_dtype(kind):
        content = "durations" if pd.api.types.is_timedelta64_dtype(kind) else "numbers"
        shown = ", ".join(str(stamp) for stamp in stamps.iloc[:3])
        where = ', or name the column of the times: time="…"' if time is None else ""
        return None, place, None, [
            f"{place} holds {content} ({shown} …), expected times: make a DatetimeIndex of it, such as "
            f'pandas.to_datetime(…, unit="s", utc=True){where}'
        ]  # fmt: skip
    return stamps, place, None, []


@dataclass(frozen=True, kw_only=True)
class _FramePlace(Place):
    """Places of a case in the arguments of `read_frames`: the frame, with the column of a signal."""

    sources: Sequence[Mapping[str, Any]]

    def at(self, *keys: str) -> str:
        if len(self.path) < 2:
            return ",".join([self.file, *(self.table(str(key)) for key in self.path)])
        source = self.sources[int(self.path[1])]
        signal = next((key for key in (*keys, *self.path[3:]) if key in source["signals"]), None)
        if signal is None:
            return str(source["file"])
        return f'{source["file"]}, column "{source["signals"][signal]["column"]}"'

    def table(self, key: str) -> str:
        return f" {key}={{…}}"
