"""Plants: random cabinets under weather and operation, with their truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from plants.cabinet import Cabinet, Forcing, Trajectory, integrate
from plants.drivers import MINUTE_S, Drivers, own_drivers
from plants.effects import DISTURBANCES, HeatDisturbance, VapourDisturbance
from plants.loggers import Logging, PlantSeries, log_plant
from plants.operation import turbine_operation
from plants.outdoors import with_fronts


@dataclass(frozen=True)
class Hidden:
    """What is hidden in a plant, and how large it is.

    cause, form: name and number of the functional form; description: that form in words.
    asked, reached: [-] strength; 1 lets the error of the bare model grow by 30 %, or is what
        `measure` says. limited: whether the cause's ranges keep `reached` from `asked`.
    quantity: the one whose error grows most. rmse_without, rmse_with: [K] or [kg/m3] error of the
        refitted bare model in it, without and with the cause. rmse_true: that of a model with the
        cause and its true parameters; 1 - rmse_true / rmse_with is all that can be gained.
    noncentrality: (temperature, humidity) [-] of the likelihood ratio of a whole record.
    parameters: value by name with unit. dates: [s] since the Unix epoch.
    """

    cause: str
    form: int
    description: str
    asked: float
    reached: float
    limited: bool
    measure: str
    quantity: str
    rmse_without: float
    rmse_with: float
    rmse_true: float
    noncentrality: tuple[float, float]
    parameters: dict[str, float] = field(default_factory=dict)
    dates: tuple[float, ...] = ()


@dataclass(frozen=True)
class Truth:
    """What an estimate is held against.

    tau_h: [h] (R_AT + R_IC) C_conv. rho: [-] R_AT / (R_AT + R_IC). hygric_h: [h] R_D* V* at the
    means cabinet_K and ambient_K [K] of the record. hygric_constant_h: [h] k of equation (4).
    operation_K, standstill_K: heat release in kelvin, as `Cabinet` has it in watts.
    preheating_K: [K]. heat: and vapour: the disturbances. biases: (signal, bias in its unit).
    class_right: whether the base model's class holds the plant. hidden: hidden causes.
    """

    tau_h: float
    rho: float
    hygric_h: float
    hygric_constant_h: float
    cabinet_K: float
    ambient_K: float
    operation_K: tuple[float, ...]
    standstill_K: tuple[float, ...]
    preheating_K: float
    heat: HeatDisturbance
    vapour: VapourDisturbance
    biases: tuple[tuple[str, float], ...]
    class_right: bool
    hidden: tuple[Hidden, ...] = ()


@dataclass(frozen=True)
class Plant:
    """A cabinet, what drives it, what happened in it and what is known of it."""

    name: str
    seed: int
    cabinet: Cabinet
    drivers: Drivers
    forcing: Forcing
    trajectory: Trajectory
    series: tuple[PlantSeries, ...]
    truth: Truth

    def __getitem__(self, signal: str) -> PlantSeries:
        for one in self.series:
            if one.signal == signal:
                return one
        raise KeyError(f"{self.name} has no {signal}")


def random_cabinet(random: np.random.Generator, **given: object) -> Cabinet:
    """A cabinet within the ranges of wind-turbine converters.

    given: `tau_h`, `rho`, `hygric_h` (at 292 K inside, 283 K outside) fix what is otherwise
    drawn; any other name is a field of `Cabinet`.
    """

    def choose(name: str, drawn: float) -> float:
        return float(given.pop(name, drawn))  # type: ignore[arg-type]

    tau_h = choose("tau_h", float(np.exp(random.uniform(np.log(0.8), np.log(3.0)))))
    rho = choose("rho", random.uniform(0.72, 0.93))
    hygric_h = choose("hygric_h", float(np.exp(random.uniform(np.log(0.15), np.log(0.8)))))
    outer = random.uniform(0.012, 0.04)
    volume = random.uniform(1.5, 6.0)
    span, bend = random.uniform(3.5, 6.5), random.uniform(0.5, 2.0)
    operation_K = (random.uniform(6.5, 9.0), span + bend, -bend, random.uniform(-0.2, -0.02))
    standstill_K = (random.uniform(4.5, 6.0), random.uniform(-0.12, -0.02))
    preheating_K = random.uniform(6.0, 11.0)
    made = Cabinet(
        heat_capacity=3600.0 * tau_h * rho / outer,
        outer_resistance=outer,
        inner_resistance=outer * (1.0 / rho - 1.0),
        volume=volume,
        gap=1.0,
        operation_W=tuple(part / outer for part in operation_K),  # type: ignore[arg-type]
        standstill_W=tuple(part / outer for part in standstill_K),  # type: ignore[arg-type]
        preheating_W=preheating_K / outer,
    )
    made = replace(made, gap=made.hygric_h(292.0, 283.0) / hygric_h)
    return replace(made, **given)  # type: ignore[arg-type]


def _forcing(
    seed: np.random.SeedSequence,
    cabinet: Cabinet,
    drivers: Drivers,
    effects: Sequence[HeatDisturbance | VapourDisturbance],
) -> Forcing:
    steps = drivers.time.size - 1
    heat_W = cabinet.heat_release(drivers.power_W[:-1], drivers.held_ambient_K, drivers.preheating[:-1])
    forcing = Forcing(heat_W=heat_W, vapour_kg_s=np.zeros(steps))
    for effect, child in zip(effects, seed.spawn(len(effects)), strict=True):
        forcing = effect.force(np.random.default_rng(child), cabinet, drivers, forcing)
    return forcing


@dataclass(frozen=True)
class Ingredients:
    """A plant before its states are integrated; loggers draw from `logger_seed`."""

    cabinet: Cabinet
    forcing: Forcing
    heat: HeatDisturbance
    vapour: VapourDisturbance
    logger_seed: np.random.SeedSequence
    pure: bool


def ingredients(
    seed: int,
    drivers: Drivers,
    *,
    disturbance: str = "ou",
    wall: bool = False,
    **given: object,
) -> Ingredients:
    """Cabinet, disturbances and forcing under given drivers; see `plant` for the arguments."""
    if disturbance not in DISTURBANCES:
        raise ValueError(f"disturbance must be one of {DISTURBANCES}, found {disturbance!r}")
    # The second word keeps these streams apart from those of the drivers.
    making, forcing_seed, logger_seed = np.random.SeedSequence([seed, 1]).spawn(3)
    random = np.random.default_rng(making)
    wall_h, wall_place = random.uniform(4.0, 12.0), random.uniform(0.3, 0.7)
    quiet = disturbance == "none"
    heat = HeatDisturbance(
        kind=disturbance,
        free_run_K=0.0 if quiet else random.uniform(1.2, 1.75),
        correlation_h=float(np.exp(random.uniform(np.log(4.0), np.log(14.0)))),
        diffusion_K=0.0 if quiet else random.uniform(0.03, 0.08),
    )
    vapour = VapourDisturbance(
        kind=disturbance,
        free_run_kg_m3=0.0 if quiet else 1e-3 * random.uniform(0.34, 0.45),
        correlation_h=float(np.exp(random.uniform(np.log(3.0), np.log(10.0)))),
        diffusion_kg_m3=0.0 if quiet else 1e-3 * random.uniform(0.01, 0.03),
    )
    cabinet = random_cabinet(random, **given)
    if wall:
        # Time constant of the wall between its two halves of R_AT.
        between = cabinet.outer_resistance * wall_place * (1.0 - wall_place)
        cabinet = replace(cabinet, wall_capacity=3600.0 * wall_h / between, wall_place=wall_place)
    forcing = _forcing(forcing_seed, cabinet, drivers, (heat, vapour))
    pure = disturbance in ("ou", "none") and not wall and cabinet.vapour_balance == "paper"
    return Ingredients(cabinet, forcing, heat, vapour, logger_seed, pure)


def truth_of(
    made: Ingredients,
    drivers: Drivers,
    logging: Logging,
    trajectory: Trajectory,
    biases: tuple[tuple[str, float], ...],
    hidden: tuple[Hidden, ...] = (),
) -> Truth:
    """What is known of a plant."""
    cabinet = made.cabinet
    inside, outside = float(trajectory.cabinet_K.mean()), float(drivers.ambient_K.mean())
    outer = cabinet.outer_resistance
    return Truth(
        tau_h=cabinet.thermal_h,
        rho=cabinet.rho,
        hygric_h=cabinet.hygric_h(inside, outside),
        hygric_constant_h=cabinet.hygric_constant_h,
        cabinet_K=inside,
        ambient_K=outside,
        operation_K=tuple(outer * part for part in cabinet.operation_W),
        standstill_K=tuple(outer * part for part in cabinet.standstill_W),
        preheating_K=outer * cabinet.preheating_W,
        heat=made.heat,
        vapour=made.vapour,
        biases=biases,
        class_right=(
            made.pure
            and logging.sensor_errors != "all"
            and logging.power_gap_days == 0.0
            and bool(drivers.power_known.all())
            and not hidden
        ),
        hidden=hidden,
    )


def build_plant(
    name: str,
    seed: int,
    drivers: Drivers,
    logging: Logging,
    **options: object,
) -> Plant:
    """A plant under given drivers; see `plant` and `ingredients` for the arguments."""
    made = ingredients(seed, drivers, **options)  # type: ignore[arg-type]
    trajectory = integrate(made.cabinet, MINUTE_S, drivers.ambient_K, drivers.ambient_kg_m3, made.forcing)
    series, biases = log_plant(np.random.default_rng(made.logger_seed), drivers, trajectory, logging)
    truth = truth_of(made, drivers, logging, trajectory, biases)
    return Plant(name, seed, made.cabinet, drivers, made.forcing, trajectory, series, truth)


def plant(
    seed: int,
    *,
    days: float = 180.0,
    logger_step_min: float = 15.0,
    logger_mean: bool = False,
    sensor_errors: str = "cabinet",
    missing: float = 0.01,
    power_gap_days: float = 0.0,
    logger_gaps: int = 0,
    ambient_humidity: str = "relative",
    ambient_step_min: int = 10,
    power: str = "wind",
    standstill: bool = True,
    preheating: bool = False,
    faults: int | None = None,
    operation: str = "plain",
    weather: str = "plain",
    disturbance: str = "ou",
    wall: bool = False,
    build: Callable[..., Plant] = build_plant,
    **given: object,
) -> Plant:
    """A random plant; with the defaults the base model's class holds it.

    seed: the same seed gives the same plant, and options that do not concern the weather, the
    cabinet or the disturbances leave these as they are. logger_step_min ... logger_gaps: see
    `Logging`. ambient_step_min ... faults: see `own_drivers`. operation: "plain", or "turbine"
    with what `turbine_operation` adds. weather: "plain", or "fronts" with what `with_fronts`
    adds. disturbance: one of DISTURBANCES, for the heat and the vapour flow. wall: a second
    thermal mass of 4 to 12 h. build: what makes the plant of its drivers. given: `tau_h`, `rho`,
    `hygric_h` or a field of `Cabinet`, which are otherwise drawn.
    """
    if operation not in ("plain", "turbine"):
        raise ValueError(f'operation must be "plain" or "turbine", found {operation!r}')
    if weather not in ("plain", "fronts"):
        raise ValueError(f'weather must be "plain" or "fronts", found {weather!r}')
    drivers = own_drivers(
        np.random.default_rng(np.random.SeedSequence([seed, 0])),
        days=days,
        ambient_step_min=ambient_step_min,
        power=power,
        standstill=standstill,
        preheating=preheating and operation == "plain",
        faults=faults,
    )
    if weather == "fronts":
        drivers = with_fronts(np.random.default_rng(np.random.SeedSequence([seed, 7])), drivers)
    if operation == "turbine":
        random = np.random.default_rng(np.random.SeedSequence([seed, 5]))
        rated_W = float(given.get("rated_W", Cabinet.rated_W))  # type: ignore[arg-type]
        drivers = turbine_operation(random, drivers, rated_W, preheating)
    logging = Logging(
        logger_step_min=logger_step_min,
        logger_mean=logger_mean,
        sensor_errors=sensor_errors,
        missing=missing,
        power_gap_days=power_gap_days,
        ambient_humidity=ambient_humidity,
        logger_gaps=logger_gaps,
    )
    return build(
        f"plant-{seed}",
        seed,
        drivers,
        logging,
        disturbance=disturbance,
        wall=wall,
        **given,
    )


def undisturbed(made: Plant) -> Trajectory:
    """The free run of the bare physics with the true parameters: no effects at all."""
    forcing = _forcing(np.random.SeedSequence(0), made.cabinet, made.drivers, ())
    drivers = made.drivers
    return integrate(made.cabinet, MINUTE_S, drivers.ambient_K, drivers.ambient_kg_m3, forcing)
