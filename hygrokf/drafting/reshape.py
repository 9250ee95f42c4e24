"""Exports in a form that a case can name: one turbine, one column a quantity, one column of stamps."""

from __future__ import annotations

import re
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
"""Temperature, humidity and dew point: a logger has no more."""
_LABEL = re.compile(
    r"(?:^|[ _.\-])((?:wtg|wt|wea|wec|turbine|t|w|k|r)[ _\-]?0*\d{1,5})(?=[ _.\-]|$)", re.IGNORECASE
)


def prepared(export: Export, turbine: str | None) -> Export:
    """An export that a case can name, after selection of one turbine and reordering of its cells.

    turbine: to select, or None for the first.  Its `changes` say why a copy is needed.  Raises TableFault.
    """
    column, hours = time_columns(export)
    export = _one_turbine(export, column, hours, turbine)
    if hours is not None:
        of_day, ends = time_of_day(export.cells[hours])
        joined = export.cells[column].str.cat(of_day, sep=" ")
        cells = export.cells.drop(columns=[column, hours])
        column = "time_end" if ends else "time"
        named = cells.assign(**{column: joined})[[column, *cells]]
        export = _with(export, named, "date and time in two columns")
    export = _wide(export, column)
    text, was = as_text(export.cells[column])
    if was is not None:
        export = _with(export, export.cells.assign(**{column: text}), f"stamps in {was}")
    if not column.strip():
        cells = export.cells.rename(columns={column: "time"})
        export, column = _with(export, cells, "a column of stamps without a name"), "time"
    header = dict(zip(export.cells, export.names, strict=False))
    marks = quality_columns(list(export.cells), [one for one in export.cells if one != column]).values()
    if not export.changes and any(export.names.count(header.get(one, one)) > 1 for one in marks):
        export = _with(export, export.cells, "several columns of one name")
    return _one_label(replace(export, column=column), turbine)


def joined(exports: list[Export]) -> list[Export]:
    """Exports, those with the same columns joined to one: files of consecutive months or years."""
    import pandas as pd

    result: list[Export] = []
    for export in exports:
        same = [n for n, one in enumerate(result) if _continues(one, export)]
        if not same or export.changes:
            result.append(export)
            continue
        before = result[same[0]]
        cells = pd.concat([before.cells, export.cells], ignore_index=True)
        change = f"joined with {export.file.name}"
        missing = tuple(dict.fromkeys((*before.missing, *export.missing)))
        result[same[0]] = replace(before, cells=cells, missing=missing, changes=(*before.changes, change))
    return result


def same_layout(exports: list[Export]) -> list[str]:
    """Faults of exports that have the columns and the stamps of another one: they are of another turbine.

    Two loggers of one make have them too: they read little else than temperature and humidity.
    """
    faults = []
    for number, export in enumerate(exports):
        said = [name_says(name, unit) for name, unit in zip(export.names, export.units, strict=True)]
        readings = [one for one in said if one.quantity or one.signal]
        power = any("power" in one.signal for one in readings)
        logger = len(readings) <= _LOGGER_QUANTITIES and not power
        for before in exports[:number]:
            if before.names == export.names and not logger:
                faults.append(
                    f"{export.file}: expected one turbine, found the columns and stamps of "
                    f"{before.file} again; draft one case for each turbine"
                )
    return faults


def _continues(before: Export, export: Export) -> bool:
    """Whether an export has the columns of another one and hardly any of its stamps."""
    if before.names != export.names or before.decimal != export.decimal:
        return False
    stamps, _ = time_columns(export)
    return float(export.cells[stamps].isin(set(before.cells[stamps])).mean()) < 0.1


def _with(
    export: Export, cells: pandas.DataFrame, change: str, units: dict[str, str] | None = None
) -> Export:
    """An export with other cells, and why."""
    old = dict(zip(export.cells.columns, export.units, strict=True)) | (units or {})
    names = tuple(map(str, cells.columns))
    of_names = tuple(old.get(name, "") for name in names)
    return replace(export, cells=cells, names=names, units=of_names, changes=(*export.changes, change))


