"""Parameters: the name of a number, its range, and the coordinate in which it is estimated.

Structure (a `Parameter`), numbers (a mapping name -> value) and the set of fixed parameters are kept apart.
Estimation moves in the coordinate z: z = ln θ for positive parameters, z = θ otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.errors import unknown_names

LIFT = 20.0
"""Factor by which a lifted guard widens a search range: a positive parameter's limits are divided and
multiplied by it, any other range is scaled about its middle."""
AT_LIMIT = 1e-6
"""[1] share of a search range within which a value counts as being at a limit."""


@dataclass(frozen=True)
class Prior:
    """A normal prior of one parameter, knowledge from outside the record: θ ~ N(mean, sd²).

    mean, sd: in the parameter's unit; sd above 0.
    logarithmic: whether the prior applies to ln θ; `mean` and `sd` then describe ln θ.

    Raises ValueError where a number is not finite or `sd` is not above 0.
    """

    mean: float
    sd: float
    logarithmic: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and math.isfinite(self.sd) and self.sd > 0.0):
            raise ValueError(
                f"prior: expected a finite mean and a standard deviation above 0, found {self.mean} and "
                f"{self.sd}; to hold a parameter at a value, give it in `fixed`"
            )

    def log_density(self, value: float) -> float:
        return -0.5 * self._distance(value) ** 2 - math.log(self.sd * math.sqrt(2 * math.pi))

    def log_density_derivative(self, value: float) -> float:
        """Derivative of the log density with respect to the value [1/unit]."""
        return -self._distance(value) * self._rate(value)

    def information(self, value: float) -> float:
        """Expected information about the value [1/unit²], 1/sd²."""
        return self._rate(value) ** 2

    def in_unit(self) -> tuple[float, float]:
        """Mean and standard deviation in the parameter's unit; for a logarithmic prior the median and the
        first-order sd."""
        median = math.exp(self.mean) if self.logarithmic else self.mean
        return median, self.sd * (median if self.logarithmic else 1.0)

    def _distance(self, value: float) -> float:
        return ((math.log(value) if self.logarithmic else value) - self.mean) / self.sd

    def _rate(self, value: float) -> float:
        return 1.0 / (self.sd * value) if self.logarithmic else 1.0 / self.sd


@dataclass(frozen=True)
class Parameter:
    """One parameter: name, unit, start value, bounds, coordinate, prior, meaning.

    name: identifier, unique in a model.
    unit: of its values, limits and start, such as "h", "K" or "1".
    start, lower, upper: where the search starts and its limits, in `unit`.
    positive: whether it is estimated as a logarithm; its lower limit must then be above zero.
    prior: prior knowledge of its value, or None.
    null: the value, in `unit`, at which its mechanism has no effect; None where there is no such value.
    noise: whether it belongs to a disturbance or a sensor; the estimation varies the start values of these.
    meaning: what it is, in words.
    physical: the physically possible range, in `unit`.  A search limit (`lower` or `upper`) inside this range
        is a guard against meaningless numbers, which the profile of another parameter may pass (see
        `profile_likelihood.profile`).
    """

    name: str
    unit: str
    start: float
    lower: float
    upper: float
    positive: bool = False
    prior: Prior | None = None
    null: float | None = None
    noise: bool = False
    meaning: str = ""
    physical: tuple[float, float] = (-math.inf, math.inf)

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"{self.name}: expected lower < upper, found {self.lower} and {self.upper}")
        if not self.lower <= self.start <= self.upper:
            raise ValueError(
                f"{self.name}: expected a start within {self.lower} … {self.upper}, found {self.start}"
            )
        if not self.physical[0] <= self.lower or not self.upper <= self.physical[1]:
            raise ValueError(
                f"{self.name}: expected search limits within the physical range, {self.physical[0]} … "
                f"{self.physical[1]}, found {self.lower} … {self.upper}"
            )
        if self.prior is not None and self.prior.logarithmic and not self.positive:
            raise ValueError(f"{self.name}: a prior of its logarithm needs a positive parameter")
        if self.positive and self.lower <= 0:
            raise ValueError(
                f"{self.name}: a positive parameter needs a lower bound above 0, found {self.lower}"
            )

    def to_coordinate(self, value: float) -> float:
        return math.log(value) if self.positive else value

    def from_coordinate(self, z: float) -> float:
        return math.exp(z) if self.positive else z

    def is_stopped_by_guard(self, value: float) -> bool:
        """Whether the search limit at which a value ended is a guard.

        Physical limits, the null value and the lower limit of a noise parameter are not guards.
        """
        not_guards = [*self.physical, *(() if self.null is None else (self.null,))]
        if self.noise and self.positive:
            not_guards.append(self.lower)
        return all(abs(value - limit) > AT_LIMIT * (self.upper - self.lower) for limit in not_guards)

    def slope(self, value: float) -> float:
        """dθ/dz at the value."""
        return value if self.positive else 1.0

    def lifted_limits(self) -> tuple[float, float]:
        """Search limits of the coordinate, widened by `LIFT` but not beyond the physical limits."""
        low, high = self.to_coordinate(self.lower), self.to_coordinate(self.upper)
        widening = math.log(LIFT) if self.positive else 0.5 * (LIFT - 1.0) * (high - low)
        lowest, highest = self.physical
        if self.positive:
            lowest = math.log(lowest) if lowest > 0 else -math.inf
            highest = math.log(highest)
        return max(low - widening, lowest), min(high + widening, highest)


class Coordinates:
    """The free parameters of an estimation, and the mapping between their values θ and coordinates z.

    `parameters` are all parameters of a model; `fixed` holds the values of those that are not estimated.
    """

    def __init__(self, parameters: Sequence[Parameter], fixed: Mapping[str, float] | None = None) -> None:
        self.parameters = tuple(parameters)
        self.fixed = dict(fixed or {})
        faults = unknown_names("fixed", self.fixed, [p.name for p in self.parameters])
        faults += [
            f"fixed: expected a finite {name}, found {value}"
            for name, value in self.fixed.items()
            if not math.isfinite(value)
        ]
        if faults:
            raise ValueError("; ".join(faults))
        self.free = tuple(p for p in self.parameters if p.name not in self.fixed)
        self.names = tuple(p.name for p in self.free)
        self.lower = np.array([p.to_coordinate(p.lower) for p in self.free])
        self.upper = np.array([p.to_coordinate(p.upper) for p in self.free])

    def start(self, values: Mapping[str, float] | None = None) -> np.ndarray:
        """Coordinates z (d,) of the given values, or of a parameter's start where none is given, clipped to
        the bounds."""
        given = values or {}
        z = [p.to_coordinate(min(max(given.get(p.name, p.start), p.lower), p.upper)) for p in self.free]
        return np.clip(np.array(z, dtype=float), self.lower, self.upper)

    def values(self, z: np.ndarray) -> dict[str, float]:
        """Values of all parameters, free and fixed, at z."""
        free = {p.name: p.from_coordinate(float(v)) for p, v in zip(self.free, z, strict=True)}
        return {p.name: free.get(p.name, self.fixed.get(p.name, math.nan)) for p in self.parameters}

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """dθ/dz (d,) of the free parameters."""
        return np.array([p.slope(p.from_coordinate(float(v))) for p, v in zip(self.free, z, strict=True)])

    def positions(self) -> np.ndarray:
        """Positions (d,) of the free parameters among all parameters."""
        index = {p.name: i for i, p in enumerate(self.parameters)}
        return np.array([index[name] for name in self.names], dtype=int)

    def directions(self, z: np.ndarray) -> np.ndarray:
        """Derivatives (all parameters, d) of the parameter values with respect to the coordinates z."""
        result = np.zeros((len(self.parameters), len(z)))
        result[self.positions(), np.arange(len(z))] = self.slopes(z)
        return result

    def parameter(self, name: str) -> Parameter:
        """The parameter with this name, free or fixed."""
        return next(p for p in self.parameters if p.name == name)

    def log_prior(self, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Log prior density, its gradient (d,) and minus its second derivative (d,) in z.

        The density is that of θ, without the Jacobian of z, so that the posterior mode maximises the
        penalised likelihood.
        """
        total, gradient, curvature = 0.0, np.zeros(len(self.free)), np.zeros(len(self.free))
        for i, (p, v) in enumerate(zip(self.free, z, strict=True)):
            if p.prior is not None:
                value = p.from_coordinate(float(v))
                slope = p.slope(value)
                total += p.prior.log_density(value)
                gradient[i] = p.prior.log_density_derivative(value) * slope
                curvature[i] = p.prior.information(value) * slope**2
        return total, gradient, curvature


