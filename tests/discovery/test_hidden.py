"""Plants with hidden causes: stated sizes, closed balances, nothing else moved."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from plants import Cabinet, Forcing, Plant, integrate, plant
from plants.balances import LATENT_J_KG
from plants.chamber import Terms, gab, integrate_hidden, no_exposure
from plants.chance import low_pass
from plants.drivers import Drivers
from plants.hidden import FORMS, HIDDEN_OPTIONS, LIBRARY, Search, hidden_plant, make_scene
from plants.operation import standstills
from plants.outdoors import outdoors, sun_azimuth, wall_irradiance
from plants.paper import PREHEATING_H, paper_case
from plants.plant import ingredients
from plants.saturation import concentration, dew_point, relative_humidity, saturation_pressure
from plants.scene import Change, Scene, coarse_drivers, coarse_scene, seen, states, with_air
from plants.strength import GROWTH, growth

SEED, DAYS = 5, 40.0
EVERY = [(cause, form) for cause, forms in FORMS.items() for form in range(len(forms))]
SOME = [(cause, place % len(forms)) for place, (cause, forms) in enumerate(FORMS.items())]
"""One form of every cause; the slow test builds all."""
OPTIONAL = ("wind_speed", "global_horizontal_irradiance", "rain")


def scene_of(seed: int, days: float, **options: object) -> Scene:
    """The scene of a plant, as its cause would find it."""
    found: list[Scene] = []

    def build(name: str, seed: int, drivers: Drivers, logging: object, **rest: object):
        found.append(make_scene(ingredients(seed, drivers, **rest), seed, drivers))

    plant(seed, days=days, build=build, **{**HIDDEN_OPTIONS, **options})
    return found[0]


@pytest.fixture(scope="module")
def nothing() -> Plant:
    return hidden_plant(SEED, "none", days=DAYS)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of(SEED, DAYS)


@pytest.fixture(scope="module")
def search(scene: Scene) -> Search:
    return Search(scene)


@cache
def hiding(cause: str, form: int) -> Plant:
    """The plant of the seed that hides a cause; made once, where a test asks for it."""
    return hidden_plant(SEED, cause, form=form, days=DAYS)


def same(one: Plant, two: Plant, signal: str) -> bool:
    first, second = one[signal], two[signal]
    return np.array_equal(first.time, second.time) and np.array_equal(
        first.value, second.value, equal_nan=True
    )


# --- every cause ----------------------------------------------------------------------------


def test_every_cause_has_two_forms() -> None:
    assert all(len(FORMS[cause]) >= 2 for cause in LIBRARY)


@pytest.mark.parametrize(("cause", "form"), SOME)
def test_a_cause_is_built_with_its_truth(nothing: Plant, cause: str, form: int) -> None:
    made = hiding(cause, form)
    (hidden,) = made.truth.hidden
    assert (hidden.cause, hidden.form, hidden.asked) == (cause, form, 1.0)
    assert hidden.reached == pytest.approx(1.0, abs=0.1) or hidden.limited
    assert hidden.parameters and all(math.isfinite(value) for value in hidden.parameters.values())
    assert hidden.rmse_without > 0.0 and hidden.rmse_with > 0.0 and hidden.rmse_true > 0.0
    if "growth" in hidden.measure:
        grown = hidden.rmse_with / hidden.rmse_without - 1.0
        assert grown == pytest.approx(GROWTH * hidden.reached, abs=1e-9)
    assert max(hidden.noncentrality) > 50.0
    assert all(made.drivers.time[0] <= date <= made.drivers.time[-1] + 1.0 for date in hidden.dates)
    assert not made.truth.class_right
    # The weather, the operation and the disturbances are those of the plant without a cause.
    for name in ("ambient_K", "ambient_kg_m3", "power_W", "preheating", "wind_m_s"):
        np.testing.assert_array_equal(getattr(made.drivers, name), getattr(nothing.drivers, name))
    np.testing.assert_array_equal(made.forcing.heat_W, nothing.forcing.heat_W)
    np.testing.assert_array_equal(made.forcing.vapour_kg_s, nothing.forcing.vapour_kg_s)
    assert made.cabinet == nothing.cabinet
    assert made.truth.biases == nothing.truth.biases
    changed = {one.signal for one in nothing.series if not same(made, nothing, one.signal)}
    assert changed, "nothing that is logged shows the cause"
    inside = {"cabinet_temperature", "cabinet_relative_humidity"}
    outside = {"ambient_temperature", "ambient_relative_humidity"}
    if cause == "ambient_bias":
        assert changed <= outside
    elif cause != "clock_shift":
        assert changed <= inside
    for one in made.series:
        assert np.all(np.diff(one.time) > 0.0), one.signal
        assert np.isfinite(one.value).mean() > 0.9, one.signal


def test_readings_stay_plausible() -> None:
    for made in (hiding(cause, form) for cause, form in SOME[::2]):
        inside = made["cabinet_temperature"].value
        assert -10.0 < np.nanmin(inside) and np.nanmax(inside) < 75.0
        assert np.nanmin(made["cabinet_relative_humidity"].value) >= 0.0


def test_none_is_the_plant_itself(nothing: Plant) -> None:
    plain = plant(SEED, days=DAYS, **HIDDEN_OPTIONS)
    np.testing.assert_array_equal(plain.trajectory.cabinet_K, nothing.trajectory.cabinet_K)
    np.testing.assert_array_equal(plain.trajectory.cabinet_kg_m3, nothing.trajectory.cabinet_kg_m3)
    signals = [one.signal for one in plain.series if one.signal not in OPTIONAL]
    assert len(signals) == 6
    assert all(same(plain, nothing, signal) for signal in signals)
    assert nothing.truth == plain.truth
    assert nothing.truth.hidden == ()


def test_the_same_seed_hides_the_same() -> None:
    one, two = (hidden_plant(6, "rain_ingress", form=1, days=20.0) for _ in range(2))
    assert one.truth == two.truth
    assert all(same(one, two, series.signal) for series in one.series)
    other = hidden_plant(7, "rain_ingress", form=1, days=20.0)
    assert other.truth.hidden[0].parameters != one.truth.hidden[0].parameters


def test_half_the_strength_is_half_the_growth() -> None:
    full, half = (hidden_plant(SEED, "solar_gain", days=DAYS, strength=s).truth.hidden[0] for s in (1.0, 0.5))
    assert half.reached == pytest.approx(0.5, abs=0.05)
    assert half.parameters["absorbing_m2"] < full.parameters["absorbing_m2"]
    assert half.parameters["lag_h"] == full.parameters["lag_h"]
    step = hidden_plant(SEED, "exchange_step", days=DAYS, strength=0.5).truth.hidden[0]
    whole = hidden_plant(SEED, "exchange_step", days=DAYS).truth.hidden[0]
    assert step.parameters["factor"] == pytest.approx(math.sqrt(whole.parameters["factor"]))


def test_two_causes_at_once() -> None:
    both = hidden_plant(SEED, "solar_gain", second=("rain_ingress", 1), days=DAYS)
    first, second = both.truth.hidden
    assert (first.cause, second.cause, second.form) == ("solar_gain", "rain_ingress", 1)
    alone = hidden_plant(SEED, "solar_gain", days=DAYS)
    assert first == alone.truth.hidden[0]
    wet = hidden_plant(SEED, "rain_ingress", form=1, days=DAYS)
    np.testing.assert_allclose(both.trajectory.cabinet_K, alone.trajectory.cabinet_K, atol=1e-9)
    assert not np.array_equal(both.trajectory.cabinet_kg_m3, alone.trajectory.cabinet_kg_m3)
    assert not np.array_equal(both.trajectory.cabinet_kg_m3, wet.trajectory.cabinet_kg_m3)
    with pytest.raises(ValueError, match="two of different kinds"):
        hidden_plant(SEED, "condensation", second=("condensation", 1), days=10.0)


# --- size -----------------------------------------------------------------------------------


def test_what_refitting_absorbs_is_no_effect(search: Search) -> None:
    bare = search.errors(Change())
    assert bare.size == pytest.approx(search.without.size)
    # A constant heat flow, a constant offset of the thermometer and a vapour flow within the sensors'
    # accuracy.
    assert search.errors(Change(heat_W=40.0)).size[0] == pytest.approx(bare.size[0], rel=1e-3)
    warmer = Change(sees=lambda drivers, run: (drivers, replace(run, cabinet_K=run.cabinet_K + 1.0)))
    assert search.errors(warmer).size[0] == pytest.approx(bare.size[0], rel=1e-6)
    gram_h = 1e-3 / 3600.0
    assert search.errors(Change(vapour_kg_s=0.5 * gram_h)).size[1] < 1.02 * bare.size[1]
    assert search.errors(Change(vapour_kg_s=30.0 * gram_h)).size[1] > 1.5 * bare.size[1]
    # Heat capacity, too, is refitted.
    more = replace(
        search.coarse,
        cabinet=replace(search.coarse.cabinet, heat_capacity=1.25 * search.coarse.cabinet.heat_capacity),
    )
    slow, _ = states(more, ())
    slowed = search.yardstick.errors(search.coarse.drivers, slow)
    assert slowed.size[0] < 1.03 * bare.size[0]


@pytest.mark.parametrize(
    ("cause", "form"),
    [("moisture_sorption", 1), ("cooling_switching", 0), ("condensation", 0), ("door_opening", 0)],
)
def test_the_search_on_a_coarse_grid_holds_at_minutes(search: Search, cause: str, form: int) -> None:
    made = hiding(cause, form)
    (hidden,) = made.truth.hidden
    run = coarse_scene(replace(search.fine, trajectory=made.trajectory), 5).trajectory
    errors = search.yardstick.errors(coarse_drivers(made.drivers, 5), run)
    grown, quantity = growth(errors, search.without)
    assert quantity == hidden.quantity
    assert grown == pytest.approx(GROWTH * hidden.reached, abs=0.03)


def test_noncentrality_is_that_of_white_noise(search: Search) -> None:
    """A white mark on white errors is as large as its squared sum over their variance."""
    yardstick = search.yardstick
    random = np.random.default_rng(3)
    size = search.without.raw[0].size
    white = (random.normal(0.0, 0.5, size), random.normal(0.0, 1e-4, size))
    mark = random.choice((-0.1, 0.1), size)
    without = replace(search.without, raw=white, left=white)
    marked = replace(without, raw=(white[0] + mark, white[1]))
    found = yardstick.noncentrality(without, marked, (0.0, 0.0))
    assert found[0] == pytest.approx(np.sum(mark**2) / 0.25, rel=0.05)
    assert found[1] == 0.0


# --- physics --------------------------------------------------------------------------------

MECHANISMS = {
    "lumped": {"lumped_kg": 30.0, "warmth": 0.3},
    "slab": {"slab_m2": 40.0, "slab_m": 4e-4, "slab_m2_s": 5e-13},
    "film": {"film_m2": 2.0, "surface_s": 4e4, "surface_share": 0.0},
    "drops": {"film_m2": 2.0, "surface_s": 3e3, "surface_share": 0.0, "drop_kg": 1e-4, "drain": 0.5},
    "pool": {"pool_m2": 0.3, "pool_kg": 0.1},
    "dryer": {"dry_m3_s": 2e-3, "dry_kind": 1.0, "dry_on": 0.45, "dry_off": 0.4, "dry_floor": 3e-3},
}


def run_terms(scene: Scene, terms: Mapping[str, float], **exposure: object):
    """States of the scene's cabinet, closed, with mechanisms and changes of the exposure."""
    cabinet = replace(scene.cabinet, vapour_balance="mass")
    drivers = scene.drivers
    given = replace(no_exposure(drivers.power_W), **exposure)
    return integrate_hidden(
        cabinet, 60.0, drivers.ambient_K, drivers.ambient_kg_m3, scene.forcing, Terms(**terms), given
    )


