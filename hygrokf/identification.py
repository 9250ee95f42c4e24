"""From a record to a `Fit`: the whole identification, in the order in which it is reported."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property

import numpy as np

from hygrokf.confidence import (
    Bounds,
    Uncertainty,
    normal_quantile,
    profile,
    standard_error,
    uncertainty,
    wald_bounds,
)
from hygrokf.design import CASCADE, JOINT, Design, design, extended, merged, reading_step_h
from hygrokf.drivers import Run, run
from hygrokf.evaluation import bands, baselines, scores, sensor_share
from hygrokf.fitting import Estimate, Objective, climb, maximise
from hygrokf.kalman import smooth
from hygrokf.likelihood import Likelihood
from hygrokf.mechanisms.hygric import exchange_factor, hygric_time_constant
from hygrokf.output_error import OutputError, fit_output_error
from hygrokf.parameters import Coordinates
from hygrokf.record import Record, Series
from hygrokf.simulation import air_temperature, free_run, measured, project
from hygrokf.thermal import thermal_poles
from hygrokf.version import __version__

LEVEL = 0.95
TIME_CONSTANTS = ("thermal_time_constant", "hygric_k")
STARTS = 4
SEARCH_DAYS = 30.0
"""[d] stretch of the record on which the starts over the noise parameters are tried."""
DEFAULT_KIND = CASCADE
"""Decided by trial: docs/decisions/0002-joint-or-cascade.md."""
FEWEST = 50
"""Readings below which nothing is identified."""
SECOND = ("second_heat_disturbance", "second_vapour_disturbance")
SCREEN_GAIN = 3.0
"""Log-likelihood that a second disturbance must gain on the shorter stretch to be tried on the whole."""
CRITERIA = ("likelihood", "simulation")
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Fit:
    """An identified model: everything to repeat it and to use it elsewhere.

    `design` and `values` make the model; `results` is the plain data of `fit.json`; `series` the arrays for pictures.
    """

    name: str
    design: Design
    values: Mapping[str, float]
    results: Mapping[str, object]
    series: Mapping[str, np.ndarray] = field(default_factory=dict)

    @cached_property
    def covariance(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Names and covariance (r, r) of the parameters that have one, in their own units."""
        found = self.results["covariance"]
        return tuple(found["names"]), np.array(found["matrix"], dtype=float).reshape(len(found["names"]), -1)

    def to_json(self) -> dict:
        return dict(self.results)

    @classmethod
    def from_json(cls, data: Mapping) -> Fit:
        """A fit from what `to_json` gave."""
        values = {name: row["value"] for name, row in data["parameters"].items()}
        return cls(data["name"], Design.from_json(data["design"]), values, dict(data))


def identify(
    record: Record,
    *,
    criterion: str = "likelihood",
    kind: str = DEFAULT_KIND,
    starts: int = STARTS,
    profiles: bool = True,
    progress: Progress | None = None,
) -> Fit:
    """Identify the thermal and, where there is humidity, the hygric model of a record.

    Everything is chosen and estimated on the identification period; the validation period is only scored.
    `criterion`: "likelihood" (innovations) or "simulation" (free run, as in the paper) gives the reported values; both
    sets of time constants are always shown.  `kind`: "joint" or "cascade".  Raises ValueError for unknown options and
    for records from which nothing can be identified.
    """
    if kind not in (JOINT, CASCADE):
        raise ValueError(f"kind: expected {JOINT!r} or {CASCADE!r}, found {kind!r}")
    if criterion not in CRITERIA:
        raise ValueError(f"criterion: expected one of {CRITERIA}, found {criterion!r}")
    say = progress or (lambda text: None)
    early = record.identification()
    _refuse(early)
    from hygrokf.stationary import heat_release_regression

    say("heat-release regression")
    regression = heat_release_regression(early)
    orders = _orders(regression)
    stages = []
    for part in (JOINT,) if kind == JOINT else ("thermal", CASCADE):
        base = design(early, kind=part, **orders)
        if part == CASCADE and base.humidity is None:
            continue
        driven = early
        if part == CASCADE:
            say("smoothed cabinet temperature")
            driven = early.replace_series(smoothed_temperature(stages[0], base.humidity))
        stages.append(_Stage(record, driven, base, say))
        stages[-1].estimate(starts, profiles)
    say("output-error fit")
    whole = merged([stage.base for stage in stages])
    values = {name: value for stage in stages for name, value in stage.estimate_.values.items()}
    simulated = _simulation(early, whole, values)
    return _assemble(record, stages, whole, values, simulated, regression, criterion, kind, say)


