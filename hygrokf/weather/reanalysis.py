"""Read reanalyses: ERA5 of the Climate Data Store (NetCDF in either layout, ZIP, CSV of the point product),
and MERRA-2 of NASA (hourly means of tavg1_2d_slv_Nx (M2T1NXSLV) and related collections).

Layout of the Climate Data Store since September 2024: time axis `valid_time`; `number` and `expver` are
coordinates that need no dimension. Legacy layout: `time` in hours since 1900; if a request reaches into the
last months, a dimension `expver` with two entries, final and preliminary, each NaN where the other has
values.
"""

from __future__ import annotations

import io
import math
import os
import warnings as python_warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.columns import Notation, TableFault
from hygrokf.data.numbers import UNKNOWN_MEANING
from hygrokf.data.record import Record, Site
from hygrokf.data.table_readers import table_in
from hygrokf.data.timestamps import DAY_S, HOUR_S, MINUTE_S, modal_step
from hygrokf.physics.psychrometrics import dew_point, vapour_pressure_from_specific_humidity
from hygrokf.texts.wording import duration_text, stamp_text
from hygrokf.weather.archive import FORMATS_OF_KINDS, MOST_BYTES, FileContent, contents, read_each
from hygrokf.weather.joining import join_records
from hygrokf.weather.site_weather import (
    GRAVITY,
    SiteWeather,
    Variable,
    WeatherField,
    place_text,
    require_temperature,
    short_name,
    unit_in_weather,
)

if TYPE_CHECKING:
    import xarray


_TIMES = ("valid_time", "time", "datetime", "date")
_AXES_OF_PLACE = (("latitude", "lat"), ("longitude", "lon"))
_PRELIMINARY = ("5", "0005")


GROUND = Variable(
    "ambient_pressure", "m2 s-2", part=True, names=("geopotential", "geopotential_at_surface", "PHIS")
)
"""The geopotential of the ground, from which its height follows."""


# -- fields at one point -------------------------------------------------------------------------------------
def point_site(latitude_deg: float, longitude_deg: float, altitude_m: float | None = None) -> Site:
    """Return the point of a file as a site. Raises TableFault for impossible coordinates."""
    try:
        return Site(latitude_deg, (longitude_deg + 180.0) % 360.0 - 180.0, altitude_m)
    except ValueError as outside:
        raise TableFault(f"the file's point is impossible: {outside}") from None


def open_dataset(data: bytes, kind: str) -> xarray.Dataset:
    """Read the data set in the bytes of a NetCDF file, with scale and offset applied.

    data: all bytes. kind: "netcdf4" or "netcdf3". Raises TableFault, with the remedy, if it cannot be read.
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
    except Exception as fault:  # each layer of the library has its own errors for a damaged file
        reason = " ".join(str(fault).split())[:160] or type(fault).__name__
        raise TableFault(
            f"cannot be read as NetCDF ({reason}): the file is damaged or cut short; fetch it again"
        ) from None


def point_weather(
    dataset: xarray.Dataset, file: str, variables: Mapping[str, Variable], site: Site | None = None,
    shift_s: float = 0.0,
) -> SiteWeather:  # fmt: skip
    """Return the fields of a data set at the site.

    dataset: with a time axis (`valid_time` or `time`, decoded), and latitude and longitude as scalars or
        axes; other axes must have length 1, except `expver`, whose entries are merged. Names of fields are
        short (t2m) or long (2m_temperature).
    file: name for messages. variables: of the format. shift_s: [s] from a stamp to the time of its value.
    site: selects the nearest grid cell with data; None: the data set must have a single cell.

    Raises TableFault without a decoded time axis, for a grid without a site, for a site outside the grid, and
    for ensemble members or levels.
    """
    time_name = _time_name(dataset)
    short_names = {
        str(name): short_name_of_field
        for name in dataset.data_vars
        if (short_name_of_field := short_name(variables, str(name)))
    }
    if not short_names:
        names_found = ", ".join(str(name) for name in dataset.data_vars) or "no field"
        raise TableFault(f"no field of weather that is known here; found {names_found}")
    dataset = dataset[list(short_names)]
    latitude, longitude = (
        next((name for name in names if name in dataset.variables), None) for names in _AXES_OF_PLACE
    )
    if time_name not in dataset.dims and dataset[time_name].ndim == 0:
        dataset = dataset.expand_dims(time_name)
    dataset, preliminary_hours = _merge_versions(dataset, time_name)
    dataset = _drop_single_axes(dataset, {time_name, latitude, longitude})
    warnings = []
    if preliminary_hours:
        warnings.append(
            f"{preliminary_hours} hours are preliminary (ERA5T): ask again in three months for the final ones"
        )
    point: tuple[float, float] | None = None
    if latitude is not None and longitude is not None:
        dataset, point = _select_nearest_cell(dataset, latitude, longitude, site, short_names)
    stamps = _stamps(dataset, time_name)
    fields, altitude_m = {}, None
    for name, short_name_of_field in short_names.items():
        field = dataset[name]
        unit = field.attrs.get("units")
        if short_name_of_field == "z":
            altitude_m = _altitude(field.values, unit)
        elif field.dims == (time_name,):
            fields[short_name_of_field] = WeatherField(
                field.values.astype(float), name, None if unit is None else str(unit)
            )
    return SiteWeather(
        file, stamps, fields, variables,
        site=None if point is None else point_site(*point, altitude_m), near=site, shift_s=shift_s,
        warnings=warnings,
    )  # fmt: skip


def _altitude(value: np.ndarray, unit: str | None) -> float | None:
    """The height of the reanalysis' ground [m] from its geopotential; None if it is unknown or impossible."""
    finite = np.asarray(value, dtype=float).ravel()
    finite = finite[np.isfinite(finite)]
    metres_per_unit = {None: 1 / GRAVITY, "m**2 s**-2": 1 / GRAVITY, "m2 s-2": 1 / GRAVITY, "m": 1.0}
    height = metres_per_unit.get(unit, math.nan) * float(np.median(finite)) if len(finite) else math.nan
    return height if -500.0 <= height <= 9000.0 else None