def test_without_mechanisms_the_balances_are_the_bare_ones(scene: Scene) -> None:
    drivers = scene.drivers
    for balance in ("paper", "mass"):
        cabinet = replace(scene.cabinet, vapour_balance=balance)
        bare = integrate(cabinet, 60.0, drivers.ambient_K, drivers.ambient_kg_m3, scene.forcing)
        mine, _ = integrate_hidden(
            cabinet,
            60.0,
            drivers.ambient_K,
            drivers.ambient_kg_m3,
            scene.forcing,
            Terms(),
            no_exposure(drivers.power_W),
        )
        for name in ("converter_K", "cabinet_K", "equivalent_kg_m3", "cabinet_kg_m3"):
            np.testing.assert_allclose(getattr(mine, name), getattr(bare, name), rtol=1e-10)
    walled = replace(scene.cabinet, wall_capacity=2e6, wall_place=0.4)
    bare = integrate(walled, 60.0, drivers.ambient_K, drivers.ambient_kg_m3, scene.forcing)
    mine, _ = states(
        replace(scene, cabinet=scene.cabinet), (Change(terms={"wall_J_K": 2e6, "wall_place": 0.4}),)
    )
    np.testing.assert_allclose(mine.cabinet_K, bare.cabinet_K, atol=1e-8)
    np.testing.assert_allclose(mine.wall_K, bare.wall_K, atol=1e-8)