def _refuse(early: Record) -> None:
    """Say what is missing where nothing can be identified."""
    missing = [
        f"{name}: expected at least {FEWEST} readings in the identification period, found {found}"
        for name in ("cabinet_temperature", "ambient_temperature")
        if (found := int(np.isfinite(early[name].value).sum()) if name in early else 0) < FEWEST
    ]
    if missing:
        raise ValueError(
            "; ".join(missing) + ": both temperatures are needed, also for the humidity; check the case with `hygrokf check`"
        )


def smoothed_temperature(stage: _Stage, humidity: str) -> Series:
    """The cabinet air temperature given all its readings [K], at its own times and those of the humidity.

    The hygric model divides by e_s(T): with raw readings their noise would weaken that dependence, as errors in a
    regressor do, and end up in the humidity sensor's bias; the smoothed temperature is free of it.
    """
    t, base = stage.run_.timeline, stage.base
    values = stage.estimate_.values
    mean, _ = smooth(stage.likelihood, values, covariance=False)
    air, _ = project(base, values, stage.run_, mean, None, air_temperature)
    seconds = t.origin_s + 3600.0 * t.time
    raw = stage.early["cabinet_temperature"]
    moist = stage.early[humidity]
    time = np.union1d(raw.time[~raw.missing], moist.time[~moist.missing])
    time = time[(time >= seconds[0]) & (time <= seconds[-1])]
    return replace(raw, time=time, value=np.interp(time, seconds, air), hold="linear", interval_s=0.0)


def _orders(regression) -> dict:
    """Design settings from the regression: start values, and an order of at least two.

    Cross-validation drops terms that do not help to predict a few dozen stationary periods; left out of the likelihood
    they become a disturbance that follows the power, and bias the time constant (6 % on simulated plants).  So the
    likelihood keeps the quadratic term and both ambient slopes; where the data do not need them they come out near 0.
    """
    settings: dict = {"heat_start": regression.start()}
    if regression.operation is not None and regression.operation.coefficients:
        settings["power_order"] = max(2, regression.operation.order)
    return settings


