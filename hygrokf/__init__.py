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
    "describe_text": "report.record_text",
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
    "prepare_run": "modelling.inputs",
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
    "simulate": "evaluation.simulation",
    "forecast": "evaluation.simulation",
    "smooth": "estimation.smoother",
    "filterpy_filter": "estimation.smoother",
    "thermal_system": "modelling.thermal_system",
    "evaluate": "identification.tables",
    "comparison_column": "transfer.comparison",
    "compare": "transfer.comparison",
    "transfer_fit": "transfer.procedure",
    "write_comparison": "report.comparison_page",
    "write_transfer": "report.transfer_page",
    "TurbineType": "identification.turbine_type",
    "pool_types": "identification.turbine_type",
    "read_type": "identification.turbine_type",
    "write_type": "identification.turbine_type",
    "Cause": "discovery.cause",
    "Variant": "discovery.cause",
    "cause_of": "discovery.own_causes",
    "load_library": "discovery.own_causes",
    "discover": "discovery.procedure",
    "Discovery": "discovery.procedure",
    "read_weather": "weather.years",
    "climate_profile": "climate.procedure",
    "synthetic_turbine": "cases.synthetic",
    "write_case": "cases.synthetic",
    "HygrokfError": "errors",
    "reference_filter": "estimation.reference_filter",
}
_FORMER = {
    "compared": "compare",
    "column": "comparison_column",
    "pooled": "pool_types",
    "run": "prepare_run",
    "free_run": "simulate",
    "forecasts": "forecast",
}
"""Names of the version before, and what they are called now."""

if TYPE_CHECKING:
    from hygrokf.cases.case_file import CaseFault as CaseFault
    from hygrokf.cases.case_file import read_case as read_case
    from hygrokf.cases.summary import describe as describe
    from hygrokf.cases.synthetic import synthetic_turbine as synthetic_turbine
    from hygrokf.cases.synthetic import write_case as write_case
    from hygrokf.climate.procedure import climate_profile as climate_profile
    from hygrokf.data.record import Record as Record
    from hygrokf.data.record import Series as Series
    from hygrokf.data.record import Site as Site
    from hygrokf.discovery.cause import Cause as Cause
    from hygrokf.discovery.cause import Variant as Variant
    from hygrokf.discovery.own_causes import cause_of as cause_of
    from hygrokf.discovery.own_causes import load_library as load_library
    from hygrokf.discovery.procedure import Discovery as Discovery
    from hygrokf.discovery.procedure import discover as discover
    from hygrokf.engine.timeline import Timeline as Timeline
    from hygrokf.errors import HygrokfError as HygrokfError
    from hygrokf.estimation.confidence import Bounds as Bounds
    from hygrokf.estimation.inference import confidence_bounds as confidence_bounds
    from hygrokf.estimation.inference import covariances as covariances
    from hygrokf.estimation.inference import system_time_constants as system_time_constants
    from hygrokf.estimation.likelihood import Gaussian as Gaussian
    from hygrokf.estimation.likelihood import Likelihood as Likelihood
    from hygrokf.estimation.optimiser import Estimate as Estimate
    from hygrokf.estimation.optimiser import maximise as maximise
    from hygrokf.estimation.reference_filter import reference_filter as reference_filter
    from hygrokf.estimation.smoother import filterpy_filter as filterpy_filter
    from hygrokf.estimation.smoother import smooth as smooth
    from hygrokf.evaluation.simulation import forecast as forecast
    from hygrokf.evaluation.simulation import simulate as simulate
    from hygrokf.identification.fit import Fit as Fit
    from hygrokf.identification.procedure import identify as identify
    from hygrokf.identification.results import read_fit as read_fit
    from hygrokf.identification.results import write_fit as write_fit
    from hygrokf.identification.tables import evaluate as evaluate
    from hygrokf.identification.turbine_type import TurbineType as TurbineType
    from hygrokf.identification.turbine_type import pool_types as pool_types
    from hygrokf.identification.turbine_type import read_type as read_type
    from hygrokf.identification.turbine_type import write_type as write_type
    from hygrokf.modelling.design import Design as Design
    from hygrokf.modelling.inputs import prepare_run as prepare_run
    from hygrokf.modelling.thermal_system import thermal_system as thermal_system
    from hygrokf.physics.mechanisms import linear_network as linear_network
    from hygrokf.physics.model import Mechanism as Mechanism
    from hygrokf.physics.model import Model as Model
    from hygrokf.physics.model import compose as compose
    from hygrokf.physics.model import extend as extend
    from hygrokf.physics.parameters import Parameter as Parameter
    from hygrokf.physics.parameters import Prior as Prior
    from hygrokf.report.comparison_page import write_comparison as write_comparison
    from hygrokf.report.fit_page import write_report as write_report
    from hygrokf.report.record_text import describe_text as describe_text
    from hygrokf.report.transfer_page import write_transfer as write_transfer
    from hygrokf.transfer.comparison import compare as compare
    from hygrokf.transfer.comparison import comparison_column as comparison_column
    from hygrokf.transfer.procedure import transfer_fit as transfer_fit
    from hygrokf.weather.years import read_weather as read_weather


def __getattr__(name: str) -> object:
    if name in _FORMER:
        raise AttributeError(f"hygrokf.{name} is called hygrokf.{_FORMER[name]} now")
    if name not in _WHERE:
        raise AttributeError(f"module 'hygrokf' has no attribute {name!r}; it has {sorted(_WHERE)}")
    value = getattr(import_module(f"hygrokf.{_WHERE[name]}"), name)
    globals()[name] = value  # a submodule of the same name must not come back
    return value


def __dir__() -> list[str]:
    return sorted([*_WHERE, "__version__"])


__all__ = [*_WHERE, "__version__"]
