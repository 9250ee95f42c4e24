"""Records from pandas frames: each frame is a source, stated with the keys of a case file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from hygrokf.cases.case_file import CaseFault, record_of
from hygrokf.cases.form import StatedColumn, StatedPeriod, StatedSource, stated_case
from hygrokf.data.columns import HEADER, FileColumns, Places, TableFault, column_fault, places_of, table_of
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
        Columns that are not named: what the frames state in `attrs["units"]`, as those of
        `Record.to_frames` do, or in their types (pint).  Another unit than these is a fault.
    name, rated_power_kW, provenance, site, identification: as in a case file, the rated power in [kW], the
        last two as mappings, such as identification={"until": "2020-12-01T00:00Z"}.
    cabinet, ambient: whether a cabinet signal and an ambient temperature are required; as for `read_case`.
    settings: the further keys of a case file.  Those of a signal map columns: accuracy={"RH": 2.0},
        resolution, response_time, one, quality={"RH": "RH quality"}. Those of a source are one value for all
        frames or a mapping from their names: timezone, stamp, interval, hold, longest_hold,
        clock_uncertainty, clock_correction, decimal, thousands, missing, time_format, ignore_offset,
        vocabulary, use_uncertain, compare, and time, the column that holds the times where the index does
        not.

    Where several frames have columns of the same name, nest the mappings from columns in mappings from
    frames: units={"cabinet": {"T": "degC"}, "mast": {"T": "K"}}.

    Returns the record; its `warnings` list what was masked or repaired.
    Raises CaseFault with all faults.
    """
    faults = [
        f'unknown option "{key}"{_instead(key)}'
        for key in settings
        if key not in FRAME_KEYS and key not in COLUMN_OPTIONS
    ]
    named, refused = _named(frames)
    if refused:
        raise CaseFault(_HEAD, [*faults, *refused])
    by_frame = {key: settings[key] for key in FRAME_KEYS if settings.get(key) is not None}
    for key, value in by_frame.items():
        if isinstance(value, Mapping):
            faults += _unknown_frames(key, value, named)
    given = {**settings, "units": units}
    by_column = {key: _per_frame(key, given.get(key), named, faults) for key in COLUMN_OPTIONS}
    mapped = _per_frame("signals", signals, named, faults)
    sources: list[dict[str, Any]] = []
    tables: dict[str, Callable[[StatedSource], FileColumns]] = {}
    for frame_name, frame in named.items():
        stated = {
            key: value.get(frame_name) if isinstance(value, Mapping) else value
            for key, value in by_frame.items()
        }
        columns = {key: values[frame_name] for key, values in by_column.items()}
        prepared = _prepare(frame_name, frame, mapped[frame_name], columns, stated, faults)
        if prepared is not None:
            sources.append(prepared[0])
            tables[frame_name] = prepared[1]
    if not sources:
        raise CaseFault(_HEAD, faults)
    if isinstance(site, Site):
        site = {key: value for key, value in asdict(site).items() if value is not None}
    about: dict[str, Any] = {"rated_power_kW": rated_power_kW, "provenance": provenance, "site": site}
    about |= {"name": name, "source": sources, "identification": identification}
    content = {key: value for key, value in about.items() if value is not None}
    case = stated_case(content, _FramePlace(file=_HEAD, sources=sources, faults=faults))
    return record_of(
        case, lambda source: tables[source.file](source), _HEAD, cabinet=cabinet, ambient=ambient
    )


def _instead(key: str) -> str:
    """The replacement for an unknown option, as a phrase of its message."""
    for table, form in (("identification", StatedPeriod), ("site", Site)):
        if key in keys_of(form):
            return f': write {table}={{"{key}": …}}'
    if key in keys_of(StatedSource) or key == "format":
        return ": it is for files, which a case file names"
    own = ("name", "signals", "units", "site", "rated_power_kW", "provenance", "identification")
    known = (*own, *FRAME_KEYS, *COLUMN_OPTIONS, "cabinet", "ambient")
    return suggestion(key, known) or f"; expected {', '.join(dict.fromkeys(known))}"


