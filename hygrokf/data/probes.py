"""Probes: temperature, humidity and dew point of one probe belong to one place.

A file, logger or controller may hold several probes; their columns differ in what remains of a name without
its words of quantity and unit.  Dew points are told by two words, "dew point", so that a logger's is found.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from hygrokf.data.record import Series
from hygrokf.data.signals import HUMIDITIES
from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_from_dew_point
from hygrokf.texts.record import DoubtCode
from hygrokf.texts.statement import Statement

FEWEST_IN_COMMON = 20
"""Readings at common times from which two series are compared."""
ROUNDING = 0.01
"""[1] deviation in vapour pressure that rounding and another formula make: 0.15 K of a dew point."""
QUANTITIES = (
    ("dew_point_temperature", r"(dew|frost) ?points?( temp(erature)?)?|taupunkt(temperatur)?|tdew|dp|td"),
    ("relative_humidity", r"(rel(ative)? )?(humidity|humid|hum|feuchte|luftfeuchte)|rel|rh|rf"),
    ("temperature", r"temperatures?|temperatur|temp|tmp|t"),
)
"""Quantity and the words by which probes name it; the first that fits counts."""
_UNITS = r"deg( ?[cf])?|degrees?|celsius|fahrenheit|c|f|k|pct|percent"


def probe_of(name: str) -> tuple[str, str]:
    """What tells a column's probe from others of its file, and its quantity; "" where it is none of a
    probe's."""
    words = re.sub(r"([a-z])([A-Z])", r"\1 \2", re.sub(r"[(\[{][^)\]}]*[)\]}]", " ", name)).lower()
    words = re.sub(r"(?<=[a-z])(?=\d)|(?<=\d)(?=[a-z])", " ", words)
    words = f" {re.sub(r'[^0-9a-zäöü]+', ' ', words).strip()} "
    quantity = next((one for one, words_of in QUANTITIES if re.search(f" ({words_of}) ", words)), "")
    for pattern in (*(words_of for _, words_of in QUANTITIES), _UNITS):
        words = re.sub(f" ({pattern})(?= )", " ", words)
    return re.sub(r"\s+", " ", words).strip(), quantity


def temperatures_of(probe: str, columns: Iterable[str]) -> list[str]:
    """Columns of the temperature of the probe that a column is of."""
    return [one for one in columns if probe_of(one) == (probe_of(probe)[0], "temperature")]


def copies(series: Sequence[Series]) -> Iterator[Statement]:
    """Doubts about series of the ambient that are the cabinet's own."""
    of = {one.signal: one for one in series}
    for kind in ("temperature", *HUMIDITIES):
        inside, outside = of.get(f"cabinet_{kind}"), of.get(f"ambient_{kind}")
        if inside is not None and outside is not None and _same_readings(inside, outside):
            yield DoubtCode.SAME_READINGS(
                inside=inside.signal, inside_source=inside.source,
                signal=outside.signal, source=outside.source,
            )  # fmt: skip
    warm, moist = of.get("cabinet_temperature"), of.get("cabinet_relative_humidity")
    for kind in ("absolute_humidity", "dew_point_temperature"):
        outside = of.get(f"ambient_{kind}")
        if warm is not None and moist is not None and outside is not None and _derived(warm, moist, outside):
            yield DoubtCode.COMPUTED_FROM_CABINET(
                signal=outside.signal, source=outside.source, temperature_source=warm.source,
                humidity_source=moist.source, instead=f"cabinet_{kind}",
            )  # fmt: skip


def _same_readings(one: Series, other: Series) -> bool:
    """Whether two varying series agree to rounding at nearly all their common times."""
    _, i, j = np.intersect1d(one.time, other.time, return_indices=True)
    there = ~(one.missing[i] | other.missing[j])
    first, second = one.value[i][there], other.value[j][there]
    if len(first) < FEWEST_IN_COMMON or not np.ptp(first) > 0.0:
        return False
    return bool(np.mean(np.isclose(first, second, rtol=1e-9, atol=0.0)) > 0.99)


def _derived(warm: Series, moist: Series, vapour: Series) -> bool:
    """Whether a dew point or an absolute humidity follows from a temperature and a relative humidity at
    nearly all their common times, although it varies by much more than rounding."""
    time = np.intersect1d(np.intersect1d(warm.time, moist.time), vapour.time)
    t, rh, other = (one.value[np.searchsorted(one.time, time)] for one in (warm, moist, vapour))
    if vapour.signal.endswith("dew_point_temperature"):
        other = absolute_humidity_from_dew_point(other, t)
    with np.errstate(divide="ignore", invalid="ignore"):
        own, ratio = np.log(absolute_humidity(rh, t)), np.log(other / absolute_humidity(rh, t))
    there = np.isfinite(own) & np.isfinite(ratio)
    if there.sum() < FEWEST_IN_COMMON or np.std(own[there]) < 5.0 * ROUNDING:
        return False
    return bool(np.mean(np.abs(ratio[there] - np.median(ratio[there])) < ROUNDING) > 0.95)
