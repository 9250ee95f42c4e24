"""hygrokf: hygrothermal models of converter cabinets by Kalman filtering.

The names below are loaded at first use, so that `import hygrokf` and the command line start at once;
docs/reference/reference.md has an example of each.  Everything else is imported from its own module.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from hygrokf.version import __version__

_WHERE = {
    "read_case": "cases.case_file",
    "read_frames": "cases.frames",
    "Record": "data.record",
    "synthetic_turbine": "cases.synthetic",
    "write_case": "cases.synthetic",
    "identify": "identification.identify",
    "Fit": "identification.fit",
    "read_fit": "identification.fit",
    "write_fit": "identification.fit",
    "write_report": "report.fit_page",
    "evaluate": "identification.fit_on_record",
    "model_inputs": "modelling.inputs",
    "simulate": "evaluation.prediction",
    "forecast": "evaluation.prediction",
    "Parameter": "physics.parameters",
    "Prior": "physics.parameters",
    "Mechanism": "physics.model",
    "linear_network": "physics.mechanisms",
    "exp": "physics.expression",
    "log": "physics.expression",
    "sqrt": "physics.expression",
    "where": "physics.expression",
    "compose": "physics.model",
    "extend": "physics.model",
    "Model": "physics.model",
    "timeline": "engine.timeline",
    "Likelihood": "estimation.likelihood",
    "JointLikelihood": "estimation.joint_likelihood",
    "Gaussian": "estimation.moments",
    "fit_mle": "estimation.optimiser",
    "confidence_intervals": "estimation.inference",
    "covariances": "estimation.subject",
    "parameter_table": "estimation.inference",
    "modal_time_constants": "estimation.inference",
    "smooth": "evaluation.prediction",
    "innovations": "evaluation.prediction",
    "to_filterpy": "estimation.smoother",
    "to_statespace": "evaluation.responses",
    "bode": "evaluation.responses",
    "step_response": "evaluation.responses",
    "discover": "discovery.discover",
    "Cause": "modelling.causes.cause",
    "cause_of": "modelling.causes.cause",
    "load_library": "discovery.own_causes",
    "compare": "transfer.comparison",
    "comparison_column": "transfer.comparison",
    "transfer_fit": "transfer.transfer_fit",
    "climate_profile": "climate.climate_profile",
    "run_fleet": "commands.fleet_tasks",
    "Tracker": "live.tracker",
    "HygrokfError": "errors",
}

if TYPE_CHECKING:
    from hygrokf.cases.case_file import read_case as read_case
    from hygrokf.cases.frames import read_frames as read_frames
    from hygrokf.cases.synthetic import synthetic_turbine as synthetic_turbine
    from hygrokf.cases.synthetic import write_case as write_case
    from hygrokf.climate.climate_profile import climate_profile as climate_profile
    from hygrokf.commands.fleet_tasks import run_fleet as run_fleet
    from hygrokf.data.record import Record as Record
    from hygrokf.discovery.discover import discover as discover
    from hygrokf.discovery.own_causes import load_library as load_library
    from hygrokf.engine.timeline import timeline as timeline
    from hygrokf.errors import HygrokfError as HygrokfError
    from hygrokf.estimation.inference import confidence_intervals as confidence_intervals
    from hygrokf.estimation.inference import modal_time_constants as modal_time_constants
    from hygrokf.estimation.inference import parameter_table as parameter_table
    from hygrokf.estimation.joint_likelihood import JointLikelihood as JointLikelihood
    from hygrokf.estimation.likelihood import Likelihood as Likelihood
    from hygrokf.estimation.moments import Gaussian as Gaussian
    from hygrokf.estimation.optimiser import fit_mle as fit_mle
    from hygrokf.estimation.smoother import to_filterpy as to_filterpy
    from hygrokf.estimation.subject import covariances as covariances
    from hygrokf.evaluation.prediction import forecast as forecast
    from hygrokf.evaluation.prediction import innovations as innovations
    from hygrokf.evaluation.prediction import simulate as simulate
    from hygrokf.evaluation.prediction import smooth as smooth
    from hygrokf.evaluation.responses import bode as bode
    from hygrokf.evaluation.responses import step_response as step_response
    from hygrokf.evaluation.responses import to_statespace as to_statespace
    from hygrokf.identification.fit import Fit as Fit
    from hygrokf.identification.fit import read_fit as read_fit
    from hygrokf.identification.fit import write_fit as write_fit
    from hygrokf.identification.fit_on_record import evaluate as evaluate
    from hygrokf.identification.identify import identify as identify
    from hygrokf.live.tracker import Tracker as Tracker
    from hygrokf.modelling.causes.cause import Cause as Cause
    from hygrokf.modelling.causes.cause import cause_of as cause_of
    from hygrokf.modelling.inputs import model_inputs as model_inputs
    from hygrokf.physics.expression import exp as exp
    from hygrokf.physics.expression import log as log
    from hygrokf.physics.expression import sqrt as sqrt
    from hygrokf.physics.expression import where as where
    from hygrokf.physics.mechanisms import linear_network as linear_network
    from hygrokf.physics.model import Mechanism as Mechanism
    from hygrokf.physics.model import Model as Model
    from hygrokf.physics.model import compose as compose
    from hygrokf.physics.model import extend as extend
    from hygrokf.physics.parameters import Parameter as Parameter
    from hygrokf.physics.parameters import Prior as Prior
    from hygrokf.report.fit_page import write_report as write_report
    from hygrokf.transfer.comparison import compare as compare
    from hygrokf.transfer.comparison import comparison_column as comparison_column
    from hygrokf.transfer.transfer_fit import transfer_fit as transfer_fit


def __getattr__(name: str) -> object:
    if name in _WHERE:
        value = getattr(import_module(f"hygrokf.{_WHERE[name]}"), name)
        globals()[name] = value  # a submodule of the same name must not come back
        return value
    raise AttributeError(f"module 'hygrokf' has no attribute {name!r}; it has {sorted(_WHERE)}")


def __dir__() -> list[str]:
    return sorted([*_WHERE, "__version__"])


__all__ = [*_WHERE, "__version__"]