def unique(parameters: Iterable[Parameter]) -> tuple[Parameter, ...]:
    """The parameters as a tuple; raises ValueError where two of them have the same name."""
    seen: dict[str, Parameter] = {}
    for p in parameters:
        if p.name in seen:
            raise ValueError(f"two mechanisms have a parameter named {p.name!r}: rename one of them")
        seen[p.name] = p
    return tuple(seen.values())


def expect_values(parameters: Iterable[Parameter], values: Mapping[str, float]) -> None:
    """Check that every parameter has a value; raises ValueError that names the parameters without one."""
    names = [p.name for p in parameters]
    missing = ", ".join(name for name in names if name not in values)
    if missing:
        faults = [f"values: expected a value of every parameter, found none of {missing}"]
        raise ValueError("; ".join(faults + unknown_names("values", values, names)))


def expect_starts(
    parameters: Sequence[Parameter], fixed: Mapping[str, float], starts: Mapping[str, Mapping[str, float]]
) -> None:
    """Check that start values have known names and lie within the limits.

    starts: name of the argument that gave the values → parameter → value.

    Raises ValueError that lists every fault.  Values of `fixed` parameters are not checked.
    """
    free, faults = {p.name: p for p in parameters if p.name not in fixed}, []
    for argument, given in starts.items():
        faults += unknown_names(argument, given, [p.name for p in parameters])
        faults += [
            f"{argument}: expected {name} within {free[name].lower:g} … {free[name].upper:g} "
            f"{free[name].unit}, found {value}; start within its limits, or widen them"
            for name, value in given.items()
            if name in free and not _inside(free[name], value)
        ]
    if faults:
        raise ValueError("; ".join(faults))


def within_limits(parameters: Iterable[Parameter], values: Mapping[str, float]) -> dict[str, float]:
    """Select the values of these parameters and clip them to the limits: start values from a fit of another
    record, whose limits may differ."""
    return {p.name: min(max(values[p.name], p.lower), p.upper) for p in parameters if p.name in values}


def _inside(p: Parameter, value: float) -> bool:
    """Whether a value lies within a parameter's limits, apart from the rounding of its coordinate."""
    slack = 1e-12 * max(abs(p.lower), abs(p.upper))
    return p.lower - slack <= value <= p.upper + slack