@pytest.mark.parametrize("name", MECHANISMS)
def test_water_is_kept_with_the_exchange_shut(scene: Scene, name: str) -> None:
    """Air, film, pool, material, drain and dryer share what came in, and no more."""
    still = replace(scene, forcing=replace(scene.forcing, vapour_kg_s=np.zeros(scene.stopped.size)))
    water = np.zeros(scene.stopped.size)
    water[1000:1600] = 2e-6
    # The surface lies well below the dew point now and then.
    cold = -12.0 * (np.arange(scene.drivers.time.size) % 4000 > 2000)
    run, inside = run_terms(
        still,
        MECHANISMS[name],
        exchange=np.zeros(water.size),
        surface_K=cold,
        water_kg_s=water if name == "pool" else np.zeros(water.size),
    )
    came = np.concatenate(([0.0], np.cumsum(60.0 * water))) if name == "pool" else 0.0
    air = scene.cabinet.volume * run.cabinet_kg_m3
    held = inside.film_kg + inside.pool_kg + inside.sorbed_kg + inside.drained_kg + inside.dried_kg
    total = air + held - came
    assert np.ptp(held) > 1e-3, "nothing moved"
    np.testing.assert_allclose(total, total[0], atol=1e-9)
    assert inside.film_kg.min() >= 0.0
    assert inside.pool_kg.min() >= 0.0
    assert air.min() > 0.0
    assert np.all(np.diff(inside.drained_kg) >= 0.0)
    assert np.all(np.diff(inside.dried_kg) >= 0.0)


