"""The moisture network of the paper (Fig. 5) and its disturbances."""

from __future__ import annotations

from hygrokf.physics.expression import Value, exp, log
from hygrokf.physics.mechanisms.effects import PAPER, ornstein_uhlenbeck, white_noise
from hygrokf.physics.model import Mechanism, Pair, Space, Values
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.psychrometrics import GAS_CONSTANT_VAPOUR, SATURATION_WATER

REFERENCE_TEMPERATURE = 273.0
"""[K] reference temperature of the diffusion coefficient in equation (4) of the paper."""
DIFFUSION_EXPONENT = 0.8
"""[1] exponent of the ambient temperature in equation (4)."""


def exchange_factor(ambient_temperature: Value) -> Value:
    """T_amb^0.8 / (273 K)^1.8 [1/K]: the ambient part of the rate in equation (4); `ambient_temperature`
    [K]."""
    return ambient_temperature**DIFFUSION_EXPONENT / REFERENCE_TEMPERATURE ** (1.0 + DIFFUSION_EXPONENT)


def hygric_time_constant(k: Value, cabinet_temperature: Value, ambient_temperature: Value) -> Value:
    """R_D*·V* [h] at given temperatures [K]: k (273 K)^1.8 / (T_conv,a T_amb^0.8), from equation (4)."""
    return k / (cabinet_temperature * exchange_factor(ambient_temperature))


def saturation_pressure(temperature: Value) -> Value:
    """Sonntag's saturation pressure over water [Pa]; also accepts traced temperatures [K]."""
    a, b, c, d, e = SATURATION_WATER
    return exp(a / temperature + b + (c + d * temperature) * temperature + e * log(temperature))


def saturated_vapour(surface: Value, temperature: Value) -> Value:
    """Vapour concentration [g/m³], at a temperature [K], of air saturated over a surface [K]."""
    return saturation_pressure(surface) / (temperature * (1e-3 * GAS_CONSTANT_VAPOUR))


def vapour_pressure(vapour: Value, temperature: Value) -> Value:
    """Vapour pressure c R_v T [Pa] of a concentration [g/m³] at a temperature [K].

    The vapour pressure of the cabinet air is c* R_v T_amb, by equation (5).
    """
    return vapour * temperature * (1e-3 * GAS_CONSTANT_VAPOUR)


def cabinet_humidity(x: Space, u: Space, q: Space) -> Value:
    """Relative humidity of the cabinet air over water [1]."""
    return vapour_pressure(x.vapour, u.ambient_temperature) / saturation_pressure(q.cabinet_air_temperature)


def cabinet_vapour(x: Space, u: Space, q: Space) -> Value:
    """Vapour concentration of the cabinet air, c* T_amb/T_conv,a [g/m³], equation (5)."""
    return x.vapour * u.ambient_temperature / q.cabinet_air_temperature


LEAST_K_H = 0.005
"""[h] default lower bound of k."""


def hygric_exchange(shortest_h: float = LEAST_K_H) -> Mechanism:
    """Vapour exchange with the ambient air: equation (4) of the paper as a balance of vapour mass.

        dc*/dt = T_conv,a T_amb^0.8 /(k (273 K)^1.8) · (1 + Σ exchange) (c_amb − c* + w) + vapour_release,
    c* [g/m³] is the equivalent concentration (that of the cabinet air at ambient temperature), w the vapour
    disturbance. The factor T_amb^0.8 is linear between the ambient readings.  `shortest_h` [h] is the lower
    bound of k that the readings can resolve.
    """

    def drift(p: Space, x: Space, u: Space, q: Space, s: Space) -> Values:
        rate = q.cabinet_air_temperature * u.exchange_factor / p.hygric_k * (1.0 + s.exchange)
        drive = u.ambient_absolute_humidity - x.vapour + s.ambient_vapour
        return {"vapour": rate * drive + s.vapour_release}

    def initial(p: Space, u: Space) -> dict[str, Pair]:
        return {"vapour": (u.ambient_absolute_humidity, (0.3 * u.ambient_absolute_humidity) ** 2)}

    return Mechanism(
        name="hygric_exchange",
        parameters=(
            Parameter(
                "hygric_k", "h", 0.5, shortest_h, 200.0, positive=True,
                meaning="R_D*·V* at 273 K inside and outside, the k of equation (4)",
            ),
        ),
        states=("vapour",),
        amounts=("vapour",),
        inputs=("ambient_temperature", "ambient_absolute_humidity", "exchange_factor"),
        drift=drift,
        initial=initial,
        settings={"shortest_h": shortest_h},
        meaning="vapour exchanged through gaps with the ambient air",
        source=f"{PAPER}, equations (4) and (5)",
    )  # fmt: skip


vapour_disturbance = ornstein_uhlenbeck(
    "vapour_disturbance", __name__, "ambient_vapour", "g/m3", (0.3, 1e-4, 20.0), 6.0,
    "coloured disturbance of the vapour flow, as an error of the ambient air",
    "slowly wandering humidity residuals; a hygric time constant that is too long",
    "It represents vapour flows beyond the exchange with the ambient series.",
)  # fmt: skip
second_vapour_disturbance = ornstein_uhlenbeck(
    "second_vapour_disturbance", __name__, "ambient_vapour", "g/m3", (0.1, 1e-4, 20.0), 1.0,
    "second coloured disturbance of the vapour flow, as an error of the ambient air",
    "innovations that are not white although the model has one coloured disturbance",
    "It has another time scale, for records where one disturbance is not enough.",
)  # fmt: skip
hygric_diffusion = white_noise(
    "hygric_diffusion", __name__, "vapour",
    Parameter(
        "hygric_diffusion", "g/m3/h^0.5", 0.05, 1e-5, 10.0, positive=True, null=0.0, noise=True,
        meaning="intensity of the white disturbance of the vapour concentration",
    ),
    "vapour flow",
)  # fmt: skip

# fmt: off
BASE = (hygric_exchange, vapour_disturbance, second_vapour_disturbance, hygric_diffusion)
# fmt: on
