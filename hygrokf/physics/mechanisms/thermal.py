"""The thermal network of the paper (Fig. 2), its heat release and its disturbances."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hygrokf.physics.expression import Given, Value, exp, log
from hygrokf.physics.mechanisms.effects import PAPER, ornstein_uhlenbeck, white_noise
from hygrokf.physics.model import Mechanism, Space, Values
from hygrokf.physics.parameters import Parameter, Prior


def thermal_network() -> Mechanism:
    """Converter mass between the cabinet air and the ambient: equations (2) and (3) of the paper.

    With τ = (R_AT+R_IC) C [h] and ρ = R_AT/(R_AT+R_IC) [1],
        dT_conv/dt = (T_amb − T_conv + f_ΔT/ρ)/τ,    T_conv,a = ρ T_conv + (1−ρ) T_amb,
    f_ΔT [K] the sum of all heat releases.  The data do not determine R_AT, R_IC and C individually.

    Where other mechanisms add conductances g in parallel to 1/R_AT, R_AT/(1+g) replaces R_AT. With
    e = 1 + (1−ρ) g:
        dT_conv/dt = ((T_amb − T_conv)(1+g)/e + f_ΔT/ρ)/τ,    T_conv,a = (ρ T_conv + (1−ρ)(1+g) T_amb)/e.
    """

    def denominator(p: Space, g: Value) -> Value:
        return 1.0 + (1.0 - p.resistance_ratio) * g

    def quantities(p: Space, x: Space, u: Space, g: Value) -> Values:
        ambient_weight = (1.0 - p.resistance_ratio) * (1.0 + g)
        air = p.resistance_ratio * x.converter_temperature + ambient_weight * u.ambient_temperature
        return {"cabinet_air_temperature": air / denominator(p, g)}

    def drift(p: Space, x: Space, u: Space, q: Space, s: Space) -> Values:
        ambient_drive = (u.ambient_temperature - x.converter_temperature) * (
            (1.0 + q.air_conductance) / denominator(p, q.air_conductance)
        )
        drive = ambient_drive + s.heat_release / p.resistance_ratio
        return {"converter_temperature": drive * (1.0 + s.thermal_pace) / p.thermal_time_constant}

    return Mechanism(
        name="thermal_network",
        parameters=(
            Parameter(
                "thermal_time_constant", "h", 2.0, 0.02, 200.0, positive=True,
                meaning="(R_AT+R_IC) C",
            ),
            Parameter(
                "resistance_ratio", "1", 0.9, 0.2, 1.0, physical=(0.0, 1.0),
                meaning="R_AT/(R_AT+R_IC); 1 where the air follows the converter mass alone",
            ),
        ),
        states=("converter_temperature",),
        inputs=("ambient_temperature",),
        quantities=quantities,
        drift=drift,
        initial=lambda p, u: {"converter_temperature": (u.ambient_temperature + 5.0, 25.0)},
        meaning="heat stored in the converter and lost to the ambient",
        source=f"{PAPER}, equations (2) and (3)",
    )  # fmt: skip


def measured_air(accuracy: float = 0.0, step: bool = False) -> Mechanism:
    """Measured cabinet air temperature (linear between readings) in place of a thermal model: the cascade.

    The sensor's `accuracy` [K] (95 %) is the prior of a constant error of these readings; 0 means no error.
    An error of 0.15 K changes the relative humidity by 1 %, and with it the exchange rate that explains the
    readings: bounds that ignore the error are too narrow.  `step` adds an error that begins at a date (input
    `after_step`).
    """
    errors = []
    if accuracy > 0:
        errors.append(
            Parameter(
                "cabinet_temperature_offset", "K", 0.0, -4 * accuracy, 4 * accuracy, null=0.0,
                prior=Prior(0.0, accuracy / 1.96),
                meaning="constant error of the cabinet temperature that the hygric part runs on",
            )
        )  # fmt: skip
    if step:
        errors.append(
            Parameter(
                "cabinet_temperature_step", "K", 0.0, -30.0, 30.0, null=0.0,
                meaning="error of the cabinet temperature that the hygric part runs on, from the date on",
            )
        )  # fmt: skip

    def quantities(p: Space, x: Space, u: Space, g: Value) -> Values:
        air = u.cabinet_temperature
        if accuracy > 0:
            air = air - p.cabinet_temperature_offset
        if step:
            air = air - p.cabinet_temperature_step * u.after_step
        return {"cabinet_air_temperature": air}

    return Mechanism(
        name="measured_air",
        parameters=tuple(errors),
        inputs=("cabinet_temperature", "ambient_temperature", *(("after_step",) if step else ())),
        quantities=quantities,
        settings={"accuracy": accuracy, "step": step},
        meaning="cabinet air temperature as an input",
    )


def heat_release(
    order: int = 2,
    ambient: bool = True,
    standstill_ambient: bool = True,
    operation: bool = True,
    standstill: bool = True,
    preheating: bool = False,
    reference_K: float = 283.15,
    gap_covariance: Sequence[Sequence[float]] | None = None,
    gap_time_h: float = 24.0,
    start: Mapping[str, float] | None = None,
) -> Mechanism:
    """Heat release by operating point, f_ΔT = Q R_AT [K]: a polynomial in operation, a line at standstill.

    In operation (P > 0), with p = P/P_rated:  a₀ + a₁ p + … + a_K p^K + a_T (T_amb − T_ref);
    at standstill (P ≤ 0):                     b₀ + b_T (T_amb − T_ref);
    known pre-heating adds `preheating_heat` times its duty.  Inputs are constant over each interval of the
    power. In long gaps of the power the features take their means, and a random heat release is added with
    the features' covariance `gap_covariance` (operating, p, …, p^K) and the correlation time `gap_time_h`
    [h].
    """
    starts = start or {}
    reference, gap_rate = Given(reference_K), Given(1.0 / gap_time_h)
    gap_matrix = [[Given(value) for value in row] for row in gap_covariance or ()]
    both_regimes = operation and standstill
    powers = [f"power_{k}" for k in range(1, order + 1)] if operation else []
    parameters = _release_parameters(
        powers, ambient, standstill_ambient, operation, standstill, preheating, starts
    )

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        ambient_excess = u.ambient_temperature - reference
        total = 0.0
        if operation:
            share = u.operating if both_regimes else 1.0
            active = p.heat_release_operation
            if ambient:
                active = active + p.heat_release_operation_ambient * ambient_excess
            total = total + share * active
            for name in powers:
                total = total + getattr(p, f"heat_release_{name}") * getattr(u, name)
        if standstill:
            idle = p.heat_release_standstill
            if standstill_ambient:
                idle = idle + p.heat_release_standstill_ambient * ambient_excess
            total = total + ((1.0 - u.operating) * idle if both_regimes else idle)
        if preheating:
            total = total + p.preheating_heat * u.preheating
        if gap_covariance is not None:
            total = total + u.power_unknown * x.unknown_heat
        return {"heat_release": total}

    def unknown_variance(p: Space) -> Value:
        step = p.heat_release_operation - p.heat_release_standstill if both_regimes else 0.0
        return _quadratic_form(gap_matrix, [step, *(getattr(p, f"heat_release_{name}") for name in powers)])

    has_gaps = gap_covariance is not None
    is_read = {"ambient_temperature": True, "operating": both_regimes, **dict.fromkeys(powers, True),
               "preheating": preheating, "power_unknown": has_gaps}  # fmt: skip
    return Mechanism(
        name="heat_release",
        parameters=parameters,
        states=("unknown_heat",) if has_gaps else (),
        inputs=tuple(name for name, is_needed in is_read.items() if is_needed),
        contributions=contributions,
        drift=(lambda p, x, u, q, s: {"unknown_heat": -(x.unknown_heat * gap_rate)}) if has_gaps else None,
        diffusion=(lambda p: {"unknown_heat": unknown_variance(p) * 2.0 * gap_rate}) if has_gaps else None,
        initial=(lambda p, u: {"unknown_heat": (0.0, unknown_variance(p))}) if has_gaps else None,
        settings={
            "order": order, "ambient": ambient, "standstill_ambient": standstill_ambient,
            "operation": operation, "standstill": standstill, "preheating": preheating,
            "reference_K": reference_K, "gap_time_h": gap_time_h,
            "gap_covariance": [list(map(float, row)) for row in gap_covariance or ()] if has_gaps else None,
            "start": dict(starts),
        },
        meaning="heat that the converter releases into the cabinet",
        source=f"{PAPER}, equation (1) and Fig. 4",
    )  # fmt: skip


def _quadratic_form(matrix: Sequence[Sequence[float]], vector: Sequence[Value]) -> Value:
    """v' M v of traced values."""
    total: Value = 0.0
    for row, a in zip(matrix, vector, strict=True):
        for value, b in zip(row, vector, strict=True):
            total = total + value * a * b
    return total