def _named(frames: Any) -> tuple[dict[str, pandas.DataFrame], list[str]]:
    """Frames by name, and the faults of anything that is not a frame."""
    import pandas as pd

    faults = []
    if isinstance(frames, pd.DataFrame):
        given: dict[str, Any] = {"frame": frames}
    elif isinstance(frames, Mapping):
        given = {str(name): frame for name, frame in frames.items()}
    elif isinstance(frames, list | tuple):
        given = {f"frame {number}": frame for number, frame in enumerate(frames, 1)}
    else:
        given = {"frame": frames}
    if not given:
        faults.append("expected a DataFrame, or several by name, found none")
    named = {}
    for name, frame in given.items():
        if isinstance(frame, pd.DataFrame):
            if frame.columns.nlevels == 1:
                named[name] = frame
            else:
                faults.append(
                    f"{name}: expected one level of column names, found {frame.columns.nlevels}: give each "
                    "column one name"
                )
            continue
        found = f"{name}: expected a pandas DataFrame, found {type(frame).__module__}.{type(frame).__name__}"
        if isinstance(frame, pd.Series):
            found += ': make it one with .to_frame("cabinet_temperature"), or what the signal is'
        elif hasattr(frame, "to_pandas"):
            found += ": pass .to_pandas()"
        faults.append(found)
    return named, faults


def _unknown_frames(
    option: str, stated: Mapping[Any, Any], named: Mapping[str, pandas.DataFrame]
) -> list[str]:
    """Faults of an option that names frames which were not given."""
    return [
        f'{option}: no frame is called "{name}" (there are {", ".join(named)}){suggestion(str(name), named)}'
        for name in stated
        if name not in named
    ]


def _per_frame(
    option: str, stated: Any, named: Mapping[str, pandas.DataFrame], faults: list[str]
) -> dict[str, dict[str, Any]]:
    """Column -> value for each frame, from an option that maps columns, or frames to such mappings."""
    nothing: dict[str, dict[str, Any]] = {name: {} for name in named}
    if stated is None:
        return nothing
    if not isinstance(stated, Mapping):
        faults.append(f"{option}: expected a mapping from columns, found {stated!r}")
        return nothing
    nested = [isinstance(one, Mapping) for one in stated.values()]
    if any(nested) and not all(nested):
        faults.append(f"{option}: expected columns or frames as keys, found both")
        return nothing
    if any(nested):
        faults += _unknown_frames(option, stated, named)
        return nothing | {
            name: {str(column): value for column, value in stated[name].items()}
            for name in named
            if name in stated
        }
    columns = {str(column): value for column, value in stated.items()}
    found = {name: {str(column) for column in frame.columns} for name, frame in named.items()}
    for column in columns:
        if not any(column in one for one in found.values()):
            holder = "the frame has" if len(named) == 1 else "the frames have"
            there = list(dict.fromkeys(str(one) for frame in named.values() for one in frame.columns))
            faults.append(f"{option}: {column_fault(column, there, holder)}")
    return {
        name: {column: value for column, value in columns.items() if column in found[name]} for name in named
    }


