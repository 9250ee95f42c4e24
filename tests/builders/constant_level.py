"""Independent normal readings as a filter: a level that starts without variance and does not move."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.physics.expression import Value
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Space, compose
from hygrokf.physics.parameters import Parameter


def constant_level(
    parameters: Sequence[Parameter],
    read: np.ndarray,
    level: Callable[[Space], Value],
    variance: Callable[[Space], Value],
) -> Likelihood:
    """Readings (T,) an hour apart with the mean `level(p)` and the variance `variance(p)`."""
    constant = linear_network(
        "constant",
        parameters,
        ["x"],
        [],
        lambda p, x, u: {"x": 0.0 * x.x},
        {"y": lambda p, x, u: (x.x, variance(p))},
        lambda p: {"x": 0.0},
        lambda p, u: {"x": (level(p), 0.0)},
    )
    model = compose([constant])
    return Likelihood(model, timeline(model, np.arange(float(len(read))), {}, {"y": read}))
