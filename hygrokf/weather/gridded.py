"""Fields at one point of an xarray data set, in either layout of the reanalysis.

New layout (since September 2024): time axis `valid_time`, `number` and `expver` as coordinates that need no
dimension. Legacy layout: `time` in hours since 1900, and where a request reaches into the last months a
dimension `expver` whose two halves, final and preliminary, are NaN where the other has values.
"""

from __future__ import annotations

import io
import math
import warnings as python_warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Site
from hygrokf.weather.archive import MOST_BYTES
from hygrokf.weather.site_weather import GRAVITY, SiteWeather, Variable, WeatherField, place_text, short_name

if TYPE_CHECKING:
    import xarray

_TIMES = ("valid_time", "time", "datetime", "date")
_AXES_OF_PLACE = (("latitude", "lat"), ("longitude", "lon"))
_PRELIMINARY = ("5", "0005")


GROUND = Variable(
    "ambient_pressure", "m2 s-2", part=True, names=("geopotential", "geopotential_at_surface", "PHIS")
)
"""The geopotential of the ground, by which its height is known."""


def point_site(latitude_deg: float, longitude_deg: float, altitude_m: float | None = None) -> Site:
    """A point of a file as a site.  Raises TableFault where it is impossible."""
    try:
        return Site(latitude_deg, (longitude_deg + 180.0) % 360.0 - 180.0, altitude_m)
    except ValueError as outside:
        raise TableFault(f"the file's point is impossible: {outside}") from None


def open_dataset(data: bytes, kind: str) -> xarray.Dataset:
    """The data set in the bytes of a NetCDF file, all of it read, scale and offset undone.

    data: all bytes. kind: "netcdf4" or "netcdf3". Raises TableFault where it cannot be read, with the remedy.
    """
    engine = {"netcdf4": "h5netcdf", "netcdf3": "scipy"}[kind]
    try:
        import xarray

        with python_warnings.catch_warnings():
            # deprecations inside the library do not concern the user of a weather file
            python_warnings.simplefilter("ignore")
            with xarray.open_dataset(io.BytesIO(data), engine=engine, decode_timedelta=False) as opened:
                # a file of a few kB may declare an array of any size
                if opened.nbytes > MOST_BYTES * 2:
                    raise TableFault(
                        f"holds {opened.nbytes / 2**30:.1f} GiB of fields, expected no more than "
                        f"{MOST_BYTES * 2 / 2**30:g}: request a smaller area, or one file per year"
                    )
                return opened.load()
    except TableFault:
        raise
    except ImportError:
        raise TableFault('reading NetCDF needs the extra "weather": pip install "hygrokf[weather]"') from None
    except MemoryError:
        raise TableFault("does not fit into memory: request a smaller area, or one file per year") from None
    except Exception as broken:  # each layer of the library has its own errors for a damaged file
        reason = " ".join(str(broken).split())[:160] or type(broken).__name__
        raise TableFault(
            f"cannot be read as NetCDF ({reason}): the file is damaged or cut short; fetch it again"
        ) from None


