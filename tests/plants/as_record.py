"""A plant as a record of the package: the only file of the plants that knows the package."""

from __future__ import annotations

from hygrokf.data.record import Provenance, Record, Series, Site
from plants.loggers import PlantSeries
from plants.plant import Plant

# SI value = factor * value + offset; differences take the factor alone.
_TO_SI = {
    "degC": (1.0, 273.15),
    "%": (0.01, 0.0),
    "g/m3": (1e-3, 0.0),
    "kW": (1e3, 0.0),
    "m/s": (1.0, 0.0),
    "W/m2": (1.0, 0.0),
    "mm": (1.0, 0.0),
    "1": (1.0, 0.0),
}


def to_series(one: PlantSeries, clock_uncertainty_s: float = 0.0) -> Series:
    """One series in SI units."""
    factor, offset = _TO_SI[one.unit]
    return Series(
        signal=one.signal,
        time=one.time,
        value=factor * one.value + offset,
        hold="mean" if one.stamp == "end" else "linear",
        interval_s=one.interval_s,
        resolution=factor * one.resolution,
        accuracy=None if one.accuracy is None else factor * one.accuracy,
        clock_uncertainty_s=clock_uncertainty_s,
        source=one.source,
    )


def to_record(made: Plant, *, until_s: float | None = None, clock_uncertainty_s: float = 0.0) -> Record:
    """The record of a plant.

    until_s: [s] end of the identification period, None = the whole record.
    clock_uncertainty_s: [s] stated for the cabinet logger.
    """
    return Record(
        name=made.name,
        series=tuple(
            to_series(one, clock_uncertainty_s if one.source == "cabinet logger" else 0.0)
            for one in made.series
        ),
        site=Site(
            latitude_deg=made.drivers.latitude_deg, longitude_deg=made.drivers.longitude_deg, altitude_m=None
        ),
        rated_power_W=made.cabinet.rated_W,
        until_s=until_s,
        warnings=(),
        provenance=Provenance.SIMULATED,
    )
