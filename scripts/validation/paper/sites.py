"""The measured drivers of two wind farms: ERA5's air and the turbine's power, from the files of the data
folder.

Kelmarsh, UK: ERA5 with humidity, hourly power.  La Haute Borne, France: ERA5 without humidity, ten-minute
power and an outdoor sensor on the nacelle.  Neither has a logger beside a cabinet, so there is no second
ambient series to measure the paper's comparison of local air and reanalysis with; `cabinets.LocalAir` makes
one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from plants.uk import ten_minute_power

from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_from_dew_point
from validation.frame import Absent

KELMARSH = "kelmarsh_2018_2019_era5_power_hourly.csv.gz"
FRENCH_POWER = "la_haute_borne_R80736_10min_2014_2015.csv.gz"
FRENCH_WEATHER = "la_haute_borne_era5_hourly_2014_2015.csv.gz"
EAVES = {
    f"attic_trh1_R{house}_hourly.csv.gz": side for house, side in ((2, "west"), (4, "south"), (7, "east"))
}
HOUR_S = 3600.0
STEP_S = 600.0
FREEZING_K = 273.15
FOUR_YEARS_S = 1461 * 86400.0
"""[s] from a date to the same date four years later, one leap day included."""


@dataclass(frozen=True)
class Site:
    """Measured drivers of one turbine.

    hour_s: [s] (H,) since 1970, each hour. temperature_K, vapour_kg_m3: (H,) ERA5's air at these instants.
    step_s: [s] (T,) starts of ten-minute intervals. power_W: (T,) mean power of each, filled where
    power_known is False. outdoor_K: (T,) the turbine's own outdoor sensor, or None. latitude_deg,
    longitude_deg: [deg].
    """

    name: str
    hour_s: np.ndarray
    temperature_K: np.ndarray
    vapour_kg_m3: np.ndarray
    step_s: np.ndarray
    power_W: np.ndarray
    power_known: np.ndarray
    outdoor_K: np.ndarray | None
    latitude_deg: float
    longitude_deg: float


def kelmarsh(folder: Path, start: str, days: float, seed: int) -> Site:
    """Turbine 2 at Kelmarsh from `start` (UTC) over `days`.

    The power has the measured hourly means and a made-up course within the hour (`seed`).
    """
    found = _kelmarsh(folder)
    hours = _window(found, start, days, KELMARSH)
    random = np.random.default_rng(np.random.SeedSequence([seed, 20]))
    power_kW, known = ten_minute_power(random, hours["P_K2_kW"].to_numpy())
    kelvin, dew = hours["T2m_C"].to_numpy() + FREEZING_K, hours["Td2m_C"].to_numpy() + FREEZING_K
    hour_s = _seconds(hours.index)
    return Site(
        "Kelmarsh, UK",
        hour_s,
        kelvin,
        absolute_humidity_from_dew_point(np.minimum(dew, kelvin), kelvin),
        _steps(hour_s),
        1e3 * power_kW,
        known,
        None,
        52.4,
        -0.95,
    )


def la_haute_borne(folder: Path, start: str, days: float) -> Site:
    """Turbine R80736 at La Haute Borne from `start` (UTC) over `days`.

    The files have no humidity there: ERA5's dew-point depression at Kelmarsh, at the same hour of the same
    date four years later, is put on the French temperature.
    """
    weather, turbine, english = _french_weather(folder), _french_turbine(folder), _kelmarsh(folder)
    hours = _window(weather, start, days, FRENCH_WEATHER)
    hour_s = _seconds(hours.index)
    kelvin = hours["t_2m"].to_numpy()
    depression = english["T2m_C"] - english["Td2m_C"]
    lent = np.interp(hour_s + FOUR_YEARS_S, _seconds(english.index), np.maximum(depression.to_numpy(), 0.0))
    grid = _steps(hour_s)
    place = np.searchsorted(_seconds(turbine.index), grid)
    place = np.minimum(place, len(turbine) - 1)
    there = _seconds(turbine.index)[place] == grid
    power = np.where(there, turbine["P_avg"].to_numpy()[place], np.nan)
    outdoor = np.where(there, turbine["Ot_avg"].to_numpy()[place], np.nan)
    known = np.isfinite(power)
    return Site(
        "La Haute Borne, France",
        hour_s,
        kelvin,
        absolute_humidity_from_dew_point(kelvin - lent, kelvin),
        grid,
        1e3 * _bridged(grid, power),
        known,
        _bridged(grid, outdoor) + FREEZING_K,
        48.45,
        5.6,
    )


def nacelle_deviation(folder: Path) -> dict[str, float]:
    """How the outdoor sensor of the French nacelle differs from ERA5: n, mean, course of the day, the rest
    and its time.

    `sd_K` is what is left without the running mean of 30 days and the mean course of the day; `time_h` the
    lag at which its autocorrelation has fallen to 1/e.
    """
    weather, turbine = _french_weather(folder), _french_turbine(folder)
    # a mean over ten minutes belongs to the middle of them; a sensor that repeats itself to the last digit is
    # stuck
    reading = turbine["Ot_avg"]
    reading = reading.where((reading.diff() != 0) | (reading.diff(-1) != 0))
    air = (
        np.interp(_seconds(turbine.index) + 0.5 * STEP_S, _seconds(weather.index), weather["t_2m"])
        - FREEZING_K
    )
    apart = pd.Series(reading - air, turbine.index)
    apart = apart.where(apart.abs() < 8.0).resample("10min").mean()
    daily = apart.groupby(apart.index.hour).transform("mean") - apart.mean()
    rest = apart - apart.rolling("30D", center=True).mean() - daily
    return {
        "n": int(apart.notna().sum()),
        "mean_K": float(apart.mean()),
        "day_K": float(daily.max() - daily.min()),
        "sd_K": float(rest.std()),
        "time_h": _decay(rest.to_numpy()) / 6.0,
    }


def eave_deviations(folder: Path) -> list[dict[str, float]]:
    """How loggers outside three Finnish houses differ from the weather station in absolute humidity
    (relative, ln)."""
    rows = []
    for name, side in EAVES.items():
        table = pd.read_csv(folder / name, index_col=0, parse_dates=[0])
        humidity = [
            absolute_humidity(
                0.01 * table[f"RH_{place}"].to_numpy(), table[f"T_{place}"].to_numpy() + FREEZING_K
            )
            for place in ("fmi", f"roof{side}_outside")
        ]
        with np.errstate(all="ignore"):
            apart = np.log(humidity[1] / humidity[0])
        apart = (
            pd.Series(np.where(np.abs(apart) < 1.5, apart, np.nan), table.index)
            .resample("h")
            .mean()
            .to_numpy()
        )
        rows.append(
            {
                "house": name.split("_")[2],
                "n": int(np.isfinite(apart).sum()),
                "mean": float(np.nanmean(apart)),
                "sd": float(np.nanstd(apart)),
                "time_h": _decay(apart),
            }
        )
    return rows


# -- files ---------------------------------------------------------------------------------------------------
def expect_files(folder: Path) -> None:
    """All files of the experiments are there; raises Absent that names those that are not."""
    missing = [
        name for name in (KELMARSH, FRENCH_POWER, FRENCH_WEATHER, *EAVES) if not (folder / name).is_file()
    ]
    if missing:
        raise Absent(f"{folder}: expected the measured drivers, found no {', '.join(missing)}")


def _kelmarsh(folder: Path) -> pd.DataFrame:
    table = pd.read_csv(folder / KELMARSH, index_col="datetime_start_utc", parse_dates=["datetime_start_utc"])
    utc = table if table.index.tz is None else table.tz_convert("UTC")
    return utc.tz_localize(None)


def _french_weather(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / FRENCH_WEATHER, index_col="datetime", parse_dates=["datetime"])


def _french_turbine(folder: Path) -> pd.DataFrame:
    """The turbine's table on its own clock, which is UTC whatever offset the stamps carry."""
    table = pd.read_csv(folder / FRENCH_POWER)
    table.index = pd.to_datetime(table["Date_time"].str[:19])
    return table[~table.index.duplicated()].sort_index()


