"""Variants of the causes that bring vapour into the cabinet air, take it out, or store it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.cause import Variant, at_setting, needs_humidity
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.grids import SETTLING_DAYS, best_date, best_hours, best_switch, readings_of
from hygrokf.discovery.scan import Probe, abrupt
from hygrokf.discovery.submodel import HYGRIC, THERMAL

HEAVY_MM_H = 1.0
"""[mm/h] of rain that counts as heavy."""
USUAL_EXCHANGE_H = 3.0
"""[h] time constant of the vapour exchange beyond which films and driers are looked for at lower rates."""


@needs_humidity
def sorption(baseline: Baseline) -> list[Variant]:
    found = []
    for uptake, activated in (("uptake faster when warm", True), ("uptake alike at all temperatures", False)):
        thin, slab = (
            Variant(
                "moisture_sorption", f"{material}, {uptake}",
                {HYGRIC: (("moisture_sorption", {"activated": activated, "slab": material == "slab"}),)},
                searched=4,
            )
            for material in ("thin", "slab")
        )  # fmt: skip
        starts = tuple({"sorption_capacity": 0.5, "sorption_time": time} for time in (3.0, 15.0, 60.0))
        # in its first hours a slab takes up water like thin material with a fifth of its capacity and a
        # shorter time constant
        slab = replace(slab, scaled={"sorption_capacity": 5.0, "sorption_time": 18.0})
        found.append(replace(thin, starts=starts, finer=slab))
    return found


def _pace(baseline: Baseline) -> float:
    """Factor of the start rates: in a tight cabinet, whose own exchange is slow, slow rates matter."""
    return min(1.0, USUAL_EXCHANGE_H / baseline.submodels[HYGRIC].values["hygric_k"])


@needs_humidity
def condensation(baseline: Baseline) -> list[Variant]:
    pace = _pace(baseline)

    def starts(*undercooling: float) -> tuple[Settings, ...]:
        # with a film that is there or not, the likelihood has many maxima
        return tuple(
            {
                "condensation_rate": rate * pace,
                "surface_time": time,
                "surface_share": 0.03,
                "surface_undercooling": below,
            }
            for rate in (0.2, 0.7, 2.5)
            for time in (1.0, 4.0, 9.0, 20.0)
            for below in undercooling
        )

    forms = [("heavy surface", False, starts(0.3, 1.0))]
    if baseline.record.site is not None:
        forms.append(("skin under the night sky", True, starts(1.5, 4.0)))
    return [
        Variant(
            "condensation", form, {HYGRIC: (("condensation", {"sky": sky}),)},
            {"night_sky": {}} if sky else {},
            starts=first, searched=len(forms),
        )
        for form, sky, first in forms
    ]  # fmt: skip


@needs_humidity
def rain(baseline: Baseline) -> list[Variant]:
    if "rain" not in baseline.record:
        return []
    series = baseline.record["rain"]
    step_s = series.interval_s if series.interval_s > 0 else float(np.median(np.diff(series.time)))
    above = HEAVY_MM_H * step_s / 3600.0
    starts = tuple({"rain_intake": 0.5, "rain_drying_time": t} for t in (2.0, 12.0))
    return [
        Variant(
            "rain_ingress", form, {HYGRIC: (("rain_ingress", {"flag": flag}),)}, features, starts, settings, 2
        )
        for form, flag, features, settings in (
            ("all rain", "rain", {}, {}),
            ("heavy rain", "heavy_rain", {"heavy_rain": {"above": above}}, {"above": above}),
        )
    ]  # fmt: skip


@needs_humidity
def source(baseline: Baseline) -> list[Variant]:
    start = ({"moisture_source": 0.02}, {"moisture_source": 0.3}, {"moisture_source": 2.0})

    def variant(form: str, when: str, setting: Settings | None = None, searched: float = 3.0) -> Variant:
        features = {} if when == "always" else {when: setting or {}}
        additions = {HYGRIC: (("internal_moisture_source", {"when": when}),)}
        return Variant("internal_moisture_source", form, additions, features, start, setting or {}, searched)

    rates = tuple({"evaporation_rate": rate * _pace(baseline)} for rate in (0.02, 0.2, 2.0))
    found = [
        variant("always", "always"),
        Variant(
            "internal_moisture_source", "from a wet surface", {HYGRIC: (("wet_surface", {}),)}, starts=rates,
            searched=3,
        ),
    ]  # fmt: skip
    if "active_power" in baseline.record:
        found.append(variant("at standstill", "standstill"))

    def probe(when: str) -> list[Probe]:
        mechanism = ("internal_moisture_source", {"when": when})
        return [Probe(HYGRIC, mechanism, "moisture_source", {"moisture_source": 1e-4})]

    # where the air is exchanged fast, vapour jumps when the source begins: with a date that is an hour off
    # nothing is gained
    jumps = abrupt(baseline.submodels[HYGRIC])
    date = best_date(baseline, "fading", probe("fading"), jumps, days=SETTLING_DAYS, sudden=True)
    found.append(variant("drying out from a date on", "fading", *date))
    hours = best_hours(baseline, probe("scheduled"), "scheduled")
    form = "by the clock, on workdays" if hours[0]["workdays"] else "by the clock, every day"
    found.append(variant(form, "scheduled", *hours))
    return found


@needs_humidity
def drier(baseline: Baseline) -> list[Variant]:
    if "cabinet_relative_humidity" not in baseline.record:
        return []
    levels = np.quantile(readings_of(baseline, "cabinet_relative_humidity"), np.linspace(0.3, 0.95, 9))
    starts = tuple(
        {"dehumidifier_rate": _pace(baseline), "dehumidifier_setpoint": float(a)} for a in levels[[1, 4, 7]]
    )
    found = [Variant("dehumidifier", "proportional", {HYGRIC: (("dehumidifier", {}),)}, starts=starts)]
    grid = [{"on": float(a), "off": float(a - width)} for a in levels for width in (0.03, 0.08)]
    # the rate is positive and estimated as a logarithm: its slope at a small value stands for that at zero
    probe = Probe(HYGRIC, ("switched_drying", {}), "drying_rate", {"drying_rate": 1e-4})
    switched = best_switch(baseline, "drying", [probe], grid, {"": 0.02})
    if switched is None:
        return found
    for form, plate, heats in (
        ("two-point, cold plate", True, False),
        ("two-point, desiccant", False, False),
        ("two-point, cold plate, heats the air", True, True),
    ):
        additions = {HYGRIC: (("switched_drying", {"plate": plate}),)}
        if heats:
            additions[THERMAL] = (("drying_heat", {}),)
        rates = ({"drying_rate": 0.02}, {"drying_rate": 0.2})
        found.append(at_setting("dehumidifier", form, additions, "drying", switched, rates, joint=heats))
    return found