class _Stage:
    """One likelihood on its way from design to bounds."""

    def __init__(self, record: Record, early: Record, base: Design, say: Progress) -> None:
        self.record, self.early, self.say = record, early, say
        self.bounds: dict[str, Bounds] = {}
        self._set(base)

    def _set(self, base: Design) -> None:
        self.base = base
        self.run_: Run = run(base, self.early)
        self.likelihood = Likelihood(base.model, self.run_.timeline)

    def _search(self) -> Likelihood | None:
        """The likelihood of a shorter stretch, for trying starts and second disturbances."""
        t = self.run_.timeline
        if t.time[-1] <= 2.0 * 24.0 * SEARCH_DAYS:
            return None
        return Likelihood(self.base.model, t.window(0, int(np.searchsorted(t.time, 24.0 * SEARCH_DAYS))))

    def estimate(self, starts: int, profiles: bool) -> None:
        self.estimate_: Estimate = maximise(
            self.likelihood, count=starts, progress=self.say, search=self._search()
        )
        for name in SECOND:
            if name.replace("second_", "") in [m for m, _ in self.base.mechanisms]:
                self._second(name)
        self.objective = Objective(self.likelihood, self.estimate_.coordinates)
        self.say("observed information")
        self.uncertainty_: Uncertainty = uncertainty(self.objective, self.estimate_)
        for name in TIME_CONSTANTS:
            if name in self.estimate_.coordinates.names:
                if profiles:
                    self.bounds[name] = profile(
                        self.objective, self.estimate_, self.uncertainty_, name, LEVEL, self.say
                    )
                else:
                    self.bounds[name] = wald_bounds(self.estimate_, self.uncertainty_, name, LEVEL)
        self.clock = self._clock()
        self.sampling = self._sampling()

    def _sampling(self) -> dict | None:
        """Shift of the log time constants when every second ambient reading is left out.

        What the ambient does between its readings is interpolated; this says how much that could matter.
        """
        thinned = [
            replace(s, time=s.time[::2], value=s.value[::2])
            for s in self.early.series
            if s.signal.startswith("ambient_") and s.hold == "linear"
        ]
        if not thinned:
            return None
        self.say("ambient sampling")
        other = Likelihood(self.base.model, run(self.base, self.early.replace_series(*thinned)).timeline)
        there = climb(
            Objective(other, self.estimate_.coordinates), self.estimate_.z, passes=8, tolerance=0.05
        )
        values = self.estimate_.coordinates.values(there.z)
        return {
            "step_h": reading_step_h(thinned[0]) / 2.0,
            **{name: math.log(values[name] / self.estimate_.values[name]) for name in self.bounds},
        }

    def _second(self, name: str) -> None:
        """Add a second disturbance of a kind where the likelihood of the whole record pays for it (BIC).

        It is first tried on a shorter stretch, faster and slower than the first one; a real disturbance rarely has one
        time scale alone, and what is left over would be taken for the cabinet's own dynamics.
        """
        self.say(f"{name.replace('_', ' ')}?")
        before, found = (self.base, self.likelihood, self.run_), self.estimate_
        settings = next(s for m, s in self.base.mechanisms if m == name.replace("second_", ""))
        first = found.values[name.replace("second_", "") + "_time"]
        sd = found.values[name.replace("second_", "") + "_sd"]
        short = self._search() or self.likelihood
        plain = climb(Objective(short, found.coordinates), found.z, passes=12, tolerance=1e-2)
        self._set(extended(self.base, [(name, {**settings, "start_h": first / 5.0})]))
        scout = self._search() or self.likelihood
        best = None
        for factor in (0.2, 5.0):
            start = {**found.values, f"{name}_time": first * factor, f"{name}_sd": 0.4 * sd}
            coordinates = Coordinates(self.base.model.parameters)
            there = climb(Objective(scout, coordinates), coordinates.start(start), passes=20, tolerance=1e-2)
            if best is None or there.objective > best.objective:
                best = there
        if best.objective - plain.objective > SCREEN_GAIN:
            wider = maximise(self.likelihood, coordinates.values(best.z), count=1)
            if wider.objective - found.objective > math.log(max(self.run_.timeline.n_readings, 3)):
                self.estimate_ = wider
                return
        self.base, self.likelihood, self.run_ = before

    def _clock(self) -> dict[str, dict]:
        """Shift of each log time constant by one standard uncertainty of each source's clock."""
        shifts: dict[str, dict] = {}
        for series in self.early.series:
            delta = series.clock_uncertainty_s
            if delta <= 0 or series.signal not in _CLOCKED:
                continue
            same = [s for s in self.early.series if s.source.split(",")[0] == series.source.split(",")[0]]
            key = series.source.split(",")[0]
            if key in shifts:
                continue
            self.say(f"clock of {key}")
            found = {}
            for sign in (-1.0, 1.0):
                moved = self.early.replace_series(*(replace(s, time=s.time + sign * delta) for s in same))
                shifted = Likelihood(self.base.model, run(self.base, moved).timeline)
                there = climb(
                    Objective(shifted, self.estimate_.coordinates), self.estimate_.z, passes=6, tolerance=0.05
                )
                found[sign] = self.estimate_.coordinates.values(there.z)
            shifts[key] = {
                "clock_uncertainty_s": delta,
                **{name: [found[-1.0][name], found[1.0][name]] for name in self.bounds},
            }
        return shifts


_CLOCKED = (
    "ambient_temperature",
    "ambient_relative_humidity",
    "ambient_absolute_humidity",
    "ambient_dew_point_temperature",
    "active_power",
    "cabinet_temperature",
    "cabinet_relative_humidity",
    "cabinet_absolute_humidity",
)


def _simulation(early: Record, base: Design, values: Mapping[str, float]) -> dict[str, OutputError]:
    """Output-error estimates: the thermal model on temperature, the hygric one on the measured temperature."""
    found: dict[str, OutputError] = {}
    plain = _plain(base, values)
    if "thermal_network" in [name for name, _ in base.mechanisms]:
        thermal = replace(
            base,
            mechanisms=tuple(m for m in base.mechanisms if m[0] in _THERMAL_PLAIN),
            humidity=None,
            averaged={k: v for k, v in base.averaged.items() if k == "cabinet_temperature"},
        )
        likelihood = Likelihood(thermal.model, run(thermal, early).timeline)
        found["thermal_time_constant"] = fit_output_error(likelihood, plain(thermal))
    if base.humidity is not None and "cabinet_temperature" in early:
        cascade = design(early, kind=CASCADE, coloured=False)
        likelihood = Likelihood(cascade.model, run(cascade, early).timeline)
        found["hygric_k"] = fit_output_error(likelihood, plain(cascade))
    return found