def point_weather(
    dataset: xarray.Dataset, file: str, variables: Mapping[str, Variable], site: Site | None = None,
    shift_s: float = 0.0,
) -> SiteWeather:  # fmt: skip
    """Fields of a data set at the site.

    dataset: with a time axis (`valid_time` or `time`, decoded) and latitude and longitude as scalars or axes;
        other axes must have one entry, except `expver`, whose halves are merged. Names short (t2m) or long
        (2m_temperature).
    file: name for messages. variables: of the format. shift_s: [s] from a stamp to the time of its value.
    site: the nearest grid cell with data is used; may be None for a single cell.

    Raises TableFault: no time, a time that is not decoded, a grid without a site, a site outside of the grid,
    ensemble members, levels.
    """
    time_name = _time_name(dataset)
    used = {str(name): short for name in dataset.data_vars if (short := short_name(variables, str(name)))}
    if not used:
        listed = ", ".join(str(name) for name in dataset.data_vars) or "no field"
        raise TableFault(f"no field of weather that is known here; found {listed}")
    dataset = dataset[list(used)]
    latitude, longitude = (
        next((name for name in names if name in dataset.variables), None) for names in _AXES_OF_PLACE
    )
    if time_name not in dataset.dims and dataset[time_name].ndim == 0:
        dataset = dataset.expand_dims(time_name)
    dataset, preliminary = _merged_versions(dataset, time_name)
    dataset = _without_single_axes(dataset, {time_name, latitude, longitude})
    warnings = []
    if preliminary:
        warnings.append(
            f"{preliminary} hours are preliminary (ERA5T): ask again in three months for the final ones"
        )
    at: tuple[float, float] | None = None
    if latitude is not None and longitude is not None:
        dataset, at = _nearest(dataset, latitude, longitude, site, used)
    stamps = _stamps(dataset, time_name)
    fields, altitude_m = {}, None
    for name, short in used.items():
        one = dataset[name]
        unit = one.attrs.get("units")
        if short == "z":
            altitude_m = _altitude(one.values, unit)
        elif one.dims == (time_name,):
            fields[short] = WeatherField(one.values.astype(float), name, None if unit is None else str(unit))
    return SiteWeather(
        file, stamps, fields, variables,
        site=None if at is None else point_site(*at, altitude_m), near=site, shift_s=shift_s,
        warnings=warnings,
    )  # fmt: skip


def _altitude(value: np.ndarray, unit: str | None) -> float | None:
    """Height of the reanalysis' ground [m] from its geopotential, or None."""
    finite = np.asarray(value, dtype=float).ravel()
    finite = finite[np.isfinite(finite)]
    known = {None: 1 / GRAVITY, "m**2 s**-2": 1 / GRAVITY, "m2 s-2": 1 / GRAVITY, "m": 1.0}
    height = known.get(unit, math.nan) * float(np.median(finite)) if len(finite) else math.nan
    return height if -500.0 <= height <= 9000.0 else None


def _time_name(dataset: xarray.Dataset) -> str:
    """The axis of time. Raises TableFault where there is none, or where its units are missing."""
    there = [name for name in _TIMES if name in dataset.variables]
    if not there:
        listed = ", ".join(f"{name} ({size})" for name, size in dataset.sizes.items()) or "none"
        raise TableFault(f"no time axis: expected valid_time or time, found the axes {listed}")
    for name in there:
        if dataset[name].dims in ((name,), ()):
            if np.issubdtype(dataset[name].dtype, np.datetime64):
                return name
            found = dataset[name].attrs.get("units", "no unit")
            raise TableFault(
                f'{name}: expected times such as "hours since 1900-01-01", found {found} and no calendar time'
            )
    raise TableFault(
        f"{there[0]} has the axes {', '.join(map(str, dataset[there[0]].dims))}; expected one axis of "
        "time: ask for NetCDF, not for a converted forecast with steps"
    )


def _stamps(dataset: xarray.Dataset, time_name: str) -> np.ndarray:
    """Times [s] (T,) of the fields; for a forecast `valid_time` = `time` + `step`."""
    at = dataset[time_name]
    if "valid_time" in dataset.variables and dataset["valid_time"].dims == at.dims:
        at = dataset["valid_time"]
    values = np.atleast_1d(at.values).astype("datetime64[us]")
    lost = int(np.isnat(values).sum())
    if lost:
        raise TableFault(f"{at.name}: {lost} of {len(values)} stamps are missing; fetch the file again")
    return values.astype(np.int64) / 1e6


def _merged_versions(dataset: xarray.Dataset, time_name: str) -> tuple[xarray.Dataset, int]:
    """The data set without the axis `expver`, and the number of preliminary hours."""
    if "expver" not in dataset.variables and "expver" not in dataset.dims:
        return dataset, 0
    if "expver" not in dataset.dims:
        version = dataset["expver"]
        many = version.dims == (time_name,)
        number = sum(_label(one) in _PRELIMINARY for one in np.atleast_1d(version.values)) if many else 0
        return dataset.drop_vars("expver"), int(number)
    labels = (
        [_label(one) for one in dataset["expver"].values]
        if "expver" in dataset.variables
        else [str(number) for number in range(dataset.sizes["expver"])]
    )
    # the final version first; the preliminary one fills its gaps
    order = sorted(range(len(labels)), key=lambda place: (labels[place] in _PRELIMINARY, labels[place]))
    parts = [dataset.isel(expver=place, drop=True) for place in order]
    merged = parts[0]
    for part in parts[1:]:
        merged = merged.fillna(part)
    name = next(iter(merged.data_vars))
    filled = merged[name].notnull() & parts[0][name].isnull()
    others = [one for one in filled.dims if one != time_name]
    return merged, int(filled.any(others).sum())


