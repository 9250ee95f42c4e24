"""What a hidden cause sees of a plant, and what it changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from plants.cabinet import DIFFUSIVITY_273, Cabinet, Forcing, Trajectory
from plants.chamber import Exposure, Inside, Terms, integrate_hidden, no_exposure, usual_activity
from plants.drivers import Drivers
from plants.loggers import PlantSeries
from plants.outdoors import Outdoors
from plants.saturation import relative_humidity

AIR_J_M3_K = 1200.0
"""[J/(m3 K)] heat capacity of air near 20 degC: exchanged air carries heat as well as vapour."""

QUANTITIES = ("temperature", "absolute_humidity")

Seen = Callable[[Drivers, Trajectory], tuple[Drivers, Trajectory]]
Stamped = Callable[[tuple[PlantSeries, ...]], tuple[PlantSeries, ...]]


def sees_all(drivers: Drivers, trajectory: Trajectory) -> tuple[Drivers, Trajectory]:
    """Loggers that see what is there."""
    return drivers, trajectory


def as_logged(series: tuple[PlantSeries, ...]) -> tuple[PlantSeries, ...]:
    """Series as the loggers wrote them."""
    return series


@dataclass(frozen=True)
class Scene:
    """A plant without its cause: what a cause may look at to find its place.

    step_s: [s] between the instants. trajectory: of the plant with its disturbances. indoor
    arrays are at the instants (T,), held ones over the steps (T - 1,).
    """

    cabinet: Cabinet
    drivers: Drivers
    sky: Outdoors
    forcing: Forcing
    trajectory: Trajectory
    step_s: float

    @property
    def days(self) -> float:
        """Length [d]."""
        return float(self.drivers.time[-1] - self.drivers.time[0]) / 86400.0

    @property
    def progress(self) -> np.ndarray:
        """Share of the record that has passed, at the instants [-]."""
        return np.linspace(0.0, 1.0, self.drivers.time.size)

    @property
    def stopped(self) -> np.ndarray:
        """Whether the turbine stands still over each step."""
        return self.drivers.power_W[:-1] <= 0.0

    @property
    def humidity(self) -> np.ndarray:
        """Relative humidity in the cabinet at the instants [-]."""
        return relative_humidity(self.trajectory.cabinet_kg_m3, self.trajectory.cabinet_K)

    @property
    def release_W(self) -> np.ndarray:
        """Heat release without any disturbance, over the steps [W]."""
        drivers = self.drivers
        return self.cabinet.heat_release(
            drivers.power_W[:-1], drivers.held_ambient_K, drivers.preheating[:-1]
        )

    @property
    def air_flow_m3_s(self) -> float:
        """Air exchange with the outside [m3/s] at the mean ambient temperature."""
        warm = float(self.drivers.ambient_K.mean()) / 273.0
        return self.cabinet.gap * DIFFUSIVITY_273 * warm**1.8

    @property
    def activity(self) -> float:
        """Relative humidity [-] at which stored water begins, that of the first ten days."""
        first = slice(0, round(10.0 * 86400.0 / self.step_s))
        drivers = self.drivers
        return usual_activity(
            self.cabinet, drivers.ambient_K[first], drivers.ambient_kg_m3[first], self.forcing.heat_W[first]
        )


@dataclass(frozen=True)
class Change:
    """What a cause changes; the defaults change nothing.

    terms: fields of `Terms`. heat_W, vapour_kg_s: added to the forcing. skin_K, surface_K,
    conductance_W_K, water_kg_s: added to the exposure; exchange: its factor. sees: what the
    loggers see of drivers and states. stamped: what becomes of the logged series. measured:
    stands in for `stamped` where errors are computed from states. parameters, dates: for the truth.
    """

    terms: Mapping[str, float] = field(default_factory=dict)
    heat_W: np.ndarray | float = 0.0
    vapour_kg_s: np.ndarray | float = 0.0
    skin_K: np.ndarray | float = 0.0
    surface_K: np.ndarray | float = 0.0
    exchange: np.ndarray | float = 1.0
    conductance_W_K: np.ndarray | float = 0.0
    water_kg_s: np.ndarray | float = 0.0
    sees: Seen = sees_all
    stamped: Stamped = as_logged
    measured: Seen = sees_all
    parameters: Mapping[str, float] = field(default_factory=dict)
    dates: tuple[float, ...] = ()

    @property
    def inside(self) -> bool:
        """Whether the states differ at all, and not only what is logged of them."""
        quiet = (self.heat_W, self.vapour_kg_s, self.skin_K, self.surface_K, self.conductance_W_K)
        same = all(np.all(np.asarray(part) == 0.0) for part in (*quiet, self.water_kg_s))
        return bool(self.terms) or not same or bool(np.any(np.asarray(self.exchange) != 1.0))


@dataclass(frozen=True)
class Law:
    """One functional form of a cause, with everything drawn but its amplitude.

    description: the form in words. low, high: ends of the amplitude's physical range.
    change: the change at an amplitude. size: the amplitude at a strength, for causes whose
    strength is no growth of an error; measure: what such a strength means.
    quantities: those whose growth counts; a cause that only amplifies the disturbances of the
    other one says so. single: whether there is one size only, whatever strength is asked for.
    """

    description: str
    low: float
    high: float
    change: Callable[[float], Change]
    size: Callable[[float], float] | None = None
    measure: str = "growth of the bare model's free-run error, 30 % at strength 1"
    single: bool = False
    quantities: tuple[str, ...] = QUANTITIES


Form = Callable[[np.random.Generator, Scene], Law]


def _coarse_steps(values: np.ndarray | float, every: int) -> np.ndarray | float:
    if np.ndim(values) == 0:
        return values
    return np.asarray(values).reshape(-1, every).mean(axis=1)


def _coarse_points(values: np.ndarray | float, every: int) -> np.ndarray | float:
    return values if np.ndim(values) == 0 else np.asarray(values)[::every]


def _coarse_held(values: np.ndarray, every: int) -> np.ndarray:
    return np.append(values[:-1].reshape(-1, every).mean(axis=1), values[-1])


def coarse_drivers(drivers: Drivers, every: int) -> Drivers:
    """Drivers at every so many minutes; what holds over a step is averaged."""
    return replace(
        drivers,
        time=drivers.time[::every],
        ambient_K=drivers.ambient_K[::every],
        ambient_kg_m3=drivers.ambient_kg_m3[::every],
        power_W=_coarse_held(drivers.power_W, every),
        power_known=drivers.power_known[::every],
        preheating=_coarse_held(drivers.preheating, every),
        wind_m_s=drivers.wind_m_s[::every],
        irradiance_W_m2=drivers.irradiance_W_m2[::every],
    )


def coarse_change(change: Change, every: int) -> Change:
    """A change at every so many minutes."""
    return replace(
        change,
        **{name: _coarse_points(getattr(change, name), every) for name in ("skin_K", "surface_K")},
        **{
            name: _coarse_steps(getattr(change, name), every)
            for name in ("heat_W", "vapour_kg_s", "exchange", "conductance_W_K", "water_kg_s")
        },
    )


def coarse_scene(scene: Scene, every: int) -> Scene:
    """A scene at every so many minutes, to search in."""
    run = scene.trajectory
    return replace(
        scene,
        drivers=coarse_drivers(scene.drivers, every),
        sky=Outdoors(scene.sky.rain_mm_h[::every], scene.sky.wind_direction[::every]),
        forcing=Forcing(
            np.asarray(_coarse_steps(scene.forcing.heat_W, every)),
            np.asarray(_coarse_steps(scene.forcing.vapour_kg_s, every)),
        ),
        trajectory=Trajectory(
            run.converter_K[::every],
            run.wall_K[::every],
            run.cabinet_K[::every],
            run.equivalent_kg_m3[::every],
            run.cabinet_kg_m3[::every],
        ),
        step_s=scene.step_s * every,
    )


def states(scene: Scene, changes: Sequence[Change]) -> tuple[Trajectory, Inside]:
    """True states with the changes made."""
    terms: dict[str, float] = {}
    heat, vapour = scene.forcing.heat_W, scene.forcing.vapour_kg_s
    exposure: Exposure = no_exposure(scene.drivers.power_W)
    for change in changes:
        both = set(terms) & set(change.terms) - {"start_activity", "dwell_min"}
        if both:
            raise ValueError(f"two causes set {', '.join(sorted(both))}: take two of different kinds")
        terms |= change.terms
        heat = heat + change.heat_W
        vapour = vapour + change.vapour_kg_s
        exposure = replace(
            exposure,
            skin_K=exposure.skin_K + change.skin_K,
            surface_K=exposure.surface_K + change.surface_K,
            exchange=exposure.exchange * change.exchange,
            conductance_W_K=exposure.conductance_W_K + change.conductance_W_K,
            water_kg_s=exposure.water_kg_s + change.water_kg_s,
        )
    drivers = scene.drivers
    return integrate_hidden(
        scene.cabinet,
        scene.step_s,
        drivers.ambient_K,
        drivers.ambient_kg_m3,
        Forcing(heat, vapour),
        Terms(**terms),
        exposure,
    )


def seen(drivers: Drivers, trajectory: Trajectory, changes: Sequence[Change]) -> tuple[Drivers, Trajectory]:
    """Drivers and states as the loggers see them."""
    for change in changes:
        drivers, trajectory = change.sees(drivers, trajectory)
    return drivers, trajectory


def with_air(trajectory: Trajectory, kelvin: np.ndarray, kg_m3: np.ndarray) -> Trajectory:
    """States with other readings of the cabinet air."""
    return replace(trajectory, cabinet_K=kelvin, cabinet_kg_m3=kg_m3)
