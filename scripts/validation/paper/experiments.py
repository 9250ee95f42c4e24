"""The paper's three experiments: identify and validate, ERA5 instead of local air, the sister elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from plants.plant import Plant

from hygrokf.data.record import Record
from hygrokf.data.structured import plain as plain_data
from validation.paper.cabinets import (
    INDIVIDUAL,
    era5_record,
    first_plant,
    local_drivers,
    local_record,
    sister_plant,
)
from validation.paper.models import (
    CRITERIA,
    FREE_RUN,
    LIKELIHOOD,
    Identified,
    Simulation,
    identify_both,
    simulate,
)
from validation.paper.sites import Site, kelmarsh, la_haute_borne

DAY_S = 86400.0


STARTS = ("2018-07-15", "2014-07-15")
"""First days of the records in the UK and in France, UTC; the French one lies four years before the other."""


@dataclass(frozen=True)
class Plan:
    """What is run: days of each record, day on which the identification ends, starts of every fit."""

    days: float = 200.0
    until_day: float = 170.0
    starts: int = 4


@dataclass(frozen=True)
class Case:
    """A cabinet and its two records: with the local air, and with ERA5's."""

    site: Site
    plant: Plant
    local: Record
    era5: Record


def home(plan: Plan, folder: Path, seed: int) -> Case:
    """The cabinet at Kelmarsh."""
    site = kelmarsh(folder, STARTS[0], plan.days, seed)
    made = first_plant(site, local_drivers(site, plan.days, seed), seed)
    local = local_record(made, made.drivers.time[0] + plan.until_day * DAY_S)
    return Case(site, made, local, era5_record(local, site))


def sister(plan: Plan, folder: Path, seed: int, kin: Plant, outdoor: bool = False) -> Case:
    """Its sister at La Haute Borne; all of its record is scored."""
    site = la_haute_borne(folder, STARTS[1], plan.days)
    drivers = local_drivers(site, plan.days, seed + 10_000, outdoor)
    made = sister_plant(site, drivers, seed, kin.cabinet)
    local = local_record(made, None)
    return Case(site, made, local, era5_record(local, site))


SIMULATIONS = ("local", "era5", "local_on_era5", "sister", "sister_own", "sister_outdoor")
"""local, era5: identified and run with that air. local_on_era5: identified with the local air, run with
ERA5's.  sister: the model `era5` on the sister with ERA5's air there.  sister_own: identified on the sister's
own record with ERA5's air.  sister_outdoor: as `sister`, but the cabinet's air is what the outdoor sensor of
the French nacelle measured."""


@dataclass(frozen=True)
class Outcome:
    """All that one seed gives; `runs` by name of SIMULATIONS and criterion."""

    seed: int
    home: Case
    sister: Case
    models: dict[str, Identified]
    runs: dict[tuple[str, str], Simulation]


def repeated(plan: Plan, folder: Path, seed: int) -> Outcome:
    """The three experiments with one seed."""
    first = home(plan, folder, seed)
    other = sister(plan, folder, seed, first.plant)
    outdoor = sister(plan, folder, seed, first.plant, outdoor=True)
    models = {}
    for name, record in (("local", first.local), ("era5", first.era5), ("sister_own", other.era5)):
        models[name] = identify_both(record, plan.starts)
    runs = {}
    for criterion in CRITERIA:
        for name, (model, record, own_sensors) in {
            "local": ("local", first.local, True),
            "era5": ("era5", first.era5, True),
            "local_on_era5": ("local", first.era5, True),
            "sister": ("era5", other.era5, False),
            "sister_own": ("sister_own", other.era5, True),
            "sister_outdoor": ("era5", outdoor.era5, False),
        }.items():
            found = models[model]
            values = found.values[criterion] if own_sensors else found.without_sensors(criterion)
            runs[name, criterion] = simulate(found.fit.design, values, record)
    return Outcome(seed, first, other, models, runs)


def plain(found: Outcome) -> dict:
    """The numbers of one seed as plain data."""
    truth, kin = found.home.plant.truth, found.sister.plant.truth
    return {
        "seed": found.seed,
        "truth": {
            "thermal_h": truth.tau_h,
            "hygric_h": _true_hygric_h(found, "local"),
            "sister_thermal_h": kin.tau_h,
            "sister_hygric_h": _true_hygric_h(found, "sister_own"),
            "sister_individual_ln": INDIVIDUAL,
            "disturbance_K": truth.heat.free_run_K,
            "disturbance_g_m3": 1e3 * truth.vapour.free_run_kg_m3,
            "sister_disturbance_K": kin.heat.free_run_K,
            "sister_disturbance_g_m3": 1e3 * kin.vapour.free_run_kg_m3,
            "sensor_errors": dict(truth.biases),
        },
        "local_air": local_air(found.home),
        "time_constants": {
            name: {
                part: _constant(entry) for part, entry in plain_data(one.fit.results.time_constants).items()
            }
            for name, one in found.models.items()
        },
        "sensor_errors": {
            name: {
                p: one.values[LIKELIHOOD][p]
                for p in sorted(one.without_sensors(LIKELIHOOD))
                if p.endswith("_bias")
            }
            for name, one in found.models.items()
        },
        "converged": {name: bool(one.fit.results.converged) for name, one in found.models.items()},
        "rmse": {
            name: {
                criterion: {"whole": found.runs[name, criterion].whole, **found.runs[name, criterion].periods}
                for criterion in CRITERIA
            }
            for name in SIMULATIONS
        },
    }


def _true_hygric_h(found: Outcome, model: str) -> float:
    """R_D* V* [h] that was put in, at the temperatures at which a model's estimate is stated."""
    at = found.models[model].fit.results.time_constants["hygric"].mean_temperatures
    assert at is not None
    case = found.sister if model == "sister_own" else found.home
    return case.plant.cabinet.hygric_h(at.cabinet_temperature_K, at.ambient_temperature_K)


def _constant(entry: dict | None) -> dict | None:
    if entry is None:
        return None
    keys = ("value_h", "lower_h", "upper_h")
    free = entry["simulation"]
    return {
        LIKELIHOOD: {key: entry[key] for key in keys},
        FREE_RUN: None if free is None else {key: free[key] for key in keys},
    }


def local_air(case: Case) -> dict[str, float]:
    """How far the simulated local air lies from ERA5's: standard deviations of temperature [K] and vapour
    [g/m3]."""
    drivers, site = case.plant.drivers, case.site
    kelvin = drivers.ambient_K - np.interp(drivers.time, site.hour_s, site.temperature_K)
    vapour = 1e3 * (drivers.ambient_kg_m3 - np.interp(drivers.time, site.hour_s, site.vapour_kg_m3))
    return {
        "temperature_mean_K": float(kelvin.mean()),
        "temperature_sd_K": float(kelvin.std()),
        "vapour_mean_g_m3": float(vapour.mean()),
        "vapour_sd_g_m3": float(vapour.std()),
    }
