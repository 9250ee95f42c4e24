"""Probes: temperature, humidity and dew point of one probe belong to one place.

A file, logger or controller may hold several probes.  The words of a column's name that name neither its
quantity nor its unit identify the probe.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from hygrokf.data.record import Series
from hygrokf.data.signals import HUMIDITIES
from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_from_dew_point
from hygrokf.texts.record_codes import DoubtCode
from hygrokf.texts.statement import Statement

FEWEST_IN_COMMON = 20
"""Readings at common times from which two series are compared."""
PRESSURE_ROUNDING = 0.01
"""[1] deviation in vapour pressure that rounding and another formula make: 0.15 K of a dew point."""
QUANTITY_PATTERNS = (
    ("dew_point_temperature", r"(dew|frost) ?points?( temp(erature)?)?|taupunkt(temperatur)?|tdew|dp|td"),
    ("relative_humidity", r"(rel(ative)? )?(humidity|humid|hum|feuchte|luftfeuchte)|rel|rh|rf"),
    ("temperature", r"temperatures?|temperatur|temp|tmp|t"),
)
"""Quantity and the words by which probes name it; the first that fits counts."""
_UNITS = r"deg( ?[cf])?|degrees?|celsius|fahrenheit|c|f|k|pct|percent"


def probe_of(name: str) -> tuple[str, str]:
    """The words that distinguish a column's probe from others of its file, and the column's quantity, "" if
    it is none of `QUANTITY_PATTERNS`."""
    words = re.sub(r"([a-z])([A-Z])", r"\1 \2", re.sub(r"[(\[{][^)\]}]*[)\]}]", " ", name)).lower()
    words = re.sub(r"(?<=[a-z])(?=\d)|(?<=\d)(?=[a-z])", " ", words)
    words = f" {re.sub(r'[^0-9a-zäöü]+', ' ', words).strip()} "
    quantity = next(
        (
            quantity_name
            for quantity_name, words_of in QUANTITY_PATTERNS
            if re.search(f" ({words_of}) ", words)
        ),
        "",
    )
    for pattern in (*(words_of for _, words_of in QUANTITY_PATTERNS), _UNITS):
        words = re.sub(f" ({pattern})(?= )", " ", words)
    return re.sub(r"\s+", " ", words).strip(), quantity


def temperatures_of(probe: str, columns: Iterable[str]) -> list[str]:
    """Columns that hold the temperature of the same probe as the column `probe`."""
    return [column for column in columns if probe_of(column) == (probe_of(probe)[0], "temperature")]


def copies(series: Sequence[Series]) -> Iterator[Statement]:
    """Doubts about ambient series that copy the cabinet's series or follow from them."""
    by_signal = {item.signal: item for item in series}
    for kind in ("temperature", *HUMIDITIES):
        inside, outside = by_signal.get(f"cabinet_{kind}"), by_signal.get(f"ambient_{kind}")
        if inside is not None and outside is not None and _same_readings(inside, outside):
            yield DoubtCode.SAME_READINGS(
                inside=inside.signal, inside_source=inside.source,
                signal=outside.signal, source=outside.source,
            )  # fmt: skip
    temperature, humidity = by_signal.get("cabinet_temperature"), by_signal.get("cabinet_relative_humidity")
    for kind in ("absolute_humidity", "dew_point_temperature"):
        outside = by_signal.get(f"ambient_{kind}")
        if temperature is None or humidity is None or outside is None:
            continue
        if _follows(outside, temperature, humidity):
            yield DoubtCode.COMPUTED_FROM_CABINET(
                signal=outside.signal, source=outside.source, temperature_source=temperature.source,
                humidity_source=humidity.source, instead=f"cabinet_{kind}",
            )  # fmt: skip


def _same_readings(inside: Series, outside: Series) -> bool:
    """Whether two varying series agree to rounding at nearly all their common times."""
    _, i, j = np.intersect1d(inside.time, outside.time, return_indices=True)
    is_present = ~(inside.missing[i] | outside.missing[j])
    inside_values, outside_values = inside.value[i][is_present], outside.value[j][is_present]
    if len(inside_values) < FEWEST_IN_COMMON or not np.ptp(inside_values) > 0.0:
        return False
    return bool(np.mean(np.isclose(inside_values, outside_values, rtol=1e-9, atol=0.0)) > 0.99)


def _follows(vapour: Series, temperature: Series, humidity: Series) -> bool:
    """Whether a dew point or an absolute humidity follows from a temperature and a relative humidity at
    nearly all their common times, although it varies by much more than rounding."""
    time = np.intersect1d(np.intersect1d(temperature.time, humidity.time), vapour.time)
    temperature_K, relative, derived = (
        series.value[np.searchsorted(series.time, time)] for series in (temperature, humidity, vapour)
    )
    if vapour.signal.endswith("dew_point_temperature"):
        derived = absolute_humidity_from_dew_point(derived, temperature_K)
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = absolute_humidity(relative, temperature_K)
        log_vapour, log_ratio = np.log(expected), np.log(derived / expected)
    is_present = np.isfinite(log_vapour) & np.isfinite(log_ratio)
    if is_present.sum() < FEWEST_IN_COMMON or np.std(log_vapour[is_present]) < 5.0 * PRESSURE_ROUNDING:
        return False
    return bool(
        np.mean(np.abs(log_ratio[is_present] - np.median(log_ratio[is_present])) < PRESSURE_ROUNDING) > 0.95
    )