def _time_name(dataset: xarray.Dataset) -> str:
    """Return the name of the time axis. Raises TableFault if there is none, or if it is not decoded."""
    time_names = [name for name in _TIMES if name in dataset.variables]
    if not time_names:
        listed = ", ".join(f"{name} ({size})" for name, size in dataset.sizes.items()) or "none"
        raise TableFault(f"no time axis: expected valid_time or time, found the axes {listed}")
    for name in time_names:
        if dataset[name].dims in ((name,), ()):
            if np.issubdtype(dataset[name].dtype, np.datetime64):
                return name
            unit = dataset[name].attrs.get("units", "no unit")
            raise TableFault(
                f'{name}: expected times such as "hours since 1900-01-01", found {unit} and no calendar time'
            )
    axes = ", ".join(map(str, dataset[time_names[0]].dims))
    raise TableFault(
        f"{time_names[0]} has the axes {axes}; expected one axis of time: "
        "ask for NetCDF, not for a converted forecast with steps"
    )


def _stamps(dataset: xarray.Dataset, time_name: str) -> np.ndarray:
    """Return the times [s since 1970] (T,) of the fields; `valid_time` is preferred, which in forecasts is
    `time` + `step`."""
    times = dataset[time_name]
    if "valid_time" in dataset.variables and dataset["valid_time"].dims == times.dims:
        times = dataset["valid_time"]
    values = np.atleast_1d(times.values).astype("datetime64[us]")
    missing = int(np.isnat(values).sum())
    if missing:
        raise TableFault(f"{times.name}: {missing} of {len(values)} stamps are missing; fetch the file again")
    return values.astype(np.int64) / 1e6


def _merge_versions(dataset: xarray.Dataset, time_name: str) -> tuple[xarray.Dataset, int]:
    """Return the data set without the axis `expver`, and the number of preliminary hours."""
    if "expver" not in dataset.variables and "expver" not in dataset.dims:
        return dataset, 0
    if "expver" not in dataset.dims:
        version = dataset["expver"]
        has_labels = version.dims == (time_name,)
        count = (
            sum(_label(label) in _PRELIMINARY for label in np.atleast_1d(version.values)) if has_labels else 0
        )
        return dataset.drop_vars("expver"), int(count)
    labels = (
        [_label(label) for label in dataset["expver"].values]
        if "expver" in dataset.variables
        else [str(number) for number in range(dataset.sizes["expver"])]
    )
    # the final version first; the preliminary one fills its gaps
    order = sorted(
        range(len(labels)),
        key=lambda version_number: (labels[version_number] in _PRELIMINARY, labels[version_number]),
    )
    versions = [dataset.isel(expver=version_number, drop=True) for version_number in order]
    merged = versions[0]
    for later_version in versions[1:]:
        merged = merged.fillna(later_version)
    name = next(iter(merged.data_vars))
    is_filled = merged[name].notnull() & versions[0][name].isnull()
    other_axes = [axis for axis in is_filled.dims if axis != time_name]
    return merged, int(is_filled.any(other_axes).sum())


