"""Hidden causes that leave the cabinet alone and change what is known of it: sensors and clocks."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from plants.cabinet import Trajectory
from plants.chance import low_pass
from plants.drivers import DAY_S, HOUR_S, Drivers
from plants.loggers import PlantSeries
from plants.saturation import concentration, relative_humidity, saturation_pressure
from plants.scene import Change, Law, Scene, with_air

SOURCES = ("cabinet logger", "SCADA", "ambient logger")


def _vapour(humidity: np.ndarray, kelvin: np.ndarray) -> np.ndarray:
    return concentration(humidity * saturation_pressure(kelvin), kelvin)


def _misread(scene: Scene, distort) -> object:
    """Loggers that see `distort(humidity, share of the record that has passed)`."""
    first, span = scene.drivers.time[0], scene.drivers.time[-1] - scene.drivers.time[0]

    def sees(drivers: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
        humidity = relative_humidity(run.cabinet_kg_m3, run.cabinet_K)
        wrong = np.maximum(distort(humidity, (drivers.time - first) / span), 0.0)
        return drivers, with_air(run, run.cabinet_K, _vapour(wrong, run.cabinet_K))

    return sees


def humidity_drifts(random: np.random.Generator, scene: Scene) -> Law:
    """Offset of the relative humidity that grows linearly to 1 to 30 % at the end, of either sign.

    Sound sensors drift by less than 0.5 % a year; contaminated ones by tens.
    """
    sign = 1.0 if random.random() < 0.7 else -1.0

    def change(percent: float) -> Change:
        slope = 0.01 * sign * percent
        return Change(
            sees=_misread(scene, lambda humidity, passed: humidity + slope * passed),
            parameters={"offset_at_the_end": slope, "per_year": slope * 365.25 / scene.days},
        )

    return Law("linear drift of the offset", 1.0, 30.0, change)


def humidity_scale_grows(random: np.random.Generator, scene: Scene) -> Law:
    """Scale error that grows with the square root of time to 2 to 80 % at the end; ageing polymer
    of a capacitive sensor gains or loses slope.
    """
    sign = 1.0 if random.random() < 0.5 else -1.0

    def change(percent: float) -> Change:
        slope = 0.01 * sign * min(percent, 60.0 if sign < 0.0 else 80.0)
        return Change(
            sees=_misread(scene, lambda humidity, passed: humidity * (1.0 + slope * np.sqrt(passed))),
            parameters={"scale_at_the_end": slope},
        )

    return Law("scale error that grows", 2.0, 80.0, change)


def humidity_sticks(random: np.random.Generator, scene: Scene) -> Law:
    """A sensor that sticks at a ceiling, which 0.1 to 60 % of the true values exceed; 92 down to
    35 %.
    """
    humidity = scene.humidity

    def change(share: float) -> Change:
        ceiling = float(np.clip(np.quantile(humidity, 1.0 - share), 0.35, 0.92))

        def distort(true: np.ndarray, passed: np.ndarray) -> np.ndarray:
            return true - 0.005 * np.logaddexp(0.0, (true - ceiling) / 0.005)

        return Change(sees=_misread(scene, distort), parameters={"ceiling": ceiling})

    return Law("sticks at a ceiling", 1e-3, 0.6, change)


def _warmer(since_s: float, kelvin: float) -> object:
    def sees(drivers: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
        # The humidity element measures what it feels; only the temperature is told wrongly.
        humidity = relative_humidity(run.cabinet_kg_m3, run.cabinet_K)
        told = run.cabinet_K + kelvin * (drivers.time >= since_s)
        return drivers, with_air(run, told, _vapour(humidity, told))

    return sees


def temperature_is_off(random: np.random.Generator, scene: Scene) -> Law:
    """Constant offset of the cabinet's temperature reading, 0.5 to 5 K beyond its accuracy, of
    either sign.
    """
    sign = random.choice((-1.0, 1.0))

    def change(kelvin: float) -> Change:
        return Change(sees=_warmer(-np.inf, sign * kelvin), parameters={"offset_K": sign * kelvin})

    return Law("constant offset", 0.5, 5.0, change)


def temperature_jumps(random: np.random.Generator, scene: Scene) -> Law:
    """Offset of 0.5 to 5 K from a date on: a sensor moved, a logger changed."""
    sign = random.choice((-1.0, 1.0))
    begin = float(scene.drivers.time[0] + random.uniform(0.25, 0.75) * scene.days * DAY_S)

    def change(kelvin: float) -> Change:
        return Change(
            sees=_warmer(begin, sign * kelvin), parameters={"offset_K": sign * kelvin}, dates=(begin,)
        )

    return Law("offset from a date on", 0.5, 5.0, change)


def _resampled(drivers: Drivers, run: Trajectory, source: str, when: np.ndarray):
    """Drivers and states with one source's values taken at other instants [s], (T,)."""
    time = drivers.time
    if source == "cabinet logger":
        kelvin = np.interp(when, time, run.cabinet_K)
        return drivers, with_air(run, kelvin, np.interp(when, time, run.cabinet_kg_m3))
    if source == "ambient logger":
        kelvin = np.interp(when, time, drivers.ambient_K)
        vapour = np.interp(when, time, drivers.ambient_kg_m3)
        return replace(drivers, ambient_K=kelvin, ambient_kg_m3=vapour), run
    place = np.clip(np.round((when - time[0]) / (time[1] - time[0])).astype(int), 0, time.size - 1)
    names = ("power_W", "power_known", "preheating", "wind_m_s")
    return replace(drivers, **{name: getattr(drivers, name)[place] for name in names}), run