def test_a_film_comes_and_goes(scene: Scene) -> None:
    run, inside = run_terms(scene, MECHANISMS["film"])
    wet = inside.film_kg > 0.0
    assert 0.02 < wet.mean() < 0.9
    assert np.count_nonzero(np.diff(wet.astype(int)) == -1) >= 2, "never dries"
    assert inside.film_kg.min() == 0.0
    pressure = run.cabinet_kg_m3 * 461.52 * run.cabinet_K
    grows = np.diff(inside.film_kg) > 1e-9
    assert np.all(pressure[:-1][grows] > 0.995 * saturation_pressure(inside.surface_K[:-1][grows]))


def test_the_surface_follows_with_its_lag(scene: Scene) -> None:
    terms = {"film_m2": 1.0, "surface_s": 7200.0, "surface_share": 0.25}
    run, inside = run_terms(scene, terms)
    goal = scene.drivers.ambient_K + 0.25 * (run.cabinet_K - scene.drivers.ambient_K)
    np.testing.assert_allclose(inside.surface_K, low_pass(goal, 1.0 / 60.0, 2.0), atol=0.05)


def settled(cabinet: Cabinet, humidity: float, terms: Terms, hours: float, **exposure: object):
    """A cabinet without heat at 296.15 K beside air of a humidity."""
    size = round(60.0 * hours) + 1
    outside = float(concentration(humidity * saturation_pressure(np.array(296.15)), np.array(296.15)))
    forcing = Forcing(np.zeros(size - 1), np.zeros(size - 1))
    given = replace(no_exposure(np.ones(size)), **exposure)
    ambient = np.full(size, 296.15)
    return integrate_hidden(cabinet, 60.0, ambient, np.full(size, outside), forcing, terms, given)


def test_material_settles_on_its_isotherm(scene: Scene) -> None:
    terms = Terms(
        lumped_kg=10.0, monolayer=0.02, gab_c=6.0, gab_k=0.75, sorption_s=7200.0, start_activity=0.2
    )
    _, inside = settled(scene.cabinet, 0.6, terms, 400.0)
    assert inside.sorbed_kg[0] == pytest.approx(10.0 * gab(0.2, 0.02, 6.0, 0.75))
    assert inside.sorbed_kg[-1] == pytest.approx(10.0 * gab(0.6, 0.02, 6.0, 0.75), rel=1e-4)
    # Polyamide 6.6 takes up 2.5 to 2.8 % at 50 %.
    assert gab(0.5, 0.022, 6.0, 0.75) == pytest.approx(0.0275, abs=1e-3)


def test_the_slab_takes_up_water_as_crank_has_it(scene: Scene) -> None:
    """Against the series solution for a face that is suddenly at another humidity."""
    thickness, diffusivity = 5e-4, 1e-12
    terms = Terms(
        slab_m2=1.0,
        slab_m=thickness,
        slab_m2_s=diffusivity,
        slab_kg_m3=40.0,
        slab_J_mol=4e4,
        air_m_s=1.0,
        start_activity=0.2,
    )
    # So much air that the slab does not dry it.
    roomy = replace(scene.cabinet, volume=1e4)
    _, inside = settled(roomy, 0.7, terms, 300.0)
    uptake = (inside.sorbed_kg - inside.sorbed_kg[0]) / (1.0 * thickness * 40.0 * 0.5)
    seconds = 60.0 * np.arange(uptake.size)
    odd = 2.0 * np.arange(200)[:, None] + 1.0
    rate = diffusivity * np.pi**2 / (4.0 * thickness**2)
    exact = 1.0 - np.sum(8.0 / (np.pi * odd) ** 2 * np.exp(-rate * odd**2 * seconds), axis=0)
    np.testing.assert_allclose(uptake[60:], exact[60:], atol=0.02)


def test_warm_slabs_diffuse_faster(scene: Scene) -> None:
    """exp(-E/R (1/T - 1/296.15)): 40 kJ/mol double the rate over 12 K."""
    size = 60 * 30
    forcing = Forcing(np.zeros(size - 1), np.zeros(size - 1))
    roomy = replace(scene.cabinet, volume=1e4)
    terms = Terms(slab_m2=1.0, slab_m=2e-3, slab_m2_s=1e-12, slab_J_mol=4e4, air_m_s=1.0, start_activity=0.2)
    taken = []
    for kelvin in (296.15, 308.15):
        ambient = np.full(size, kelvin)
        outside = np.full(size, float(concentration(0.7 * saturation_pressure(ambient[:1]), ambient[:1])[0]))
        _, inside = integrate_hidden(
            roomy, 60.0, ambient, outside, forcing, terms, no_exposure(np.ones(size))
        )
        taken.append(inside.sorbed_kg[-1] - inside.sorbed_kg[0])
    # Early uptake goes with the root of the diffusivity.
    expected = math.exp(-4e4 / 8.314462618 * (1.0 / 308.15 - 1.0 / 296.15))
    assert (taken[1] / taken[0]) ** 2 == pytest.approx(expected, rel=0.05)


