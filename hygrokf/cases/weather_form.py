"""The form of a [[source]] that is a weather file: it has a format in place of columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from hygrokf.cases.keys import Statement, expect_known_keys, stated_number, stated_text
from hygrokf.data.record import Site
from hygrokf.data.timestamps import duration, signed_duration
from hygrokf.errors import suggestion

FORMATS = ("era5", "epw")
_KEYS = (
    "file",
    "format",
    "year",
    "altitude_m",
    "to_site_altitude",
    "lapse_rate_K_per_km",
    "clock_correction",
    "clock_uncertainty",
    "compare",
)


@dataclass(frozen=True)
class StatedWeather:
    """One [[source]] of the case file that is a weather file.

    file: relative to the case file. format: one of `FORMATS`. year: of a typical year, or None.
    altitude_m: [m] that the weather is of, or None: as the file has it.
    to_site_altitude: whether it is moved to the site's altitude. lapse_rate: [K/m] for this.
    clock_correction_s: [s] added to the stamps. clock_uncertainty_s: [s].
    compare: whether it is only held against the other sources. block: number of the [[source]].
    """

    file: str
    format: str
    year: int | None
    altitude_m: float | None
    to_site_altitude: bool
    lapse_rate: float
    clock_correction_s: float
    clock_uncertainty_s: float | None
    compare: bool
    block: int


def stated_weather(
    table: dict[str, Any], site: Site | None, lines: Statement, block: int, faults: list[str]
) -> StatedWeather | None:
    """The weather file that a [[source]] states, or None; every fault of its form goes to `faults`.

    table: as parsed. site: of the case. lines: of the case file. block: number of the [[source]].
    """
    before = len(faults)
    if "signals" in table:
        faults.append(
            f"{lines.at(block, 'signals')}: a source with format brings the signals that its file has; remove signals"
        )
    if "time" in table:
        faults.append(f"{lines.at(block, 'time')}: a source with format needs no time; remove it")
    named = {key: one for key, one in table.items() if key not in ("signals", "time")}
    expect_known_keys(named, _KEYS, " in a [[source]] with format", lines, block, faults)
    file = stated_text(table, "file", lines, block, faults)
    if "file" not in table:
        faults.append(f"{lines.at(block)}: this source needs file")
    form = stated_text(table, "format", lines, block, faults)
    if form is not None and form not in FORMATS:
        faults.append(
            f"{lines.at(block, 'format')}: format must be one of {', '.join(FORMATS)}, found "
            f'"{form}"{suggestion(form, FORMATS)}; a table of columns needs no format'
        )
    flags = {}
    for key in ("to_site_altitude", "compare"):
        flags[key] = table.get(key, False)
        if not isinstance(flags[key], bool):
            faults.append(f"{lines.at(block, key)}: {key} must be true or false, found {flags[key]!r}")
    year = table.get("year")
    if year is not None and (isinstance(year, bool) or not isinstance(year, int) or not 1900 <= year <= 2200):
        faults.append(f"{lines.at(block, 'year')}: year must be a whole number such as 2019, found {year!r}")
    elif year is not None and form == "era5":
        faults.append(
            f"{lines.at(block, 'year')}: year is for typical years (epw); this file has its own stamps"
        )
    altitude = _within(table, "altitude_m", -500.0, 9000.0, lines, block, faults)
    lapse = _within(table, "lapse_rate_K_per_km", -20.0, 20.0, lines, block, faults)
    if flags["to_site_altitude"] is True and (site is None or site.altitude_m is None):
        faults.append(f"{lines.at(block, 'to_site_altitude')}: to_site_altitude needs altitude_m in [site]")
    if flags["to_site_altitude"] is False and lapse is not None:
        faults.append(
            f"{lines.at(block, 'lapse_rate_K_per_km')}: lapse_rate_K_per_km is used with to_site_altitude = true only"
        )
    lengths: dict[str, float | None] = {"clock_correction": 0.0, "clock_uncertainty": None}
    for key in lengths:
        if key in table:
            try:
                lengths[key] = (signed_duration if key == "clock_correction" else duration)(table[key])
            except ValueError as wrong:
                faults.append(f"{lines.at(block, key)}: {key}: {wrong}")
    if len(faults) > before or file is None or form is None:
        return None
    return StatedWeather(
        file,
        form,
        year,
        altitude,
        flags["to_site_altitude"],
        1e-3 * (6.5 if lapse is None else lapse),
        lengths["clock_correction"] or 0.0,
        lengths["clock_uncertainty"],
        flags["compare"],
        block,
    )


def _within(
    table: dict[str, Any], key: str, low: float, high: float, lines: Statement, block: int, faults: list[str]
) -> float | None:
    """A number within limits that may be absent."""
    if key not in table:
        return None
    number = stated_number(table[key])
    if number is None or not low <= number <= high:
        faults.append(
            f"{lines.at(block, key)}: {key} must be a number within {low:g} … {high:g}, found {table[key]!r}"
        )
        return None
    return number