def _release_parameters(
    powers: Sequence[str],
    ambient: bool,
    standstill_ambient: bool,
    operation: bool,
    standstill: bool,
    preheating: bool,
    starts: Mapping[str, float],
) -> tuple[Parameter, ...]:
    """Parameters of `heat_release`; `starts` holds start values by name."""
    slope = ("K/K", 0.0, 2.0, "slope over the ambient temperature")
    rows: list[tuple[bool, str, str, float, float, str]] = [
        (operation, "heat_release_operation", "K", 3.0, 60.0, "heat release at zero power in operation"),
        *(
            (operation, f"heat_release_{name}", "K", 0.0, 200.0, f"coefficient of (P/P_rated)^{k}")
            for k, name in enumerate(powers, start=1)
        ),
        (operation and ambient, "heat_release_operation_ambient", *slope),
        (standstill, "heat_release_standstill", "K", 2.0, 60.0, "heat release at standstill"),
        (standstill and standstill_ambient, "heat_release_standstill_ambient", *slope),
        (preheating, "preheating_heat", "K", 5.0, 80.0, "heat release of the known pre-heating"),
    ]
    return tuple(
        Parameter(name, unit, starts.get(name, start), -bound, bound, null=0.0, meaning=meaning)
        for is_present, name, unit, start, bound, meaning in rows
        if is_present
    )