def _label(version: object) -> str:
    """A version as text: "0005", also where the file has it as bytes."""
    return (version.decode("ascii", "replace") if isinstance(version, bytes) else str(version)).strip()


def _without_single_axes(dataset: xarray.Dataset, kept: set[str | None]) -> xarray.Dataset:
    """The data set without further axes of one entry. Raises TableFault for axes of several."""
    faults = []
    for name in [one for one in dataset.dims if one not in kept]:
        size = dataset.sizes[name]
        if size == 1:
            dataset = dataset.isel({name: 0}, drop=True)
        elif name == "number":
            faults.append(
                f'holds {size} members of an ensemble; ask for product_type "reanalysis", or choose one '
                "member"
            )
        else:
            faults.append(
                f"has an axis {name} with {size} entries; expected time, latitude and longitude only"
            )
    if faults:
        raise TableFault(*faults)
    return dataset


def _nearest(
    dataset: xarray.Dataset, latitude: str, longitude: str, site: Site | None, used: dict[str, str]
) -> tuple[xarray.Dataset, tuple[float, float]]:
    """The data set at the nearest cell with a temperature, and its latitude and longitude [deg]."""
    rows, columns = (np.atleast_1d(dataset[name].values.astype(float)) for name in (latitude, longitude))
    gridded = [name for name in (latitude, longitude) if name in dataset.dims]
    for name in (latitude, longitude):
        if dataset[name].dims not in ((), (name,)):
            raise TableFault(f"{name} has the axes {', '.join(map(str, dataset[name].dims))}; expected one")
    if len(rows) * len(columns) > 1 and site is None:
        raise TableFault(
            f"holds a grid of {len(rows)} × {len(columns)} cells and no site is given: name a case "
            "file with [site] latitude_deg and longitude_deg and this file as its source"
        )
    row, column = 0, 0
    if site is not None and gridded:
        east = (columns - site.longitude_deg + 180.0) % 360.0 - 180.0
        north = rows - site.latitude_deg
        outside = []
        for name, off, values in ((latitude, north, rows), (longitude, east, columns)):
            step = float(np.median(np.abs(np.diff(values)))) if len(values) > 1 else math.inf
            if len(values) > 1 and np.abs(off).min() > 0.75 * step:
                outside.append(f"{name} {values.min():g} … {values.max():g}")
        if outside:
            raise TableFault(
                f"the site at {place_text(site.latitude_deg, site.longitude_deg)} lies outside of "
                f"the grid ({', '.join(outside)}): ask for an area around it, or correct [site]"
            )
        narrowing = math.cos(math.radians(site.latitude_deg))
        away = np.hypot(north[:, None], narrowing * east[None, :])
        filled = _filled(dataset, latitude, longitude, used, away.shape)
        nearest = np.unravel_index(int(np.argmin(np.where(filled, away, np.inf))), away.shape)
        row, column = (int(place) for place in nearest)
    chosen = {
        name: int(place) for name, place in ((latitude, row), (longitude, column)) if name in dataset.dims
    }
    return dataset.isel(chosen), (float(rows[row]), float(columns[column]))


def _filled(
    dataset: xarray.Dataset, latitude: str, longitude: str, used: dict[str, str], shape: tuple[int, int]
) -> np.ndarray:
    """Cells (rows, columns) that have a temperature: land reanalyses have none over the sea."""
    name = next((name for name, short in used.items() if short in ("t2m", "T2M")), None)
    if name is None or not {latitude, longitude} <= set(dataset[name].dims):
        return np.ones(shape, dtype=bool)
    there = (
        dataset[name].notnull().any([one for one in dataset[name].dims if one not in (latitude, longitude)])
    )
    filled = there.transpose(latitude, longitude).values
    return filled if filled.any() else np.ones(shape, dtype=bool)