def _selected(export: Export, names: list[str], turbine: str | None, where: str) -> Export:
    """An export of several turbines with one of them chosen, by default the first, with a doubt.  Raises
    TableFault."""
    chosen = names[0] if turbine is None else turbine
    if chosen not in names:
        found = f"{', '.join(names[:20])}{suggestion(chosen, names)}"
        raise TableFault(f'{where}: expected the turbine "{chosen}", found {found}')
    if turbine is None:
        rest = ", ".join(names[1:8]) + (" …" if len(names) > 8 else "")
        doubt = f'turbine "{chosen}" is the first of {len(names)} ({rest}): --turbine selects another one'
        export = replace(export, doubts=(*export.doubts, doubt))
    return replace(export, turbine=chosen)


def _one_turbine(export: Export, column: str, hours: str | None, turbine: str | None) -> Export:
    """The rows of one turbine, where a column names several."""
    cells = export.cells
    keys = [one for one in cells if one not in (column, hours) and _TURBINE.search(words_of(one))]
    for key in keys:
        names = list(cells[key].dropna().unique())
        stamps = [column] if hours is None else [column, hours]
        if not 2 <= len(names) <= 1000 or cells.duplicated(stamps).mean() < 0.3:
            continue
        export = _selected(export, names, turbine, f'column "{key}"')
        rows = cells[cells[key] == export.turbine].drop(columns=[key]).reset_index(drop=True)
        return _with(export, rows, f'rows of turbine "{export.turbine}" alone')
    alone = turbine is not None and any(cells[key].nunique() == 1 for key in keys)
    return replace(export, turbine=turbine) if alone else export


def _wide(export: Export, column: str) -> Export:
    """One column a tag, from rows of stamp, tag and value; units of a column of units."""
    cells = export.cells
    rest = [one for one in cells if one != column]
    sample = {one: cells[one].dropna().iloc[:500] for one in rest}
    unit = next((one for one in rest if _UNIT.match(words_of(one))), None)
    numbers = [one for one in rest if len(sample[one]) and sample[one].map(is_value).mean() > 0.9]
    values = [one for one in numbers if _VALUE.search(words_of(one))] or (
        numbers if len(numbers) == 1 else []
    )
    if not values:
        return export
    quality = quality_columns(list(cells), values[:1]).get(values[0])
    tags = [one for one in rest if one not in (*numbers, unit, quality) and 2 <= cells[one].nunique() <= 500]
    tags.sort(key=lambda one: _TAG.search(words_of(one)) is None)
    tagged = bool(tags) and (
        cells[column].duplicated().mean() >= 0.3
        # each tag has stamps of its own where a row comes when its value changes
        or (len(numbers) == 1 and _TAG.search(words_of(tags[0])) and _VALUE.search(words_of(values[0])))
    )
    if not tagged:
        if unit is None or cells[unit].nunique() != 1:
            return export
        units = tuple(
            str(cells[unit].dropna().iloc[0]) if name == values[0] else given
            for name, given in zip(cells, export.units, strict=True)
        )
        return replace(export, units=units)
    tag = tags[0]
    rows = cells.dropna(subset=[tag, column])
    if rows[column].str.match(r"\d{4}-").all():
        rows = rows.sort_values(column, kind="stable")
    how = {"index": column, "columns": tag, "aggfunc": "first", "sort": False}
    table = rows.pivot_table(values=values[0], **how)
    if quality is not None:
        table = table.join(rows.pivot_table(values=quality, **how).add_suffix(" quality"))
    units_of = {} if unit is None else rows.dropna(subset=[unit]).groupby(tag)[unit].first().to_dict()
    table = table.reset_index().rename_axis(columns=None)
    return _with(export, table.where(table.notna(), None), "one row a value", units_of)


def _one_label(export: Export, turbine: str | None) -> Export:
    """The columns of one turbine, where the names of columns hold several."""
    cells = export.cells
    labels = {one: found[1] for one in cells if one != export.column and (found := _LABEL.search(one))}
    stems: dict[str, list[str]] = {}
    for name, label in labels.items():
        stem = name.replace(label, "", 1).strip(" _.-")
        if re.search(r"[A-Za-z]", stem):
            stems.setdefault(stem, []).append(label)
    names = list(dict.fromkeys(label for found in stems.values() if len(found) > 1 for label in found))
    if not names:
        return export
    before = export.turbine
    export = _selected(export, names, turbine, "names of columns")
    chosen = export.turbine or ""
    kept = [one for one in cells if labels.get(one) not in names or labels[one] == chosen]
    units = tuple(given for one, given in zip(cells, export.units, strict=True) if one in kept)
    # nothing moves in the file: the case names the columns of one turbine
    return replace(export, cells=cells[kept], units=units, label=chosen, turbine=before or chosen)
