"""A measured greenhouse compartment with its actuators, as a record: plants and sun act in it.

Third Autonomous Greenhouse Challenge, processed by Koidra, MIT licence (greenhouse_data/README.md).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from hygrokf.cases.frames import read_frames
from hygrokf.data.record import Record

EXCERPTS = Path(__file__).parent / "greenhouse_data"
WHOLE = Path(__file__).resolve().parents[2] / "../shared/data"
PIPE_K = 60.0
"""[K] warmth of the pipe above the air that counts as full duty."""
UNITS = {
    "cabinet_temperature": "degC", "cabinet_relative_humidity": "%", "heater_duty": "1", "fan_duty": "1",
    "ambient_temperature": "degC", "ambient_relative_humidity": "%", "global_horizontal_irradiance": "W/m2",
    "wind_speed": "m/s",
}  # fmt: skip


def _read(file: Path) -> pd.DataFrame:
    found = pd.read_csv(file)
    found.index = pd.to_datetime(found.pop("time"))
    return found[~found.index.duplicated()]


def excerpt(compartment: str) -> Record:
    """Quarter-hourly rows of four weeks, identified up to 1 March."""
    inside, weather = (_read(EXCERPTS / f"{name}_15min.csv.gz") for name in (compartment, "weather"))
    return _record(compartment, inside, weather, "2022-03-01T00:00+01:00")


def files(compartment: str) -> tuple[str, str]:
    """The files of a compartment and of the weather, which are not shipped."""
    return tuple(f"greenhouse_agc2022_{name}_5min.csv.gz" for name in (compartment, "weather"))


def whole(compartment: str) -> Record:
    """Five-minute rows of six weeks, identified up to 4 March; FileNotFoundError where they are absent."""
    inside, weather = (_read(WHOLE / file) for file in files(compartment))
    return _record(compartment, inside, weather, "2022-03-04T00:00+01:00")


def _record(compartment: str, inside: pd.DataFrame, weather: pd.DataFrame, until: str) -> Record:
    pipe = np.clip(inside.heating_pipe_degC - inside.air_temperature_degC, 0.0, None)
    cabinet = pd.DataFrame(
        {
            "cabinet_temperature": inside.air_temperature_degC,
            "cabinet_relative_humidity": inside.air_relative_humidity_pct,
            "heater_duty": (pipe / PIPE_K).clip(0.0, 1.0),
            "fan_duty": ((inside.vent_lee_pct + inside.vent_wind_pct) / 200.0).clip(0.0, 1.0),
        }
    )
    ambient = pd.DataFrame(
        {
            "ambient_temperature": weather.outside_temperature_degC,
            "ambient_relative_humidity": weather.outside_relative_humidity_pct,
            "global_horizontal_irradiance": weather.global_irradiance_W_m2,
            "wind_speed": weather.wind_speed_m_s,
        }
    )
    return read_frames(
        {"climate computer": cabinet, "weather": ambient},
        units=UNITS,
        timezone="+01:00",
        identification={"until": until},
        name=compartment,
    )
