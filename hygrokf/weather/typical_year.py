"""Hours of a typical year, composed of months from different years: in one calendar year, and as series."""

from __future__ import annotations

import calendar
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.timestamps import DAY_S, HOUR_S

WIND_HEIGHT_M = 10.0
"""[m] height of the wind in files of typical years."""
SHIFTED = "the columns are shifted, or in other units"
"""What impossible values mean in files of typical years."""
WIND_WARNING = "wind_speed is measured at 10 m, not at hub height"


def placed_in_year(
    stamps: np.ndarray, columns: Mapping[str, np.ndarray], year: int, own: str
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Hours moved to one calendar year: their stamps, their columns, and warnings.

    stamps: (T, 4) year, month, day, hour 1…24 as written. columns: of numbers (T,). year: 1900 … 2200.
    own: the years of the file in words, "" where it is that year.

    29 February is a repetition of the 28th where the year needs it and the file has none; it is left out
    where the year has none.  Raises TableFault for a year out of range.
    """
    if not 1900 <= year <= 2200:
        raise TableFault(f"year must lie within 1900 … 2200, found {year}")
    month, day = stamps[:, 1], stamps[:, 2]
    leap_day = (month == 2) & (day == 29)
    before = np.flatnonzero((month == 2) & (day == 28))
    keep, said = np.arange(len(month)), []
    placed = stamps.copy()
    placed[:, 0] = year
    if calendar.isleap(year) and not leap_day.any() and len(before) == 24:
        keep = np.insert(keep, before[-1] + 1, before)
        placed = placed[keep]
        placed[before[-1] + 1 : before[-1] + 25, 2] = 29
        said.append(f"{year} is a leap year: 28 February is repeated as 29 February")
    elif not calendar.isleap(year) and leap_day.any():
        keep = np.flatnonzero(~leap_day)
        placed = placed[keep]
        said.append(f"{year} is not a leap year: 29 February is left out")
    if own:
        said.append(f"hours of {own} stand in {year}: a typical year, not the weather of {year}")
    return placed, {name: one[keep] for name, one in columns.items()}, said


def local_seconds(stamps: np.ndarray) -> np.ndarray:
    """Ends of hours (T, 4) as seconds since 1970-01-01T00:00 of the local clock (T,) [s]."""
    months = (stamps[:, 0] - 1970) * 12 + stamps[:, 1] - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(int) + stamps[:, 2] - 1
    return days * DAY_S + stamps[:, 3] * HOUR_S


def hours_table(
    lines: Sequence[tuple[int, Sequence[str]]],
    width: int,
    used: Sequence[int],
    date: Callable[[np.ndarray], Iterable[float]],
    faults: list[str],
    exact: bool = False,
) -> np.ndarray:
    """The hours (T, columns) of lines, NaN where a cell is empty; the faults of the first lines are added.

    lines: number and cells. width: of a line at least, or with `exact` of every line.
    used: columns of numbers. date: year, month, day and hour 1 … 24 of a row.
    """
    table = np.full((len(lines), max([width, *(len(cells) for _, cells in lines)])), np.nan)
    wrong = []
    for row, (number, cells) in zip(table, lines, strict=True):
        try:
            if len(cells) < width or (exact and len(cells) > width):
                raise ValueError(f"expected {'' if exact else 'at least '}{width} cells, found {len(cells)}")
            for column in used:
                if column < len(cells) and cells[column].strip():
                    row[column] = float(cells[column])
                    if not np.isfinite(row[column]):
                        raise ValueError(f"cell {column + 1}: expected a number, found {cells[column]}")
            year, month, day, hour = (int(one) for one in date(row))
            if not 1 <= hour <= 24:
                raise ValueError(f"expected an hour 1 … 24, found {hour}")
            if not (1 <= month <= 12 and 1 <= day <= 31 and 1800 <= year <= 2300):
                raise ValueError(f"expected a date, found {year}, {month}, {day}")
            if day > (29 if month == 2 else calendar.monthrange(year, month)[1]):
                raise ValueError(f"month {month} has no day {day}")
        except ValueError as reason:
            wrong.append(f"line {number}: {reason}")
    more = f" (and {len(wrong) - 3} more lines)" if len(wrong) > 3 else ""
    faults += [*wrong[:2], *(one + more for one in wrong[2:3])]
    return table
