"""Plants that hide a cause: one of the library's names, none, or something that no library holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from plants import causes_exchange as exchange
from plants import causes_heat as heat
from plants import causes_loggers as loggers
from plants import causes_moisture as moisture
from plants import causes_outside as outside
from plants.cabinet import Forcing, integrate
from plants.drivers import MINUTE_S, Drivers
from plants.loggers import Logging, log_plant
from plants.outdoors import optional_series, outdoors, with_series
from plants.plant import Hidden, Ingredients, Plant, ingredients, plant, truth_of
from plants.scene import QUANTITIES, Change, Form, Law, Scene, coarse_change, coarse_scene, seen, states
from plants.strength import GROWTH, Errors, Yardstick, find_amplitude, growth

FORMS: dict[str, tuple[Form, ...]] = {
    "moisture_sorption": (moisture.lumped_sorption, moisture.slab_sorption),
    "condensation": (moisture.condensate_film, moisture.condensate_drops),
    "wall_thermal_mass": (heat.one_wall, heat.two_walls),
    "solar_gain": (heat.sun_on_roof, heat.sun_on_wall),
    "wind_driven_exchange": (heat.wind_blows, heat.wind_presses),
    "unlogged_heater": (heat.thermostat_heater, heat.humidistat_heater, heat.frost_heater),
    "cooling_switching": (heat.filter_fan, heat.coolant_stages, exchange.vent_opens),
    "exchange_step": (exchange.exchange_steps, exchange.exchange_ramps),
    "heat_release_drift": (heat.linear_fouling, heat.saturating_fouling),
    "humidity_sensor_drift": (loggers.humidity_drifts, loggers.humidity_scale_grows, loggers.humidity_sticks),
    "temperature_sensor_offset": (loggers.temperature_is_off, loggers.temperature_jumps),
    "clock_shift": (loggers.clock_is_off, loggers.clock_is_local),
    "rain_ingress": (moisture.rain_seeps, moisture.rain_breaks_in),
    "door_opening": (exchange.doors_open, exchange.door_left_open),
    "dehumidifier": (moisture.dehumidifier_switches, moisture.dehumidifier_follows),
    "internal_moisture_source": (moisture.steady_source, moisture.standstill_source, moisture.drying_source),
    "ambient_bias": (loggers.ambient_is_off, loggers.ambient_is_elsewhere),
    "neighbour_exhaust": (heat.neighbour_exhaust,),
    "logger_repeat": (loggers.logger_repeats,),
    "scheduled_heat": (heat.lamps, heat.people_at_work),
    "tide": (outside.tide_surrounds,),
    "weekly_routine": (outside.weekly_routine,),
    "load_by_chance": (outside.load_by_chance,),
    "pressure_leak": (outside.pressure_breathes,),
    "sunlit_sensor": (outside.sensor_in_the_sun,),
    "wet_filter": (outside.wet_filter,),
}
"""Functional forms of every cause."""

OUT_OF_LIBRARY = (
    "neighbour_exhaust",
    "logger_repeat",
    "tide",
    "weekly_routine",
    "load_by_chance",
    "pressure_leak",
    "sunlit_sensor",
    "wet_filter",
)
LIBRARY = tuple(name for name in FORMS if name not in OUT_OF_LIBRARY)

HIDDEN_OPTIONS: dict[str, object] = {
    "sensor_errors": "all",
    "preheating": True,
    "operation": "turbine",
    "weather": "fronts",
    "power_gap_days": 1.5,
    "logger_gaps": 2,
}
"""Options of `plant` that plants with hidden causes have unless told otherwise."""

_COARSE = 5
_NOISE = (0.06, 6e-5)  # [K], [kg/m3] scatter of the readings: 0.05 K and 0.3 % with their rounding


_DRAWS = 6


def _drawn(seed: int, cause: str, form: int, draw: int, scene: Scene) -> Law:
    """The law of a cause in a plant, from a stream that belongs to both."""
    number = list(FORMS).index(cause)
    stream = np.random.SeedSequence([seed, 3, number, form, draw])
    return FORMS[cause][form](np.random.default_rng(stream), scene)


class Search:
    """Errors of one plant at any amplitude of any cause, on a coarse grid or at minutes."""

    def __init__(self, scene: Scene) -> None:
        self.fine = scene
        self.coarse = coarse_scene(scene, _COARSE)
        plain, _ = states(self.coarse, ())
        self.coarse = replace(self.coarse, trajectory=plain)
        self.yardstick = Yardstick(self.coarse)
        self.without = self.yardstick.errors(self.coarse.drivers, plain)

    def errors(self, change: Change) -> Errors:
        """Errors with a change of the minutes."""
        coarse = coarse_change(change, _COARSE)
        run = states(self.coarse, (coarse,))[0] if change.inside else self.coarse.trajectory
        drivers, run = coarse.measured(*seen(self.coarse.drivers, run, (coarse,)))
        return self.yardstick.errors(drivers, run)

    def known(self, change: Change) -> tuple[float, float]:
        """Error of the cause's own model with true parameters, without disturbances [K], [kg/m3]."""
        still = Forcing(self.coarse.release_W, np.zeros(self.coarse.release_W.size))
        coarse = coarse_change(change, _COARSE)
        drivers = self.coarse.drivers
        two = []
        for forcing in (self.coarse.forcing, still):
            run, _ = states(replace(self.coarse, forcing=forcing), (coarse,))
            two.append(coarse.measured(*seen(drivers, run, (coarse,)))[1])
        temperature = np.sqrt(np.mean((two[0].cabinet_K - two[1].cabinet_K) ** 2))
        humidity = np.sqrt(np.mean((two[0].cabinet_kg_m3 - two[1].cabinet_kg_m3) ** 2))
        return float(temperature), float(humidity)

    def hide(
        self, seed: int, cause: str, form: int, strength: float, halved: bool = False
    ) -> tuple[Change, Hidden]:
        """A cause with the strength asked for, drawn anew where its ranges do not lead there; else the
        nearest.

        halved: half the amplitude that has this strength.
        """
        best: tuple[Change, Hidden] | None = None
        for draw in range(_DRAWS):
            law = _drawn(seed, cause, form, draw, self.fine)
            amplitude, limited = self.amplitude(law, strength)
            found = self.settle(cause, form, law, strength, amplitude, limited)
            if best is None or abs(found[1].reached - strength) < abs(best[1].reached - strength):
                best, chosen = found, (law, amplitude)
            # A cause with a size has the one that it is told to have.
            if not best[1].limited or law.size is not None:
                break
        assert best is not None
        if not halved:
            return best
        law, amplitude = chosen
        return self.settle(cause, form, law, strength, 0.5 * amplitude, law.single)

    def amplitude(self, law: Law, strength: float) -> tuple[float, bool]:
        """Amplitude that has the strength asked for, and whether the law's ranges keep it from that."""
        if law.size is not None:
            return law.size(strength), law.single and strength != 1.0

        def grown(amplitude: float) -> float:
            return growth(self.errors(law.change(amplitude)), self.without, law.quantities)[0]

        return find_amplitude(grown, law.low, law.high, GROWTH * strength)

    def settle(
        self, cause: str, form: int, law: Law, strength: float, amplitude: float, limited: bool
    ) -> tuple[Change, Hidden]:
        """The change of an amplitude, and its account."""
        change = law.change(amplitude)
        errors = self.errors(change)
        known = self.known(change)
        grown, quantity = growth(errors, self.without, law.quantities)
        which = QUANTITIES.index(quantity)
        reached = grown / GROWTH
        if law.size is not None:
            reached = 1.0 if law.single else strength * amplitude / law.size(strength)
        return change, Hidden(
            cause=cause,
            form=form,
            description=law.description,
            asked=strength,
            reached=reached,
            limited=limited,
            measure=law.measure,
            quantity=quantity,
            rmse_without=self.without.size[which],
            rmse_with=errors.size[which],
            rmse_true=known[which],
            noncentrality=self.yardstick.noncentrality(self.without, errors, _NOISE),
            parameters={name: float(value) for name, value in change.parameters.items()},
            dates=tuple(float(date) for date in change.dates),
        )


