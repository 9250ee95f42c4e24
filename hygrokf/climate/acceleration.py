"""How fast heat and humidity age: Peck's law, with Arrhenius' as its case without humidity.

    rate(T, h) ∝ h^n exp(−E_a / (k_B T)),

T [K], h [1] relative humidity.  Peck, D. S.: Comprehensive model for humidity testing correlation, IRPS 1986,
gives n = 2.66 and E_a = 0.79 eV as the best fit to tests of aluminium corrosion in plastic packages; other
mechanisms have other exponents, and no single one stands for a cabinet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.data.toml_form import setting
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K

BOLTZMANN_EV = 8.617333262e-5
"""[eV/K] CODATA 2018, exact."""


@dataclass(frozen=True)
class Acceleration:
    """Peck's law, and the condition at which its rate counts as 1."""

    humidity_exponent: float = setting(2.66, "n [1]; 0: Arrhenius", least=0.0, most=10.0)
    activation_energy_eV: float = setting(0.79, "E_a", least=0.05, most=3.0)
    reference_degC: float = setting(85.0, "at which the rate counts as 1", least=-50.0, most=200.0)
    reference_percent: float = setting(85.0, "at which the rate counts as 1", least=1.0, most=100.0)

    @property
    def humid(self) -> bool:
        """Whether the humidity matters."""
        return self.humidity_exponent != 0.0

    def rate(self, temperature_K: np.ndarray, relative_humidity: np.ndarray | None = None) -> np.ndarray:
        """Ageing [h at the reference condition per h], any shape; humidity above saturation counts as
        saturation."""
        slope = self.activation_energy_eV / BOLTZMANN_EV
        rate = np.exp(slope * (1.0 / (self.reference_degC + ZERO_CELSIUS_K) - 1.0 / temperature_K))
        if self.humid:
            if relative_humidity is None:
                raise ValueError(
                    "Peck's law needs a relative humidity, found none; set humidity_exponent = 0 for "
                    "Arrhenius"
                )
            h = np.clip(relative_humidity, 0.0, 1.0)
            rate = rate * (100.0 * h / self.reference_percent) ** self.humidity_exponent
        return rate
