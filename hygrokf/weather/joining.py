"""Join records of the same place: different signals side by side, different times one after the other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.readings import order_readings
from hygrokf.data.record import Record, Series, Site, least_measured

SAME_PLACE_DEG = 0.02
"""[deg] largest distance between two files of the same point; reanalyses write coordinates with two
digits."""

PACKED = 5e-5
"""Share of a field's range by which equal values may differ between two files that are each packed in two
bytes with a scale of their own: three times 1/65536, rounded up."""


def join_records(records: Sequence[Record], name: str) -> Record:
    """Join records of the same place.

    records: at least one; each with any signals over any time. name: of the result.

    Readings of a signal are sorted by time.  Of several readings with the same stamp one is kept if they
    agree to the rounding of packed files; contradicting readings are masked, with a warning.  Raises
    TableFault where the records are of different places, or a signal has different holds or heights.
    """
    if len(records) == 1:
        return dataclasses.replace(records[0], name=name)
    warnings = list(dict.fromkeys(warning for record in records for warning in record.warnings))
    faults: list[str] = []
    site = _common_site(records, faults)
    series = []
    for signal in dict.fromkeys(signal for record in records for signal in record.signals):
        parts = [record[signal] for record in records if signal in record]
        if len({(part.hold, part.interval_s) for part in parts}) > 1:
            faults.append(f"{signal}: means over different intervals in different files; convert them first")
            continue
        heights = sorted({part.height_m for part in parts if part.height_m is not None})
        if len(heights) > 1:
            listed = " and ".join(f"{height:g} m" for height in heights)
            faults.append(
                f"{signal}: at {listed} in different files; ask for the same height in all of them, or leave "
                "it out of some"
            )
            continue
        joined_series, messages = _join_series(parts)
        series.append(joined_series)
        warnings += messages
    if faults:
        raise TableFault(*faults)
    files = tuple(dict.fromkeys(pair for record in records for pair in record.files))
    provenance = least_measured(record.provenance for record in records)
    return Record(name, tuple(series), site, warnings=tuple(warnings), files=files, provenance=provenance)


def follows(one: Record, other: Record) -> bool:
    """Whether two weather records of the same place follow each other, as files of single years do.

    True where they have a signal in common, and every such signal shares less than half of the shorter
    series' readings; False for two sources over the same time, and for different places.
    """
    if (
        one.site is not None
        and other.site is not None
        and _distance_deg(one.site, other.site) > SAME_PLACE_DEG
    ):
        return False
    pairs = [(one[signal], other[signal]) for signal in one.signals if signal in other]
    ordered = [sorted(pair, key=len) for pair in pairs if all(map(len, pair))]
    overlaps = [(short.time >= long.time[0]) & (short.time <= long.time[-1]) for short, long in ordered]
    return bool(overlaps) and all(np.mean(is_inside) < 0.5 for is_inside in overlaps)


def _distance_deg(one: Site, other: Site) -> float:
    return max(abs(one.latitude_deg - other.latitude_deg), abs(one.longitude_deg - other.longitude_deg))


def _common_site(records: Sequence[Record], faults: list[str]) -> Site | None:
    sites = [(record.name, record.site) for record in records if record.site is not None]
    for name, site in sites[1:]:
        first = sites[0][1]
        if _distance_deg(site, first) > SAME_PLACE_DEG:
            faults.append(
                f"{sites[0][0]} and {name} are of different places ({first.latitude_deg:g}, "
                f"{first.longitude_deg:g} and {site.latitude_deg:g}, {site.longitude_deg:g} deg); give files "
                "of one place"
            )
    return min((site for _, site in sites), key=lambda site: site.altitude_m is None, default=None)


def _join_series(parts: Sequence[Series]) -> tuple[Series, list[str]]:
    parts = sorted((part for part in parts if len(part)), key=lambda part: part.time[0]) or list(parts[:1])
    first = parts[0]
    if len(parts) == 1:
        return first, []
    time, value = np.concatenate([part.time for part in parts]), [first.value]
    for count, part in enumerate(parts[1:], 1):
        value.append(_without_packing_noise(parts[:count], value, part))
    time, values, messages = order_readings(time, {first.signal: np.concatenate(value)})
    source = first.source
    if len({part.source for part in parts}) > 1:
        source = f"{first.source} and {len(parts) - 1} more"
    joined_series = dataclasses.replace(
        first,
        time=time,
        value=values[first.signal],
        source=source,
        clock_uncertainty_s=max(
            (part.clock_uncertainty_s for part in parts if part.clock_uncertainty_s is not None), default=None
        ),
    )
    return joined_series, [
        f"{first.signal}: {message}" for message in messages if not message.startswith("unsorted")
    ]


def _without_packing_noise(
    earlier_parts: Sequence[Series], values: Sequence[np.ndarray], part: Series
) -> np.ndarray:
    """Values of a part (T,), replaced by the earlier parts' values where only packing makes them differ."""
    value = part.value.copy()
    for earlier, earlier_value in zip(earlier_parts, values, strict=True):
        if earlier.time[-1] < part.time[0]:  # most of many daily files share no stamp
            continue
        _, i, j = np.intersect1d(earlier.time, part.time, return_indices=True)
        finite = np.concatenate([earlier_value, part.value])
        finite = finite[np.isfinite(finite)]
        if not len(i) or not len(finite):
            continue
        is_equal = np.abs(earlier_value[i] - value[j]) <= PACKED * float(np.ptp(finite))
        value[j[is_equal]] = earlier_value[i[is_equal]]
    return value
