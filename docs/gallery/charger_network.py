"""
The cabinet of an EV charger, composed of mechanisms
====================================================

The parts are not bound to wind turbines. A charger's cabinet is a network of power electronics and
enclosure; a fan that starts above 45 °C and the sun on its roof are mechanisms of their own that
contribute to named sums of the network.
"""

import matplotlib.pyplot as plt
import numpy as np

import hygrokf


def positive(name: str, unit: str, start: float, noise: bool = False) -> hygrokf.Parameter:
    """A parameter that is estimated as a logarithm."""
    return hygrokf.Parameter(name, unit, start, start / 1e3, start * 1e3, positive=True, noise=noise)


enclosure = hygrokf.Mechanism(
    name="enclosure",
    parameters=(
        positive("electronics_h", "h", 0.3), positive("enclosure_h", "h", 1.0), positive("loss_K", "K", 10.0),
        positive("read_sd", "K", 0.2, True), positive("sd", "K/√h", 0.3, True),
    ),
    states=("electronics", "air"),
    inputs=("ambient", "charging"),
    drift=lambda p, x, u, q, s: {
        "electronics": (x.air - x.electronics + p.loss_K * u.charging) / p.electronics_h,
        "air": (0.4 * (x.electronics - x.air) + u.ambient - x.air + s.enclosure_heat) / p.enclosure_h,
    },
    diffusion=lambda p: {"electronics": 0.0, "air": p.sd**2},
    initial=lambda p, u: {"electronics": (20.0, 25.0), "air": (20.0, 25.0)},
    outputs={
        "electronics_reading": lambda p, x, u, q, s: (x.electronics, p.read_sd**2),
        "air_reading": lambda p, x, u, q, s: (x.air, p.read_sd**2),
    },
    contributions=lambda p, x, u, q: {"enclosure_heat": 0.0},
)  # fmt: skip
fan = hygrokf.Mechanism(
    name="fan",
    parameters=(hygrokf.Parameter("fan_gain", "1", 0.5, 0.0, 50.0, null=0.0),),
    inputs=("fan_on", "ambient"),
    contributions=lambda p, x, u, q: {"enclosure_heat": -p.fan_gain * u.fan_on * (x.air - u.ambient)},
)
roof = hygrokf.Mechanism(
    name="roof",
    parameters=(hygrokf.Parameter("roof_gain", "K/(kW/m²)", 1.0, -50.0, 100.0, null=0.0),),
    inputs=("sun",),
    contributions=lambda p, x, u, q: {"enclosure_heat": p.roof_gain * u.sun},
)
holds = {"ambient": "linear", "sun": "linear", "charging": "mean", "fan_on": "mean"}
model = hygrokf.compose([enclosure, fan, roof], holds)

# %%
# Four summer days at a motorway, simulated here by explicit steps of 6 s.

random = np.random.default_rng(11)
time = np.arange(0.0, 96.0, 1 / 12)
ambient = 21.0 + 6.0 * np.sin(2 * np.pi * (time - 9.0) / 24.0)
sun = np.clip(0.85 * np.sin(2 * np.pi * (time - 6.0) / 24.0), 0.0, None)
busy = random.uniform(size=len(time) // 6) < 0.15 + 0.35 * (np.abs((time[::6] % 24) - 14.0) < 6.0)
charging = np.repeat(busy * random.uniform(0.4, 1.0, len(busy)), 6)
electronics, air, fan_on, rows = 20.0, 20.0, 0.0, []
for k in range(len(time)):
    for _ in range(50):
        step = 1 / 600
        heat = 9.0 * sun[k] - 2.5 * fan_on * (air - ambient[k])
        electronics += step * (air - electronics + 32.0 * charging[k]) / 0.25
        air += step * (0.4 * (electronics - air) + ambient[k] - air + heat) / 0.8
        air += np.sqrt(step) * 0.25 * random.normal()
    rows.append((fan_on, electronics + 0.15 * random.normal(), air + 0.15 * random.normal()))
    fan_on = float(electronics > (40.0 if fan_on else 45.0))
fans, hot, warm = np.array(rows).T

inputs = {"ambient": ambient, "sun": sun, "charging": charging, "fan_on": fans}
made = hygrokf.timeline(model, time, inputs, {"electronics_reading": hot, "air_reading": warm})
likelihood = hygrokf.Likelihood(model, made)
estimate = hygrokf.fit_mle(likelihood, count=2)
bounds = hygrokf.confidence_intervals(likelihood, estimate, method="wald")
truth = {"electronics_h": 0.25, "enclosure_h": 0.8, "loss_K": 32.0, "fan_gain": 2.5, "roof_gain": 9.0}
for name, true in truth.items():
    found, one = estimate.values[name], bounds[name]
    print(f"{name:14} {found:6.2f} ({one.lower:.2f} … {one.upper:.2f}), made with {true}")

smoothed = hygrokf.smooth(likelihood, estimate)
figure, axes = plt.subplots(2, sharex=True, figsize=(9, 5.4), height_ratios=(3, 1))
for place, (reading, label) in enumerate(((hot, "electronics"), (warm, "air"))):
    colour = ("C1", "C0")[place]
    axes[0].plot(time, reading, ".", color=colour, markersize=2, alpha=0.5)
    axes[0].plot(
        time, smoothed.value[label], color=colour, linewidth=1.1, label=f"{label}: readings and smoothed"
    )
axes[0].plot(time, ambient, color="C2", linewidth=1.0, label="ambient")
axes[0].axhline(45.0, color="0.4", linewidth=0.8, linestyle=":")
axes[0].set_ylabel("temperature [°C]")
axes[0].legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
axes[1].fill_between(time, charging, step="pre", color="0.6", linewidth=0, label="charging power [1]")
axes[1].fill_between(time, -0.25 * fans, step="pre", color="C0", linewidth=0, label="fan on")
axes[1].set_xlabel("time [h]")
axes[1].set_xlim(0, 96)
axes[1].set_ylim(-0.3, 1.05)
axes[1].legend(ncols=2, loc="lower left", bbox_to_anchor=(0, 0.96))
figure.tight_layout()