def test_heat_is_kept_with_two_walls_a_heater_and_a_fan(scene: Scene) -> None:
    cabinet = scene.cabinet
    terms = {
        "wall_J_K": 3e5,
        "wall_place": 0.3,
        "outer_wall_J_K": 4e6,
        "outer_wall_place": 0.3,
        "heater_W": 400.0,
        "heater_kind": 1.0,
        "heater_on": 293.0,
        "heater_off": 296.0,
    }
    run, inside = run_terms(scene, terms)
    beyond = cabinet.outer_resistance * 0.4
    lost = (inside.outer_wall_K - scene.drivers.ambient_K) / beyond
    lost = np.concatenate(([0.0], np.cumsum(30.0 * (lost[:-1] + lost[1:]))))
    stored = cabinet.heat_capacity * run.converter_K + 3e5 * run.wall_K + 4e6 * inside.outer_wall_K
    given = np.concatenate(([0.0], np.cumsum(60.0 * (scene.forcing.heat_W + 400.0 * inside.heater[:-1]))))
    np.testing.assert_allclose(lost + stored - stored[0], given, atol=1e-5 * given[-1])
    assert np.ptp(inside.outer_wall_K) > 5.0 and 0.0 < inside.heater.mean() < 0.9


def test_the_dryer_leaves_its_heat_in_the_cabinet(scene: Scene) -> None:
    cabinet = replace(scene.cabinet, vapour_balance="mass")
    terms = Terms(dry_m3_s=2e-3, dry_kind=2.0, dry_on=0.5, dry_off=0.3, dry_floor=1e-3, dry_W=50.0)
    run, inside = settled(cabinet, 0.7, terms, 200.0)
    rate = (inside.dried_kg[-1] - inside.dried_kg[-61]) / 3600.0
    duty = inside.dehumidifier[-1]
    assert 0.05 < duty <= 1.0
    assert rate == pytest.approx(duty * 2e-3 * (run.cabinet_kg_m3[-1] - 1e-3), rel=1e-3)
    warm = (LATENT_J_KG * rate + 50.0 * duty) * cabinet.outer_resistance
    assert run.cabinet_K[-1] - 296.15 == pytest.approx(warm, rel=1e-3)


def turns(on: np.ndarray) -> np.ndarray:
    """Minutes between switchings."""
    return np.diff(np.flatnonzero(np.diff(on) != 0.0))


@pytest.mark.parametrize("kind", [1.0, 2.0])
def test_a_heater_switches_by_its_hysteresis_at_standstill_only(scene: Scene, kind: float) -> None:
    on, off = (293.0, 296.0) if kind == 1.0 else (0.5, 0.44)
    run, inside = run_terms(
        scene, {"heater_W": 900.0, "heater_kind": kind, "heater_on": on, "heater_off": off}
    )
    heater, stopped = inside.heater[:-1], scene.stopped
    assert 0.01 < heater.mean() < 0.9
    assert not np.any(heater[~stopped])
    felt = run.cabinet_K if kind == 1.0 else relative_humidity(run.cabinet_kg_m3, run.cabinet_K)
    felt = felt[:-1] if kind == 1.0 else -felt[:-1]
    low, high = (on, off) if kind == 1.0 else (-on, -off)
    begins = np.flatnonzero(np.diff(heater) > 0.0) + 1
    ends = np.flatnonzero((np.diff(heater) < 0.0) & stopped[1:]) + 1
    assert begins.size > 3 and ends.size > 3
    assert np.all(felt[begins] < low)
    assert np.all(felt[ends] > high)
    inner = stopped[:-1] & stopped[1:]
    flips = np.flatnonzero((np.diff(heater) != 0.0) & inner)
    assert np.diff(flips).min() >= 5


def test_fan_stages_never_chatter(scene: Scene) -> None:
    terms = {
        "fan_W_K": 60.0,
        "fan_exchange": 5.0,
        "fan_on_K": 297.0,
        "fan_off_K": 294.0,
        "second_W_K": 60.0,
        "second_on_K": 301.0,
        "second_off_K": 298.0,
    }
    run, inside = run_terms(scene, terms)
    assert set(np.unique(inside.fan)) == {0.0, 1.0, 2.0}
    assert turns((inside.fan > 0.0).astype(float)).min() >= 5
    plain, _ = run_terms(scene, {})
    assert run.cabinet_K.max() < plain.cabinet_K.max() - 1.0
    assert np.all(run.cabinet_K <= plain.cabinet_K + 1e-9)


