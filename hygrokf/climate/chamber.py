"""What a test in a climate chamber has to do: its length, the law of ageing, and the limits of the chamber.

docs/how_to/climate_test.toml is an example of the file.
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
    """Peck's law of ageing by heat and humidity, with Arrhenius' as its case without humidity.

        rate(T, h) ∝ h^n exp(−E_a / (k_B T)),

    T [K], h [1] relative humidity; the rate counts as 1 at the reference condition.  Peck, D. S.:
    Comprehensive model for humidity testing correlation, IRPS 1986, gives n = 2.66 and E_a = 0.79 eV as the
    best fit to tests of aluminium corrosion in plastic packages.  Other failure mechanisms have other
    parameters, and no single mechanism stands for a cabinet.
    """

    humidity_exponent: float = setting(2.66, "n [1]; 0: Arrhenius", least=0.0, most=10.0)
    activation_energy_eV: float = setting(0.79, "E_a", least=0.05, most=3.0)
    reference_degC: float = setting(85.0, "reference condition, with rate 1", least=-50.0, most=200.0)
    reference_percent: float = setting(85.0, "reference condition, with rate 1", least=1.0, most=100.0)

    @property
    def humid(self) -> bool:
        """Whether the law depends on the humidity."""
        return self.humidity_exponent != 0.0

    def rate(self, temperature_K: np.ndarray, relative_humidity: np.ndarray | None = None) -> np.ndarray:
        """Return the ageing [h at the reference condition per h] at a temperature [K] and relative humidity
        [1] of any shape; humidity above saturation counts as saturation.

        Raises ValueError if the law needs a humidity and there is none.
        """
        slope = self.activation_energy_eV / BOLTZMANN_EV
        rate = np.exp(slope * (1.0 / (self.reference_degC + ZERO_CELSIUS_K) - 1.0 / temperature_K))
        if self.humid:
            if relative_humidity is None:
                raise ValueError(
                    "Peck's law needs a relative humidity, found none; set humidity_exponent = 0 for "
                    "Arrhenius"
                )
            humidity = np.clip(relative_humidity, 0.0, 1.0)
            rate = rate * (100.0 * humidity / self.reference_percent) ** self.humidity_exponent
        return rate


@dataclass(frozen=True)
class Chamber:
    """The conditions and ramps that a chamber can set."""

    temperature_degC: tuple[float, float] = setting((-20.0, 85.0), "range", least=-80.0, most=200.0)
    relative_humidity_percent: tuple[float, float] = setting((10.0, 95.0), "range", least=0.0, most=100.0)
    temperature_ramp_K_per_h: float = setting(60.0, "steepest ramp", least=0.1, most=6000.0)
    humidity_ramp_percent_per_h: float = setting(60.0, "steepest ramp", least=0.1, most=6000.0)


@dataclass(frozen=True)
class ProfileLength:
    """The length of a test, and the years of service whose ageing it should cause."""

    length_h: float = setting(1000.0, "of the test", least=24.0, most=20000.0)
    service_years: float = setting(20.0, "of service, with the same ageing", least=0.001, most=100.0)


@dataclass(frozen=True)
class ProfilePlan:
    """The plan of a test, as in its file: length and years of service, law of ageing, and limits of the
    chamber."""

    test: ProfileLength = setting(ProfileLength, "length of the test, and of the service that it represents")
    law: Acceleration = setting(Acceleration, "of ageing")
    chamber: Chamber = setting(Chamber, "limits of the chamber")
