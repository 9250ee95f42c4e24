"""Two coupled masses as a network of a user's own, simulated exactly by matrix exponentials."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import expm

import hygrokf

VALUES = {"inner": 0.5, "outer": 6.0, "share": 0.6, "warmth": 3.0, "wander": 0.3, "noise": 0.1}
STATES = ("air", "wall")
FIRST = ((18.0, 4.0), (16.0, 9.0))
"""Mean and variance of the states at the first instant [°C], [K²]."""


def network() -> hygrokf.Model:
    """Air that exchanges with the ambient and with a wall, and a heater in the air."""
    made = hygrokf.linear_network(
        "masses",
        [
            hygrokf.Parameter("inner", "h", 0.7, 0.01, 20.0, positive=True),
            hygrokf.Parameter("outer", "h", 5.0, 0.1, 200.0, positive=True),
            hygrokf.Parameter("share", "1", 0.5, 0.01, 0.99),
            hygrokf.Parameter("warmth", "K", 2.0, 0.01, 100.0, positive=True),
            hygrokf.Parameter("wander", "K/√h", 0.2, 1e-4, 10.0, positive=True, noise=True),
            hygrokf.Parameter("noise", "K", 0.2, 1e-4, 10.0, positive=True, noise=True),
        ],
        states=STATES,
        inputs=["ambient", "heater"],
        rates=lambda p, x, u: {
            "air": (
                p.share * (u.ambient - x.air) + (1.0 - p.share) * (x.wall - x.air) + p.warmth * u.heater
            ) / p.inner,
            "wall": (x.air - x.wall) / p.outer,
        },
        outputs={"read": lambda p, x, u: (x.air, p.noise * p.noise)},
        intensities=lambda p: {"air": 0.0, "wall": p.wander * p.wander},
        initial=lambda p, u: dict(zip(STATES, FIRST, strict=True)),
    )  # fmt: skip
    return hygrokf.compose([made], {"ambient": "mean", "heater": "mean"})


def matrices(v: Mapping[str, np.ndarray | float]) -> tuple[np.ndarray, np.ndarray]:
    """A (…, 2, 2) [1/h] and B (…, 2, 2), written out."""
    one = np.ones_like(np.asarray(v["inner"], dtype=float))
    inner, outer, share, warmth = (v[name] * one for name in ("inner", "outer", "share", "warmth"))
    a = np.stack([-1.0 / inner, (1.0 - share) / inner, 1.0 / outer, -1.0 / outer], axis=-1)
    b = np.stack([share / inner, warmth / inner, 0.0 * one, 0.0 * one], axis=-1)
    return a.reshape(*one.shape, 2, 2), b.reshape(*one.shape, 2, 2)


def discrete(v: Mapping[str, float], hours: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F, G and Q of a step [h] with held inputs, by exponentials (Van Loan 1978)."""
    a, b = matrices(v)
    both = expm(hours * np.block([[a, b], [np.zeros((2, 4))]]))
    noise = np.diag([0.0, v["wander"] ** 2])
    loan = expm(hours * np.block([[-a, noise], [np.zeros((2, 2)), a.T]]))
    return both[:2, :2], both[:2, 2:], loan[2:, 2:].T @ loan[:2, 2:]


def inputs(time_h: np.ndarray, random: np.random.Generator) -> dict[str, np.ndarray]:
    """A daily course of the ambient, and a heater that switches every two hours."""
    switches = random.integers(0, 2, int(time_h[-1] // 2) + 1).astype(float)
    return {
        "ambient": 10.0 + 5.0 * np.sin(2 * np.pi * time_h / 24.0),
        "heater": switches[(time_h // 2).astype(int)],
    }


def simulated(
    time_h: np.ndarray, random: np.random.Generator, v: Mapping[str, float] = VALUES
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Inputs and readings (T,) at times (T,) [h], drawn from the model's exact law."""
    driven = inputs(time_h, random)
    mean, variance = np.array(FIRST).T
    x = mean + np.sqrt(variance) * random.normal(size=2)
    read = np.empty(len(time_h))
    lengths = np.diff(time_h, prepend=time_h[0]).round(9).tolist()
    steps = {hours: discrete(v, hours) for hours in set(lengths)}
    for k, hours in enumerate(lengths):
        if hours > 0.0:
            f, g, q = steps[hours]
            x = f @ x + g @ np.array([driven["ambient"][k], driven["heater"][k]])
            x = x + np.linalg.cholesky(q + 1e-18 * np.eye(2)) @ random.normal(size=2)
        read[k] = x[0] + v["noise"] * random.normal()
    return driven, read


def likelihood(time_h: np.ndarray, driven: Mapping[str, np.ndarray], read: np.ndarray) -> hygrokf.Likelihood:
    """The likelihood of readings (T,), NaN where there is none."""
    model = network()
    return hygrokf.Likelihood(model, hygrokf.timeline(model, time_h, driven, {"read": read}))


def joint(
    time_h: np.ndarray, driven: Mapping[str, np.ndarray], v: Mapping[str, float] = VALUES
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (2 T,) and covariance (2 T, 2 T) of the states at all instants, by dense algebra."""
    count = len(time_h)
    mean, covariance = np.zeros(2 * count), np.zeros((2 * count, 2 * count))
    at, spread = np.array(FIRST).T[0], np.diag(np.array(FIRST).T[1])
    for k, hours in enumerate(np.diff(time_h, prepend=time_h[0])):
        own = slice(2 * k, 2 * k + 2)
        if hours > 0.0:
            f, g, q = discrete(v, hours)
            at, spread = f @ at + g @ np.array([one[k] for one in driven.values()]), f @ spread @ f.T + q
            covariance[own, : 2 * k] = f @ covariance[2 * k - 2 : 2 * k, : 2 * k]
            covariance[: 2 * k, own] = covariance[own, : 2 * k].T
        mean[own], covariance[own, own] = at, spread
    return mean, covariance
