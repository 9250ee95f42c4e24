"""Hidden causes in the vapour balance: stored water, films, rain, dryers, sources.

Each function draws everything but the amplitude from ranges with their reason beside them.
"""

from __future__ import annotations

import numpy as np

from plants.chance import log_uniform, low_pass
from plants.drivers import DAY_S, HOUR_S, MINUTE_S
from plants.outdoors import MINUTE_H
from plants.saturation import concentration, saturation_pressure
from plants.scene import Change, Law, Scene


def lumped_sorption(random: np.random.Generator, scene: Scene) -> Law:
    """Dry material whose water strives towards its GAB isotherm with one time constant.

    Monolayer, C, K: such that 1.5 to 6.5 % at 50 % relative humidity, polyamide 6.6 (2.5 to 2.8
    %, ISO 1110) to pressboard (6 to 7 %). Time constant 3 to 40 h at 23 degC: parts of 0.2 to 1
    mm at 1e-12 m2/s. 1 to 200 kg: cables, ducts, laminate, insulation of a cabinet of 300 to
    1,500 kg.
    """
    terms = {
        "monolayer": random.uniform(0.015, 0.045),
        "gab_c": random.uniform(4.0, 14.0),
        "gab_k": random.uniform(0.68, 0.8),
        "sorption_s": HOUR_S * log_uniform(random, 3.0, 40.0),
        "warmth": random.uniform(0.0, 1.0),
        "start_activity": scene.activity,
    }

    def change(kilograms: float) -> Change:
        parameters = {"dry_material_kg": kilograms, "time_constant_h": terms["sorption_s"] / HOUR_S}
        wet = 0.5 * terms["gab_k"]
        below = (1.0 - wet) * (1.0 - wet + terms["gab_c"] * wet)
        parameters["water_at_half_humidity"] = terms["monolayer"] * terms["gab_c"] * wet / below
        for name in ("monolayer", "gab_c", "gab_k", "warmth"):
            parameters[name] = terms[name]
        return Change(terms={"lumped_kg": kilograms, **terms}, parameters=parameters)

    return Law(
        "linear driving force towards a GAB isotherm at the material's temperature", 1.0, 200.0, change
    )


def slab_sorption(random: np.random.Generator, scene: Scene) -> Law:
    """Fick's diffusion in a polymer slab of six layers behind an air film, with its heat of
    sorption.

    Diffusivity 2e-13 to 3e-12 m2/s at 23 degC and 28 to 55 kJ/mol: moulding compound 4e-13 with
    29 kJ/mol, epoxy 31 kJ/mol, polyamide 6.6 up to a few 1e-12 (Broudin et al. 2015). Water 25 to
    90 kg/m3 at 100 %: epoxy 2 to 3 %, polyamide 7 to 8 %. Slowest time constant 5 to 60 h, hence
    0.1 to 1.3 mm behind the face. 1 to 150 m2 of faces: boards, ducts and cables of a cabinet.
    """
    diffusivity, slowest_h = log_uniform(random, 2e-13, 3e-12), log_uniform(random, 5.0, 60.0)
    terms = {
        "slab_m": 0.5 * np.pi * float(np.sqrt(diffusivity * HOUR_S * slowest_h)),
        "slab_kg_m3": random.uniform(25.0, 90.0),
        "slab_m2_s": diffusivity,
        "slab_J_mol": 1e3 * random.uniform(28.0, 55.0),
        "air_m_s": 1e-3 * random.uniform(2.0, 4.0),
        "warmth": random.uniform(0.2, 1.0),
        "start_activity": scene.activity,
        "latent": 1.0,
    }

    def change(area: float) -> Change:
        parameters = {
            "area_m2": area,
            "thickness_mm": 1e3 * terms["slab_m"],
            "water_at_full_humidity_kg": area * terms["slab_m"] * terms["slab_kg_m3"],
            "diffusivity_m2_s": terms["slab_m2_s"],
            "activation_kJ_mol": 1e-3 * terms["slab_J_mol"],
            "time_constant_h": slowest_h,
            "warmth": terms["warmth"],
        }
        return Change(terms={"slab_m2": area, **terms}, parameters=parameters)

    return Law("diffusion in a polymer slab, Arrhenius", 1.0, 150.0, change)


def _night_sky_K(scene: Scene) -> np.ndarray:
    """Radiative undercooling of an outer surface in clear nights, at the instants, -1 at its
    deepest.
    """
    drivers = scene.drivers
    dark = drivers.irradiance_W_m2 <= 0.0
    # The day before tells how clear the sky is; at night nothing else does.
    bright = low_pass(drivers.irradiance_W_m2, MINUTE_H, 24.0)
    clear = np.clip(bright / np.quantile(bright, 0.9), 0.0, 1.0)
    return -low_pass(dark * clear, MINUTE_H, 1.0)