def make_scene(made: Ingredients, seed: int, drivers: Drivers) -> Scene:
    """The plant as a cause finds it."""
    sky = outdoors(np.random.default_rng(np.random.SeedSequence([seed, 4])), drivers)
    plain = integrate(made.cabinet, MINUTE_S, drivers.ambient_K, drivers.ambient_kg_m3, made.forcing)
    return Scene(made.cabinet, drivers, sky, made.forcing, plain, MINUTE_S)


def finish(
    name: str,
    seed: int,
    made: Ingredients,
    scene: Scene,
    logging: Logging,
    changes: Sequence[Change],
    hidden: tuple[Hidden, ...] = (),
) -> Plant:
    """The plant with its changes made, logged by its loggers."""
    drivers, run = scene.drivers, scene.trajectory
    if any(change.inside for change in changes):
        run, _ = states(scene, changes)
    seen_drivers, seen_run = seen(drivers, run, changes)
    series, biases = log_plant(np.random.default_rng(made.logger_seed), seen_drivers, seen_run, logging)
    # What is logged beside the usual hangs on the seed alone, unless a cause cannot be named without it.
    instruments = np.random.default_rng(np.random.SeedSequence([seed, 6]))
    has_sun, has_gauge = instruments.random() < 0.5, instruments.random() < 0.5
    rainy = any(one.cause == "rain_ingress" for one in hidden)
    extra = optional_series(instruments, seen_drivers, scene.sky, irradiance=has_sun, rain=has_gauge or rainy)
    series = with_series(series, extra)
    for change in changes:
        series = change.stamped(series)
    truth = truth_of(made, drivers, logging, run, biases, hidden)
    return Plant(name, seed, made.cabinet, drivers, made.forcing, run, series, truth)


