"""What the package's causes are as models: forms, each with the mechanisms that it adds and the settings to
try.

A form is told with its cause.  What is a near image of another form, such as a heater by thermostat or by
humidistat, is a form of one cause and not a cause of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps

import numpy as np

from hygrokf.data.clocks import in_america, sources
from hygrokf.data.record import Record
from hygrokf.data.timestamps import HOUR_S, summer_time
from hygrokf.discovery.results import Settings
from hygrokf.modelling.derived_inputs import operating
from hygrokf.modelling.design import Design
from hygrokf.physics.mechanisms.moisture import SLAB

MechanismSettings = tuple[str, Settings]
"""A mechanism's name and its settings."""
AMBIENT_HUMIDITY = "ambient_relative_humidity"
SLOWEST_H = 2.0
"""[h] shortest time constant of walls, of sorption and of lagging air: shorter ones repair the noise of
inputs."""
OPEN = (-0.95, 50.0)
"""Relative change of the exchange through an open door: beyond it the vapour follows the ambient between two
readings, however fast."""
DATES = 23
SHIFTS_H = (-1.5, -1.25, -1.0, -0.75, -0.5, -0.25, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
FEWEST_IDLE = 200
IN_SUMMER = ":summer_time"
"""What follows the source in the code of a clock that is off in summer time only."""
AZIMUTHS = (90.0, 135.0, 180.0, 225.0, 270.0)


@dataclass(frozen=True)
class Setting:
    """One point of a form's grid: settings of features, values of parameters, a clock's shift [s], and what
    finding it costs in −2 ln L beside the grid's price."""

    features: Mapping[str, Settings] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    shift_s: float = 0.0
    price: float = 0.0


@dataclass(frozen=True)
class Form:
    """One form of a cause.

    heat, vapour: mechanisms that it adds; altered: mechanism of the base → settings that differ.
    grid: what is tried; limits: of parameters, where they are narrower than the library's.
    steps: (feature, key) → first change by which a found setting is refined; clock: source whose stamps move.
    summer: whether they do in summer time only; freed: parameter of the base that loses its prior.
    together: whether every quantity must gain.
    windows: whether its `door_open` is sought in the innovations.
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
    """What forms are made from: the identification period, the inputs of the base model of the heat and of
    that of the vapour, whether there is one, and the heat release in operation: order of the power, and
    whether it is one of its own."""

    record: Record
    inputs: tuple[frozenset[str], frozenset[str]]
    humid: bool
    order: int
    operation: bool

    def quantiles(self, signal: str, shares: Iterable[float], idle: bool = False) -> list[float]:
        series = self.record[signal]
        value = series.value
        if idle:
            value = value[operating(self.record, series.time) < 0.5]
        value = value[np.isfinite(value)]
        return np.quantile(value, list(shares)).tolist() if len(value) >= FEWEST_IDLE else []

    @property
    def span_s(self) -> tuple[float, float]:
        series = self.record["cabinet_temperature"]
        return float(series.time[0]), float(series.time[-1])

    def dates(self) -> list[float]:
        first, last = self.span_s
        return (first + (last - first) * np.arange(1, DATES + 1) / (DATES + 1)).tolist()


def ground_of(record: Record, heat: Design, vapour: Design | None) -> Ground:
    """The ground of a record's base designs."""
    release = dict(heat.mechanisms)["heat_release"]
    inputs = [frozenset(() if one is None else one.model.inputs) for one in (heat, vapour)]
    return Ground(
        record.identification(), (inputs[0], inputs[1]), vapour is not None, release.get("order", 0),
        release.get("operation", False),
    )  # fmt: skip


# -- heat and air exchange -----------------------------------------------------------------------------------
def _joint(ground: Ground, vapour: MechanismSettings) -> tuple[MechanismSettings, ...]:
    return (vapour,) if ground.humid else ()


def wall(ground: Ground) -> list[Form]:
    grid = tuple(
        Setting(values={"wall_time_constant": h, "wall_position": at})
        for h in (2.0, 7.0, 20.0, 60.0)
        for at in (0.0, 0.5, 1.0)
    )
    limits = {"wall_time_constant": (SLOWEST_H, 500.0)}
    return [Form("wall_thermal_mass", "second_mass", (("wall_thermal_mass", {}),), grid=grid, limits=limits)]


def sun(ground: Ground) -> list[Form]:
    record = ground.record
    if "global_horizontal_irradiance" not in record and record.site is None:
        return []
    lags = (0.3, 1.0, 4.0)
    roof = ("solar_gain", {"lagged": True})
    found = [
        Form("solar_gain", "roof", (roof,), grid=tuple(
            Setting({"sunshine": {}}, {"solar_time": lag}) for lag in lags
        ))
    ]  # fmt: skip
    if record.site is not None:
        side = ("solar_gain", {"lagged": True, "flag": "sunlit_wall"})
        grid = tuple(
            Setting({"sunlit_wall": {"azimuth_deg": one}}, {"solar_time": lag})
            for one in AZIMUTHS
            for lag in lags
        )
        found.append(
            Form("solar_gain", "wall", (side,), grid=grid, steps={("sunlit_wall", "azimuth_deg"): 22.5})
        )
    return found


def wind(ground: Ground) -> list[Form]:
    if "wind_speed" not in ground.record:
        return []
    return [
        Form(
            "wind_driven_exchange", code, (("wind_loss", {"flag": flag}),),
            _joint(ground, ("wind_exchange", {"flag": flag})), (Setting({flag: {}}),),
        )
        for code, flag in (("linear", "wind_tenth"), ("square", "wind_square"))
    ]  # fmt: skip


def heater(ground: Ground) -> list[Form]:
    found = []
    idle = "active_power" in ground.record and bool(ground.quantiles("cabinet_temperature", (0.5,), True))
    for still in (False, True) if idle else (False,):
        where = "standstill" if still else "always"
        for reads, code in (
            ("cabinet_temperature", "thermostat"),
            ("cabinet_relative_humidity", "humidistat"),
        ):
            if reads not in ground.record:
                continue
            warm = reads == "cabinet_temperature"
            levels = ground.quantiles(
                reads, (0.1, 0.3, 0.5, 0.7, 0.85) if warm else (0.3, 0.5, 0.7, 0.85, 0.95), still
            )
            widths = (1.5, 5.0) if warm else (0.04, 0.12)
            grid = tuple(
                Setting({"throttled_heating": {
                    "reads": reads, "start": level, "idle": still,
                    "full": level - width if warm else level + width,
                }})
                for level in levels
                for width in widths
            )  # fmt: skip
            mechanism = ("unreported_heater", {"flag": "throttled_heating"})
            found.append(Form("unlogged_heater", f"{code}_{where}", (mechanism,), grid=grid))
    return found


def cooling(ground: Ground) -> list[Form]:
    shares = (0.3, 0.5, 0.65, 0.8, 0.9, 0.96)
    found = []
    levels = ground.quantiles("cabinet_temperature", shares)

    def grid(
        feature: str, levels: Sequence[float], widths: Sequence[float], reads: str
    ) -> tuple[Setting, ...]:
        return tuple(
            Setting({feature: {"reads": reads, "start": level, "full": level + width}})
            for level in levels
            for width in widths
        )

    warm = grid("venting", levels, (1.5, 5.0), "cabinet_temperature")
    found.append(Form("cooling_switching", "stage", (("throttled_cooling_loss", {}),), grid=warm))
    found.append(Form("cooling_switching", "capacity", (("throttled_cooling", {}),), grid=warm))
    loss: tuple[MechanismSettings, ...] = (("vent_loss", {}),)
    exchange = _joint(ground, ("vent_exchange", {}))
    found.append(Form("cooling_switching", "vent", loss, exchange, grid=warm))
    if ground.humid and "cabinet_relative_humidity" in ground.record:
        levels = ground.quantiles("cabinet_relative_humidity", shares)
        damp = grid("venting", levels, (0.04, 0.12), "cabinet_relative_humidity")
        found.append(Form("cooling_switching", "vent_by_humidity", loss, exchange, grid=damp))
    return found


def exchange_step(ground: Ground) -> list[Form]:
    grid = tuple(Setting({"after_step": {"date_s": date}}) for date in ground.dates())
    return [
        Form(
            "exchange_step", "date", (("stepped_loss", {}),), _joint(ground, ("stepped_exchange", {})),
            grid, steps={("after_step", "date_s"): _step_s(ground)},
        )
    ]  # fmt: skip


def doors(ground: Ground) -> list[Form]:
    if "door_open" in ground.record:
        return []
    return [
        Form("door_opening", "windows", (("open_loss", {}),), _joint(ground, ("open_exchange", {})),
             (Setting({"door_open": {"spans": [[-1e18, 1e18]]}}),), limits={"door_exchange": OPEN},
             together=True, windows=True)
    ]  # fmt: skip


def _step_s(ground: Ground) -> float:
    first, last = ground.span_s
    return 0.5 * (last - first) / (DATES + 1)


def heat_drift(ground: Ground) -> list[Form]:
    own = {"order": ground.order, "operation": True} if ground.operation else {}
    first, last = ground.span_s
    elapsed = {"elapsed": {"start_s": first, "end_s": last}}
    saturating = tuple(
        Setting({"since": {"date_s": date, "days": days}})
        for date in (first, *ground.dates())
        for days in (8.0, 30.0)
    )
    return [
        Form("heat_release_drift", "straight", (("release_drift", own),), grid=(Setting(elapsed),)),
        Form(
            "heat_release_drift", "saturating", (("release_drift", {**own, "flag": "since"}),),
            grid=saturating, steps={("since", "date_s"): _step_s(ground), ("since", "days"): 4.0},
        ),
    ]  # fmt: skip


def by_the_clock(ground: Ground) -> list[Form]:
    return [
        Form("scheduled_heat", code, (("scheduled_heat", {}),), grid=_hours(workdays, "scheduled"),
             steps={("scheduled", "start_h"): 1.0, ("scheduled", "hours"): 1.0})
        for code, workdays in (("daily", False), ("workdays", True))
    ]  # fmt: skip


def _hours(workdays: bool, feature: str) -> tuple[Setting, ...]:
    return tuple(
        Setting({feature: {"start_h": start, "hours": hours, "workdays": workdays}})
        for start in range(0, 24, 2)
        for hours in (2.0, 4.0, 8.0, 12.0)
    )


def clock(ground: Ground) -> list[Form]:
    """Shifts of each source against the others; of two sources only the difference shows."""
    main = {"cabinet_temperature", "ambient_temperature", "active_power"}
    known = sources(ground.record)
    names = [name for name, signals in known.items() if main & set(signals)]
    names = names[: {1: 0, 2: 1}.get(len(known))]
    found = [
        Form(
            "clock_shift", name, grid=tuple(Setting(shift_s=HOUR_S * h) for h in SHIFTS_H),
            steps={("clock", "shift_s"): 0.125 * HOUR_S}, clock=name,
        )
        for name in names
    ]  # fmt: skip
    summer = summer_time(ground.record["cabinet_temperature"].time, in_america(ground.record))
    if summer.all() or not summer.any():
        return found
    hours = (Setting(shift_s=-HOUR_S), Setting(shift_s=HOUR_S))
    return [
        *found,
        *(Form("clock_shift", f"{one}{IN_SUMMER}", grid=hours, clock=one, summer=True) for one in names),
    ]


def temperature_offset(ground: Ground) -> list[Form]:
    grid = tuple(Setting({"after_step": {"date_s": date}}) for date in ground.dates())
    name = "temperature_sensor_offset"
    # the humidity sensor has a temperature of its own: what moves is the one on which the vapour runs
    moved: Mapping[str, Settings] = {"measured_air": {"step": True}} if ground.humid else {}
    found = [
        Form(
            name, "date", (("temperature_step", {}),), grid=grid, altered=moved,
            steps={("after_step", "date_s"): _step_s(ground)},
        )
    ]  # fmt: skip
    return [*found, Form(name, "constant", freed="cabinet_temperature_offset")] if ground.humid else found


def ambient(ground: Ground) -> list[Form]:
    # all of the air that surrounds the cabinet lags; a share of it is an outer wall
    times, shares = (SLOWEST_H, 24.0), (0.8, 1.2)
    intake = {"breathed_lag_time": times, "breathed_lag_share": shares}
    limits = {"ambient_lag_time": times, "ambient_lag_share": shares, **intake}
    lags = (2.0, 4.0, 12.0)
    heat: tuple[MechanismSettings, ...] = (("leading_ambient", {}),)
    vapour = _joint(ground, ("breathed_lead", {}))
    found = [Form("ambient_bias", "smoothed", heat, vapour, together=True)]
    if ground.humid:
        # where the temperature alone lags, that is an outer wall
        both = tuple(Setting(values={"ambient_lag_time": h, "breathed_lag_time": h}) for h in lags)
        found.append(
            Form("ambient_bias", "air_lags", (("lagged_ambient", {}),), (("breathed_lag", {}),), both,
                 limits=limits, together=True)
        )  # fmt: skip
        found.append(
            Form("ambient_bias", "intake_lags", vapour=(("breathed_lag", {}),), limits=intake,
                 grid=tuple(Setting(values={"breathed_lag_time": h}) for h in lags))
        )  # fmt: skip
        found.append(Form("ambient_bias", "offset", vapour=(("breathed_air", {"form": "vapour"}),)))
        found.append(Form("ambient_bias", "gain", freed="breathed_gain"))
        if AMBIENT_HUMIDITY in ground.record:
            found.append(Form("ambient_bias", "humidity", freed="breathed_humidity_offset"))
    return found


# -- moisture ------------------------------------------------------------------------------------------------
def of_vapour(forms: Callable[[Ground], list[Form]]) -> Callable[[Ground], list[Form]]:
    """Forms that exist only where the record has humidity."""

    @wraps(forms)
    def where_there_is(ground: Ground) -> list[Form]:
        return forms(ground) if ground.humid else []

    return where_there_is


@of_vapour
def sorption(ground: Ground) -> list[Form]:
    found = []
    # the skin of a slab responds faster than its slowest mode by this factor
    skin = SLAB["sorbed_skin"][1]
    for slab, hours, limits in (
        (False, (2.0, 8.0, 30.0, 120.0), (SLOWEST_H, 400.0)),
        (True, (150.0, 400.0, 1200.0), (skin * SLOWEST_H, 4000.0)),
    ):
        grid = tuple(Setting(values={"sorption_time": h}) for h in hours)
        for activated in (True, False):
            code = ("slab" if slab else "thin") + ("_activated" if activated else "")
            mechanism = ("moisture_sorption", {"activated": activated, "slab": slab})
            found.append(
                Form("moisture_sorption", code, vapour=(mechanism,), grid=grid,
                     limits={"sorption_time": limits})
            )  # fmt: skip
    return found


@of_vapour
def condensation(ground: Ground) -> list[Form]:
    grid = tuple(
        Setting(values={"surface_time": h, "surface_undercooling": below})
        for h in (1.0, 4.0, 12.0)
        for below in (0.3, 1.5, 4.0)
    )
    found = [Form("condensation", "cold_surface", vapour=(("condensation", {}),), grid=grid)]
    if ground.record.site is not None:
        night = tuple(replace(one, features={"night_sky": {}}) for one in grid)
        found.append(Form("condensation", "night_sky", vapour=(("condensation", {"sky": True}),), grid=night))
    return found


@of_vapour
def rain(ground: Ground) -> list[Form]:
    if "rain" not in ground.record:
        return []
    grid = tuple(Setting(values={"rain_drying_time": h}) for h in (0.5, 2.0, 8.0, 30.0))
    return [Form("rain_ingress", "all_rain", vapour=(("rain_ingress", {}),), grid=grid)]


@of_vapour
def drier(ground: Ground) -> list[Form]:
    if "cabinet_relative_humidity" not in ground.record:
        return []
    levels = ground.quantiles("cabinet_relative_humidity", (0.2, 0.35, 0.5, 0.65, 0.8, 0.92))
    grid = tuple(
        Setting({"throttled_drying": {"reads": "cabinet_relative_humidity", "start": at, "full": at + width}})
        for at in levels
        for width in (0.04, 0.15)
    )
    heat: tuple[MechanismSettings, ...] = (("drying_heat", {"flag": "throttled_drying"}),)
    return [
        Form("dehumidifier", code, heat if warms else (), grid=grid,
             vapour=(("switched_drying", {"plate": plate, "flag": "throttled_drying"}),))
        for code, plate, warms in (
            ("plate", True, False), ("plate_warms", True, True), ("desiccant", False, False)
        )
    ]  # fmt: skip


@of_vapour
def source(ground: Ground) -> list[Form]:
    def mechanism(when: str) -> tuple[MechanismSettings, ...]:
        return (("internal_moisture_source", {"when": when}),)

    name = "internal_moisture_source"
    found = [
        Form(name, "constant", vapour=mechanism("always")),
        Form(name, "wet_surface", vapour=(("wet_surface", {}),)),
    ]
    if "active_power" in ground.record:
        found.append(
            Form(name, "standstill", vapour=mechanism("standstill"), grid=(Setting({"standstill": {}}),))
        )
    fading = tuple(
        Setting({"fading": {"date_s": date, "days": days}})
        for date in ground.dates()
        for days in (2.0, 8.0, 30.0)
    )
    found.append(
        Form(name, "fading", vapour=mechanism("fading"), grid=fading,
             steps={("fading", "date_s"): _step_s(ground), ("fading", "days"): 1.0})
    )  # fmt: skip
    found.append(
        Form(name, "by_the_clock", vapour=mechanism("scheduled"), grid=_hours(False, "scheduled"),
             steps={("scheduled", "start_h"): 1.0, ("scheduled", "hours"): 1.0})
    )  # fmt: skip
    return found


@of_vapour
def humidity_sensor(ground: Ground) -> list[Form]:
    if "cabinet_relative_humidity" not in ground.record:
        return []
    first, last = ground.span_s
    elapsed = {"elapsed": {"start_s": first, "end_s": last}}
    levels = ground.quantiles("cabinet_relative_humidity", (0.5, 0.8, 0.95))
    name = "humidity_sensor_drift"
    return [
        Form(name, "drift", vapour=(("humidity_drift", {}),), grid=(Setting(elapsed),)),
        Form(name, "scale_drifts", vapour=(("humidity_scale", {}),), grid=(Setting(elapsed),)),
        Form(name, "scale", freed="humidity_scale_error"),
        Form(name, "ceiling", vapour=(("humidity_ceiling", {}),),
             grid=tuple(Setting(values={"humidity_ceiling": level}) for level in levels)),
    ]  # fmt: skip
