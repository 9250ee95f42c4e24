"""Records of the same place put together: other signals beside each other, other times after each other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from hygrokf.masks import order_readings
from hygrokf.readers import TableFault
from hygrokf.record import Record, Series, Site

SAME_PLACE_DEG = 0.02
"""[deg] within which two files are of the same point: that of a reanalysis' cell is written with two digits."""


def joined(records: Sequence[Record], name: str) -> Record:
    """One record of several of the same place.

    records: one at least; each with any signals over any time. name: of the result.

    Readings of a signal are put in order of time; of equal ones one is kept, contradicting ones are masked and said.
    Raises TableFault where the records are of different places, or have a signal with different holds.
    """
    if len(records) == 1:
        return dataclasses.replace(records[0], name=name)
    warnings = list(dict.fromkeys(said for one in records for said in one.warnings))
    faults: list[str] = []
    site = _one_place(records, faults)
    series = []
    for signal in dict.fromkeys(signal for one in records for signal in one.signals):
        parts = [one[signal] for one in records if signal in one]
        if len({(part.hold, part.interval_s) for part in parts}) > 1:
            faults.append(f"{signal}: means over different intervals in different files; convert them first")
            continue
        made, said = _one_series(parts)
        series.append(made)
        warnings += said
    if faults:
        raise TableFault(faults)
    provenance = tuple(dict.fromkeys(pair for one in records for pair in one.provenance))
    return Record(name, tuple(series), site, warnings=tuple(warnings), provenance=provenance)


def _one_place(records: Sequence[Record], faults: list[str]) -> Site | None:
    sites = [(one.name, one.site) for one in records if one.site is not None]
    for name, site in sites[1:]:
        first = sites[0][1]
        apart = max(
            abs(site.latitude_deg - first.latitude_deg), abs(site.longitude_deg - first.longitude_deg)
        )
        if apart > SAME_PLACE_DEG:
            faults.append(
                f"{sites[0][0]} and {name} are of different places ({first.latitude_deg:g}, {first.longitude_deg:g} "
                f"and {site.latitude_deg:g}, {site.longitude_deg:g} deg); give files of one place"
            )
    with_altitude = [site for _, site in sites if site.altitude_m is not None]
    return (with_altitude or [site for _, site in sites] or [None])[0]


def _one_series(parts: Sequence[Series]) -> tuple[Series, list[str]]:
    parts = sorted((part for part in parts if len(part)), key=lambda part: part.time[0]) or list(parts[:1])
    first = parts[0]
    if len(parts) == 1:
        return first, []
    time, values, said = order_readings(
        np.concatenate([part.time for part in parts]),
        {first.signal: np.concatenate([part.value for part in parts])},
    )
    source = first.source
    if len({part.source for part in parts}) > 1:
        source = f"{first.source} and {len(parts) - 1} more"
    made = dataclasses.replace(first, time=time, value=values[first.signal], source=source)
    return made, [f"{first.signal}: {one}" for one in said if not one.startswith("unsorted")]