def _label(version: object) -> str:
    """Return a version as text, such as "0005"; some files have it as bytes."""
    return (version.decode("ascii", "replace") if isinstance(version, bytes) else str(version)).strip()


def _drop_single_axes(dataset: xarray.Dataset, kept: set[str | None]) -> xarray.Dataset:
    """Return the data set without its axes of length 1, except those in `kept`.

    Raises TableFault for a longer axis that is not in `kept`.
    """
    faults = []
    for name in [axis for axis in dataset.dims if axis not in kept]:
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


def _select_nearest_cell(
    dataset: xarray.Dataset, latitude: str, longitude: str, site: Site | None, used: dict[str, str]
) -> tuple[xarray.Dataset, tuple[float, float]]:
    """Return the data set at the cell with a temperature that is nearest to the site, and its latitude and
    longitude [deg].

    used: name of a field → short name. Raises TableFault for a grid without a site, or a site outside the
        grid.
    """
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
        for name, distance, values in ((latitude, north, rows), (longitude, east, columns)):
            step = float(np.median(np.abs(np.diff(values)))) if len(values) > 1 else math.inf
            if len(values) > 1 and np.abs(distance).min() > 0.75 * step:
                outside.append(f"{name} {values.min():g} … {values.max():g}")
        if outside:
            raise TableFault(
                f"the site at {place_text(site.latitude_deg, site.longitude_deg)} lies outside of "
                f"the grid ({', '.join(outside)}): ask for an area around it, or correct [site]"
            )
        cos_latitude = math.cos(math.radians(site.latitude_deg))
        distances = np.hypot(north[:, None], cos_latitude * east[None, :])
        has_data = _cells_with_temperature(dataset, latitude, longitude, used, distances.shape)
        nearest = np.unravel_index(int(np.argmin(np.where(has_data, distances, np.inf))), distances.shape)
        row, column = (int(index) for index in nearest)
    selection = {
        name: int(index) for name, index in ((latitude, row), (longitude, column)) if name in dataset.dims
    }
    return dataset.isel(selection), (float(rows[row]), float(columns[column]))


def _cells_with_temperature(
    dataset: xarray.Dataset, latitude: str, longitude: str, used: dict[str, str], shape: tuple[int, int]
) -> np.ndarray:
    """Whether each cell (rows, columns) has a temperature: reanalyses of land have no values over the sea."""
    name = next((name for name, short in used.items() if short in ("t2m", "T2M")), None)
    if name is None or not {latitude, longitude} <= set(dataset[name].dims):
        return np.ones(shape, dtype=bool)
    has_value = (
        dataset[name]
        .notnull()
        .any([axis for axis in dataset[name].dims if axis not in (latitude, longitude)])
    )
    has_data = has_value.transpose(latitude, longitude).values
    return has_data if has_data.any() else np.ones(shape, dtype=bool)