heat_disturbance = ornstein_uhlenbeck(
    "heat_disturbance", __name__, "heat_release", "K", (1.0, 1e-3, 50.0), 6.0,
    "coloured disturbance of the heat flow, as Q R_AT",
    "slowly wandering residuals; a time constant that is too long",
    "It represents sun, wind, doors, ventilation and other influences that the network leaves out, whose "
    "slow effect would otherwise be attributed to the cabinet's own time constant.",
)  # fmt: skip
second_heat_disturbance = ornstein_uhlenbeck(
    "second_heat_disturbance", __name__, "heat_release", "K", (0.3, 1e-3, 50.0), 1.0,
    "second coloured disturbance of the heat flow, as Q R_AT",
    "innovations that are not white although the model has one coloured disturbance",
    "It has another time scale, for records where one disturbance is not enough.",
)  # fmt: skip
thermal_diffusion = white_noise(
    "thermal_diffusion", __name__, "converter_temperature",
    Parameter(
        "thermal_diffusion", "K/h^0.5", 0.1, 1e-4, 20.0, positive=True, null=0.0, noise=True,
        meaning="intensity of the white disturbance of the converter temperature",
    ),
    "heat flow",
)  # fmt: skip


def wall_thermal_mass() -> Mechanism:
    """A second thermal mass: walls and fittings between the cabinet air and the ambient.

        dT_w/dt = (T_w∞ − T_w)/θ_w,    T_w∞ = T_amb + λ (T_conv,a − T_amb),    f += g (T_w − T_w∞)  [K],
    g is the conductance between air and mass in units of 1/R_AT, θ_w [h] the time constant of the mass.  λ
    [1] is its position: 1 for fittings in the cabinet air, 0 for an outer wall warmed by the ambient alone.
    The mass stores heat without losing any, so steady states do not change; g = 0 gives exactly the network
    of the paper.
    """

    def equilibrium(p: Space, u: Space, q: Space) -> Value:
        return u.ambient_temperature + p.wall_position * (q.cabinet_air_temperature - u.ambient_temperature)

    return Mechanism(
        name="wall_thermal_mass",
        parameters=(
            Parameter(
                "wall_conductance", "1", 0.3, 1e-4, 20.0, positive=True, null=0.0,
                meaning="R_AT/R_w between the cabinet air and the second mass",
            ),
            Parameter(
                "wall_time_constant", "h", 10.0, 0.5, 500.0, positive=True,
                meaning="R_w C_w of the second mass",
            ),
            Parameter(
                "wall_position", "1", 0.5, 0.0, 1.0, physical=(0.0, 1.0),
                meaning="position of the second mass between the ambient (0) and the cabinet air (1)",
            ),
        ),
        states=("wall_temperature",),
        inputs=("ambient_temperature",),
        contributions=lambda p, x, u, q: {
            "heat_release": p.wall_conductance * (x.wall_temperature - equilibrium(p, u, q))
        },
        drift=lambda p, x, u, q, s: {
            "wall_temperature": (equilibrium(p, u, q) - x.wall_temperature) / p.wall_time_constant
        },
        initial=lambda p, u: {"wall_temperature": (u.ambient_temperature + 5.0, 25.0)},
        meaning="heat stored in walls and fittings of the cabinet",
        source=f"{PAPER}, section on the thermal model (tried there and left out)",
        leaves="a slow tail after every change of the heat release or the ambient; two poles instead of one",
    )  # fmt: skip


