"""Frames of results: stamps as times in UTC, units beside the numbers.

A column states its unit in brackets, as "value [h]", or `frame.attrs["units"]` does, as {column: unit}; where
the unit changes from row to row, it is the column "unit".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pandas import DataFrame, DatetimeIndex

ENDINGS = {
    "_h": "h", "_s": "s", "_K": "K", "_degC": "°C", "_percent": "%", "_g_m3": "g/m³", "_kW": "kW", "_W": "W",
    "_share": "1", "_coverage": "1", "confidence": "1",
}  # fmt: skip
"""Units of columns by the end of their names, as results write them."""


def with_units(frame: DataFrame, units: Mapping[str, str], stamps: Sequence[str] = ()) -> DataFrame:
    """The frame with the units of its columns, and with the columns `stamps` (text in ISO 8601) as times in
    UTC."""
    import pandas as pd

    for name in stamps:
        frame[name] = pd.to_datetime(frame[name], utc=True, format="ISO8601")
    frame.attrs["units"] = {name: unit for name, unit in units.items() if name in frame.columns}
    return frame


def units_by_name(columns: Sequence[str]) -> dict[str, str]:
    """The units that the names of columns end in; bounds have those of their value."""
    found = {}
    for name in columns:
        bare = name.removesuffix("_lower").removesuffix("_upper")
        unit = next((unit for end, unit in ENDINGS.items() if bare.endswith(end)), "")
        if unit:
            found[name] = unit
    return found


def utc_index(time_s: np.ndarray) -> DatetimeIndex:
    """Times [s] since 1970-01-01T00:00Z as an index in UTC, to the microsecond."""
    import pandas as pd

    stamps = np.round(1e6 * np.asarray(time_s, dtype=float)).astype("int64").astype("datetime64[us]")
    return pd.DatetimeIndex(stamps, name="time").tz_localize("UTC")