def test_an_open_door_lets_the_outside_in(scene: Scene) -> None:
    """Thirty times the exchange is stiff against a minute; the air then has the vapour of outside."""
    wide = np.full(scene.stopped.size, 200.0)
    run, _ = run_terms(scene, {}, exchange=wide)
    outside = scene.drivers.ambient_kg_m3
    assert np.max(np.abs(run.equivalent_kg_m3[60:] / outside[60:] - 1.0)) < 0.05
    hot = np.full(scene.stopped.size, 1e6)
    run, _ = run_terms(scene, {}, conductance_W_K=hot)
    np.testing.assert_allclose(run.cabinet_K, scene.drivers.ambient_K, atol=0.01)


def test_sun_on_the_skin_warms_as_outside_air_does(scene: Scene) -> None:
    warmer, _ = run_terms(scene, {}, skin_K=np.full(scene.drivers.time.size, 3.0))
    plain, _ = run_terms(scene, {})
    rise = warmer.cabinet_K - plain.cabinet_K
    assert rise[0] == pytest.approx(3.0 * (1.0 - scene.cabinet.rho), abs=1e-6)
    assert rise[-1] == pytest.approx(3.0, abs=1e-6)


# --- weather and operation ------------------------------------------------------------------


def test_rain_is_intermittent_and_prefers_humid_air() -> None:
    wet, yearly, excess = [], [], []
    for seed in range(6):
        drivers = scene_of(seed, 60.0).drivers
        rain = outdoors(np.random.default_rng(seed), drivers).rain_mm_h
        humidity = relative_humidity(drivers.ambient_kg_m3, drivers.ambient_K)
        wet.append(np.mean(rain > 0.0))
        yearly.append(rain.mean() * 8766.0)
        excess.append(humidity[rain > 0.0].mean() - humidity.mean())
    assert 0.04 < min(wet) and max(wet) < 0.09
    assert 500.0 < np.mean(yearly) < 1100.0
    assert min(excess) > 0.02


def test_the_sun_stands_where_it_should(scene: Scene) -> None:
    drivers = scene.drivers
    azimuth = np.degrees(sun_azimuth(drivers.time, 52.0, 0.0))
    hour = (drivers.time % 86400.0) / 3600.0
    assert azimuth[hour == 12.0] == pytest.approx(180.0, abs=0.1)
    assert np.all(azimuth[(hour > 7.0) & (hour < 9.0)] < 130.0)
    east, west = (wall_irradiance(drivers, math.radians(angle)) for angle in (90.0, 270.0))
    noon = 12.0 - drivers.longitude_deg / 15.0
    assert np.average(hour, weights=east) < noon - 1.0
    assert np.average(hour, weights=west) > noon + 1.0
    assert east[drivers.irradiance_W_m2 == 0.0].max() == 0.0
    assert 300.0 < east.max() < 1000.0


def test_fronts_make_cold_surfaces_wet_as_measured_weather_does() -> None:
    """Under UK reanalysis a surface with a lag of 24 h lies below the dew point in 10 % of the time."""
    shares = []
    for seed in range(4):
        drivers = plant(seed, days=180.0, weather="fronts").drivers
        hours = slice(None, None, 60)
        dew = dew_point(drivers.ambient_kg_m3[hours], drivers.ambient_K[hours])
        shares.append(np.mean(dew > low_pass(drivers.ambient_K[hours], 1.0, 24.0)))
        humidity = relative_humidity(drivers.ambient_kg_m3, drivers.ambient_K)
        assert 0.2 < humidity.min() and humidity.max() <= 1.0
        # Exact inputs are still straight between their readings.
        places = slice(drivers.ambient_offset_min, None, drivers.ambient_step_min)
        inside = slice(drivers.ambient_offset_min, 20000)
        rebuilt = np.interp(drivers.time[inside], drivers.time[places], drivers.ambient_K[places])
        np.testing.assert_allclose(rebuilt, drivers.ambient_K[inside], atol=1e-9)
    assert 0.06 < np.mean(shares) < 0.18


def test_turbines_stand_still_for_days_and_are_heated_before_they_start() -> None:
    cold = 0
    for seed in (1, 2, 3):
        drivers = scene_of(seed, 180.0).drivers
        found = standstills(drivers)
        days = [(end - begin) / 1440.0 for begin, end in found]
        assert 3 <= len([one for one in days if one > 1.9])
        assert 2.0 < max(days) < 16.0
        heated = drivers.preheating > 0.0
        assert heated.any()
        assert np.all(drivers.power_W[heated] <= 0.0)
        cold += sum(not heated[begin:end].any() for begin, end in found)
        for begin, end in found:
            if heated[begin:end].any():
                assert heated[end - 1]
                assert 4.0 <= heated[begin:end].sum() / 60.0 <= 24.2
        windy = drivers.wind_m_s > 12.5
        assert np.mean(drivers.power_W[windy] < 1.9e6) > 0.05, "no curtailment and no fault in strong wind"
        assert np.all(np.diff(np.flatnonzero(np.diff(drivers.power_W) != 0.0)) % 10 == 0)
    assert cold > 0, "every standstill ends with pre-heating"


