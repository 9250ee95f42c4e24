"""Join weather records of the same place: different signals side by side, different times one after the
other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.readings import order_readings
from hygrokf.data.record import Record, Series, Site, least_measured

SAME_PLACE_DEG = 0.02
"""[deg] two files whose points are no further apart are of the same point; reanalyses write coordinates with
two digits."""

PACKED = 5e-5
"""[1] share of a field's range by which equal values may differ between two files, each packed in two bytes
with its own scale: three times 1/65536, rounded up."""


def join_records(records: Sequence[Record], name: str) -> Record:
    """Join records of the same place.

    records: at least one, each with any signals over any time. name: of the result.

    Readings of a signal are sorted by time. Of several readings with the same stamp one is kept if they agree
    up to the rounding of packed files; contradicting readings are masked, with a warning. Raises TableFault
    if the records are of different places, or if a signal has different holds or heights.
    """
    if len(records) == 1:
        return dataclasses.replace(records[0], name=name)
    warnings = list(dict.fromkeys(warning for record in records for warning in record.warnings))
    faults: list[str] = []
    site = _common_site(records, faults)
    series = []
    for signal in dict.fromkeys(signal for record in records for signal in record.signals):
        series_of_signal = [record[signal] for record in records if signal in record]
        if len({(part.hold, part.interval_s) for part in series_of_signal}) > 1:
            faults.append(f"{signal}: means over different intervals in different files; convert them first")
            continue
        heights = sorted({part.height_m for part in series_of_signal if part.height_m is not None})
        if len(heights) > 1:
            heights_text = " and ".join(f"{height:g} m" for height in heights)
            faults.append(
                f"{signal}: at {heights_text} in different files; ask for the same height in all of them, or "
                "leave it out of some"
            )
            continue
        joined_series, messages = _join_series(series_of_signal)
        series.append(joined_series)
        warnings += messages
    if faults:
        raise TableFault(*faults)
    files = tuple(dict.fromkeys(pair for record in records for pair in record.files))
    provenance = least_measured(record.provenance for record in records)
    return Record(name, tuple(series), site, warnings=tuple(warnings), files=files, provenance=provenance)


def follows(first: Record, second: Record) -> bool:
    """Return whether two weather records of the same place follow each other, as files of single years do.

    True if they have a signal in common, and if for every such signal less than half of the shorter series
    lies inside the other one; False for two sources over the same time, and for different places.
    """
    if (
        first.site is not None
        and second.site is not None
        and _distance_deg(first.site, second.site) > SAME_PLACE_DEG
    ):
        return False
    common_series = [(first[signal], second[signal]) for signal in first.signals if signal in second]
    ordered = [sorted(pair, key=len) for pair in common_series if all(map(len, pair))]
    overlaps = [
        (shorter.time >= longer.time[0]) & (shorter.time <= longer.time[-1]) for shorter, longer in ordered
    ]
    return bool(overlaps) and all(np.mean(is_inside) < 0.5 for is_inside in overlaps)


def _distance_deg(first: Site, second: Site) -> float:
    """Return the larger one of the differences in latitude and longitude [deg]."""
    return max(abs(first.latitude_deg - second.latitude_deg), abs(first.longitude_deg - second.longitude_deg))


def _common_site(records: Sequence[Record], faults: list[str]) -> Site | None:
    """Return the site of the records, preferably one with an altitude; adds a fault to `faults` for different
    places."""
    sites = [(record.name, record.site) for record in records if record.site is not None]
    for name, site in sites[1:]:
        first_site = sites[0][1]
        if _distance_deg(site, first_site) > SAME_PLACE_DEG:
            faults.append(
                f"{sites[0][0]} and {name} are of different places ({first_site.latitude_deg:g}, "
                f"{first_site.longitude_deg:g} and {site.latitude_deg:g}, {site.longitude_deg:g} deg); give "
                "files of one place"
            )
    return min((site for _, site in sites), key=lambda site: site.altitude_m is None, default=None)


def _join_series(parts: Sequence[Series]) -> tuple[Series, list[str]]:
    """Join series of one signal; returns the joined series and messages about its readings."""
    parts = sorted((part for part in parts if len(part)), key=lambda part: part.time[0]) or list(parts[:1])
    first = parts[0]
    if len(parts) == 1:
        return first, []
    time, values_of_parts = np.concatenate([part.time for part in parts]), [first.value]
    for count, part in enumerate(parts[1:], 1):
        values_of_parts.append(_without_packing_noise(parts[:count], values_of_parts, part))
    time, values, messages = order_readings(time, {first.signal: np.concatenate(values_of_parts)})
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
    """The values of a part (T,), replaced by those of earlier parts where they differ only by packing."""
    value = part.value.copy()
    for earlier, earlier_value in zip(earlier_parts, values, strict=True):
        if earlier.time[-1] < part.time[0]:  # most of many daily files share no stamp
            continue
        _, earlier_index, index = np.intersect1d(earlier.time, part.time, return_indices=True)
        finite = np.concatenate([earlier_value, part.value])
        finite = finite[np.isfinite(finite)]
        if not len(earlier_index) or not len(finite):
            continue
        is_equal = np.abs(earlier_value[earlier_index] - value[index]) <= PACKED * float(np.ptp(finite))
        value[index[is_equal]] = earlier_value[earlier_index[is_equal]]
    return value
