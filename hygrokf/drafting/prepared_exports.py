"""Exports in a form that a case can read: one turbine, one column for each quantity, one column of stamps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from hygrokf.data.columns import TableFault
from hygrokf.data.quality import quality_columns
from hygrokf.drafting.layout import Export, is_value
from hygrokf.drafting.stamps import as_text, time_columns, time_of_day
from hygrokf.drafting.vocabulary import name_says, words_of
from hygrokf.errors import suggestion

if TYPE_CHECKING:
    import pandas

_TURBINE = re.compile(r"turbine|wtg| wec | wea |anlage|asset|device|station|maschine| unit id | plant ")
_TAG = re.compile(
    r" tag|signal|variable|entity|channel|kanal|messstelle|parameter| point| sensor|quantity|groesse|^ name $"
)
_VALUE = re.compile(r"value|wert|reading|messwert| state ")
_UNIT = re.compile(r"^ (unit|units|einheit) $")
_LOGGER_QUANTITIES = 3
"""Largest number of quantities of a simple logger: temperature, humidity and dew point."""
_FEWEST_REPEATED = 0.3
"""[1] least share of repeated stamps in an export with one row for each turbine or tag; two make it 0.5."""
_LABEL = re.compile(
    r"(?:^|[ _.\-])((?:wtg|wt|wea|wec|turbine|t|w|k|r)[ _\-]?0*\d{1,5})(?=[ _.\-]|$)", re.IGNORECASE
)


def prepare_export(export: Export, turbine: str | None) -> Export:
    """Return an export in a form that a case can read, with one `turbine` selected (None: the first).

    The result's `changes` say why a copy is needed.  Raises TableFault.
    """
    time_column, hour_column = time_columns(export)
    export = _rows_of_turbine(export, time_column, hour_column, turbine)
    if hour_column is not None:
        times_of_day, is_end = time_of_day(export.cells[hour_column])
        joined = export.cells[time_column].str.cat(times_of_day, sep=" ")
        cells = export.cells.drop(columns=[time_column, hour_column])
        time_column = "time_end" if is_end else "time"
        reordered = cells.assign(**{time_column: joined})[[time_column, *cells]]
        export = _with_cells(export, reordered, "date and time in two columns")
    export = _one_column_per_tag(export, time_column)
    text, original_kind = as_text(export.cells[time_column])
    if original_kind is not None:
        export = _with_cells(export, export.cells.assign(**{time_column: text}), f"stamps in {original_kind}")
    if not time_column.strip():
        cells = export.cells.rename(columns={time_column: "time"})
        export, time_column = _with_cells(export, cells, "a column of stamps without a name"), "time"
    header_of = dict(zip(export.cells, export.names, strict=False))
    quality_names = quality_columns(
        list(export.cells), [name for name in export.cells if name != time_column]
    ).values()
    if not export.changes and any(
        export.names.count(header_of.get(name, name)) > 1 for name in quality_names
    ):
        export = _with_cells(export, export.cells, "several columns of one name")
    return _columns_of_turbine(replace(export, column=time_column), turbine)


def join_exports(exports: list[Export]) -> list[Export]:
    """Join exports that continue each other, such as one file a month, if they have the same columns."""
    import pandas as pd

    result: list[Export] = []
    for export in exports:
        places = [index for index, other in enumerate(result) if _continues(other, export)]
        if not places or export.changes:
            result.append(export)
            continue
        earlier = result[places[0]]
        cells = pd.concat([earlier.cells, export.cells], ignore_index=True)
        change = f"joined with {export.file.name}"
        missing = tuple(dict.fromkeys((*earlier.missing, *export.missing)))
        result[places[0]] = replace(earlier, cells=cells, missing=missing, changes=(*earlier.changes, change))
    return result


def same_layout_faults(exports: list[Export]) -> list[str]:
    """Return the faults of exports with the columns and stamps of another one: they are of another turbine.
    Loggers are excepted, since two of one make may share columns and stamps."""
    faults = []
    for position, export in enumerate(exports):
        named_columns = [name_says(name, unit) for name, unit in zip(export.names, export.units, strict=True)]
        columns_with_meaning = [column for column in named_columns if column.quantity or column.signal]
        has_power = any("power" in column.signal for column in columns_with_meaning)
        is_logger = len(columns_with_meaning) <= _LOGGER_QUANTITIES and not has_power
        for earlier in exports[:position]:
            if earlier.names == export.names and not is_logger:
                faults.append(
                    f"{export.file}: expected one turbine, found the columns and stamps of "
                    f"{earlier.file} again; draft one case for each turbine"
                )
    return faults


def _continues(earlier: Export, export: Export) -> bool:
    """Whether two exports have the same columns and hardly any stamps in common."""
    if earlier.names != export.names or earlier.decimal != export.decimal:
        return False
    stamps, _ = time_columns(export)
    return float(export.cells[stamps].isin(set(earlier.cells[stamps])).mean()) < 0.1


def _with_cells(
    export: Export, cells: pandas.DataFrame, change: str, units: dict[str, str] | None = None
) -> Export:
    """Return an export with other cells; `change`, the reason, is added to its changes; `units`: of new
    columns."""
    unit_of = dict(zip(export.cells.columns, export.units, strict=True)) | (units or {})
    names = tuple(map(str, cells.columns))
    units_of_names = tuple(unit_of.get(name, "") for name in names)
    return replace(export, cells=cells, names=names, units=units_of_names, changes=(*export.changes, change))


def _select_turbine(export: Export, names: list[str], turbine: str | None, where: str) -> Export:
    """Return an export with `turbine`, one of `names`, selected; None: the first, with a doubt.

    Raises TableFault for a turbine that is not among them; `where` begins the message.
    """
    selected = names[0] if turbine is None else turbine
    if selected not in names:
        listed = f"{', '.join(names[:20])}{suggestion(selected, names)}"
        raise TableFault(f'{where}: expected the turbine "{selected}", found {listed}')
    if turbine is None:
        others = ", ".join(names[1:8]) + (" …" if len(names) > 8 else "")
        doubt = f'turbine "{selected}" is the first of {len(names)} ({others}): --turbine selects another one'
        export = replace(export, doubts=(*export.doubts, doubt))
    return replace(export, turbine=selected)


def _rows_of_turbine(
    export: Export, time_column: str, hour_column: str | None, turbine: str | None
) -> Export:
    """Return the rows of one turbine, where a column names several turbines; otherwise the export
    unchanged."""
    cells = export.cells
    turbine_columns = [
        name for name in cells if name not in (time_column, hour_column) and _TURBINE.search(words_of(name))
    ]
    for name in turbine_columns:
        turbines = list(cells[name].dropna().unique())
        stamp_columns = [time_column] if hour_column is None else [time_column, hour_column]
        if not 2 <= len(turbines) <= 1000 or cells.duplicated(stamp_columns).mean() < _FEWEST_REPEATED:
            continue
        export = _select_turbine(export, turbines, turbine, f'column "{name}"')
        rows = cells[cells[name] == export.turbine].drop(columns=[name]).reset_index(drop=True)
        return _with_cells(export, rows, f'rows of turbine "{export.turbine}" alone')
    has_single_turbine = turbine is not None and any(cells[name].nunique() == 1 for name in turbine_columns)
    return replace(export, turbine=turbine) if has_single_turbine else export


def _one_column_per_tag(export: Export, time_column: str) -> Export:
    """Return a table with a column for each tag, from rows of stamp, tag and value (and unit, quality).

    Of other exports with a column of values and one of their unit, the unit is moved to that of the values;
    all others are returned unchanged.
    """
    cells = export.cells
    other_names = [name for name in cells if name != time_column]
    sample = {name: cells[name].dropna().iloc[:500] for name in other_names}
    unit_column = next((name for name in other_names if _UNIT.match(words_of(name))), None)
    numeric = [name for name in other_names if len(sample[name]) and sample[name].map(is_value).mean() > 0.9]
    value_columns = [name for name in numeric if _VALUE.search(words_of(name))] or (
        numeric if len(numeric) == 1 else []
    )
    if not value_columns:
        return export
    quality_column = quality_columns(list(cells), value_columns[:1]).get(value_columns[0])
    tag_columns = [
        name
        for name in other_names
        if name not in (*numeric, unit_column, quality_column) and 2 <= cells[name].nunique() <= 500
    ]
    tag_columns.sort(key=lambda name: _TAG.search(words_of(name)) is None)
    repeated_share = cells[time_column].duplicated().mean()
    if not tag_columns or not _is_tagged(repeated_share, tag_columns[0], value_columns[0], numeric):
        if unit_column is None or cells[unit_column].nunique() != 1:
            return export
        units = tuple(
            str(cells[unit_column].dropna().iloc[0]) if name == value_columns[0] else unit
            for name, unit in zip(cells, export.units, strict=True)
        )
        return replace(export, units=units)
    tag_column = tag_columns[0]
    rows = cells.dropna(subset=[tag_column, time_column])
    if rows[time_column].str.match(r"\d{4}-").all():
        rows = rows.sort_values(time_column, kind="stable")
    options = {"index": time_column, "columns": tag_column, "aggfunc": "first", "sort": False}
    table = rows.pivot_table(values=value_columns[0], **options)
    if quality_column is not None:
        table = table.join(rows.pivot_table(values=quality_column, **options).add_suffix(" quality"))
    unit_of_tag = (
        {}
        if unit_column is None
        else rows.dropna(subset=[unit_column]).groupby(tag_column)[unit_column].first().to_dict()
    )
    table = table.reset_index().rename_axis(columns=None)
    return _with_cells(export, table.where(table.notna(), None), "one row a value", unit_of_tag)


def _is_tagged(
    repeated_share: float, tag_column: str, value_column: str, numeric_columns: Sequence[str]
) -> bool:
    """Whether each row holds the value of one tag.

    repeated_share: of the stamps, those that an earlier row has too.  tag_column, value_column: candidates.
    """
    if repeated_share >= _FEWEST_REPEATED:
        return True
    # where a row is written when a value changes, each tag has its own stamps: the names must tell
    is_named = _TAG.search(words_of(tag_column)) and _VALUE.search(words_of(value_column))
    return len(numeric_columns) == 1 and bool(is_named)


def _columns_of_turbine(export: Export, turbine: str | None) -> Export:
    """Return the columns of one turbine, where names of columns contain labels of several; otherwise all
    columns."""
    cells = export.cells
    labels = {name: match[1] for name in cells if name != export.column and (match := _LABEL.search(name))}
    stems: dict[str, list[str]] = {}
    for name, label in labels.items():
        stem = name.replace(label, "", 1).strip(" _.-")
        if re.search(r"[A-Za-z]", stem):
            stems.setdefault(stem, []).append(label)
    labels_of_shared = [labels_of_stem for labels_of_stem in stems.values() if len(labels_of_stem) > 1]
    turbines = list(dict.fromkeys(label for labels_of_stem in labels_of_shared for label in labels_of_stem))
    if not turbines:
        return export
    turbine_of_rows = export.turbine
    export = _select_turbine(export, turbines, turbine, "names of columns")
    selected = export.turbine or ""
    kept = [name for name in cells if labels.get(name) not in turbines or labels[name] == selected]
    units = tuple(unit for name, unit in zip(cells, export.units, strict=True) if name in kept)
    # no copy is needed: the case names the columns of one turbine in the file as it is
    return replace(
        export, cells=cells[kept], units=units, label=selected, turbine=turbine_of_rows or selected
    )
