"""The tasks that a fleet can do for each turbine: options, columns of the table, and the quantities by which
turbines are compared.

A task is one entry of `TASKS`; the function that does its jobs is in `commands.fleet_tasks`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hygrokf.data.toml_form import setting
from hygrokf.estimation.conventions import STARTS
from hygrokf.fleet.job import Row
from hygrokf.texts.parts import PARTS
from hygrokf.texts.reasons import REJECT


@dataclass(frozen=True)
class Compared:
    """A positive quantity by which turbines are compared on a logarithmic scale.

    column: of the value. lower, upper: columns of its bounds, or "". title, unit: for tables and figures.
        verdict: column that states whether the value is reliable, or "".
    """

    column: str
    title: str
    unit: str
    lower: str = ""
    upper: str = ""
    verdict: str = ""

    def rejected(self, row: Row) -> bool:
        """Return whether a turbine's value is not reliable."""
        return bool(self.verdict) and row.get(self.verdict) == REJECT


_FILES = "a list of paths in quotes"


@dataclass(frozen=True)
class LibraryOptions:
    """The options of tasks that read a fitted model."""

    library: tuple[str, ...] = setting(
        (), "files with causes of your own, which are executed", expected=_FILES
    )


@dataclass(frozen=True)
class FitOptions:
    """The options of the task "fit"."""

    criterion: str = setting(
        "likelihood", "innovations, or the free run's error", choices=("likelihood", "simulation")
    )
    kind: str = setting(
        "cascade", "hygric on the measured temperature, or one filter", choices=("cascade", "joint")
    )
    starts: int = setting(STARTS, "starts of the search for the maximum", least=1)
    profiles: bool = setting(False, "bounds by profile likelihood; otherwise Wald bounds")
    report: bool = setting(False, "write each turbine's own page too")


@dataclass(frozen=True)
class DiscoverOptions(LibraryOptions):
    """The options of the task "discover"."""

    report: bool = setting(True, "write each turbine's own page too")


@dataclass(frozen=True)
class ClimateOptions(LibraryOptions):
    """The options of the task "climate"."""

    standstill: bool = setting(False, "no power all year; otherwise the case must have `active_power`")
    limits: tuple[str, ...] = setting(
        (), "limits for the climate: files, or names of classes", expected=_FILES
    )
    members: int = setting(50, "of the ensemble", least=2)
    seed: int = setting(1, "of the ensemble", least=0)


@dataclass(frozen=True)
class Tally:
    """A column whose values are counted on the page."""

    column: str
    title: str


@dataclass(frozen=True)
class Task:
    """What a fleet does for every turbine.

    options: dataclass of the options. columns: name → meaning with unit. compared: quantities by which
        turbines are compared. tallies: columns whose values the page counts. listed: further quantities that
        the page lists for every turbine. ranking: column by which turbines are ranked, largest first.
        uses_fit: whether the task needs a fitted model. files: options that hold paths of files, whose
        content the results depend on. named: options of `files` that also take names, which do not end in
        ".toml".
    """

    meaning: str
    options: type[FitOptions | DiscoverOptions | ClimateOptions | LibraryOptions]
    columns: Mapping[str, str]
    compared: tuple[Compared, ...]
    tallies: tuple[Tally, ...]
    listed: tuple[Compared, ...] = ()
    ranking: str = "temperature_rmse_K"
    uses_fit: bool = False
    files: tuple[str, ...] = ()
    named: tuple[str, ...] = ()


CLIMATE_COLUMNS = {
    "mean_temperature_degC": "mean temperature in the cabinet [°C]",
    "mean_relative_humidity_percent": "mean relative humidity in the cabinet [%]",
    "wetness_h": "time of wetness, above 80 % and 0 °C [h a year]",
    "condensation_h": "condensation on the coldest surface [h a year]",
    "ageing_h": "hours at the reference condition that cause the same ageing, by Peck's law [h a year]",
}

_RECORD = {
    "record": "name of the record, from the case file",
    "start": "first reading of the record [UTC]",
    "end": "last reading of the record [UTC]",
    "provenance": "of the readings, from the case file: measured, simulated or synthetic",
    "warnings": "number of warnings about masked or repaired readings",
}
_CONSTANTS = {
    f"{name}_{part}": f"{text} the {name} time constant{unit}"
    for name in PARTS
    for part, text, unit in (
        ("value_h", "estimate of", " [h]"),
        ("lower_h", "lower 95 % bound of", " [h]"),
        ("upper_h", "upper 95 % bound of", " [h], empty if the data do not bound it"),
        ("statement", "remark on", ", if value and bounds do not suffice"),
    )
}
_VERDICTS = {
    f"{name}_verdict": f"whether the {name} time constant of the model is reliable: believe, caution or "
    "reject"
    for name in PARTS
}
_QUANTITIES = (("temperature", "K", "temperature", "K"), ("humidity", "g_m3", "absolute humidity", "g/m³"))
"""Of each scored quantity: name and unit in names of columns, then name and unit in their meanings."""
_BOUNDS = ("lower", "upper")
_SCORES = {
    "scored_period": "period of the errors: validation, or identification if nothing is held out",
    **{
        f"{name}_rmse_{end}": f"free-run error of the {text} in total, root mean square [{unit}]"
        for name, end, text, unit in _QUANTITIES
    },
}
_ERRORS = tuple(
    Compared(f"{name}_rmse_{end}", f"free-run error of the {text}", unit)
    for name, end, text, unit in _QUANTITIES
)
_CONSTANTS_AND_ERRORS = (
    *(
        Compared(f"{n}_value_h", f"{n} time constant", "h", f"{n}_lower_h", f"{n}_upper_h", f"{n}_verdict")
        for n in PARTS
    ),
    *_ERRORS,
)

