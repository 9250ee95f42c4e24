"""hygrokf: hygrothermal models of converter cabinets by Kalman filtering.

The names below are loaded at first use, so that `import hygrokf` and the command line start at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from hygrokf.version import __version__

_WHERE = {
    "read_case": "cases.case_file",
    "CaseFault": "cases.case_file",
    "describe": "cases.summary",
    "describe_text": "cases.summary",
    "Record": "data.record",
    "Series": "data.record",
    "Site": "data.record",
    "Parameter": "physics.parameters",
    "Prior": "physics.parameters",
    "Mechanism": "physics.model",
    "Model": "physics.model",
    "compose": "physics.model",
    "extend": "physics.model",
    "Design": "modelling.design",
    "run": "modelling.inputs",
    "Timeline": "engine.timeline",
    "Likelihood": "estimation.likelihood",
    "Gaussian": "estimation.likelihood",
    "maximise": "estimation.optimiser",
    "Estimate": "estimation.optimiser",
    "Bounds": "estimation.confidence",
    "covariances": "estimation.inference",
    "confidence_bounds": "estimation.inference",
    "system_time_constants": "estimation.inference",
    "linear_network": "physics.mechanisms",
    "identify": "identification.procedure",
    "Fit": "identification.fit",
    "read_fit": "identification.results",
    "write_fit": "identification.results",
    "write_report": "report.fit_page",
    "free_run": "evaluation.simulation",
    "forecasts": "evaluation.simulation",
    "smooth": "estimation.smoother",
    "filterpy_filter": "estimation.smoother",
    "thermal_system": "modelling.thermal_system",
    "evaluation": "identification.tables",
    "column": "transfer.comparison",
    "compared": "transfer.comparison",
    "transfer_fit": "transfer.procedure",
    "write_comparison": "report.comparison_page",
    "write_transfer": "report.transfer_page",
    "TurbineType": "identification.turbine_type",
    "pooled": "identification.turbine_type",
    "read_type": "identification.turbine_type",
    "write_type": "identification.turbine_type",
    "Cause": "discovery.cause",
    "Variant": "discovery.cause",
    "cause_of": "discovery.own_causes",
    "load_library": "discovery.own_causes",
    "discover": "discovery.procedure",
    "Discovery": "discovery.procedure",
    "read_weather": "weather.years",
    "climate_profile": "climate.study",
    "synthetic_turbine": "cases.synthetic",
    "write_case": "cases.synthetic",
}

if TYPE_CHECKING:
    from hygrokf.cases.case_file import CaseFault as CaseFault
    from hygrokf.cases.case_file import read_case as read_case
    from hygrokf.identification.fit import Fit as Fit
    from hygrokf.identification.procedure import identify as identify


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module 'hygrokf' has no attribute {name!r}; it has {sorted(_WHERE)}")
    value = getattr(import_module(f"hygrokf.{_WHERE[name]}"), name)
    globals()[name] = value  # a submodule of the same name must not come back
    return value


def __dir__() -> list[str]:
    return sorted([*_WHERE, "__version__"])


__all__ = [*_WHERE, "__version__"]
