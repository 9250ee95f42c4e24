"""Files of Open-Meteo, MERRA-2 and TRY in their published layouts, with known values."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from builders.moist_air import humidity_ratio
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K, vapour_pressure

OPEN_METEO = {
    # name: unit, and values over the hour of the file
    "temperature_2m": ("°C", lambda hour: np.round(8.0 + 4.0 * np.sin(2 * np.pi * (hour - 9) / 24), 1)),
    "relative_humidity_2m": ("%", lambda hour: np.round(75.0 + 10.0 * np.cos(hour / 7.0))),
    "dew_point_2m": ("°C", lambda hour: np.round(3.0 + np.sin(hour / 11.0), 1)),
    "surface_pressure": ("hPa", lambda hour: np.round(985.0 + 5.0 * np.sin(hour / 30.0), 1)),
    "wind_speed_10m": ("km/h", lambda hour: np.round(18.0 + 3.6 * np.sin(hour / 5.0), 1)),
    "wind_speed_100m": ("km/h", lambda hour: np.round(36.0 + 3.6 * np.sin(hour / 5.0), 1)),
    "wind_direction_100m": ("°", lambda hour: np.mod(200.0 + hour, 360.0)),
    "shortwave_radiation": (
        "W/m²", lambda hour: np.round(500.0 * np.fmax(0.0, np.sin(np.pi * (np.mod(hour, 24) - 6) / 12))),
    ),
    "precipitation": ("mm", lambda hour: np.where(np.mod(hour, 17) < 3, 0.4, 0.0)),
    "cloud_cover": ("%", lambda hour: np.mod(7.0 * hour, 101.0)),
    "weather_code": ("wmo code", lambda hour: np.zeros(len(hour))),
}  # fmt: skip


def open_meteo(
    names: tuple[str, ...] = tuple(OPEN_METEO),
    hours: int = 96,
    start: str = "2021-03-01T00:00",
    offset_s: int = 0,
    units: dict[str, str] | None = None,
) -> dict:
    """The JSON of one place; stamps are of a clock that is `offset_s` [s] ahead of UTC."""
    hour = np.arange(hours, dtype=float)
    stamps = np.datetime64(start, "m") + 60 * np.arange(hours)
    stated = {name: OPEN_METEO[name][0] for name in names} | (units or {})
    return {
        "latitude": 48.5, "longitude": 5.5, "generationtime_ms": 0.2, "utc_offset_seconds": offset_s,
        "timezone": "GMT" if offset_s == 0 else "Europe/Paris",
        "timezone_abbreviation": f"GMT{offset_s // 3600:+d}" if offset_s else "GMT",
        "elevation": 411.0,
        "hourly_units": {"time": "iso8601", **stated},
        "hourly": {
            "time": [str(one) for one in stamps],
            **{name: [float(one) for one in OPEN_METEO[name][1](hour)] for name in names},
        },
    }  # fmt: skip


def open_meteo_json(path: Path, answer: dict | list) -> Path:
    path.write_text(json.dumps(answer, ensure_ascii=False), encoding="utf-8")
    return path


def open_meteo_csv(path: Path, answer: dict) -> Path:
    """The same answer as CSV: two lines on the place, an empty one, then names with units in brackets."""
    meta = ("latitude", "longitude", "elevation", "utc_offset_seconds", "timezone", "timezone_abbreviation")
    names = [name for name in answer["hourly"] if name != "time"]
    head = ",".join(["time", *(f"{name} ({answer['hourly_units'][name]})" for name in names)])
    rows = zip(answer["hourly"]["time"], *(answer["hourly"][name] for name in names), strict=True)
    lines = [
        ",".join(meta), ",".join(str(answer[name]) for name in meta), "", head,
        *(",".join("" if cell is None else str(cell) for cell in row) for row in rows),
    ]  # fmt: skip
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


# --- MERRA-2 ---------------------------------------------------------------------------------

MERRA2 = {
    "T2M": ("K", lambda hour, place: 280.0 + 4.0 * np.sin(2 * np.pi * (hour - 9) / 24) + place),
    "T10M": ("K", lambda hour, place: 279.0 + 4.0 * np.sin(2 * np.pi * (hour - 9) / 24) + place),
    "QV2M": ("kg kg-1", lambda hour, place: 0.004 + 0.0005 * np.sin(hour / 11.0) + 0.0001 * place),
    "PS": ("Pa", lambda hour, place: 97000.0 + 300.0 * np.sin(hour / 30.0) + 100.0 * place),
    "U10M": ("m s-1", lambda hour, place: 3.0 + np.sin(hour / 7.0)),
    "V10M": ("m s-1", lambda hour, place: -2.0 + np.cos(hour / 5.0)),
    "U50M": ("m s-1", lambda hour, place: 5.0 + np.sin(hour / 7.0)),
    "V50M": ("m s-1", lambda hour, place: -4.0 + np.cos(hour / 5.0)),
    "SLP": ("Pa", lambda hour, place: np.full(len(hour), 101300.0)),
}
MERRA2_LATITUDES, MERRA2_LONGITUDES = np.array([48.0, 48.5, 49.0]), np.array([5.0, 5.625, 6.25])


def merra2_truth(name: str, day: int = 0, days: int = 1, row: int = 1, column: int = 1) -> np.ndarray:
    """Values (T,) of a field at a cell on some days from the first one on; cells differ."""
    return MERRA2[name][1](24.0 * day + np.arange(24.0 * days), 1.0 * row + 0.1 * column)


def merra2_file(
    folder: Path, day: int = 0, names: tuple[str, ...] = tuple(MERRA2), first_minute: int = 30, name: str = ""
) -> Path:
    """One day as delivered: minutes since 00:30, latitude from the south, 1e15 for what is missing."""
    import xarray

    date = np.datetime64("2021-03-01") + day
    cells = {
        name: np.array(
            [[merra2_truth(name, day, 1, row, column) for column in range(3)] for row in range(3)]
        ).transpose(2, 0, 1)
        for name in names
    }
    dataset = xarray.Dataset(
        {
            name: (("time", "lat", "lon"), value.astype(np.float32), {"units": MERRA2[name][0]})
            for name, value in cells.items()
        },
        coords={
            "time": ("time", 60 * np.arange(24), {"units": f"minutes since {date} 00:{first_minute:02d}:00"}),
            "lat": ("lat", MERRA2_LATITUDES, {"units": "degrees_north"}),
            "lon": ("lon", MERRA2_LONGITUDES, {"units": "degrees_east"}),
        },
    )
    path = folder / (name or f"MERRA2_400.tavg1_2d_slv_Nx.{str(date).replace('-', '')}.nc4")
    fill = {name: {"_FillValue": np.float32(1e15)} for name in names}
    dataset.to_netcdf(path, engine="h5netcdf", encoding=fill)
    return path


# --- TRY -------------------------------------------------------------------------------------


def try_columns() -> dict[str, np.ndarray]:
    """Columns of a test reference year, consistent in temperature, pressure and humidity."""
    hour = np.arange(8760.0)
    warm = np.round(9.0 - 10.0 * np.cos(2 * np.pi * hour / 8760) - 4.0 * np.cos(2 * np.pi * hour / 24), 1)
    share = np.round(80.0 + 12.0 * np.cos(2 * np.pi * hour / 24))
    pressure = np.round(985.0 + 8.0 * np.sin(hour / 50.0))
    vapour = vapour_pressure(0.01 * share, warm + ZERO_CELSIUS_K)
    sun = np.round(400.0 * np.fmax(0.0, np.sin(np.pi * (np.mod(hour, 24) - 6) / 12)))
    date = np.datetime64("2015-01-01") + (hour // 24).astype(int)
    month = date.astype("datetime64[M]").astype(int) % 12 + 1
    day = (date - date.astype("datetime64[M]")).astype(int) + 1
    return {
        "RW": np.full(8760, 4162500), "HW": np.full(8760, 2733500), "MM": month, "DD": day,
        "HH": np.mod(hour, 24).astype(int) + 1, "t": warm, "p": pressure, "WR": np.mod(hour, 361),
        "WG": np.round(3.0 + np.sin(hour / 9.0), 1), "N": np.mod(hour, 9),
        "x": np.round(1e3 * humidity_ratio(vapour, 100.0 * pressure), 1), "RF": share,
        "B": np.round(0.6 * sun), "D": sun - np.round(0.6 * sun), "A": np.full(8760, 300),
        "E": np.full(8760, -350), "IL": np.ones(8760),
    }  # fmt: skip


OF_2017 = ("RW", "HW", "MM", "DD", "HH", "t", "p", "WR", "WG", "N", "x", "RF", "B", "D", "A", "E", "IL")
OF_2011 = (
    "RG", "IS", "MM", "DD", "HH", "N", "WR", "WG", "t", "p", "x", "RF", "W", "B", "D", "IK", "A", "E", "IL",
)  # fmt: skip
_DIGITS = {"t": 1, "WG": 1, "x": 1}


def try_file(path: Path, names: tuple[str, ...] = OF_2017, columns: dict | None = None) -> Path:
    """A test reference year: the header of its edition, the names, a line of ***, and the hours."""
    columns = {name: np.ones(8760) for name in ("RG", "IS", "W", "IK")} | (columns or try_columns())
    place = (
        "Koordinatensystem : Lambert konform konisch", "Rechtswert        : 4162500 Meter",
        "Hochwert          : 2733500 Meter", "Hoehenlage        : 139 Meter ueber NN",
        "Erstellung des Datensatzes im Mai 2016", "",
    )  # fmt: skip
    head = [
        *(place if "RW" in names else ("Testreferenzjahr einer Region",)),
        "Art des TRY       : mittleres Jahr", "Bezugszeitraum    : 1995-2012", "",
        "Reihenfolge der Parameter:", "t  Lufttemperatur in 2m Höhe über Grund  [GradC]", "",
        " ".join(f"{name:>7}" for name in names), "***",
    ]  # fmt: skip
    cells = [[f"{value:.{_DIGITS.get(name, 0)}f}" for value in columns[name]] for name in names]
    body = [" ".join(row) for row in zip(*cells, strict=True)]
    path.write_bytes(("\r\n".join([*head, *body]) + "\r\n").encode("latin-1"))
    return path