def condensate_film(random: np.random.Generator, scene: Scene) -> Law:
    """Film on a cold heavy surface that follows ambient and cabinet with a lag; it evaporates
    from all of it.

    Lag 8 to 36 h: a concrete foot or a ground plate. At most 8 % of the way from ambient to
    cabinet. Mass transfer 2 to 5 mm/s: Lewis' relation for 2.5 to 6 W/(m2 K). 0.3 to 60 m2: a
    plate up to the whole inner face of a tower foot.
    """
    terms = {
        "film_m_s": 1e-3 * random.uniform(2.0, 5.0),
        "surface_s": HOUR_S * log_uniform(random, 8.0, 36.0),
        "surface_share": random.uniform(0.0, 0.08),
    }

    def change(area: float) -> Change:
        parameters = {
            "area_m2": area,
            "transfer_mm_s": 1e3 * terms["film_m_s"],
            "surface_lag_h": terms["surface_s"] / HOUR_S,
            "surface_share": terms["surface_share"],
        }
        return Change(terms={"film_m2": area, **terms}, parameters=parameters)

    return Law("film on a lagging surface", 0.3, 60.0, change)


def condensate_drops(random: np.random.Generator, scene: Scene) -> Law:
    """Drops on a light skin that the clear night sky undercools; part of the water runs off.

    Undercooling up to 0.5 to 9 K: long-wave loss of 50 to 90 W/m2 over 8 to 20 W/(m2 K). Lag 0.5
    to 3 h: steel of 5 to 20 mm. 2 to 15 m2. Drops hold 20 to 80 g/m2 before they run; a fifth to
    two thirds of what comes then is lost.
    """
    area = random.uniform(2.0, 15.0)
    hold = 1e-3 * random.uniform(20.0, 80.0)
    terms = {
        "film_m2": area,
        "film_m_s": 1e-3 * random.uniform(2.0, 5.0),
        "surface_s": HOUR_S * random.uniform(0.5, 3.0),
        "surface_share": random.uniform(0.0, 0.1),
        "drop_kg": hold * area,
        "drain": random.uniform(0.2, 0.65),
    }
    sky_K = _night_sky_K(scene)

    def change(kelvin: float) -> Change:
        parameters = {
            "undercooling_K": kelvin,
            "area_m2": area,
            "hold_g_m2": 1e3 * hold,
            "drained_share": terms["drain"],
            "transfer_mm_s": 1e3 * terms["film_m_s"],
            "surface_lag_h": terms["surface_s"] / HOUR_S,
            "surface_share": terms["surface_share"],
        }
        return Change(terms=terms, surface_K=kelvin * sky_K, parameters=parameters)

    return Law("drops on a sky-cooled skin, part of them drains", 0.5, 9.0, change)


def rain_seeps(random: np.random.Generator, scene: Scene) -> Law:
    """A constant share of the rain gets in and evaporates with one time constant.

    Collecting area 0.5 to 2,000 cm2 of horizontal plane: a cable gland up to a hatch seam of
    metres. 3 to 24 h.
    """
    lag_h = log_uniform(random, 3.0, 24.0)
    held = scene.sky.rain_mm_h[:-1] / HOUR_S
    gone = low_pass(held, MINUTE_H, lag_h)

    def change(area: float) -> Change:
        return Change(vapour_kg_s=area * gone, parameters={"collecting_m2": area, "evaporation_h": lag_h})

    return Law("a share of the rain evaporates with one time constant", 5e-5, 0.2, change)


def rain_breaks_in(random: np.random.Generator, scene: Scene) -> Law:
    """Only rain above a threshold gets in; the pool evaporates into unsaturated air and slower as
    it shrinks.

    Threshold 0.7 to 2 mm/h: what a seam sheds. Pool of 0.1 to 1 m2. Collecting area as for
    seeping, wider.
    """
    threshold = random.uniform(0.7, 2.0)
    pool_m2, transfer = random.uniform(0.1, 1.0), 1e-3 * random.uniform(2.0, 4.0)
    excess = np.maximum(scene.sky.rain_mm_h[:-1] - threshold, 0.0) / HOUR_S

    def change(area: float) -> Change:
        parameters = {
            "collecting_m2": area,
            "threshold_mm_h": threshold,
            "pool_m2": pool_m2,
            "transfer_mm_s": 1e3 * transfer,
        }
        # A film of 0.5 mm wets all of the pool's floor.
        terms = {"pool_m2": pool_m2, "pool_m_s": transfer, "pool_kg": 0.5 * pool_m2}
        return Change(terms=terms, water_kg_s=area * excess, parameters=parameters)

    return Law("rain above a threshold fills a pool", 1e-4, 0.5, change)


