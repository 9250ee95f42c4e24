"""Weather files in the published layouts, with known values, and pairs of simulated weather series."""

from __future__ import annotations

import tempfile
import zipfile
from functools import cache
from pathlib import Path

import numpy as np

from hygrokf.data.record import Series
from hygrokf.physics.psychrometrics import saturation_pressure_water

START = np.datetime64("2021-03-01T00:00:00", "s")
HOURS = 96
LATITUDES = np.array([48.75, 48.5, 48.25])
LONGITUDES = np.array([5.25, 5.5, 5.75])
UNITS = {
    "t2m": "K", "d2m": "K", "sp": "Pa", "u10": "m s**-1", "v10": "m s**-1", "u100": "m s**-1",
    "v100": "m s**-1",
    "ssrd": "J m**-2", "fdir": "J m**-2", "tp": "m", "tcc": "(0 - 1)", "z": "m**2 s**-2",
}  # fmt: skip


def relative_humidity(dew_point: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Relative humidity over water [-] from dew point [K] and temperature [K]."""
    return saturation_pressure_water(dew_point) / saturation_pressure_water(temperature)


def stamps(hours: int = HOURS, start: np.datetime64 = START) -> np.ndarray:
    """Whole hours (T,) as datetime64[s]."""
    return start + 3600 * np.arange(hours)


def seconds(hours: int = HOURS, start: np.datetime64 = START) -> np.ndarray:
    return stamps(hours, start).astype(np.int64).astype(float)


def truth(name: str, hours: int = HOURS, row: int = 1, column: int = 1) -> np.ndarray:
    """Values (T,) of a field at a cell, in the file's own unit; cells differ so that a wrong one is seen."""
    hour = np.arange(hours, dtype=float)
    place = 1.0 * row + 0.1 * column
    sun = np.fmax(0.0, np.sin(np.pi * (np.mod(hour, 24) - 6.5) / 12.0))
    return {
        "t2m": 280.0 + 4.0 * np.sin(2 * np.pi * (hour - 9) / 24) + place,
        "d2m": 273.0 + np.sin(hour / 11.0) + place,
        "sp": 97000.0 + 300.0 * np.sin(hour / 30.0) + 100.0 * place,
        "u10": 3.0 + np.sin(hour / 7.0), "v10": -2.0 + np.cos(hour / 5.0),
        "u100": 6.0 + np.sin(hour / 7.0), "v100": -4.0 + np.cos(hour / 5.0),
        "ssrd": 3600.0 * 700.0 * sun, "fdir": 3600.0 * 450.0 * sun,
        "tp": np.where(np.mod(hour, 17) < 3, 4e-4, 0.0),
        "tcc": 0.5 + 0.4 * np.sin(hour / 9.0),
        "z": np.full(hours, 9.80665 * (300.0 + 10.0 * place)),
    }[name]  # fmt: skip


def grid(name: str, hours: int = HOURS) -> np.ndarray:
    """(T, 3, 3)."""
    cells = [[truth(name, hours, row, column) for column in range(3)] for row in range(3)]
    return np.moveaxis(np.array(cells), -1, 0)


def new_dataset(
    names: tuple[str, ...], hours: int = HOURS, preliminary: int = 0, start: np.datetime64 = START
):
    """The layout since September 2024: valid_time, number a scalar, expver a text for each hour."""
    import xarray

    version = np.array(["0001"] * (hours - preliminary) + ["0005"] * preliminary)
    return xarray.Dataset(
        {
            name: (
                ("valid_time", "latitude", "longitude"),
                grid(name, hours).astype(np.float32),
                {"units": UNITS[name], "GRIB_shortName": name, "GRIB_missingValue": 3.4028234663852886e38},
            )
            for name in names
        },
        coords={
            "number": ((), 0, {"units": "1", "standard_name": "realization"}),
            "valid_time": (
                "valid_time",
                stamps(hours, start).astype("datetime64[ns]"),
                {"standard_name": "time"},
            ),
            "latitude": ("latitude", LATITUDES, {"units": "degrees_north", "stored_direction": "decreasing"}),
            "longitude": ("longitude", LONGITUDES, {"units": "degrees_east"}),
            "expver": ("valid_time", version),
        },
        attrs={"Conventions": "CF-1.7", "institution": "European Centre for Medium-Range Weather Forecasts"},
    )


def netcdf4(dataset) -> bytes:
    encoding = {
        name: {"zlib": True, "complevel": 1, "_FillValue": np.float32(np.nan)} for name in dataset.data_vars
    }
    if "valid_time" in dataset.coords and np.issubdtype(dataset["valid_time"].dtype, np.datetime64):
        encoding["valid_time"] = {
            "dtype": "int64",
            "units": "seconds since 1970-01-01",
            "calendar": "proleptic_gregorian",
        }
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "made.nc"
        dataset.to_netcdf(path, engine="h5netcdf", encoding=encoding)
        return path.read_bytes()


def new_file(path: Path, names: tuple[str, ...] = ("t2m", "d2m", "sp"), **more) -> Path:
    path.write_bytes(netcdf4(new_dataset(names, **more)))
    return path


def zipped(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


@cache
def _stream(names: tuple[str, ...], hours: int) -> bytes:
    return netcdf4(new_dataset(names, hours))


def streams(path: Path, hours: int = HOURS) -> Path:
    """What a request of instantaneous and accumulated fields brings, even when it is named .nc."""
    names = ("t2m", "d2m", "sp", "u10", "v10", "u100", "v100", "tcc")
    members = {
        "data_stream-oper_stepType-instant.nc": _stream(names, hours),
        "data_stream-oper_stepType-accum.nc": _stream(("ssrd", "fdir", "tp"), hours),
    }
    return zipped(path, members, zipfile.ZIP_STORED)


def legacy_file(
    path: Path, names: tuple[str, ...] = ("t2m", "d2m", "sp"), preliminary: int | None = 24
) -> Path:
    """The layout before: NetCDF-3, hours since 1900, packed in two bytes, expver 1 and 5 where it reaches the
    last months."""
    from scipy.io import netcdf_file

    since_1900 = ((stamps() - np.datetime64("1900-01-01T00:00:00", "s")).astype(np.int64) // 3600).astype(
        np.int32
    )
    with netcdf_file(str(path), "w", version=2) as file:
        for name, size in (("longitude", 3), ("latitude", 3), ("time", HOURS)):
            file.createDimension(name, size)
        dimensions = ("time", "latitude", "longitude")
        if preliminary is not None:
            file.createDimension("expver", 2)
            dimensions = ("time", "expver", "latitude", "longitude")
            version = file.createVariable("expver", "i4", ("expver",))
            version[:] = [1, 5]
        for name, value, unit, kind in (
            ("longitude", LONGITUDES, "degrees_east", "f4"),
            ("latitude", LATITUDES, "degrees_north", "f4"),
            ("time", since_1900, "hours since 1900-01-01 00:00:00.0", "i4"),
        ):
            axis = file.createVariable(name, kind, (name,))
            axis[:] = value
            axis.units = unit
            if name == "time":
                axis.calendar = "gregorian"
        for name in names:
            value = grid(name)
            low, high = value.min(), value.max()
            scale = (high - low) / 65532.0
            offset = low + 32766.0 * scale
            packed = np.round((value - offset) / scale).astype(np.int16)
            variable = file.createVariable(name, "i2", dimensions)
            if preliminary is None:
                variable[:] = packed
            else:
                halves = np.full((HOURS, 2, 3, 3), -32767, dtype=np.int16)
                halves[: HOURS - preliminary, 0] = packed[: HOURS - preliminary]
                halves[HOURS - preliminary :, 1] = packed[HOURS - preliminary :]
                variable[:] = halves
            variable.scale_factor, variable.add_offset = float(scale), float(offset)
            variable._FillValue = variable.missing_value = np.int16(-32767)
            variable.units = UNITS[name]
    return path


def point_csv(
    names: tuple[str, ...] = ("t2m", "d2m", "sp", "u10", "v10", "ssrd", "tp"), hours: int = HOURS
) -> bytes:
    """The point product's CSV."""
    lines = [",".join(["valid_time", *names, "latitude", "longitude"])]
    columns = [truth(name, hours) for name in names]
    for place, stamp in enumerate(stamps(hours)):
        cells = [
            f"{column[place]:.6f}" if column[place] < 1e3 else f"{column[place]:.3f}" for column in columns
        ]
        lines.append(",".join([str(stamp).replace("T", " "), *cells, "48.5", "5.5"]))
    return ("\n".join(lines) + "\n").encode()


@cache
def epw_text(
    years: tuple[int, ...] = (2010,) * 12, zone: float = 1.0, altitude: float = 250.0, days: int = 365
) -> str:
    """An EPW file: temperature tells hour of the year and the code for missing stands in known places."""
    head = [
        f"LOCATION,Somewhere,-,FRA,test,000000,48.500,5.500,{zone},{altitude}",
        "DESIGN CONDITIONS,0", "TYPICAL/EXTREME PERIODS,0", "GROUND TEMPERATURES,0",
        "HOLIDAYS/DAYLIGHT SAVINGS,No,0,0,0",
        "COMMENTS 1,made", "COMMENTS 2,made", "DATA PERIODS,1,1,Data,Sunday,1/ 1,12/31",
    ]  # fmt: skip
    body = []
    for day in range(days):
        date = np.datetime64("2011-01-01") + day
        month, number = int(str(date)[5:7]), int(str(date)[8:])
        for hour in range(1, 25):
            place = 24 * day + hour - 1
            row = ["0"] * 35
            row[:6] = [str(years[month - 1]), str(month), str(number), str(hour), "60", "?9?9"]
            row[6] = "99.9" if place == 100 else f"{10.0 + 5.0 * np.sin(2 * np.pi * place / 24):.1f}"
            row[7] = "99.9" if place in (200, 201) else f"{4.0 + np.sin(place / 50):.1f}"
            row[8] = "999" if place == 201 else "60"
            row[9] = "999999" if place == 300 else "98500"
            row[13] = "9999" if place == 400 else f"{500 if 9 <= hour <= 16 else 0}"
            row[14], row[15] = "9999", "9999"
            row[20], row[21], row[22] = "270", "5.5", "7"
            row[33] = "999" if place % 2 else "0.4"
            body.append(",".join(row))
    return "\n".join([*head, *body]) + "\n"


def _relaxed(random: np.random.Generator, number: int, hours: float, step_s: float) -> np.ndarray:
    """A stationary Ornstein–Uhlenbeck course of variance 1."""
    from scipy.signal import lfilter

    keep = np.exp(-step_s / (3600.0 * hours))
    return lfilter([np.sqrt(1 - keep**2)], [1, -keep], random.normal(size=number + 4000))[4000:]


def weather_pair(
    seed: int,
    days: float,
    late_s: float = 0.0,
    summer_s: float = 0.0,
    sun: float = 0.3,
    housing_s: float = 0.0,
    summer=lambda time: np.zeros(len(time), dtype=bool),
    start_s: float = 1388534400.0,
) -> tuple[Series, Series]:
    """Outdoor temperature as a station logs it every 10 min and as a reanalysis has it every hour.

    late_s: [s] by which the station's stamps are late, and summer_s: further in summer time. sun: share of
    the daily wave that the sun adds to the station's housing, two hours late. housing_s: [s] its time
    constant.
    """
    from scipy.signal import lfilter

    random = np.random.default_rng(seed)
    step = 300.0
    time = start_s + step * np.arange(int(days * 86400 / step))
    number = len(time)
    season = -np.cos(2 * np.pi * (np.mod(time / 86400, 365.25) - 15) / 365.25)
    size = (3.0 + 1.5 * season) * np.exp(0.4 * _relaxed(random, number, 36, step))
    wave = np.cos(2 * np.pi * (time / 86400 - 15 / 24))
    fronts = 4.0 * _relaxed(random, number, 60, step) + 1.2 * _relaxed(random, number, 8, step)
    outside = 284.0 + 8.0 * season + fronts + 0.7 * _relaxed(random, number, 2, step) + size * wave
    keep = np.exp(-step / housing_s) if housing_s else 0.0
    station = outside[0] + lfilter([1 - keep], [1, -keep], outside - outside[0])
    station = station + sun * size * np.fmax(0.0, np.cos(2 * np.pi * (time / 86400 - 17 / 24)))
    station += 0.5 * _relaxed(random, number, 1.5, step) + 0.8 * _relaxed(random, number, 12, step)
    cell = np.convolve(np.pad(outside, 6, mode="edge"), np.full(13, 1 / 13), "valid") - 0.15 * size * wave
    cell += 0.6 * _relaxed(random, number, 6, step) + 0.9 * _relaxed(random, number, 30, step)
    shown, hourly = np.mod(time, 600) == 0, np.mod(time, 3600) == 0
    stamp = time[shown] + late_s + summer_s * summer(time[shown])
    value = np.round(station[shown] + random.normal(0, 0.1, shown.sum()), 1)
    order = np.argsort(stamp, kind="stable")
    stamp, value = stamp[order], value[order]
    fresh = np.append(True, np.diff(stamp) > 0)
    return (
        Series("ambient_temperature", stamp[fresh], value[fresh], source='scada.csv, column "T"'),
        Series("ambient_temperature", time[hourly], cell[hourly], source='era5.nc, column "t2m"'),
    )