_SUN = "global_horizontal_irradiance"
_DEW_POINT = "ambient_dew_point_temperature"
MERRA2 = {
    "T2M": Variable("ambient_temperature", "K", mean=True),
    "T2MDEW": Variable(_DEW_POINT, "K", mean=True),
    "PS": Variable("ambient_pressure", "Pa", mean=True),
    "SWGDN": Variable(_SUN, "W/m2", mean=True),
    "CLDTOT": Variable("cloud_cover", "1", mean=True),
    **dict.fromkeys(("PRECTOTCORR", "PRECTOT"), Variable("rain", "kg m-2 s-1", mean=True)),
    # read as a fraction [1] by the signal cloud_cover, because the humidity by mass is a fraction too
    "QV2M": Variable("cloud_cover", "kg kg-1", mean=True, part=True),
    **{
        f"{way}{height}M": Variable("wind_speed", "m/s", mean=True, part=True)
        for height in (50, 10, 2)
        for way in "UV"
    },
    "z": GROUND,
}
"""Fields of MERRA-2 that are used, by their names: single levels, radiation, precipitation; the geopotential
of the ground comes from the constant fields const_2d_asm_Nx."""
ERA5 = {
    "t2m": Variable("ambient_temperature", "K", names=("2m_temperature", "2t", "t_2m", "VAR_2T")),
    "d2m": Variable(_DEW_POINT, "K", names=("2m_dewpoint_temperature", "2d", "d_2m", "VAR_2D")),
    "sp": Variable("ambient_pressure", "Pa", names=("surface_pressure", "surf_pres")),
    "tcc": Variable("cloud_cover", "1", names=("total_cloud_cover",)),
    "tp": Variable("rain", "m", mean=True, names=("total_precipitation",)),
    "ssrd": Variable(_SUN, "J m**-2", mean=True, names=("surface_solar_radiation_downwards",)),
    "avg_sdswrf": Variable(
        _SUN, "W m**-2", mean=True, names=("msdwswrf", "mean_surface_downward_short_wave_radiation_flux")
    ),
    "fdir": Variable(
        _SUN, "J m**-2", mean=True, part=True, names=("total_sky_direct_solar_radiation_at_surface",)
    ),
    **{
        f"{way}{height}": Variable(
            "wind_speed", "m s**-1", part=True,
            names=(f"{way}_{height}", f"{height}m_{way}_component_of_wind", f"{height}{way}",
                   f"VAR_{height}{way.upper()}"),
        )
        for height in (100, 10)
        for way in "uv"
    },
    "z": GROUND,
}  # fmt: skip
"""Fields of ERA5 that are used, by their short names."""


def read_merra2(path: str | os.PathLike[str], site: Site | None = None) -> Record:
    """Read ambient signals from a file of MERRA-2, in SI units and UTC.

    path: NetCDF-4 as delivered (one day each), a subset of it as NetCDF-4 or NetCDF-3, or a ZIP archive of
        these.
    site: selects the nearest cell of a grid; may be None for a file of one point.

    All fields are means over an hour whose middle is the stamp (00:30, 01:30, …): every value of a series
    holds over the hour that ends half an hour after its stamp. The dew point over water follows from the
    specific humidity QV2M (vapour mass per mass of moist air) at the pressure PS: e = q p / (ε + (1 − ε) q);
    in a file without them it is T2MDEW.

    Raises TableFault with every fault and, for an archive, its member.
    """

    def weather_of(content: FileContent, file: str, is_only: bool) -> SiteWeather:
        if not content.kind.startswith("netcdf"):
            raise TableFault(f"expected NetCDF of MERRA-2, found {content.kind}")
        # a stamp is the middle of its hour; a record has ends
        dataset = open_dataset(content.data, content.kind)
        weather = point_weather(dataset, file, MERRA2, site, 30.0 * MINUTE_S)
        derive_merra2(weather)
        return weather

    record = _read(Path(path), weather_of)
    return require_temperature(record, "no temperature T2M: ask for the collection M2T1NXSLV", "QV2M and PS")


def read_era5(path: str | os.PathLike[str], site: Site | None = None) -> Record:
    """Read ambient signals from a file of ERA5 or ERA5-Land, in SI units and UTC.

    path: NetCDF in the current layout (`valid_time`) or that before September 2024 (`time`, perhaps
        `expver`), CSV of the point product, or a ZIP archive of these (instantaneous and accumulated fields
        come in separate files).
    site: selects the nearest cell of a grid; may be None for a file of one point.

    The record's site is the point of the reanalysis, with the height of its ground if the file has the
    geopotential; the source of each series names this point and its distance from the site. Temperature, dew
    point, pressure, wind and cloud are instants. Radiation and rain are sums over the hour that ends at the
    stamp; radiation is turned into the mean of this hour, J/m² / 3600 s. Sums since midnight, as in
    ERA5-Land, are recognised and turned into hourly sums first. Diffuse radiation is global minus direct
    radiation, both on a horizontal plane. Wind at 100 m is preferred; wind at 10 m gives a warning.

    Raises TableFault with every fault and, for an archive, its member.
    """

    def weather_of(content: FileContent, file: str, is_only: bool) -> SiteWeather | None:
        if (file_format := FORMATS_OF_KINDS.get(content.kind, "era5")) != "era5":
            raise TableFault(f'expected a file of ERA5, found {content.kind}; state format = "{file_format}"')
        if content.kind == "csv":
            weather = _csv_weather(content.data, file, site, is_only)
        else:
            dataset = open_dataset(content.data, content.kind)
            if "QV2M" in dataset.data_vars:
                raise TableFault('is a file of MERRA-2; state format = "merra2"')
            if not is_only and not any(short_name(ERA5, str(name)) for name in dataset.data_vars):
                return None  # such as one of waves
            weather = point_weather(dataset, file, ERA5, site)
        if weather is not None:
            derive_era5(weather)
        return weather

    record = _read(Path(path), weather_of)
    lacking = "no 2 m temperature (t2m, 2m_temperature): ask for it in the request"
    return require_temperature(record, lacking, "2m_dewpoint_temperature (d2m) in the request")


