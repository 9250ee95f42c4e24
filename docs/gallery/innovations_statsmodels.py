"""
Test the innovations with statsmodels
=====================================

If a model describes its record, the standardized innovations of the filter are white: each one-step
prediction uses all that the readings before it can tell. `innovations(…).tests()` judges them; they are
plain arrays, so any other package can test them too.
"""

import matplotlib.pyplot as plt
import numpy as np
from statsmodels.graphics.tsaplots import plot_acf
from statsmodels.stats.diagnostic import acorr_ljungbox

import hygrokf

random = np.random.default_rng(3)
time = np.arange(0.0, 400.0, 0.25)
ambient = 10.0 + 5.0 * np.sin(2 * np.pi * time / 24.0)
heat = np.repeat(random.integers(0, 2, len(time) // 32 + 1), 32)[: len(time)] * 6.0
inside, wall, readings = 12.0, 12.0, []
for k in range(len(time)):  # a room and its wall: two time constants
    for _ in range(10):
        inside += 0.025 * ((wall - inside) / 0.6 + (ambient[k] - inside) / 3.0 + heat[k] / 3.0)
        wall += 0.025 * (inside - wall) / 4.0 + np.sqrt(0.025) * 0.05 * random.normal()
    readings.append(inside + 0.05 * random.normal())


def positive(name: str, unit: str, start: float, noise: bool = False) -> hygrokf.Parameter:
    """A parameter that is estimated as a logarithm."""
    return hygrokf.Parameter(name, unit, start, start / 1e3, start * 1e3, positive=True, noise=noise)


shared = [positive("tau", "h", 3.0), positive("read_sd", "K", 0.1, True), positive("sd", "K/√h", 0.1, True)]
one = hygrokf.linear_network(
    "room", shared, ["inside"], ["ambient", "heat"],
    rates=lambda p, x, u: {"inside": (u.ambient + u.heat - x.inside) / p.tau},
    outputs={"read": lambda p, x, u: (x.inside, p.read_sd**2)},
    intensities=lambda p: {"inside": p.sd**2},
    initial=lambda p, u: {"inside": (12.0, 4.0)},
)  # fmt: skip
two = hygrokf.linear_network(
    "room and wall", [*shared, positive("fast", "h", 1.0), positive("slow", "h", 5.0)],
    ["inside", "wall"], ["ambient", "heat"],
    rates=lambda p, x, u: {
        "inside": (x.wall - x.inside) / p.fast + (u.ambient + u.heat - x.inside) / p.tau,
        "wall": (x.inside - x.wall) / p.slow,
    },
    outputs={"read": lambda p, x, u: (x.inside, p.read_sd**2)},
    intensities=lambda p: {"inside": 0.0, "wall": p.sd**2},
    initial=lambda p, u: {"inside": (12.0, 4.0), "wall": (12.0, 4.0)},
)  # fmt: skip

# %%
# Both models see the same readings; only the second has the wall.

innovations = {}
for network in (one, two):
    model = hygrokf.compose([network], dict.fromkeys(("ambient", "heat"), "mean"))
    made = hygrokf.timeline(model, time, {"ambient": ambient, "heat": heat}, {"read": np.array(readings)})
    likelihood = hygrokf.Likelihood(model, made)
    estimate = hygrokf.fit_mle(likelihood, count=2)
    found = hygrokf.innovations(likelihood, estimate)
    innovations[network.name] = found.standardised["read"][40:]
    print(f"{network.name}: log-likelihood {estimate.loglik:.1f}; {found.tests().statements[0]}")
    print(acorr_ljungbox(innovations[network.name], lags=[10, 40]), "\n")

figure, axes = plt.subplots(1, 2, sharey=True, figsize=(9, 3.6))
for axis, (name, error) in zip(axes, innovations.items(), strict=True):
    p = float(acorr_ljungbox(error, lags=[40])["lb_pvalue"].iloc[0])
    plot_acf(error, axis, lags=40, zero=False, title=f"{name}: Ljung–Box p = {p:.2g}")
    axis.set_xlabel("lag [¼ h]")
axes[0].set_ylabel("autocorrelation of the innovations")
axes[0].set_ylim(-0.35, 0.55)
figure.tight_layout()