def _prepare(
    name: str,
    frame: pandas.DataFrame,
    mapped: Mapping[str, Any],
    by_column: Mapping[str, Mapping[str, Any]],
    stated: Mapping[str, Any],
    faults: list[str],
) -> tuple[dict[str, Any], Callable[[StatedSource], FileColumns]] | None:
    """A frame as a source in the form of a case file, and what reads it; None where no column is usable.

    The faults that only frames can have are added.
    mapped: column -> signal. by_column: option -> column -> value. stated: key of a source -> value.
    """
    time = None if stated.get("time") is None else str(stated["time"])
    labels = [str(label) for label in frame.columns]
    stamps, stamps_named, length, wrong = _stamps(frame, labels, time, stated.get("time_format") == EXCEL)
    if length is not None:
        twice = [key for key in ("stamp", "interval") if stated.get(key) is not None]
        wrong += [f"{stamps_named} holds periods, which already give the averaging intervals: remove {key}"
                  for key in twice]  # fmt: skip
        stated = {**stated, "stamp": "start", "interval": f"{length:.6f}s"}
    used = {
        label: mapped.get(label, label)
        for label in labels
        if (label in mapped or label in SIGNALS) and label != time
    }
    before = len(faults)
    faults += [
        f"{name}: signals: {column_fault(one, labels, 'the frame has')}"
        for one in mapped
        if one not in labels
    ]
    entries = _entries(name, frame, used, labels, by_column, faults)
    if not used:
        if len(faults) == before:
            shown = ", ".join(f'"{label}"' for label in labels) or "no column"
            faults.append(
                f"{name}: none of its columns is a signal (it has {shown}): call them by signals, or say "
                "which is "
                'which, such as signals={"T": "cabinet_temperature"}'
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
    beside = quality.beside(labels, list(used))
    places = places_of([*used, *beside.values()], labels, "the frame has", wrong)
    kept = frame.iloc[:, list(places.values())].copy(deep=False)
    kept.columns = list(places)
    kept.index = range(len(frame))
    kept.attrs = {HEADER: labels}

    def table(stated: StatedSource) -> FileColumns:
        if not len(kept):
            raise TableFault("expected readings, found no row in the frame")
        return table_of(
            kept, stated.meanings, stamps, stamps_named, _PLACES, stated, stated.quality, beside, wrong
        )

    return source, table


def _entries(
    name: str,
    frame: pandas.DataFrame,
    used: Mapping[str, str],
    labels: Sequence[str],
    by_column: Mapping[str, Mapping[str, Any]],
    faults: list[str],
) -> dict[str, dict[str, Any]]:
    """What is stated of every signal, with the units that the frame states itself; adds the faults.

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
    stated = frame.attrs.get("units")
    own = {str(label): str(unit) for label, unit in stated.items()} if isinstance(stated, Mapping) else {}
    kinds = {str(label): getattr(kind, "units", None) for label, kind in frame.dtypes.items()}
    own |= {label: f"{unit:~P}" or "1" for label, unit in kinds.items() if unit is not None}
    for label, unit in own.items():
        if label in used:
            said = entries[used[label]].setdefault("unit", unit_named(unit) or unit)
            if (unit_named(str(said)) or said) != (unit_named(unit) or unit):
                faults.append(
                    f'{name}: column "{label}" is in {unit} as the frame itself states, units says {said}: '
                    "convert it, or correct one of the two"
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
        named = "the index"
        if frame.index.nlevels > 1:
            levels = ", ".join(str(one) for one in frame.index.names)
            return None, named, None, [
                f"{named} has {frame.index.nlevels} levels ({levels}), expected the times alone: turn the "
                "other levels into columns with .reset_index(level=…), or pass one frame for each of "
                "their values"
            ]  # fmt: skip
        stamps = pd.Series(frame.index)
    else:
        named = f'column "{time}"'
        if labels.count(time) != 1:
            return None, named, None, [column_fault(time, labels, "the frame has")]
        stamps = frame.iloc[:, labels.index(time)].reset_index(drop=True)
    kind = stamps.dtype
    if isinstance(kind, pd.PeriodDtype):
        starts = stamps.dt.start_time
        lengths = np.unique(((stamps + 1).dt.start_time - starts).dropna().dt.total_seconds())
        if len(lengths) <= 1:  # empty where no row has a stamp
            return starts, named, float(lengths[0]) if len(lengths) else None, []
        return None, named, None, [f"{named} holds periods of several lengths, expected one length"]
    if (pd.api.types.is_numeric_dtype(kind) and not serial) or pd.api.types.is_timedelta64_dtype(kind):
        what = "durations" if pd.api.types.is_timedelta64_dtype(kind) else "numbers"
        shown = ", ".join(str(one) for one in stamps.iloc[:3])
        where = ', or name the column of the times: time="…"' if time is None else ""
        return None, named, None, [
            f"{named} holds {what} ({shown} …), expected times: make a DatetimeIndex of it, such as "
            f'pandas.to_datetime(…, unit="s", utc=True){where}'
        ]  # fmt: skip
    return stamps, named, None, []


@dataclass(frozen=True, kw_only=True)
class _FramePlace(Place):
    """Places of a case in the arguments of `read_frames`: the frame, with the column of a signal."""

    sources: Sequence[Mapping[str, Any]]

    def at(self, *keys: str) -> str:
        if len(self.path) < 2:
            return ",".join([self.file, *(self.table(str(key)) for key in self.path)])
        source = self.sources[int(self.path[1])]
        named = next((one for one in (*keys, *self.path[3:]) if one in source["signals"]), None)
        if named is None:
            return str(source["file"])
        return f'{source["file"]}, column "{source["signals"][named]["column"]}"'

    def table(self, key: str) -> str:
        return f" {key}={{…}}"