def _restamped(source: str, late) -> object:
    """Series of one source with stamps `late(true time)` [s] late; stamps that come twice are
    written once.
    """

    def stamped(series: tuple[PlantSeries, ...]) -> tuple[PlantSeries, ...]:
        made = []
        for one in series:
            if one.source == source:
                time = one.time + late(one.time)
                new = np.concatenate(([True], time[1:] > np.maximum.accumulate(time)[:-1]))
                one = replace(one, time=time[new], value=one.value[new])
            made.append(one)
        return tuple(made)

    return stamped


def clock_is_off(random: np.random.Generator, scene: Scene) -> Law:
    """One source's stamps are late (or early) by a constant: 10 to 60 min at full strength, 5 to
    10 at half.
    """
    source = str(random.choice(SOURCES))
    sign, place = random.choice((-1.0, 1.0)), random.random()

    def size(strength: float) -> float:
        low = 10.0 * strength
        high = max(60.0 * 6.0 ** (-2.0 * (1.0 - strength)), low)
        return float(sign * max(round(low * (high / low) ** place), 1.0))

    def change(minutes: float) -> Change:
        def shifted(drivers: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
            return _resampled(drivers, run, source, drivers.time - 60.0 * minutes)

        parameters = {"late_min": minutes, "source": float(SOURCES.index(source))}
        if source == "SCADA":
            # Its means go by its own round minutes, so what it sees is late, not how it is stamped.
            return Change(sees=shifted, parameters=parameters)
        late = _restamped(source, lambda time: 60.0 * minutes)
        return Change(stamped=late, measured=shifted, parameters=parameters)

    text = f"constant shift of the {source}"
    return Law(text, -60.0, 60.0, change, size, "shift: 10 to 60 min at strength 1, 5 to 10 min at 0.5")


@lru_cache(maxsize=16)
def _last_sunday(year: int, month: int) -> float:
    """01:00 UTC of the month's last Sunday [s], when summer time begins and ends in Europe."""
    days = np.arange(f"{year}-{month:02d}-01", f"{year}-{month + 1:02d}-01", dtype="datetime64[D]")
    # 1 January 1970 was a Thursday.
    sundays = days[(days.astype(int) + 4) % 7 == 0]
    return float(sundays[-1].astype("datetime64[s]").astype(int)) + 3600.0


def summer_time(time: np.ndarray) -> np.ndarray:
    """Whether Europe has summer time at instants [s] of UTC."""
    years = time.astype("datetime64[s]").astype("datetime64[Y]").astype(int) + 1970
    summer = np.zeros(time.size, dtype=bool)
    for year in np.unique(years):
        begin, end = _last_sunday(int(year), 3), _last_sunday(int(year), 10)
        summer |= (time >= begin) & (time < end)
    return summer


def clock_is_local(random: np.random.Generator, scene: Scene) -> Law:
    """One source is stamped in local time with summer time and read as if winter time held all year."""
    source = str(random.choice(SOURCES))
    time = scene.drivers.time
    turns = np.flatnonzero(np.diff(summer_time(time).astype(int)) != 0)
    dates = tuple(float(time[turn + 1]) for turn in turns)

    def late(instants: np.ndarray) -> np.ndarray:
        return 3600.0 * summer_time(instants)

    def shifted(drivers: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
        told = drivers.time + late(drivers.time)
        new = np.concatenate(([True], told[1:] > np.maximum.accumulate(told)[:-1]))
        when = np.interp(drivers.time, told[new], drivers.time[new])
        return _resampled(drivers, run, source, when)

    def change(minutes: float) -> Change:
        parameters = {"late_in_summer_min": minutes, "source": float(SOURCES.index(source))}
        return Change(stamped=_restamped(source, late), measured=shifted, parameters=parameters, dates=dates)

    measure = "one hour in summer time, whatever strength is asked for"
    return Law(f"{source} on local time", 60.0, 60.0, change, lambda strength: 60.0, measure, single=True)


def ambient_is_off(random: np.random.Generator, scene: Scene) -> Law:
    """Logged outside temperature too high by 0.5 to 8 K, or humidity off by 2 to 30 %.

    A sensor on a sunlit or heated wall; one that is contaminated. Which of both is drawn.
    """
    thermal = random.random() < 0.5
    sign = 1.0 if thermal else random.choice((-1.0, 1.0))

    def change(amplitude: float) -> Change:
        size = sign * amplitude

        def sees(drivers: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
            humidity = relative_humidity(drivers.ambient_kg_m3, drivers.ambient_K)
            kelvin = drivers.ambient_K + (size if thermal else 0.0)
            told = np.clip(humidity + (0.0 if thermal else 0.04 * size), 0.02, 1.0)
            return replace(drivers, ambient_K=kelvin, ambient_kg_m3=_vapour(told, kelvin)), run

        name = "temperature_offset_K" if thermal else "humidity_offset"
        return Change(sees=sees, parameters={name: size if thermal else 0.04 * size})

    return Law(f"offset of the ambient {'temperature' if thermal else 'humidity'}", 0.5, 8.0, change)


def ambient_is_elsewhere(random: np.random.Generator, scene: Scene) -> Law:
    """The ambient series is smoothed by 0.5 to 8 h and taken 0 to 100 m lower (0.65 K/100 m).

    Reanalysis or a sheltered mast hut: slow, and of another height.
    """
    metres = random.uniform(0.0, 100.0)
    warmer = 0.0065 * metres

    def change(hours: float) -> Change:
        def sees(drivers: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
            step_h = float(drivers.time[1] - drivers.time[0]) / 3600.0
            kelvin = low_pass(drivers.ambient_K, step_h, hours) + warmer
            vapour = low_pass(drivers.ambient_kg_m3, step_h, hours)
            vapour = np.minimum(vapour, _vapour(np.ones(1), kelvin))
            return replace(drivers, ambient_K=kelvin, ambient_kg_m3=vapour), run

        return Change(sees=sees, parameters={"lag_h": hours, "height_m": metres})

    return Law("smoothed and of another height", 0.5, 8.0, change)


def logger_repeats(random: np.random.Generator, scene: Scene) -> Law:
    """The cabinet logger now and then writes for some hours what it wrote a day before.

    Once in 8 to 20 d, four times at least; 1 to 22 h each, longer or shorter by a third.
    """
    days = int(scene.days)
    count = min(max(round(scene.days / random.uniform(8.0, 20.0)), 4), days - 3)
    order = 2 + random.permutation(days - 3)[:count]
    begins = np.sort(scene.drivers.time[0] + DAY_S * (order + random.uniform(0.0, 0.05, count)))
    spread = random.uniform(0.67, 1.0, count)

    def repeat(time: np.ndarray, values: np.ndarray, hours: float) -> np.ndarray:
        values = values.copy()
        for begin, long in zip(begins, HOUR_S * hours * spread, strict=True):
            here = np.flatnonzero((time >= begin) & (time < begin + long))
            before = np.clip(np.searchsorted(time, time[here] - DAY_S - 1.0), 0, time.size - 1)
            found = np.abs(time[before] - (time[here] - DAY_S)) < 1.0
            values[here[found]] = values[before[found]]
        return values

    def change(hours: float) -> Change:
        def shifted(drivers: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
            kelvin = repeat(drivers.time, run.cabinet_K, hours)
            return drivers, with_air(run, kelvin, repeat(drivers.time, run.cabinet_kg_m3, hours))

        def stamped(series: tuple[PlantSeries, ...]) -> tuple[PlantSeries, ...]:
            return tuple(
                replace(one, value=repeat(one.time, one.value, hours)) if one.source == SOURCES[0] else one
                for one in series
            )

        return Change(
            stamped=stamped,
            measured=shifted,
            parameters={"hours": hours, "repeats": float(count)},
            dates=tuple(float(begin) for begin in begins),
        )

    return Law("blocks of yesterday's readings", 1.0, 22.0, change)