_THERMAL_PLAIN = ("thermal_network", "heat_release", "thermal_diffusion", "temperature_sensor")


def _plain(base: Design, values: Mapping[str, float]) -> Callable[[Design], dict[str, float]]:
    def of(other: Design) -> dict[str, float]:
        return {p.name: values.get(p.name, p.start) for p in other.model.parameters}

    return of


def reference_temperatures(run_: Run) -> tuple[float, float]:
    """Mean cabinet and ambient temperature [K] over the instants with a temperature reading (else all)."""
    known = measured(run_)["temperature_K"]
    ambient = run_.timeline.input("ambient_temperature")
    there = np.isfinite(known)
    if not there.any():
        return float(ambient.mean()), float(ambient.mean())
    return float(known[there].mean()), float(ambient[there].mean())


def _thermal_entry(stage: _Stage, simulated: Mapping[str, OutputError]) -> dict | None:
    if "thermal_time_constant" not in stage.bounds:
        return None
    entry = _entry(stage, "thermal_time_constant", 1.0, simulated)
    entry["reference"] = "(R_AT+R_IC) C"
    entry["modes"] = thermal_poles(stage.base, stage.estimate_.values)
    return entry


def _hygric_entry(stage: _Stage, simulated: Mapping[str, OutputError]) -> dict | None:
    if "hygric_k" not in stage.bounds:
        return None
    cabinet, ambient = reference_temperatures(stage.run_)
    scale = float(hygric_time_constant(1.0, cabinet, ambient))
    entry = _entry(stage, "hygric_k", scale, simulated)
    entry["reference"] = {
        "definition": "R_D*·V* = k (273 K)^1.8 / (T_conv,a T_amb^0.8)",
        "cabinet_temperature_K": cabinet,
        "ambient_temperature_K": ambient,
    }
    known = measured(stage.run_)["temperature_K"]
    there = np.isfinite(known)
    factor = known[there] * exchange_factor(stage.run_.timeline.input("ambient_temperature")[there])
    k = stage.estimate_.values["hygric_k"]
    entry["range_h"] = [float(k / factor.max()), float(k / factor.min())] if there.any() else None
    entry["modes"] = [entry["value_h"]]
    return entry


def _entry(stage: _Stage, name: str, scale: float, simulated: Mapping[str, OutputError]) -> dict:
    b = stage.bounds[name]
    lower, upper, clock = _with_clock(stage, name, b)
    place = stage.uncertainty_.place(name)
    factor = float(stage.uncertainty_.factor[place]) if place is not None else 1.0
    entry = {
        "value_h": b.value * scale,
        "lower_h": lower * scale,
        "upper_h": None if math.isinf(upper) else upper * scale,
        "level": b.level,
        "method": b.method + (" with clock uncertainty" if clock else ""),
        "statement": b.statement.replace(" h", " h at 273 K")
        if name == "hygric_k" and b.statement
        else b.statement,
        "factor": factor,
        "threshold": factor * normal_quantile(b.level) ** 2,
        "curve": [[float(x) * scale, float(y)] for x, y in b.curve],
        "clock": clock or None,
        "sampling": None,
        "simulation": None,
        "disagreement": None,
    }
    if stage.sampling is not None:
        entry["sampling"] = {
            "ambient_step_h": stage.sampling["step_h"],
            "shift_ln_when_halved": stage.sampling[name],
        }
    other = simulated.get(name)
    if other is not None:
        low, high = other.bounds(name, positive=True)
        value = other.values[name]
        if high > 1e3 * low:
            entry["simulation"] = {"value_h": value * scale, "lower_h": 0.0, "upper_h": None}
            entry["simulation"]["statement"] = "not identifiable from the free run"
            return entry
        entry["simulation"] = {"value_h": value * scale, "lower_h": low * scale, "upper_h": high * scale}
        apart = abs(math.log(value / b.value))
        reach = math.hypot(
            0.5 * math.log(max(high / low, 1.0 + 1e-9)),
            0.5 * math.log(max(upper / max(lower, 1e-9), 1.0 + 1e-9)) if math.isfinite(upper) else 50.0,
        )
        if apart > reach:
            entry["disagreement"] = (
                f"innovations say {b.value * scale:.3g} h, the free run says {value * scale:.3g} h "
                f"({low * scale:.3g} … {high * scale:.3g}): more than both uncertainties explain; "
                "the model lacks something"
            )
    return entry


