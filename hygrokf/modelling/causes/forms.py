"""The forms of the package's causes: each adds mechanisms to the base model and has settings to try.

Forms that records can hardly distinguish, such as heaters with a thermostat or with a humidistat, are forms
of one cause and not separate causes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.shared_clocks import in_america, sources
from hygrokf.data.timestamps import HOUR_S, summer_time
from hygrokf.modelling.derived_inputs import operating
from hygrokf.physics.mechanisms.moisture import SLAB
from hygrokf.physics.signal_names import (
    AMBIENT_RELATIVE_HUMIDITY,
    CABINET_RELATIVE_HUMIDITY,
    CABINET_TEMPERATURE,
)

if TYPE_CHECKING:
    from hygrokf.modelling.design import Design

Settings: TypeAlias = Mapping[str, Any]
"""Settings of a mechanism, a feature or a search: numbers, names, and spans of time [s]."""
MechanismSettings = tuple[str, Settings]
"""A mechanism's name and its settings."""
SLOWEST_H = 2.0
"""[h] shortest time constant of walls, of sorption and of lagging air: shorter time constants would only fit
the noise of the inputs."""
OPEN_DOOR = (-0.95, 50.0)
"""Range of the relative change of the exchange through an open door: at its upper end the vapour reaches the
ambient within the time between two readings."""
DATES = 23
"""Number of dates, evenly spread over the record, at which a change is tried."""
SHIFTS_H = (-1.5, -1.25, -1.0, -0.75, -0.5, -0.25, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
"""[h] shifts of a clock."""
FEWEST_IDLE = 200
"""Smallest number of readings whose quantiles serve as levels of controllers."""
AZIMUTHS = (90.0, 135.0, 180.0, 225.0, 270.0)
"""[°] directions that a wall faces, clockwise from north."""


@dataclass(frozen=True)
class Setting:
    """One point of a form's grid: settings of features, values of parameters, a clock's shift [s], and its
    `price`, the penalty in −2 ln L in addition to that of the grid."""

    features: Mapping[str, Settings] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    shift_s: float = 0.0
    price: float = 0.0


@dataclass(frozen=True)
class Form:
    """One form of a cause.

    code: its name among the cause's forms, which views write in words: one underscore stands for a space, two
    for a comma and a space.  The text after a colon is the name of a source, which is not changed.
    heat, vapour: mechanisms that the form adds; altered: mechanism of the base → settings that differ.  On a
    record without humidity only the mechanisms of the heat are added.
    grid: settings to try; limits: of parameters, if narrower than the library's.
    steps: (feature, key) → first step by which the best setting is refined; clock: source whose stamps shift.
    summer: whether they shift in summer time only; freed: parameter of the base that loses its prior.
    together: whether the fit of every quantity must improve.
    windows: whether the spans of `door_open` are searched for in the innovations.
    """

    cause: str
    code: str
    heat: tuple[MechanismSettings, ...] = ()
    vapour: tuple[MechanismSettings, ...] = ()
    grid: tuple[Setting, ...] = (Setting(),)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    steps: Mapping[tuple[str, str], float] = field(default_factory=dict)
    altered: Mapping[str, Settings] = field(default_factory=dict)
    clock: str = ""
    summer: bool = False
    freed: str = ""
    together: bool = False
    windows: bool = False


@dataclass(frozen=True)
class Ground:
    """What forms are made from.

    `record`: the identification period; `inputs` of the base models of heat and vapour; `humid`: whether
    there is a model of the vapour; `order` of the power in the heat release; `operation`: whether the heat
    release in operation has parameters of its own.
    """

    record: Record
    inputs: tuple[frozenset[str], frozenset[str]]
    humid: bool
    order: int
    operation: bool

    def quantiles(self, signal: str, shares: Iterable[float], idle: bool = False) -> list[float]:
        """Quantiles of a signal's readings, with `idle` of those at standstill; none for too few readings."""
        if signal not in self.record:
            return []
        series = self.record[signal]
        value = series.value
        if idle:
            value = value[operating(self.record, series.time) < 0.5]
        value = value[np.isfinite(value)]
        return np.quantile(value, list(shares)).tolist() if len(value) >= FEWEST_IDLE else []

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last reading of the cabinet's temperature [s]."""
        series = self.record[CABINET_TEMPERATURE]
        return float(series.time[0]), float(series.time[-1])

    @property
    def elapsed(self) -> tuple[Setting, ...]:
        """The time since the beginning of the record."""
        first, last = self.span_s
        return (Setting({"elapsed": {"start_s": first, "end_s": last}}),)

    @property
    def dates(self) -> list[float]:
        """The `DATES` dates [s] at which a change is tried."""
        first, last = self.span_s
        return (first + (last - first) * np.arange(1, DATES + 1) / (DATES + 1)).tolist()

    @property
    def half_step_s(self) -> float:
        """Half the time between two of the dates."""
        first, last = self.span_s
        return 0.5 * (last - first) / (DATES + 1)


def ground_of(record: Record, heat: Design, vapour: Design | None) -> Ground:
    """The `Ground` of a record's base designs."""
    release = dict(heat.mechanisms)["heat_release"]
    inputs = [frozenset(() if design is None else design.model.inputs) for design in (heat, vapour)]
    return Ground(
        record.identification(), (inputs[0], inputs[1]), vapour is not None, release.get("order", 0),
        release.get("operation", False),
    )  # fmt: skip


def possible(forms: Iterable[Form], ground: Ground) -> list[Form]:
    """The forms that a record can show: a form without settings, for lack of readings, is left out."""
    return [form for form in forms if form.grid and (ground.humid or form.heat or form.clock)]


def using(mechanism: str, **settings: Any) -> tuple[MechanismSettings, ...]:
    """One mechanism and its settings."""
    return ((mechanism, settings),)


def grid(
    feature: str = "", values: Mapping[str, Sequence[float]] | None = None, **settings: Iterable[Any]
) -> tuple[Setting, ...]:
    """All combinations of a feature's settings and of parameters' values; the last one varies fastest."""
    values = values or {}
    return tuple(
        Setting(
            {feature: dict(zip(settings, combination, strict=False))} if feature else {},
            dict(zip(values, combination[len(settings) :], strict=True)),
        )
        for combination in product(*settings.values(), *values.values())
    )


def switched(
    feature: str, reads: str, levels: Iterable[float], widths: Iterable[float], **settings: Any
) -> tuple[Setting, ...]:
    """Settings of a proportional controller that reads the signal `reads`, one for each pair of a level and a
    width.

    levels: readings at which it starts to act.  widths: beyond a level, where it acts fully; negative where
    it acts on falling readings.  Both [K] of a temperature, [1] of a relative humidity.
    """
    return tuple(
        Setting({feature: {"reads": reads, "start": level, **settings, "full": level + width}})
        for level in levels
        for width in widths
    )


# Every function below yields the forms of one cause that `ground` allows; `library.CAUSES` describes the
# causes.  Time constants are [h], `days` [d], `date_s` [s since 1970], steps of a setting in its own unit.


# -- heat and air exchange -----------------------------------------------------------------------------------
def wall(ground: Ground) -> Iterator[Form]:
    """A second mass that stores heat, with a time constant [h] and a `wall_position` [1] between the ambient
    (0) and the cabinet's air (1)."""
    starts = {"wall_time_constant": (2.0, 7.0, 20.0, 60.0), "wall_position": (0.0, 0.5, 1.0)}
    yield Form(
        "wall_thermal_mass", "a_second_mass_beside_the_converter", heat=using("wall_thermal_mass"),
        grid=grid(values=starts), limits={"wall_time_constant": (SLOWEST_H, 500.0)},
    )  # fmt: skip


def sun(ground: Ground) -> Iterator[Form]:
    """Heat of the sun that reaches the cabinet with a lag `solar_time` [h]: in proportion to the irradiance
    on a horizontal plane, or on a wall that faces one of `AZIMUTHS`, refined from steps of 22.5°."""
    name, lags, site = "solar_gain", {"solar_time": (0.3, 1.0, 4.0)}, ground.record.site
    if "global_horizontal_irradiance" in ground.record or site is not None:
        yield Form(name, "on_the_roof", heat=using(name, lagged=True), grid=grid("sunshine", lags))
    if site is not None:
        yield Form(
            name, "on_a_wall", heat=using(name, lagged=True, flag="sunlit_wall"),
            grid=grid("sunlit_wall", lags, azimuth_deg=AZIMUTHS),
            steps={("sunlit_wall", "azimuth_deg"): 22.5},
        )  # fmt: skip


def wind(ground: Ground) -> Iterator[Form]:
    """Losses of heat and vapour that grow with the wind speed, or with its square."""
    kinds = (
        ("in_proportion_to_the_wind_speed", "wind_tenth"),
        ("in_proportion_to_its_square", "wind_square"),
    )
    for code, flag in kinds if "wind_speed" in ground.record else ():
        yield Form(
            "wind_driven_exchange", code, heat=using("wind_loss", flag=flag),
            vapour=using("wind_exchange", flag=flag), grid=grid(flag),
        )  # fmt: skip


def heater(ground: Ground) -> Iterator[Form]:
    """A heater with a thermostat, which heats below a temperature, or with a humidistat, which heats above a
    humidity; at any time, or at standstill only.

    The levels tried are quantiles of the cabinet's readings, at standstill where the heater acts only then.
    """
    temperature_shares, humidity_shares = (0.1, 0.3, 0.5, 0.7, 0.85), (0.3, 0.5, 0.7, 0.85, 0.95)
    controllers = (
        # reading, shares of the quantiles, widths [K] and [1]
        ("thermostat", CABINET_TEMPERATURE, temperature_shares, (-1.5, -5.0)),
        ("humidistat", CABINET_RELATIVE_HUMIDITY, humidity_shares, (0.04, 0.12)),
    )
    has_standstill = bool(ground.quantiles(CABINET_TEMPERATURE, (0.5,), idle=True))
    for idle in (False, True) if "active_power" in ground.record and has_standstill else (False,):
        for controller, reads, shares, widths in controllers:
            levels = ground.quantiles(reads, shares, idle)
            yield Form(
                "unlogged_heater", f"{controller}__at_{'standstill' if idle else 'any_time'}",
                heat=using("unreported_heater", flag="throttled_heating"),
                grid=switched("throttled_heating", reads, levels, widths, idle=idle),
            )  # fmt: skip


def cooling(ground: Ground) -> Iterator[Form]:
    """A cooler that acts above a temperature, as a loss in proportion to the temperature difference or with
    constant power; or a vent that opens above a temperature or a humidity, which acts on the vapour, too."""
    name, shares = "cooling_switching", (0.3, 0.5, 0.65, 0.8, 0.9, 0.96)
    temperatures, humidities = (
        ground.quantiles(reads, shares) for reads in (CABINET_TEMPERATURE, CABINET_RELATIVE_HUMIDITY)
    )
    widths_K, humidity_widths = (1.5, 5.0), (0.04, 0.12)
    warm = switched("venting", CABINET_TEMPERATURE, temperatures, widths_K)
    damp = switched("venting", CABINET_RELATIVE_HUMIDITY, humidities, humidity_widths)
    growing_stage, constant_power = using("throttled_cooling_loss"), using("throttled_cooling")
    yield Form(name, "a_stage_that_grows_with_the_temperature", heat=growing_stage, grid=warm)
    yield Form(name, "of_constant_power", heat=constant_power, grid=warm)
    vent_loss, vent_exchange = using("vent_loss"), using("vent_exchange")
    yield Form(name, "a_vent_opened_by_temperature", heat=vent_loss, vapour=vent_exchange, grid=warm)
    if ground.humid:
        yield Form(name, "a_vent_opened_by_humidity", heat=vent_loss, vapour=vent_exchange, grid=damp)


def exchange_step(ground: Ground) -> Iterator[Form]:
    """Losses of heat and vapour that change at one of the dates."""
    yield Form(
        "exchange_step", "from_a_date_on", heat=using("stepped_loss"), vapour=using("stepped_exchange"),
        grid=grid("after_step", date_s=ground.dates), steps={("after_step", "date_s"): ground.half_step_s},
    )  # fmt: skip


def doors(ground: Ground) -> Iterator[Form]:
    """Openings of a door that no signal reports; their spans are searched for in the innovations, so that the
    one setting has a single span of all times."""
    all_times = {"door_open": {"spans": [[-1e18, 1e18]]}}
    if "door_open" not in ground.record:
        yield Form(
            "door_opening", "single_openings", heat=using("open_loss"), vapour=using("open_exchange"),
            grid=(Setting(all_times),), limits={"door_exchange": OPEN_DOOR}, together=True, windows=True,
        )  # fmt: skip


def heat_drift(ground: Ground) -> Iterator[Form]:
    """A heat release that drifts in proportion to time, or from a date on and ever more slowly, with a time
    constant of some `days`."""
    name = "heat_release_drift"
    settings = {"order": ground.order, "operation": True} if ground.operation else {}
    yield Form(name, "in_proportion_to_time", heat=using("release_drift", **settings), grid=ground.elapsed)
    yield Form(
        name, "from_a_date_on__and_less_and_less", heat=using("release_drift", **settings, flag="since"),
        grid=grid("since", date_s=(ground.span_s[0], *ground.dates), days=(8.0, 30.0)),
        steps={("since", "date_s"): ground.half_step_s, ("since", "days"): 4.0},
    )  # fmt: skip


def by_the_clock(ground: Ground) -> Iterator[Form]:
    """Heat that is released in the same hours of every day, or of every workday."""
    for code, workdays in (("every_day", False), ("on_workdays", True)):
        yield Form(
            "scheduled_heat", code, heat=using("scheduled_heat"), grid=_hours(workdays),
            steps={("scheduled", "start_h"): 1.0, ("scheduled", "hours"): 1.0},
        )  # fmt: skip


def _hours(workdays: bool) -> tuple[Setting, ...]:
    """Spans of the day by their begin `start_h` [h, UTC] and their length `hours` [h]."""
    return grid("scheduled", start_h=range(0, 24, 2), hours=(2.0, 4.0, 8.0, 12.0), workdays=(workdays,))


def clock(ground: Ground) -> Iterator[Form]:
    """Shifts of each source against the others, all year or in summer time only; with two sources only their
    difference is identifiable."""
    main = {CABINET_TEMPERATURE, "ambient_temperature", "active_power"}
    signals_by_source = sources(ground.record)
    names = [name for name, signals in signals_by_source.items() if main & set(signals)]
    # the clock of a single source has nothing to differ from
    names = names[: {1: 0, 2: 1}.get(len(signals_by_source))]
    all_year, one_hour = ([Setting(shift_s=HOUR_S * h) for h in hours] for hours in (SHIFTS_H, (-1.0, 1.0)))
    steps = {("clock", "shift_s"): 0.125 * HOUR_S}
    for name in names:
        yield Form("clock_shift", f"all_year:{name}", grid=tuple(all_year), steps=steps, clock=name)
    summer = summer_time(ground.record[CABINET_TEMPERATURE].time, in_america(ground.record))
    for name in names if summer.any() and not summer.all() else ():
        yield Form("clock_shift", f"in_summer_time:{name}", grid=tuple(one_hour), clock=name, summer=True)


def temperature_offset(ground: Ground) -> Iterator[Form]:
    """An error of the cabinet's temperature sensor that begins at a date, or that is constant: its parameter
    then loses its prior."""
    name = "temperature_sensor_offset"
    # the humidity sensor measures its own temperature: only the temperature that drives the vapour steps
    yield Form(
        name, "from_a_date_on", heat=using("temperature_step"),
        grid=grid("after_step", date_s=ground.dates), altered={"measured_air": {"step": True}},
        steps={("after_step", "date_s"): ground.half_step_s},
    )  # fmt: skip
    yield Form(name, "constant", freed="cabinet_temperature_offset")


def ambient(ground: Ground) -> Iterator[Form]:
    """An ambient series that is smoother than the air at the cabinet, that this air or the intake air lags,
    or whose humidity has an offset or a gain."""
    name = "ambient_bias"
    yield Form(
        name, "a_smoothed_series", heat=using("leading_ambient"), vapour=using("breathed_lead"), together=True
    )
    lags_h = (2.0, 4.0, 12.0)
    # all of the air around the cabinet lags; a lag of a share of the air would be an outer wall
    limits_h, share_limits = (SLOWEST_H, 24.0), (0.8, 1.2)
    intake = {"breathed_lag_time": limits_h, "breathed_lag_share": share_limits}
    surrounding = {"ambient_lag_time": limits_h, "ambient_lag_share": share_limits, **intake}
    if ground.humid:
        # temperature and vapour lag together: a lag of the temperature alone would be an outer wall
        yield Form(
            name, "the_air_around_the_cabinet_lags_the_series", heat=using("lagged_ambient"),
            vapour=using("breathed_lag"), limits=surrounding, together=True,
            grid=tuple(Setting(values={"ambient_lag_time": h, "breathed_lag_time": h}) for h in lags_h),
        )  # fmt: skip
    yield Form(
        name, "the_intake_air_lags_the_series", vapour=using("breathed_lag"), limits=intake,
        grid=grid(values={"breathed_lag_time": lags_h}),
    )  # fmt: skip
    yield Form(name, "offset_of_the_vapour", vapour=using("breathed_air", form="vapour"))
    yield Form(name, "gain_of_the_vapour", freed="breathed_gain")
    if AMBIENT_RELATIVE_HUMIDITY in ground.record:
        yield Form(name, "offset_of_the_relative_humidity", freed="breathed_humidity_offset")


# -- moisture ------------------------------------------------------------------------------------------------
def sorption(ground: Ground) -> Iterator[Form]:
    """Material that takes up vapour: thin, or a slab whose depth responds later than its skin; with a time
    constant [h] that is shorter when warm, or alike at all temperatures."""
    # the skin of a slab responds faster than its slowest mode by this factor
    skin = SLAB["sorbed_skin"][1]
    for material, slab, starts_h, limits_h in (
        ("thin_material", False, (2.0, 8.0, 30.0, 120.0), (SLOWEST_H, 400.0)),
        ("a_slab", True, (150.0, 400.0, 1200.0), (skin * SLOWEST_H, 4000.0)),
    ):
        for change, activated in (("faster_when_warm", True), ("alike_at_all_temperatures", False)):
            yield Form(
                "moisture_sorption", f"{material}__{change}",
                vapour=using("moisture_sorption", activated=activated, slab=slab),
                grid=grid(values={"sorption_time": starts_h}), limits={"sorption_time": limits_h},
            )  # fmt: skip


def condensation(ground: Ground) -> Iterator[Form]:
    """A film on a surface that follows the air with a lag `surface_time` [h] and stays colder by
    `surface_undercooling` [K], always or under a clear night sky."""
    starts = {"surface_time": (1.0, 4.0, 12.0), "surface_undercooling": (0.3, 1.5, 4.0)}
    yield Form("condensation", "on_a_cold_surface", vapour=using("condensation"), grid=grid(values=starts))
    if ground.record.site is not None:
        yield Form(
            "condensation", "on_a_surface_cooled_by_the_night_sky", vapour=using("condensation", sky=True),
            grid=grid("night_sky", starts),
        )  # fmt: skip


def rain(ground: Ground) -> Iterator[Form]:
    """Rain that enters and dries with the time constant `rain_drying_time` [h]."""
    if "rain" in ground.record:
        starts = grid(values={"rain_drying_time": (0.5, 2.0, 8.0, 30.0)})
        yield Form("rain_ingress", "with_all_rain", vapour=using("rain_ingress"), grid=starts)


def drier(ground: Ground) -> Iterator[Form]:
    """A drier that acts above a humidity: a cold plate, whose heat leaves the cabinet or stays in it, or a
    desiccant, which takes even the vapour that remains over a plate at the freezing point."""
    flag = "throttled_drying"
    levels = ground.quantiles(CABINET_RELATIVE_HUMIDITY, shares=(0.2, 0.35, 0.5, 0.65, 0.8, 0.92))
    humidity_widths = (0.04, 0.15)
    heat_of_drying = using("drying_heat", flag=flag) if ground.humid else ()
    for code, has_plate, heat in (
        ("a_cold_plate", True, ()),
        ("a_cold_plate_whose_heat_stays_in_the_cabinet", True, heat_of_drying),
        ("a_desiccant", False, ()),
    ):
        yield Form(
            "dehumidifier", code, heat=heat, vapour=using("switched_drying", plate=has_plate, flag=flag),
            grid=switched(flag, CABINET_RELATIVE_HUMIDITY, levels, humidity_widths),
        )  # fmt: skip


def source(ground: Ground) -> Iterator[Form]:
    """Water that evaporates inside: always, at standstill, in the same hours of the day, or from a date on
    and ever less, with a time constant of some `days`; or from a wet surface, more into drier air."""

    def form(code: str, when: str, settings: tuple[Setting, ...], **steps: float) -> Form:
        refined = {(when, key): step for key, step in steps.items()}
        return Form(name, code, vapour=using(name, when=when), grid=settings, steps=refined)

    name = "internal_moisture_source"
    yield form("constant", "always", (Setting(),))
    yield Form(name, "a_wet_surface", vapour=using("wet_surface"))
    if "active_power" in ground.record:
        yield form("at_standstill", "standstill", grid("standstill"))
    dates = grid("fading", date_s=ground.dates, days=(2.0, 8.0, 30.0))
    yield form("drying_out_from_a_date_on", "fading", dates, date_s=ground.half_step_s, days=1.0)
    every_day = _hours(workdays=False)
    yield form("in_the_same_hours_of_the_day", "scheduled", every_day, start_h=1.0, hours=1.0)


def humidity_sensor(ground: Ground) -> Iterator[Form]:
    """Errors of the cabinet's humidity sensor: an offset or a scale error that grows over the record, a
    constant scale error, or a ceiling of the readings [1], tried at quantiles of them."""
    if CABINET_RELATIVE_HUMIDITY not in ground.record:
        return
    name = "humidity_sensor_drift"
    yield Form(name, "an_offset_that_grows", vapour=using("humidity_drift"), grid=ground.elapsed)
    yield Form(name, "a_scale_that_goes_off", vapour=using("humidity_scale"), grid=ground.elapsed)
    yield Form(name, "a_scale_that_is_off", freed="humidity_scale_error")
    ceilings = ground.quantiles(CABINET_RELATIVE_HUMIDITY, shares=(0.5, 0.8, 0.95))
    yield Form(
        name, "a_ceiling_of_the_readings", vapour=using("humidity_ceiling"),
        grid=grid(values={"humidity_ceiling": ceilings}),
    )  # fmt: skip