STILL_K = 0.5
"""[K] smallest effective temperature difference of natural convection: the air is never quite at rest."""


def natural_convection(difference_K: float = 8.0) -> Mechanism:
    """Conductance to the ambient that grows with the temperature difference: G = (ΔT/ΔT₀)ⁿ/R_AT, ΔT =
    T_conv,a − T_amb.

        f −= ((ΔT/ΔT₀)ⁿ − 1) ΔT  [K],    ΔT₀ = `difference_K` [K],
    n = 0 gives the network of the paper.  Laminar natural convection has n = 0.25, turbulent convection 0.33.
    The thermal time constant τ is then that of small changes at ΔT₀, where R·C = (1+n) τ; at another
    difference ΔT small changes decay with τ (ΔT₀/ΔT)ⁿ (`small_signal`).
    """
    reference = Given(2.0 * math.log(difference_K))

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        difference = q.cabinet_air_temperature - u.ambient_temperature
        log_ratio = log(difference * difference + STILL_K**2) - reference
        return {
            "heat_release": (1.0 - exp(0.5 * p.convection_exponent * log_ratio)) * difference,
            "thermal_pace": 1.0 / (1.0 + p.convection_exponent) - 1.0,
        }

    return Mechanism(
        name="natural_convection",
        parameters=(
            Parameter(
                "convection_exponent", "1", 0.1, 0.0, 0.5, null=0.0,
                meaning="growth of the conductance with the temperature difference",
            ),
        ),
        inputs=("ambient_temperature",),
        contributions=contributions,
        settings={"difference_K": difference_K},
        meaning="natural convection around the cabinet",
        leaves="a cabinet that is too warm in the simulation at high heat release and decays faster there",
        source="Nusselt number of natural convection, Nu ∝ Ra^0.25 (laminar) to Ra^0.33 (turbulent)",
    )  # fmt: skip


def small_signal(time_constant: float, exponent: float, difference_K: float, at_K: Value) -> Value:
    """Time constant [h] of small changes at temperature differences `at_K` [K]; see `natural_convection`.

    `time_constant` [h] applies at `difference_K` [K]; `exponent` is n.
    """
    return time_constant * (difference_K / at_K) ** exponent


# fmt: off
BASE = (
    thermal_network, measured_air, heat_release, natural_convection, heat_disturbance,
    second_heat_disturbance, thermal_diffusion,
)
FURTHER = (wall_thermal_mass,)
# fmt: on
