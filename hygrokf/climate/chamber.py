"""What a test in a climate chamber is asked for, and what the chamber can do; docs/climate_test.toml is an
example."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

from hygrokf.climate.acceleration import Acceleration
from hygrokf.data.toml_form import read_toml_form, setting


@dataclass(frozen=True)
class Chamber:
    """What a chamber can set."""

    temperature_degC: tuple[float, float] = setting((-20.0, 85.0), "range", least=-80.0, most=200.0)
    relative_humidity_percent: tuple[float, float] = setting((10.0, 95.0), "range", least=0.0, most=100.0)
    temperature_ramp_K_per_h: float = setting(60.0, "steepest ramp", least=0.1, most=6000.0)
    humidity_ramp_percent_per_h: float = setting(60.0, "steepest ramp", least=0.1, most=6000.0)


@dataclass(frozen=True)
class ProfileLength:
    """The length of a test, and of what it stands for."""

    length_h: float = setting(1000.0, "of the test", least=24.0, most=20000.0)
    service_years: float = setting(20.0, "of service, with the same ageing", least=0.001, most=100.0)


@dataclass(frozen=True)
class ProfilePlan(ProfileLength):
    """A test: its length, the years of service whose ageing it is to have, law and chamber."""

    law: Acceleration = field(default_factory=Acceleration)
    chamber: Chamber = field(default_factory=Chamber)


@dataclass(frozen=True)
class ProfileForm:
    """A file of a test."""

    test: ProfileLength = setting(ProfileLength, "length of the test, and the service that it stands for")
    law: Acceleration = setting(Acceleration, "of ageing")
    chamber: Chamber = setting(Chamber, "what the chamber can set")


def read_test_plan(path: str | os.PathLike[str]) -> ProfilePlan:
    """A test from a TOML file, defaults for what it leaves out; raises FormFault with everything that is
    wrong."""
    form = read_toml_form(ProfileForm, path)
    return ProfilePlan(**vars(form.test), law=form.law, chamber=form.chamber)
