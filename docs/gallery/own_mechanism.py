"""
A mechanism of your own
=======================

A mechanism is one piece of physics: parameters with a null value, inputs, and a contribution to a sum of
the model. The cabinet of this example stands on a floor that the sun warms; the record has the
irradiance, the base model ignores it.
"""

import tempfile
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import hygrokf
from hygrokf.data.record import Series
from hygrokf.modelling.design import design, extended

turbine = hygrokf.synthetic_turbine(seed=6, days=16)
plain = hygrokf.read_case(hygrokf.write_case(turbine, tempfile.mkdtemp()))
cabinet = plain["cabinet_temperature"]
hour = np.arange(plain.start_s, plain.end_s, 600.0)
sun = np.clip(900.0 * np.sin(2 * np.pi * (hour / 86400.0 - 0.25)), 0.0, None)
sun = sun * np.random.default_rng(2).uniform(0.2, 1.0, len(sun) // 144 + 1)[np.arange(len(sun)) // 144]
warmer = np.zeros(len(sun))  # 6 K at 1 kW/m², through the cabinet's own lag of 1.5 h
for k in range(1, len(sun)):
    warmer[k] = warmer[k - 1] + (6e-3 * sun[k] - warmer[k - 1]) / 9.0
warm = replace(cabinet, value=cabinet.value + np.interp(cabinet.time, hour, warmer))
irradiance = Series("global_horizontal_irradiance", hour, sun, hold="linear", source="pyranometer.csv")
others = (s for s in plain.series if s.signal not in (warm.signal, irradiance.signal))
record = replace(plain, series=(*others, warm, irradiance))


def floor_in_the_sun() -> hygrokf.Mechanism:
    """Heat of the sun: f += a G [K], a [K/(kW/m²)], G [W/m²]."""
    return hygrokf.Mechanism(
        name="floor_in_the_sun",
        parameters=(hygrokf.Parameter("floor_gain", "K/(kW/m²)", 1.0, -50.0, 50.0, null=0.0),),
        inputs=("global_horizontal_irradiance",),
        contributions=lambda p, x, u, q: {
            "heat_release": 1e-3 * p.floor_gain * u.global_horizontal_irradiance
        },
        meaning="heat of the sun on the floor",
    )


# %%
# Extend the model with it. At the null value the likelihood is that of the base model.

library = hygrokf.load_library().with_mechanisms(floor_in_the_sun)
base = design(record, kind="thermal", library=library)
made = hygrokf.model_inputs(base, record).timeline
likelihood = hygrokf.Likelihood(base.model, made)
before = hygrokf.fit_mle(likelihood, count=1)
wider = extended(base, [("floor_in_the_sun", {})])
wide = hygrokf.Likelihood(wider.model, hygrokf.model_inputs(wider, record).timeline)
assert np.isclose(wide.value({**before.values, "floor_gain": 0.0}), before.loglik)
after = hygrokf.fit_mle(wide, {**before.values, "floor_gain": 1.0}, count=1)
gain = hygrokf.confidence_intervals(wide, after, ["floor_gain"], "wald")["floor_gain"]
print(f"twice the gain of the log-likelihood: {2 * (after.loglik - before.loglik):.0f} (3.84 at 5 %)")
print(
    f"gain {after.values['floor_gain']:.1f} K ({gain.lower:.1f} … {gain.upper:.1f}) at 1 kW/m², made with 6 K"
)

figure, axes = plt.subplots(2, sharex=True, figsize=(9, 5), height_ratios=(3, 1))
for one, estimate, label, colour in (
    (likelihood, before, "base model", "C3"),
    (wide, after, "with the floor in the sun", "C0"),
):
    free_run = hygrokf.simulate(one, estimate)
    error = free_run.value["cabinet_temperature"] - free_run.reading["cabinet_temperature"]
    there = np.isfinite(error)
    rms = np.sqrt(np.mean(error[there] ** 2))
    days = free_run.time_h[there] / 24.0
    axes[0].plot(days, error[there], color=colour, linewidth=0.9, label=f"{label}: {rms:.2f} K rms")
axes[0].axhline(0.0, color="0.5", linewidth=0.8)
axes[0].set_ylabel("free run less reading [K]")
axes[0].legend(ncols=2, loc="lower left", bbox_to_anchor=(0, 1))
axes[1].fill_between((hour - made.origin_s) / 86400.0, sun, color="C2", alpha=0.5, linewidth=0)
axes[1].set_ylabel("sun [W/m²]")
axes[1].set_xlabel("day of the record")
axes[1].set_xlim(0, made.time[-1] / 24.0)
figure.tight_layout()