def _read(path: Path, weather_of: Callable[[FileContent, str, bool], SiteWeather | None]) -> Record:
    """Read the record of a file, or of all members of an archive for which `weather_of` does not return
    None."""
    file_contents, digest = contents(path)

    def record(content: FileContent) -> Record | None:
        weather = weather_of(content, path.name, len(file_contents) == 1)
        return None if weather is None else weather.record(digest)

    records = [
        member_record for member_record in read_each(file_contents, record) if member_record is not None
    ]
    return join_records(records, path.name) if records else Record(path.name, ())


def _csv_weather(data: bytes, file: str, site: Site | None, is_only: bool) -> SiteWeather | None:
    """Read the point product's CSV (`valid_time`, fields, `latitude`, `longitude`); None for an archive's
    member without a known field."""
    first_line = data.partition(b"\n")[0].decode("utf-8-sig", "replace")
    names = [name.strip().strip('"') for name in first_line.split(",")]
    time_name = next((name for name in ("valid_time", "time", "datetime") if name in names), None)
    short_names = {
        name: short_name_of_column
        for name in names
        if (short_name_of_column := short_name(ERA5, name)) not in (None, "z")
    }
    if time_name is None or not short_names:
        if not is_only and time_name is not None:
            return None
        raise TableFault(
            "expected the point product's CSV with valid_time and fields such as t2m, d2m, sp; found the "
            f"columns {', '.join(names[:12])}: name another table as a plain source, with its columns"
        )
    coordinates = [name for name in ("latitude", "longitude") if name in names]
    # stamps carry no offset, and are in UTC
    columns = dict.fromkeys([*short_names, *coordinates], UNKNOWN_MEANING)
    table = table_in(data, "", columns, time_name, Notation(timezone="UTC", decimal="."))
    fields = {
        str(short_name_of_column): WeatherField(table.values[name], name)
        for name, short_name_of_column in short_names.items()
    }
    if len(coordinates) < 2:
        return SiteWeather(file, table.time, fields, ERA5, warnings=table.warnings)
    points = np.unique(np.column_stack([table.values[name] for name in coordinates]), axis=0)
    if np.isnan(points).any():
        is_missing = np.isnan(table.values["latitude"] + table.values["longitude"])
        raise TableFault(
            f"no latitude and longitude at {stamp_text(table.time[is_missing][0])}: the file is damaged or "
            "cut short; fetch it again"
        )
    if len(points) > 1:
        raise TableFault(f"holds {len(points)} points; expected one: write each into a file of its own")
    point = point_site(*map(float, points[0]))
    return SiteWeather(file, table.time, fields, ERA5, site=point, near=site, warnings=table.warnings)


# --- what is derived from the fields at a point ----------------------------------------------


def derive_merra2(weather: SiteWeather) -> None:
    """Add humidity and wind; add faults if the stamps are not the middles of hours."""
    value = weather.value
    if weather.repeated:
        fault = "stamps occur more than once: the files of two days or versions were merged wrongly"
        weather.faults.append(fault)
    is_off = np.mod(weather.time + 1.0, HOUR_S) > 2.0
    if is_off.any():
        weather.faults.append(
            f"{int(is_off.sum())} of {len(is_off)} stamps are not half past the hour; expected hourly means "
            "(tavg1_…), not instants (inst…) or means over three hours: ask for M2T1NXSLV"
        )
    if {"QV2M", "PS"} <= set(value):
        vapour = vapour_pressure_from_specific_humidity(value["QV2M"], value["PS"])
        weather.add(_DEW_POINT, np.asarray(dew_point(vapour)), "QV2M", "PS")
    elif "QV2M" in value and "T2MDEW" not in value:
        weather.faults.append("QV2M is a humidity by mass and needs the pressure PS: ask for it too")
    weather.add_wind([(float(height), f"U{height}M", f"V{height}M") for height in (50, 10, 2)])


