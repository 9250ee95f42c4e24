"""hygrokf: hygrothermal models of converter cabinets by Kalman filtering.

The names below are loaded at first use, so that `import hygrokf` and the command line start at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from hygrokf.version import __version__

_WHERE = {
    "read_case": "case",
    "CaseFault": "case",
    "describe": "checks",
    "describe_text": "checks",
    "Record": "record",
    "Series": "record",
    "Site": "record",
    "Parameter": "parameters",
    "Prior": "parameters",
    "Mechanism": "model",
    "Model": "model",
    "compose": "model",
    "extend": "model",
    "Design": "design",
    "run": "drivers",
    "Timeline": "timeline",
    "Likelihood": "likelihood",
    "Gaussian": "likelihood",
    "maximise": "fitting",
    "Estimate": "fitting",
    "Bounds": "confidence",
    "covariances": "inference",
    "confidence_bounds": "inference",
    "system_time_constants": "inference",
    "linear_network": "mechanisms",
    "identify": "identification",
    "Fit": "fit",
    "read_fit": "results",
    "write_fit": "results",
    "write_report": "report",
    "free_run": "simulation",
    "forecasts": "simulation",
    "smooth": "kalman",
    "filterpy_filter": "kalman",
    "thermal_system": "thermal",
    "evaluation": "tables",
    "column": "transfer.comparison",
    "compared": "transfer.comparison",
    "transfer_fit": "transfer.transfer",
    "write_comparison": "transfer.comparison_page",
    "write_transfer": "transfer.page",
    "TurbineType": "turbine_type",
    "pooled": "turbine_type",
    "read_type": "turbine_type",
    "write_type": "turbine_type",
    "Cause": "discovery.cause",
    "Variant": "discovery.cause",
    "cause_of": "discovery.own_causes",
    "load_library": "discovery.own_causes",
    "discover": "discovery.discover",
    "Discovery": "discovery.discover",
    "read_weather": "weather.years",
    "climate_profile": "climate.study",
    "synthetic_turbine": "synthetic",
    "write_case": "synthetic",
}

if TYPE_CHECKING:
    from hygrokf.case import CaseFault as CaseFault
    from hygrokf.case import read_case as read_case
    from hygrokf.fit import Fit as Fit
    from hygrokf.identification import identify as identify


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module 'hygrokf' has no attribute {name!r}; it has {sorted(_WHERE)}")
    value = getattr(import_module(f"hygrokf.{_WHERE[name]}"), name)
    globals()[name] = value  # a submodule of the same name must not come back
    return value


def __dir__() -> list[str]:
    return sorted([*_WHERE, "__version__"])


__all__ = [*_WHERE, "__version__"]
