"""Measured greenhouse compartments as records, with any of their logged actuators withheld: a hidden cause
whose name and course were logged.

Third Autonomous Greenhouse Challenge, processed by Koidra, MIT licence (tests/greenhouse/README.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from hygrokf.cases.frames import read_frames
from hygrokf.data.record import Record

EXCERPTS = Path(__file__).parent / "greenhouse_data"
WHOLE = Path(__file__).resolve().parents[2] / "../shared/data"
CLASSES = {
    "heater_duty": ("unlogged_heater",),
    "fan_duty": ("cooling_switching", "wind_driven_exchange", "exchange_step", "door_opening"),
}
"""Causes that are right names where an actuator is withheld: sources of heat; exchange of air."""
PIPE_K = 60.0
"""[K] warmth of the pipe above the air that counts as full duty."""
UNITS = {
    "cabinet_temperature": "degC", "cabinet_relative_humidity": "%", "heater_duty": "1", "fan_duty": "1",
    "ambient_temperature": "degC", "ambient_relative_humidity": "%", "global_horizontal_irradiance": "W/m2",
    "wind_speed": "m/s",
}  # fmt: skip


def whole(compartment: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The compartment's and the weather's five-minute rows, six weeks; FileNotFoundError where the data are
    absent."""
    return _read(WHOLE / f"greenhouse_agc2022_{compartment}_5min.csv.gz"), _read(
        WHOLE / "greenhouse_agc2022_weather_5min.csv.gz"
    )


def excerpt(compartment: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The shipped excerpt: quarter-hourly rows of four weeks."""
    return _read(EXCERPTS / f"{compartment}_15min.csv.gz"), _read(EXCERPTS / "weather_15min.csv.gz")


def _read(file: Path) -> pd.DataFrame:
    found = pd.read_csv(file)
    found.index = pd.to_datetime(found.pop("time"))
    return found[~found.index.duplicated()]


def record(
    compartment: str,
    frames: tuple[pd.DataFrame, pd.DataFrame],
    withheld: Sequence[str] = (),
    until: str = "2022-03-04T00:00+01:00",
) -> Record:
    """A compartment with all its actuators but the withheld ones, identified up to a date."""
    inside, weather = frames
    pipe = np.clip(inside.heating_pipe_degC - inside.air_temperature_degC, 0.0, None)
    cabinet = pd.DataFrame(
        {
            "cabinet_temperature": inside.air_temperature_degC,
            "cabinet_relative_humidity": inside.air_relative_humidity_pct,
            "heater_duty": (pipe / PIPE_K).clip(0.0, 1.0),
            "fan_duty": ((inside.vent_lee_pct + inside.vent_wind_pct) / 200.0).clip(0.0, 1.0),
        }
    ).drop(columns=list(withheld))
    ambient = pd.DataFrame(
        {
            "ambient_temperature": weather.outside_temperature_degC,
            "ambient_relative_humidity": weather.outside_relative_humidity_pct,
            "global_horizontal_irradiance": weather.global_irradiance_W_m2,
            "wind_speed": weather.wind_speed_m_s,
        }
    )
    columns = {*cabinet.columns, *ambient.columns}
    return read_frames(
        {"climate computer": cabinet, "weather": ambient},
        units={name: unit for name, unit in UNITS.items() if name in columns},
        timezone="+01:00",
        identification={"until": until},
        name=f"{compartment} without {', '.join(withheld) or 'nothing'}",
    )