def _window(table: pd.DataFrame, start: str, days: float, name: str) -> pd.DataFrame:
    """The hours from `start` to the hour at which `days` end."""
    first = pd.Timestamp(start)
    last = first + pd.Timedelta(days=days)
    if table.index[0] > first or table.index[-1] < last:
        raise ValueError(
            f"{name}: expected hours from {first:%Y-%m-%d} to {last:%Y-%m-%d}, found "
            f"{table.index[0]:%Y-%m-%d} to {table.index[-1]:%Y-%m-%d}; ask for fewer days"
        )
    return table.loc[first:last]


def _seconds(index: pd.DatetimeIndex) -> np.ndarray:
    return index.to_numpy().astype("datetime64[s]").astype(float)


def _steps(hour_s: np.ndarray) -> np.ndarray:
    """Starts [s] of the ten-minute intervals of all hours."""
    return (hour_s[:, None] + STEP_S * np.arange(6)).ravel()


def _bridged(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    there = np.isfinite(value)
    return np.interp(time, time[there], value[there])


def _decay(value: np.ndarray) -> float:
    """Lag [steps] at which the autocorrelation of a series with gaps has fallen to 1/e, between lags by a
    straight line."""
    value = value - np.nanmean(value)
    before, variance = 1.0, float(np.nanmean(value**2))
    for lag in range(1, len(value) // 2):
        now = float(np.nanmean(value[lag:] * value[:-lag])) / variance
        if now < 1.0 / np.e:
            return lag - 1 + (before - 1.0 / np.e) / (before - now)
        before = now
    return float(len(value) // 2)