def derive_era5(weather: SiteWeather) -> None:
    """Add diffuse radiation and wind; turn sums since midnight into sums of single hours."""
    values, name = weather.value, {short: field.name for short, field in weather.fields.items()}
    for short in values:
        weather.faults += _power_for_energy(weather, short)
    accumulated = [field for field in ("ssrd", "fdir", "tp") if field in values]
    is_sum_since_midnight = {field: _since_midnight(weather.time, values[field]) for field in accumulated}
    for short, is_daily_sum in is_sum_since_midnight.items():
        # a field that hardly ever changes is written as the others of its file
        if is_daily_sum or (is_daily_sum is None and True in is_sum_since_midnight.values()):
            step = modal_step(weather.time)[0]
            if step > HOUR_S:
                weather.faults.append(
                    f"{name[short]}: sums since 00:00 UTC, every {duration_text(step)}; expected every hour, "
                    "of which means can be made: ask for all 24 hours of the day"
                )
            values[short] = _hourly_sums(weather.time, values[short])
            weather.warnings.append(f"{name[short]}: sums since 00:00 UTC, turned into those of each hour")
    if {"ssrd", "fdir"} <= set(values):
        diffuse = np.maximum(values["ssrd"], 0.0) - values["fdir"]
        weather.add("diffuse_horizontal_irradiance", diffuse, "ssrd", "fdir")
    weather.add_wind([(float(height), f"u{height}", f"v{height}") for height in (100, 10)])


def _power_for_energy(weather: SiteWeather, short: str) -> list[str]:
    """Return a fault if radiation in W/m² seems to be read as J/m², which makes it 3600 times too small."""
    variable, field, time = weather.variables[short], weather.fields[short], weather.time
    known_units = (None, ("W/m2", 1.0))
    if variable.signal != _SUN or unit_in_weather(field.unit or variable.unit, _SUN) in known_units:
        return []
    finite = weather.value[short][np.isfinite(weather.value[short])]
    highest = float(finite.max()) if len(finite) else 0.0
    # even under winter clouds at 60 degrees of latitude, one hour in three days has more than 1 W/m²
    if not 1e-3 < highest < 1.0 or time[-1] - time[0] < 3.0 * DAY_S:
        return []
    unit_text = (
        f'the file states "{field.unit}"' if field.unit else "it has no unit, so J/m² of an hour was taken"
    )
    return [
        f"{field.name}: the radiation would reach {highest:.2g} W/m² only; {unit_text}, and its numbers look "
        "like W/m²: correct the unit or multiply by 3600"
    ]


def _since_midnight(time: np.ndarray, value: np.ndarray) -> bool | None:
    """Return whether an accumulated field is summed since 00:00 UTC; None if it hardly ever changes.

    time: [s] (T,) increasing. value: (T,). Sums since 00:00 decrease only at the end of the day, apart from
        the noise of packing (16 bits, whose step grows with the field's range); hourly sums decrease at any
        hour. The squared decreases at the ends of days and at other hours, over all days, decide.
    """
    steps = np.nan_to_num(np.diff(value))
    squared_decreases = np.square(np.minimum(steps, 0.0))
    at_end_of_day = np.diff(_day_of(time)) > 0.0
    if np.count_nonzero(steps**2 > 1e-3 * np.max(steps**2, initial=0.0)) < 6:
        return None
    return bool(np.sum(squared_decreases[~at_end_of_day]) < 0.01 * np.sum(squared_decreases[at_end_of_day]))


def _day_of(time: np.ndarray) -> np.ndarray:
    """Return the number of the day (T,) whose sum a stamp [s] belongs to: a stamp at 00:00 is the last one of
    the day before."""
    return np.ceil(np.round(time) / DAY_S)


def _hourly_sums(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the sums of single hours from sums since 00:00 UTC; NaN after a gap.

    An increase that a later sum of the day reverses is noise of the packing, and is removed.
    """
    days = np.split(value, np.flatnonzero(np.diff(_day_of(time))) + 1)
    corrected = np.concatenate([np.fmin.accumulate(day[::-1])[::-1] for day in days])
    corrected[np.isnan(value)] = np.nan
    sum_before = np.append(np.nan, corrected[:-1])
    sum_before[np.append(True, np.round(np.diff(time)) != HOUR_S)] = np.nan
    return np.where(
        np.round(np.mod(time, DAY_S)) == HOUR_S, corrected, np.maximum(corrected - sum_before, 0.0)
    )