def test_instruments_that_are_there_by_chance_tell_the_weather() -> None:
    makes = [hidden_plant(seed, "none", days=12.0) for seed in range(12)]
    signals = [{one.signal for one in made.series} for made in makes]
    assert all("wind_speed" in one for one in signals)
    for name in ("rain", "global_horizontal_irradiance"):
        assert 2 <= sum(name in one for one in signals) <= 10
    for made in makes:
        wind = made["wind_speed"]
        true = made.drivers.wind_m_s[: 10 * wind.value.size].reshape(-1, 10).mean(axis=1)
        assert 0.1 < np.std(wind.value - true) < 0.6
        assert wind.time[0] == made.drivers.time[0] + 600.0
    sunny = next(made for made, one in zip(makes, signals, strict=True) if OPTIONAL[1] in one)
    sun = sunny[OPTIONAL[1]]
    assert (sun.stamp, sun.interval_s) == ("end", 600.0)
    true = np.interp(sun.time - 300.0, sunny.drivers.time, sunny.drivers.irradiance_W_m2)
    assert np.corrcoef(sun.value, true)[0, 1] > 0.999
    assert 0.94 < np.polyfit(true, sun.value, 1)[0] < 1.06
    rainy = next(made for made, one in zip(makes, signals, strict=True) if "rain" in one)
    tips = rainy["rain"].value / 0.2
    np.testing.assert_allclose(tips, np.round(tips), atol=1e-9)
    assert hidden_plant(3, "rain_ingress", days=12.0)["rain"].value.size > 1000


# --- sensors and clocks ---------------------------------------------------------------------


def by_source(cause_form: int, source: int, days: float, **options: object) -> tuple[Plant, Plant]:
    """A plant whose clock of a source is off, and the same without."""
    for seed in range(40):
        made = hidden_plant(seed, "clock_shift", form=cause_form, days=days, **options)
        if made.truth.hidden[0].parameters["source"] == source:
            return made, hidden_plant(seed, "none", days=days, **options)
    raise AssertionError("no such source among 40 seeds")


def test_a_constant_shift_moves_one_source_alone() -> None:
    made, plain = by_source(0, 0, 4.0)
    shift = made.truth.hidden[0].parameters["late_min"]
    assert 10.0 <= abs(shift) <= 60.0
    for signal in ("cabinet_temperature", "cabinet_relative_humidity"):
        np.testing.assert_array_equal(made[signal].time, plain[signal].time + 60.0 * shift)
        np.testing.assert_array_equal(made[signal].value, plain[signal].value)
    assert same(made, plain, "ambient_temperature") and same(made, plain, "active_power")
    made, plain = by_source(0, 1, 4.0, strength=0.5)
    shift = made.truth.hidden[0].parameters["late_min"]
    assert 5.0 <= abs(shift) <= 10.0
    assert same(made, plain, "cabinet_temperature")
    # Half of each mean is taken before, the other after the true one: best at the shift.
    power = made["active_power"]
    np.testing.assert_array_equal(power.time, plain["active_power"].time)
    minutes = made.drivers.power_W[:-1]
    errors = []
    for late in range(-20, 21):
        moved = np.roll(minutes, late)[: 10 * power.value.size].reshape(-1, 10).mean(axis=1) / 1e3
        errors.append(np.nanmean(np.abs(moved - power.value)[6:-6]))
    assert int(np.argmin(errors)) - 20 == shift


def test_local_time_jumps_with_summer_time() -> None:
    made, plain = by_source(1, 0, 108.0)
    (date,) = made.truth.hidden[0].dates
    assert np.datetime64(int(date), "s") == np.datetime64("2020-10-25T01:00:00")
    late, true = made["cabinet_temperature"], plain["cabinet_temperature"]
    before, after = true.time < date, true.time >= date + 3600.0
    np.testing.assert_array_equal(late.time[: before.sum()], true.time[before] + 3600.0)
    np.testing.assert_array_equal(late.time[-after.sum() :], true.time[after])
    assert np.all(np.diff(late.time) > 0.0)
    assert 3 <= true.time.size - late.time.size <= 4
    half = hidden_plant(1, "clock_shift", form=1, days=4.0, strength=0.5).truth.hidden[0]
    assert (half.reached, half.limited) == (1.0, True)