def _by_simulation(entry: dict | None) -> dict | None:
    """The entry with the output-error estimate in front and the innovations' beside it."""
    if entry is None or entry["simulation"] is None:
        return entry
    keys = ("value_h", "lower_h", "upper_h")
    return {
        **entry,
        "statement": "",
        **entry["simulation"],
        "method": "output error, sandwich",
        "likelihood": {key: entry[key] for key in (*keys, "method")},
    }


def _with_clock(stage: _Stage, name: str, b: Bounds) -> tuple[float, float, dict]:
    """Bounds widened by the stated uncertainty of the clocks, in quadrature on the logarithm."""
    variance, clock = 0.0, {}
    for key, shift in stage.clock.items():
        low, high = shift[name]
        variance += (0.5 * math.log(high / low)) ** 2
        clock[key] = {"uncertainty_s": shift["clock_uncertainty_s"], "shift_ln": 0.5 * math.log(high / low)}
    if not clock or b.lower <= 0 or math.isinf(b.upper):
        return b.lower, b.upper, clock
    extra = normal_quantile(b.level) * math.sqrt(variance)
    down, up = (
        math.hypot(math.log(b.value / b.lower), extra),
        math.hypot(math.log(b.upper / b.value), extra),
    )
    return b.value * math.exp(-down), b.value * math.exp(up), clock


def _assemble(
    record: Record,
    stages: list[_Stage],
    whole: Design,
    values: dict[str, float],
    simulated: Mapping[str, OutputError],
    regression,
    criterion: str,
    kind: str,
    say: Progress,
) -> Fit:
    say("free run and scores")
    if criterion == "simulation":
        for found in simulated.values():
            values |= {name: found.values[name] for name in found.names if name in values}
    errors = {
        p.name: standard_error(stage.estimate_, stage.uncertainty_, p.name)
        for stage in stages
        for p in stage.estimate_.coordinates.free
    }
    made = run(whole, record)
    spread = _covariance(stages, simulated if criterion == "simulation" else {}, values)
    predicted = free_run(whole, values, made, spread)
    thermal = next((e for stage in stages if (e := _thermal_entry(stage, simulated))), None)
    moist = next((e for stage in stages if (e := _hygric_entry(stage, simulated))), None)
    if criterion == "simulation":
        thermal, moist = _by_simulation(thermal), _by_simulation(moist)
    table = scores(made, predicted, record.until_s)
    lines = list(dict.fromkeys(line for stage in stages for line in stage.base.statements))
    lines += [e["disagreement"] for e in (thermal, moist) if e and e["disagreement"]]
    lines += [line for stage in stages for line in _remarks(stage)]
    n = sum(stage.run_.timeline.n_readings for stage in stages)
    d = sum(len(stage.estimate_.z) for stage in stages)
    loglik = sum(stage.estimate_.loglik for stage in stages)
    first = stages[0]
    results: dict = {
        "name": record.name,
        "version": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "synthetic": "synthetic" in record.name.lower(),
        "criterion": criterion,
        "kind": kind,
        "rated_power_kW": None if record.rated_power_W is None else record.rated_power_W / 1e3,
        "site": None if record.site is None else asdict(record.site),
        "period": _period(record, first),
        "design": whole.to_json(),
        "statements": lines,
        "warnings": list(record.warnings),
        "provenance": [list(p) for p in record.provenance],
        "parameters": {
            name: row for stage in stages for name, row in _parameters(stage, values, errors).items()
        },
        "covariance": {"names": list(spread[0]), "matrix": spread[1].tolist()},
        "time_constants": {"thermal": thermal, "hygric": moist},
        "loglik": loglik,
        "aic": 2.0 * d - 2.0 * loglik,
        "bic": d * math.log(max(n, 1)) - 2.0 * loglik,
        "n_obs": n,
        "converged": all(stage.estimate_.converged for stage in stages),
        "message": "; ".join(dict.fromkeys(stage.estimate_.message for stage in stages)),
        "other_optima": [
            {"objective": o, **{k: v[k] for k in TIME_CONSTANTS if k in v}}
            for stage in stages
            for o, v in stage.estimate_.others
        ],
        "at_bounds": [name for stage in stages for name in stage.estimate_.at_bounds],
        "flat": [name for stage in stages for name in stage.uncertainty_.flat],
        "trade_offs": [list(t) for stage in stages for t in stage.uncertainty_.trade_offs],
        "rmse": table,
        "baselines": baselines(made, record.until_s),
        "sensor_share": sensor_share(record, made, table),
        "bands": bands(whole, values, made, predicted, record.until_s),
        "heat_release": regression.to_json(),
    }
    say("innovations")
    series = _series(whole, values, made, predicted, record)
    results["innovations"] = _diagnosis(made, series, record)
    return Fit(record.name, whole, values, results, series)