def _build(
    name: str,
    seed: int,
    drivers: Drivers,
    logging: Logging,
    *,
    causes: Sequence[tuple[str, int]],
    strength: float,
    halved: bool,
    **options: object,
) -> Plant:
    made = ingredients(seed, drivers, **options)  # type: ignore[arg-type]
    scene = make_scene(made, seed, drivers)
    found = []
    if causes:
        search = Search(scene)
        found = [search.hide(seed, cause, form, strength, halved) for cause, form in causes]
    changes, hidden = [change for change, _ in found], tuple(account for _, account in found)
    return finish(name, seed, made, scene, logging, changes, hidden)


def hidden_plant(
    seed: int,
    cause: str,
    *,
    form: int = 0,
    strength: float = 1.0,
    halved: bool = False,
    days: float = 180.0,
    second: str | tuple[str, int] | None = None,
    **options: object,
) -> Plant:
    """A random plant that hides a cause; its truth says which and how large.

    cause: a name of `FORMS`, or "none". form: its functional form. strength: 1 lets the error of
    a refitted bare model grow by 30 % in the quantity that grows most, 0.5 by 15 %; what a cause
    without such an error has instead, `Hidden.measure` says. halved: half the amplitude that has this
    strength, in the same plant (strength 0.5 has about 0.7 of the amplitude). second: a further cause,
    or (cause, form), of the same strength by itself. options: those of `plant`; `HIDDEN_OPTIONS` hold
    otherwise. Weather, cabinet, disturbances and loggers are those of the plant of that seed
    without a cause.
    """
    causes = [] if cause == "none" else [(cause, form)]
    if second is not None:
        causes.append((second, 0) if isinstance(second, str) else second)
    for name, number in causes:
        if name not in FORMS:
            raise ValueError(f'cause must be "none" or one of {", ".join(FORMS)}, found {name!r}')
        if not 0 <= number < len(FORMS[name]):
            raise ValueError(f"{name} has forms 0 to {len(FORMS[name]) - 1}, found {number}")
    if strength <= 0.0:
        raise ValueError(f'strength must be above 0, found {strength}; nothing hidden is cause "none"')
    build = partial(_build, causes=causes, strength=strength, halved=halved)
    return plant(seed, days=days, build=build, **{**HIDDEN_OPTIONS, **options})