def test_humidity_drifts_away_while_temperature_stays(nothing: Plant) -> None:
    made = hiding("humidity_sensor_drift", 0)
    assert same(made, nothing, "cabinet_temperature")
    true, told = nothing["cabinet_relative_humidity"], made["cabinet_relative_humidity"]
    passed = (true.time - true.time[0]) / (true.time[-1] - true.time[0])
    known = np.isfinite(true.value)
    slope = np.polyfit(passed[known], (told.value - true.value)[known], 1)[0]
    assert slope == pytest.approx(100.0 * made.truth.hidden[0].parameters["offset_at_the_end"], rel=0.02)
    stuck = hiding("humidity_sensor_drift", 2)
    ceiling = 100.0 * stuck.truth.hidden[0].parameters["ceiling"]
    bias = dict(stuck.truth.biases)["cabinet_relative_humidity"]
    # Scatter of 0.3 % about a ceiling.
    assert np.nanmax(stuck["cabinet_relative_humidity"].value) < ceiling + bias + 2.0
    assert np.nanmax(true.value) > ceiling + bias + 3.0


def test_a_thermometer_is_off_from_its_date_on(nothing: Plant) -> None:
    made = hiding("temperature_sensor_offset", 1)
    (hidden,) = made.truth.hidden
    true, told = nothing["cabinet_temperature"], made["cabinet_temperature"]
    off = told.value - true.value
    late = true.time >= hidden.dates[0]
    assert np.nanmax(np.abs(off[~late])) == 0.0
    assert np.nanmean(off[late]) == pytest.approx(hidden.parameters["offset_K"], abs=0.02)
    # The humidity element keeps telling what it feels.
    difference = made["cabinet_relative_humidity"].value - nothing["cabinet_relative_humidity"].value
    assert np.nanmax(np.abs(difference)) < 0.11


def test_a_logger_repeats_yesterday(nothing: Plant) -> None:
    made = hiding("logger_repeat", 0)
    true, told = nothing["cabinet_temperature"], made["cabinet_temperature"]
    moved = np.flatnonzero(np.abs(told.value - true.value) > 0.0)
    assert moved.size > 50
    before = np.searchsorted(told.time, told.time[moved] - 86400.0)
    np.testing.assert_array_equal(told.time[before], told.time[moved] - 86400.0)
    np.testing.assert_array_equal(told.value[before], told.value[moved])


def test_ambient_bias_leaves_the_cabinet_alone(nothing: Plant) -> None:
    for form in (0, 1):
        np.testing.assert_array_equal(
            hiding("ambient_bias", form).trajectory.cabinet_K, nothing.trajectory.cabinet_K
        )
    changes = [
        Change(sees=lambda drivers, run: (drivers, with_air(run, run.cabinet_K + 1.0, run.cabinet_kg_m3)))
    ]
    _, run = seen(nothing.drivers, nothing.trajectory, changes * 2)
    np.testing.assert_allclose(run.cabinet_K, nothing.trajectory.cabinet_K + 2.0)


# --- the paper's case -----------------------------------------------------------------------


@pytest.mark.parametrize("decoy", [None, "film", "source"])
def test_the_papers_case_and_what_only_looks_like_it(decoy: str | None) -> None:
    made = paper_case(2, decoy=decoy, days=84.0)
    drivers = made.drivers
    (long,) = [pair for pair in standstills(drivers, 3.0)]
    begin, end = long
    assert (end - begin) / 1440.0 == pytest.approx(7.0, abs=0.5)
    heated = np.flatnonzero(drivers.preheating)
    assert (heated[-1] + 1, heated.size) == (end, 60 * PREHEATING_H)
    assert str(drivers.time[heated[0] - 8640].astype("datetime64[s]")).startswith("2020-09-24")
    (hidden,) = made.truth.hidden
    assert hidden.reached == pytest.approx(1.0, abs=0.1)
    assert 0.9 <= hidden.parameters["peak_g_m3"] <= 2.4
    bare = hidden_plant(
        2, "none", days=84.0, operation="plain", preheating=False, faults=0, tau_h=1.5, hygric_h=0.3
    )
    extra = 1e3 * (made.trajectory.cabinet_kg_m3 - bare.trajectory.cabinet_kg_m3)
    assert extra[heated].max() > 0.5
    start = heated[0] - 8640
    earlier = np.abs(extra[1440:start]).max()
    if decoy is None:
        assert hidden.cause == "moisture_sorption"
        assert earlier > 0.2, "sorption is at work all along"
    else:
        assert hidden.cause == {"film": "condensation", "source": "internal_moisture_source"}[decoy]
        assert earlier < 0.02
    assert made.truth.tau_h == pytest.approx(1.5)


# --- all of it, at full length --------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("strength", [1.0, 0.5])
@pytest.mark.parametrize(("cause", "form"), EVERY)
def test_half_a_year_reaches_what_is_asked_for(cause: str, form: int, strength: float) -> None:
    reached = []
    for seed in (101, 102, 103):
        (hidden,) = hidden_plant(seed, cause, form=form, strength=strength).truth.hidden
        assert hidden.reached == pytest.approx(strength, abs=0.1 * strength) or hidden.limited
        reached.append(hidden.reached / strength)
    assert np.median(reached) > 0.1
