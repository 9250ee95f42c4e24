"""
A cause of your own
===================

`discover` compares the simulation with the readings and tries physical causes for what is left. A cause
is one object: a mechanism, and sentences for the reader. The auxiliary transformer beside this synthetic
cabinet warms it.
"""

import tempfile
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import hygrokf
from hygrokf.data.record import Series

turbine = hygrokf.synthetic_turbine(seed=4, days=20)
plain = hygrokf.read_case(hygrokf.write_case(turbine, tempfile.mkdtemp()))
cabinet = plain["cabinet_temperature"]
random = np.random.default_rng(5)
minute = np.arange(plain.start_s, plain.end_s + 60.0, 60.0)
turns = np.cumsum(random.exponential(5 * 3600.0, 2000)) + minute[0]
consumption = np.where(np.searchsorted(turns, minute) % 2 > 0, 22e3, 6e3)
warmer = np.zeros(len(minute))
for k in range(1, len(minute)):  # 5 K at 20 kW, through the cabinet's lag of 1.5 h
    warmer[k] = warmer[k - 1] + (5.0 * (consumption[k] / 20e3) ** 2 - warmer[k - 1]) / 90.0
warm = replace(cabinet, value=cabinet.value + np.interp(cabinet.time, minute, warmer))
tens = consumption[: len(minute) // 10 * 10].reshape(-1, 10).mean(axis=1)
logged = Series("auxiliary_power", minute[0] + 600.0 * np.arange(1, len(tens) + 1), tens,
                hold="mean", interval_s=600.0, source="scada.csv")  # fmt: skip
kept = ("active_power", "ambient_temperature", "preheating")
record = replace(plain, series=(*(s for s in plain.series if s.signal in kept), warm, logged))


def transformer_heat() -> hygrokf.Mechanism:
    """Losses of the auxiliary transformer: f += a S², a [K], S own consumption in units of 20 kW."""
    gain = hygrokf.Parameter("transformer_gain", "K", 1.0, 1e-3, 60.0, positive=True, null=0.0,
                             meaning="heat release at an own consumption of 20 kW")  # fmt: skip
    return hygrokf.Mechanism(
        name="transformer_heat",
        parameters=(gain,),
        inputs=("auxiliary_power",),
        contributions=lambda p, x, u, q: {
            "heat_release": p.transformer_gain * (u.auxiliary_power / 20e3) ** 2
        },
    )


transformer = hygrokf.cause_of(
    "transformer_heat",
    thermal=transformer_heat,
    meaning="the auxiliary transformer beside the cabinet warms it",
    remedy="ventilate the transformer's room, or move the air inlet of the cabinet",
    separate_by="a temperature sensor between transformer and cabinet",
)

# %%
# It competes with causes of the package's library.

library = hygrokf.load_library().only("wall_thermal_mass").with_causes(transformer)
found = hygrokf.discover(record, library=library)
print(found)
(cause,) = found.results.causes
estimate = cause.parameters["transformer_gain"]
print(f"{estimate.value:.2f} K ({estimate.lower:.2f} … {estimate.upper:.2f}), made with 5 K")

figure, axis = plt.subplots(figsize=(9, 4))
for fit, label, colour in ((found.base, "base model", "C3"), (found.extended, f"with {cause.cause}", "C0")):
    run = hygrokf.simulate(fit, record)
    error = run.value["cabinet_temperature"] - run.reading["cabinet_temperature"]
    there = np.isfinite(error)
    rms = np.sqrt(np.mean(error[there] ** 2))
    day, label = run.time_h[there] / 24.0, f"{label}: {rms:.2f} K rms"
    axis.plot(day, error[there], color=colour, linewidth=0.9, label=label)
axis.axhline(0.0, color="0.5", linewidth=0.8)
axis.set_xlabel("day of the record")
axis.set_ylabel("free run less reading [K]")
bounds = f"{estimate.lower:.1f} … {estimate.upper:.1f} K"
axis.set_title(f"{cause.cause}: {estimate.value:.1f} K ({bounds}) at 20 kW, made with 5 K")
axis.set_xlim(0, 20)
axis.legend(ncols=2, loc="upper left", bbox_to_anchor=(0, -0.14))
figure.tight_layout()
