"""
Profile of a pair of parameters
===============================

Bounds of single parameters hide how two of them trade off. Here the log-likelihood is profiled over a
grid of the time constant and the heat release of a cabinet: at each point the noise parameters are
estimated again. The joint region at 95 % reaches beyond the bounds of each parameter alone.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

import hygrokf

random = np.random.default_rng(5)
time = np.arange(0.0, 72.0, 0.25)
ambient = 10.0 + 4.0 * np.sin(2 * np.pi * time / 24.0)
power = np.repeat(random.uniform(0.0, 1.0, 24), 12)[: len(time)]
inside, readings = 14.0, []
for k in range(len(time)):  # time constant 3 h, release 8 K at full power
    inside += (1 - np.exp(-0.25 / 3.0)) * (ambient[k] + 8.0 * power[k] - inside) + 0.15 * random.normal()
    readings.append(inside + 0.1 * random.normal())

cabinet = hygrokf.linear_network(
    "cabinet",
    [
        hygrokf.Parameter("tau", "h", 2.0, 0.1, 50.0, positive=True),
        hygrokf.Parameter("release", "K", 5.0, 0.1, 50.0, positive=True),
        hygrokf.Parameter("read_sd", "K", 0.1, 1e-3, 10.0, positive=True, noise=True),
        hygrokf.Parameter("sd", "K/√h", 0.3, 1e-3, 10.0, positive=True, noise=True),
    ],
    states=["inside"],
    inputs=["ambient", "power"],
    rates=lambda p, x, u: {"inside": (u.ambient + p.release * u.power - x.inside) / p.tau},
    outputs={"read": lambda p, x, u: (x.inside, p.read_sd**2)},
    intensities=lambda p: {"inside": p.sd**2},
    initial=lambda p, u: {"inside": (14.0, 4.0)},
)
model = hygrokf.compose([cabinet], {"ambient": "linear", "power": "mean"})
made = hygrokf.timeline(model, time, {"ambient": ambient, "power": power}, {"read": np.array(readings)})
likelihood = hygrokf.Likelihood(model, made)

# %%
# The maximum, with bounds of each parameter alone.

best = hygrokf.fit_mle(likelihood, count=2)
bounds = hygrokf.confidence_intervals(likelihood, best, ["tau", "release"])
for name, one in bounds.items():
    print(f"{name}: {best.values[name]:.2f} ({one.lower:.2f} … {one.upper:.2f})")

# %%
# Then the pair: hold both, maximise the rest.

tau = np.linspace(0.78, 1.32, 15) * best.values["tau"]
release = np.linspace(0.88, 1.14, 15) * best.values["release"]
drop = np.array(
    [
        [
            best.loglik
            - hygrokf.fit_mle(likelihood, best.values, fixed={"tau": a, "release": b}, count=1).loglik
            for a in tau
        ]
        for b in release
    ]
)

figure, axis = plt.subplots(figsize=(7, 5))
filled = axis.contourf(tau, release, np.minimum(drop, 12.0), levels=np.linspace(0, 12, 13), cmap="Blues_r")
lines = axis.contour(tau, release, drop, levels=[chi2.ppf(q, 2) / 2 for q in (0.5, 0.95)], colors="C1")
axis.clabel(lines, fmt=dict(zip(lines.levels, ("50 %", "95 %"), strict=True)))
axis.plot(best.values["tau"], best.values["release"], "o", color="C1", label="maximum")
axis.plot(3.0, 8.0, "k+", markersize=11, markeredgewidth=2, label="truth")
for name, draw in (("tau", axis.axvline), ("release", axis.axhline)):
    for end in (bounds[name].lower, bounds[name].upper):
        draw(end, color="0.35", linewidth=0.8, linestyle=":")
axis.set_xlabel("time constant [h]")
axis.set_ylabel("heat release at full power [K]")
axis.set_title("Joint regions, and the bounds of each parameter alone (dotted)")
axis.legend(loc="upper right")
figure.colorbar(filled, label="drop of the log-likelihood")
figure.tight_layout()