def _period(record: Record, stage: _Stage) -> dict:
    def stamp(seconds: float | None) -> str | None:
        return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")

    return {
        "start": stamp(record.start_s),
        "until": stamp(record.until_s),
        "end": stamp(record.end_s),
        "n_instants": len(stage.run_.timeline),
        "n_readings": stage.run_.timeline.n_readings,
    }


def _remarks(stage: _Stage) -> list[str]:
    """Directions that the data do not pin down, in words."""
    lines = []
    estimate, found = stage.estimate_, stage.uncertainty_
    if "resistance_ratio" in estimate.at_bounds and estimate.values["resistance_ratio"] > 0.99:
        lines.append(
            "resistance_ratio is at its bound 1: the readings show no fast feed-through of the ambient temperature, "
            "R_IC cannot be told from 0"
        )
    for name, label in (("thermal_time_constant", "thermal"), ("hygric_k", "hygric")):
        shift = (stage.sampling or {}).get(name, 0.0)
        if name in stage.bounds and abs(shift) > 0.1:
            lines.append(
                f"every second ambient reading left out, the {label} time constant changes by {100 * math.expm1(shift):+.0f} %: "
                f"readings every {60 * stage.sampling['step_h']:.0f} min hardly resolve it"
            )
    others = [name for name in estimate.at_bounds if name != "resistance_ratio"]
    if others:
        lines.append(f"at a bound, so without standard error: {', '.join(others)}")
    if found.flat:
        lines.append(f"not pinned down by this record: {', '.join(found.flat)}")
    for a, b, r in found.trade_offs:
        lines.append(
            f"{a} and {b} trade off against each other (correlation {r:.2f}): only a combination is identified"
        )
    if not estimate.converged:
        lines.append(estimate.message)
    return lines


def _covariance(
    stages: list[_Stage], simulated: Mapping[str, OutputError], values: Mapping[str, float]
) -> tuple[tuple[str, ...], np.ndarray]:
    """Covariance of all estimated parameters in their units: the sandwich of every stage, or of the output error."""
    blocks: list[tuple[tuple[str, ...], np.ndarray]] = []
    for stage in stages:
        slopes = {p.name: p.slope(values[p.name]) for p in stage.base.model.parameters}
        taken = {name for found in simulated.values() for name in found.names}
        names = tuple(n for n in stage.uncertainty_.names if n not in taken)
        place = [stage.uncertainty_.place(n) for n in names]
        scale = np.array([slopes[n] for n in names])
        # the wider of the two pictures on the diagonal, the sandwich's correlations
        matrix = stage.uncertainty_.sandwich[np.ix_(place, place)]
        wald = np.diag(stage.uncertainty_.wald)[place]
        grow = np.sqrt(np.maximum(1.0, wald / np.maximum(np.diag(matrix), 1e-300)))
        blocks.append((names, matrix * np.outer(grow * scale, grow * scale)))
        for found in simulated.values():
            if set(found.names) <= set(slopes):
                scale = np.array([slopes[n] for n in found.names])
                blocks.append((found.names, found.covariance * np.outer(scale, scale)))
    names = tuple(n for part, _ in blocks for n in part)
    result = np.zeros((len(names), len(names)))
    first = 0
    for part, matrix in blocks:
        result[first : first + len(part), first : first + len(part)] = matrix
        first += len(part)
    return names, result


