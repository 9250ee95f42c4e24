"""A plant as a record: the only file here that knows the package."""

from __future__ import annotations

from hygrokf.data.record import Record, Series, Site
from other_make.loggers import Channel
from other_make.plant import Plant


def to_series(channel: Channel) -> Series:
    """One channel."""
    return Series(
        signal=channel.signal,
        time=channel.time,
        value=channel.value,
        hold="mean" if channel.interval_s else "linear",
        interval_s=channel.interval_s,
        resolution=channel.resolution,
        source=f"{channel.system}.csv, {channel.signal}",
        response_time_s=channel.response_time_s,
    )


def to_record(plant: Plant) -> Record:
    """The record of a plant."""
    return Record(
        name=plant.name,
        series=tuple(to_series(channel) for channel in plant.channels),
        site=Site(plant.weather.latitude_deg, 0.0),
        rated_power_W=plant.rated_W,
    )
