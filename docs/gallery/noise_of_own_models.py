"""
Noise, first states and several records of an own model
=======================================================

Two rooms warm up under one sun, which neither logger sees: their process noises are correlated. The wind
makes the first room's noise larger. Two records of the same rooms, read by other loggers, are fitted
together. At the end a level whose noise grows with its root is read.
"""

import matplotlib.pyplot as plt
import numpy as np

import hygrokf


def positive(name, unit, start, noise=False):
    return hygrokf.Parameter(name, unit, start, start / 1e3, start * 1e3, positive=True, noise=noise)


# %%
# `intensities` gives a row of L in place of an intensity: loadings by the names of independent white noises.
# With a second argument it reads inputs. The first states share a source too, and their mean is estimated.

rooms = hygrokf.linear_network(
    "rooms",
    [
        positive("tau", "h", 5.0),
        positive("sun", "K/√h", 0.5, noise=True),
        positive("gust", "K/√h", 0.2, noise=True),
        positive("read_sd", "K", 0.1, noise=True),
        hygrokf.Parameter("begin", "K", 15.0, -50.0, 50.0),
        hygrokf.Parameter("offset", "K", 0.0, -5.0, 5.0),
    ],
    states=["south", "north"],
    inputs=["ambient", "wind"],
    rates=lambda p, x, u: {name: (u.ambient - getattr(x, name)) / p.tau for name in ("south", "north")},
    outputs={
        "south_read": lambda p, x, u: (x.south, p.read_sd**2),
        "north_read": lambda p, x, u: (x.north + p.offset, p.read_sd**2),
    },
    intensities=lambda p, u: {"south": {"sun": p.sun, "gusts": p.gust * u.wind}, "north": {"sun": p.sun}},
    initial=lambda p, u: {"south": (p.begin, {"night": 2.0}), "north": (p.begin, {"night": 1.0, "own": 0.5})},
)
model = hygrokf.compose([rooms], {"ambient": "linear", "wind": "linear"})


def record(seed, offset):
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 96.0, 0.25)
    ambient, wind = 10.0 + 4.0 * np.sin(time / 4.0), 1.0 + np.sin(time / 9.0) ** 2
    state, read = np.array([16.0, 15.5]), []
    for k in range(len(time)):
        for part in range(25):  # Euler steps of 0.01 h
            outside, gusty = (one[k - 1] + part / 25 * (one[k] - one[k - 1]) for one in (ambient, wind))
            sun, gust = 0.1 * random.normal(size=2)
            noise = np.array([0.6 * sun + 0.3 * gusty * gust, 0.6 * sun])
            state = state + (0.01 * (outside - state) / 8.0 + noise) * (k > 0)
        read.append(state + np.array([0.0, offset]) + 0.1 * random.normal(size=2))
    south, north = np.array(read).T
    line = hygrokf.timeline(
        model, time, {"ambient": ambient, "wind": wind}, {"south_read": south, "north_read": north}
    )
    return hygrokf.Likelihood(model, line)


# %%
# One likelihood of both records, each with an offset of its own.

joint = hygrokf.JointLikelihood([record(1, 0.4), record(2, -0.8)], own=["offset"])
found = hygrokf.fit_mle(joint, count=2)
for name, one in hygrokf.confidence_intervals(joint, found, method="wald").items():
    print(f"{name}: {found.values[name]:.2f} ({one.lower:.2f} … {one.upper:.2f})")

# %%
# dx = (2 − x)/τ dt + s √x dW, a Cox–Ingersoll–Ross process: `noise_exponents` gives the power of x. The
# filter runs in 2 √x, where the noise is constant; `smooth` leads back to x.

level = hygrokf.linear_network(
    "level",
    [positive("tau", "h", 2.0), positive("size", "1/√h", 0.5)],
    states=["x"],
    inputs=[],
    rates=lambda p, x, u: {"x": (2.0 - x.x) / p.tau},
    outputs={"read": lambda p, x, u: (x.x, 0.01)},
    intensities=lambda p: {"x": p.size**2},
    initial=lambda p, u: {"x": (2.0, 0.1)},
    noise_exponents={"x": 0.5},
)
random, x, course = np.random.default_rng(3), 2.0, []
for _ in range(400):
    for _ in range(50):  # Euler steps of 0.002 h
        x = max(x + 0.002 * (2.0 - x) + 0.6 * np.sqrt(0.002 * x) * random.normal(), 1e-9)
    course.append(x)
time = 0.1 * np.arange(400)
made = hygrokf.compose([level])
read = np.array(course) + 0.1 * random.normal(size=400)
likelihood = hygrokf.Likelihood(made, hygrokf.timeline(made, time, {}, {"read": read}))
best = hygrokf.fit_mle(likelihood, count=2)
level_given_all = hygrokf.smooth(likelihood, best)

figure, axis = plt.subplots(figsize=(8, 4))
low, high = level_given_all.bounds("x")
axis.fill_between(time, low, high, color="C0", alpha=0.3, label="smoothed, 95 %")
axis.plot(time, course, "k", linewidth=0.8, label="truth")
axis.plot(time, read, ".", color="C1", markersize=3, label="readings")
axis.set_xlabel("time [h]")
axis.set_ylabel("level [1]")
axis.set_title(f"τ = {best.values['tau']:.2f} h (1), s = {best.values['size']:.2f} (0.6)")
axis.legend()
figure.tight_layout()