def _rows(
    stages: list[_Stage], values: Mapping[str, float], errors: Mapping[str, float], simulated: Mapping[str, OutputError]
) -> dict:
    """The parameter table; bounds of what the output error estimated come from its own sandwich."""
    rows = {name: row for stage in stages for name, row in _parameters(stage, values, errors).items()}
    positive = {p.name: p.positive for stage in stages for p in stage.base.model.parameters}
    for found in simulated.values():
        for name in found.names:
            if name in rows:
                lower, upper = found.bounds(name, positive[name])
                se = 0.5 * (upper - lower) / normal_quantile(LEVEL)
                rows[name] |= {"value": found.values[name], "lower": lower, "upper": upper, "se": se}
    return rows


def _parameters(stage: _Stage, values: Mapping[str, float], errors: Mapping[str, float]) -> dict:
    rows = {}
    for p in stage.base.model.parameters:
        b = stage.bounds.get(p.name) or wald_bounds(stage.estimate_, stage.uncertainty_, p.name)
        se = errors.get(p.name, math.nan)
        rows[p.name] = {
            "value": values[p.name],
            "unit": p.unit,
            "se": None if not math.isfinite(se) else se,
            "lower": b.lower if math.isfinite(b.lower) else None,
            "upper": b.upper if math.isfinite(b.upper) else None,
            "meaning": p.meaning,
            "prior": None if p.prior is None else {"mean": p.prior.mean, "sd": p.prior.sd},
            "fixed": p.name in stage.estimate_.coordinates.fixed,
            "at_bound": p.name in stage.estimate_.at_bounds,
        }
    return rows


def _series(base: Design, values: Mapping, whole: Run, predicted, record: Record) -> dict[str, np.ndarray]:
    t = whole.timeline
    known = measured(whole)
    nothing = np.full(len(t), np.nan)

    def pair(quantity: str) -> tuple[np.ndarray, np.ndarray]:
        return predicted.of(quantity) or (nothing, nothing)

    trace = Likelihood(base.model, t).trace(values)
    standard = (t.y - trace.prediction) / np.sqrt(trace.variance)

    def innovation(*names: str) -> np.ndarray:
        for name in names:
            if name in t.outputs:
                return standard[:, t.outputs.index(name)]
        return nothing

    def given(name: str) -> np.ndarray:
        return t.input(name) if name in (*t.varying, *t.regimes) else nothing

    power = given("power_1") if "power_1" in t.varying else np.where(whole.operating, 1.0, 0.0)
    return {
        "time_s": t.origin_s + t.time * 3600.0,
        "temperature_measured": known["temperature_K"],
        "relative_humidity_measured": known["relative_humidity"],
        "absolute_humidity_measured": known["absolute_humidity_g_m3"],
        "temperature_simulated": pair("temperature_K")[0],
        "temperature_sd": pair("temperature_K")[1],
        "relative_humidity_simulated": pair("relative_humidity")[0],
        "relative_humidity_sd": pair("relative_humidity")[1],
        "absolute_humidity_simulated": pair("absolute_humidity_g_m3")[0],
        "absolute_humidity_sd": pair("absolute_humidity_g_m3")[1],
        "temperature_innovation": innovation("cabinet_temperature"),
        "humidity_innovation": innovation("cabinet_relative_humidity", "cabinet_absolute_humidity"),
        "ambient_temperature": given("ambient_temperature"),
        "ambient_absolute_humidity": given("ambient_absolute_humidity"),
        "power": power,
        "operating": whole.operating.astype(float),
        "preheating": given("preheating") if "preheating" in t.varying else np.zeros(len(t)),
        "scored": whole.scored.astype(float),
        "until_s": np.array(math.nan if record.until_s is None else record.until_s),
        "start_s": np.array(record.start_s),
    }


def _diagnosis(whole: Run, series: Mapping[str, np.ndarray], record: Record) -> dict:
    """Whiteness of the innovations on the identification period."""
    from hygrokf.diagnosis import diagnose

    chosen = np.ones(len(whole.timeline), bool)
    if record.until_s is not None:
        chosen = series["time_s"] <= record.until_s
    standard = {
        name: series[key][chosen]
        for name, key in (("temperature", "temperature_innovation"), ("humidity", "humidity_innovation"))
        if np.isfinite(series[key]).any()
    }
    inputs = {
        name: series[name][chosen]
        for name in ("ambient_temperature", "ambient_absolute_humidity", "power", "preheating")
        if np.isfinite(series[name]).any() and np.nanstd(series[name][chosen]) > 0
    }
    return diagnose(whole.timeline.time[chosen], standard, inputs)