def _drying(random: np.random.Generator, scene: Scene) -> tuple[dict[str, float], float, float]:
    """Set-point between 38 and 65 %, exceeded in 25 to 60 % of the time, band of 4 to 10 %, and
    cold plate.
    """
    point = float(np.clip(np.quantile(scene.humidity, 1.0 - random.uniform(0.25, 0.6)), 0.38, 0.65))
    band = random.uniform(0.04, 0.1)
    plate_K = 273.15 + random.uniform(-2.0, 4.0)
    floor = float(concentration(saturation_pressure(np.array(plate_K)), np.array(293.15)))
    terms = {
        "dry_on": point,
        "dry_off": point - band,
        "dry_floor": floor,
        "dry_W": random.uniform(30.0, 100.0),
    }
    return terms, plate_K - 273.15, band


def dehumidifier_switches(random: np.random.Generator, scene: Scene) -> Law:
    """Cold-plate dryer with a humidistat; its power and the latent heat stay in the cabinet.

    Humidistats of cabinets are set between 40 and 65 % and switch back 4 to 10 % lower. Air flow
    over the plate 0.2 to 120 m3/h: Peltier dryers of 0.3 l/d up to compressor dryers.
    """
    terms, plate, band = _drying(random, scene)

    def change(flow: float) -> Change:
        parameters = {
            "dried_air_m3_h": flow,
            "set_point": terms["dry_on"],
            "hysteresis": band,
            "plate_degC": plate,
            "power_W": terms["dry_W"],
        }
        return Change(terms={"dry_m3_s": flow / HOUR_S, "dry_kind": 1.0, **terms}, parameters=parameters)

    return Law("on and off with hysteresis", 0.2, 120.0, change)


def dehumidifier_follows(random: np.random.Generator, scene: Scene) -> Law:
    """A dryer whose speed follows the humidity above its set-point; ranges as for the switching one."""
    terms, plate, _ = _drying(random, scene)
    width = random.uniform(0.08, 0.2)
    terms |= {"dry_off": terms["dry_on"], "dry_on": terms["dry_on"] + width}

    def change(flow: float) -> Change:
        parameters = {
            "dried_air_m3_h": flow,
            "set_point": terms["dry_off"],
            "proportional_band": width,
            "plate_degC": plate,
            "power_W": terms["dry_W"],
        }
        return Change(terms={"dry_m3_s": flow / HOUR_S, "dry_kind": 2.0, **terms}, parameters=parameters)

    return Law("proportional to the humidity above the set-point", 0.2, 120.0, change)


def steady_source(random: np.random.Generator, scene: Scene) -> Law:
    """Vapour at a constant rate, 0.5 to 120 g/h: a dripping coolant joint, a wet foot; 1 l/d is
    42 g/h.
    """

    def change(rate: float) -> Change:
        return Change(vapour_kg_s=1e-3 * rate / HOUR_S, parameters={"rate_g_h": rate})

    return Law("constant rate", 0.5, 120.0, change)


def standstill_source(random: np.random.Generator, scene: Scene) -> Law:
    """Vapour at standstill only, 0.5 to 200 g/h: coolant weeps when the joints are cold, or the
    fan that would remove it stands.
    """
    stopped = scene.stopped.astype(float)

    def change(rate: float) -> Change:
        return Change(vapour_kg_s=1e-3 * rate / HOUR_S * stopped, parameters={"rate_g_h": rate})

    return Law("constant rate at standstill only", 0.5, 200.0, change)


def drying_source(random: np.random.Generator, scene: Scene) -> Law:
    """Water left after a repair or in fresh concrete that dries out with a time constant of 8 to 40 d.

    0.5 to 200 g/h at first, from a date in the first half on.
    """
    begin = scene.drivers.time[0] + random.uniform(0.05, 0.5) * scene.days * DAY_S
    lag_d = log_uniform(random, 8.0, 40.0)
    since = (scene.drivers.time[:-1] + 0.5 * MINUTE_S - begin) / (DAY_S * lag_d)
    fading = np.where(since > 0.0, np.exp(-np.maximum(since, 0.0)), 0.0)

    def change(rate: float) -> Change:
        return Change(
            vapour_kg_s=1e-3 * rate / HOUR_S * fading,
            parameters={"first_rate_g_h": rate, "time_constant_d": lag_d},
            dates=(begin,),
        )

    return Law("dries out exponentially from a date on", 0.5, 200.0, change)