_RELIABLE = tuple(Tally(f"{name}_verdict", f"{name} time constant") for name in PARTS)

TASKS: Mapping[str, Task] = {
    "fit": Task(
        "identify the models of every case",
        FitOptions,
        {
            **_RECORD,
            "converged": "whether every search converged to a maximum",
            "n_readings": "readings of the identification period",
            **_CONSTANTS,
            **_VERDICTS,
            **_SCORES,
            "loglik": "log-likelihood of the identification period",
            "at_bounds": "parameters that ended at a limit",
        },
        _CONSTANTS_AND_ERRORS,
        _RELIABLE,
    ),
    "discover": Task(
        "name the cause that every simulation lacks",
        DiscoverOptions,
        {
            **_RECORD,
            "verdict": "none, named, ambiguous, unexplained or refuted",
            "causes": "named causes in the order of their acceptance, each with those that it could also be",
            "confidence": "smallest confidence of the named causes [1]",
            "not_judged": "causes that the budget of simulations left out",
            **_CONSTANTS,
            **_VERDICTS,
            **_SCORES,
            "base_temperature_rmse_K": "free-run error of the temperature before the extension [K]",
            "base_humidity_rmse_g_m3": "free-run error of the absolute humidity before the extension [g/m³]",
        },
        _CONSTANTS_AND_ERRORS,
        (
            Tally("verdict", "verdict"),
            Tally("causes", "named cause"),
            Tally("not_judged", "not judged: the budget of simulations ended"),
            *_RELIABLE,
        ),
        (Compared("verdict", "verdict", ""), Compared("causes", "causes", "")),
        files=("library",),
    ),
    "evaluate": Task(
        "score a fitted model on every case",
        LibraryOptions,
        {
            **_RECORD,
            "model": "name of the fitted model",
            **_VERDICTS,
            **_SCORES,
            **{
                f"{name}_rmse_{regime}_{end}": f"the same of the {text} {words} [{unit}]"
                for name, end, text, unit in _QUANTITIES
                for regime, words in (("operation", "in operation"), ("standstill", "at standstill"))
            },
            "temperature_coverage": "share of temperature readings inside the free run's 95 % band [1]",
            "humidity_coverage": "share of absolute humidities inside the free run's 95 % band [1]",
            "statements": "inputs of the record that the model does not use, and the reverse",
        },
        _ERRORS,
        _RELIABLE,
        uses_fit=True,
        files=("library",),
    ),
    "transfer": Task(
        "try a fitted model on every case, and tell which parameters carry over",
        LibraryOptions,
        {
            **_RECORD,
            "model": "name of the fitted model",
            "transfer": "whether the model transfers, transfers after re-estimating, or does not",
            "re_estimate": "parameter groups to re-estimate",
            "sentence": "the verdict in words",
            **_VERDICTS,
            **_SCORES,
            **{
                f"as_is_{name}_rmse_{end}": f"the same of the {text}, with the unchanged model [{unit}]"
                for name, end, text, unit in _QUANTITIES
            },
            **{
                f"{name}_gain_{end}{bound}": f"{of}error reduction by re-estimating, {text} [{unit}]"
                for name, end, text, unit in _QUANTITIES
                for bound, of in (("", ""), *((f"_{side}", f"{side} 95 % bound of ") for side in _BOUNDS))
            },
        },
        _ERRORS,
        (Tally("transfer", "verdict"), *_RELIABLE),
        (Compared("sentence", "verdict", ""),),
        uses_fit=True,
        files=("library",),
    ),
    "climate": Task(
        "simulate a year's climate in every cabinet",
        ClimateOptions,
        {
            **_RECORD,
            "model": "name of the fitted model",
            **_VERDICTS,
            "bounds_hold": "share of single years that the bounds hold [1]",
            **{
                f"{name}{end}": f"{words}{meaning}"
                for name, meaning in CLIMATE_COLUMNS.items()
                for end, words in (("", ""), *((f"_{side}", f"{side} bound of ") for side in _BOUNDS))
            },
            "limits": "worst verdict on the limits: fail, undecided or pass; empty without any",
            "wetness_class": "class of the time of wetness, ISO 9223:1992",
            "statements": "how weather and power were combined",
        },
        (
            Compared("ageing_h", "ageing", "h a year", "ageing_h_lower", "ageing_h_upper"),
            Compared("wetness_h", "time of wetness", "h a year", "wetness_h_lower", "wetness_h_upper"),
        ),
        (
            Tally("limits", "limits, the worst verdict"),
            Tally("wetness_class", "class of wetness, ISO 9223:1992"),
            *_RELIABLE,
            Tally("statements", "remark"),
        ),
        (
            Compared("limits", "limits", ""),
            Compared("wetness_class", "wetness", ""),
            Compared(
                "condensation_h", "condensation", "h a year", "condensation_h_lower", "condensation_h_upper"
            ),
        ),
        ranking="ageing_h",
        uses_fit=True,
        files=("library", "limits"),
        named=("limits",),
    ),
}
"""Name of a task in FLEET.toml → the task."""

SHARED_COLUMNS = {
    "turbine": "name of the turbine in the fleet",
    "status": "done; failed: see reason; lost: its process died, twice",
    "reason": "reason for the missing result, empty otherwise",
    "task": "the task",
    "key": "SHA-256 of everything the row depends on: version, task, options, case, data files, fit",
}
"""Columns of every row, before the columns of the task."""
