"""A fit on a record: the simulation file, its summary, and the evaluation with its text."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
from builders.known_values import RELEASE
from builders.record_edits import changed, without

from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record, Series
from hygrokf.data.result_file import result_text
from hygrokf.data.structured import plain, structured
from hygrokf.estimation.inference import confidence_intervals
from hygrokf.estimation.smoother import smoothed_states
from hygrokf.evaluation.prediction import forecast, innovations, simulate, smooth
from hygrokf.evaluation.scoring import REGIMES
from hygrokf.evaluation.simulation import Prediction, forecasts, free_run, measured, settled
from hygrokf.identification import fit_on_record
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_on_record import (
    Evaluation,
    SimulationSummary,
    evaluate,
    simulate_fit,
    simulation_csv,
    simulation_summary,
)
from hygrokf.identification.fit_results import Covariance, FitResults
from hygrokf.identification.identify import identify
from hygrokf.modelling.design import design
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.report.blocks import Table
from hygrokf.report.fit_tables import evaluation_blocks, evaluation_text
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.parts import SCORED
from hygrokf.texts.wording import NONE, QUANTITY_NAMES, RULE_NAMES

HOUR = 3600.0
DAY = 86400.0
KNOWN = RELEASE | {
    "thermal_time_constant": 1.5,
    "resistance_ratio": 0.85,
    "hygric_k": 0.35,
    "preheating_heat": 9.0,
}


def unfitted(record: Record) -> Fit:
    """A fit without the fitting: the model that the record calls for, its parameters near the truth."""
    base = design(record.identification())
    values = {p.name: KNOWN.get(p.name, p.start) for p in base.model.parameters}
    return Fit("made", base, values, spread(0.2))


def spread(standstill_K2: float) -> FitResults:
    """Results with a covariance of two parameters, the second one's variance stated."""
    names = ("thermal_time_constant", "heat_release_standstill")
    return FitResults(covariance=Covariance(names, np.diag([0.01, standstill_K2])))


def csv_of(fit: Fit, record: Record) -> str:
    """The simulation file of a fit on a record."""
    return simulation_csv(*simulate_fit(fit, record)[1:])


def summary_of(fit: Fit, record: Record) -> SimulationSummary:
    """The summary of that file."""
    return simulation_summary(fit, *simulate_fit(fit, record)[1:])


def parsed(text: str) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names of the columns, times [s] and cells of a simulation file; empty cells are NaN."""
    head, *lines = csv.reader(io.StringIO(text))
    assert all(len(line) == len(head) for line in lines)
    times = [datetime.fromisoformat(line[0]).timestamp() for line in lines]
    cells = [[float(cell) if cell else np.nan for cell in line[1:]] for line in lines]
    return head, np.array(times), np.array(cells)


@pytest.fixture(scope="module")
def record(tmp_path_factory) -> Record:
    """Twelve days of the synthetic turbine, the last four of them for validation."""
    read = read_case(write_case(synthetic_turbine(seed=4, days=12), tmp_path_factory.mktemp("turbine")))
    return replace(read, until_s=read.start_s + 8 * DAY)


@pytest.fixture(scope="module")
def fit(record) -> Fit:
    return unfitted(record)


@pytest.fixture(scope="module")
def text(fit, record) -> str:
    return csv_of(fit, record)


@pytest.fixture(scope="module")
def found(fit, record) -> dict:
    return evaluate(fit, record)


def columns_of(names: Sequence[str]) -> list[str]:
    """The head of a simulation file with these quantities."""
    return ["time", *(f"cabinet_{name}{end}" for name in names for end in ("", "_sd")), "inputs_known"]


# --- the simulation file ---------------------------------------------------------------------


def test_the_file_is_the_free_run_in_everyday_units(fit, record, text):
    head, times, cells = parsed(text)
    names = ("temperature_degC", "relative_humidity_pct", "absolute_humidity_g_m3")
    assert head == columns_of(names)
    whole = model_inputs(fit.design, record)
    ran = free_run(fit.design, fit.values, whole, fit.covariance)
    np.testing.assert_allclose(times, whole.timeline.seconds, atol=1e-3)
    columns = [
        ran.temperature[0] - 273.15,
        ran.temperature[1],
        100 * ran.relative_humidity[0],
        100 * ran.relative_humidity[1],
        *ran.absolute_humidity,
    ]
    np.testing.assert_allclose(cells[:, :6], np.column_stack(columns), atol=6e-5)
    np.testing.assert_array_equal(cells[:, 6], settled(fit.design, fit.values, whole).scored)


def test_the_cabinets_own_readings_do_not_matter(fit, record, text):
    """Only inputs drive a simulation: other readings at the same times give the same file."""
    spoilt = [
        replace(record[name], value=record[name].value * 0.9) for name in record.signals if "cabinet" in name
    ]
    assert csv_of(fit, record.replace_series(*spoilt)) == text


def test_parameters_that_are_less_sure_widen_the_bands(fit, record, text):
    _, _, wider = parsed(csv_of(replace(fit, results=spread(9.0)), record))
    _, _, cells = parsed(text)
    np.testing.assert_array_equal(wider[:, 0], cells[:, 0])
    idle = ~model_inputs(fit.design, record).operating
    assert np.mean(wider[idle, 1] > cells[idle, 1] + 0.3) > 0.7
    assert np.all(wider[:, 1] >= cells[:, 1])


def test_whole_seconds_stay_whole_and_milliseconds_are_written(fit, record, text):
    assert text.splitlines()[1].split(",")[0] == "2020-07-15T00:06:40Z"
    late = [
        replace(record[name], time=record[name].time + 0.25) for name in record.signals if "cabinet" in name
    ]
    moved = csv_of(fit, record.replace_series(*late))
    stamps = [line.split(",")[0] for line in moved.splitlines()[1:]]
    assert {len(stamp) for stamp in stamps} == {len("2020-07-15T00:06:40.000Z")}
    assert stamps[:2] == ["2020-07-15T00:06:40.000Z", "2020-07-15T00:10:00.000Z"]
    assert any(stamp.endswith(":20.250Z") for stamp in stamps)
    assert stamps == sorted(stamps)


def test_every_cell_of_a_small_file():
    """Four decimals, milliseconds only where they are needed, an empty cell where there is no number."""
    start = datetime(2021, 1, 1, tzinfo=UTC).timestamp()
    line = SimpleNamespace(seconds=start + HOUR * np.array([0.0, 0.5, 1.0]))
    ran = Prediction(
        (np.array([293.15, np.nan, 272.65]), np.array([0.5, np.inf, 0.25])),
        None,
        (np.array([7.0, 7.12344, 7.12346]), np.array([0.1, 0.2, 0.3])),
    )
    flags = np.array([True, False, True])
    run = Run(prepare(Record("none", ())), line, flags, flags)
    lines = [
        "time,cabinet_temperature_degC,cabinet_temperature_degC_sd,"
        "cabinet_absolute_humidity_g_m3,cabinet_absolute_humidity_g_m3_sd,inputs_known",
        "2021-01-01T00:00:00Z,20.0000,0.5000,7.0000,0.1000,1",
        "2021-01-01T00:30:00Z,,,7.1234,0.2000,0",
        "2021-01-01T01:00:00Z,-0.5000,0.2500,7.1235,0.3000,1",
    ]
    assert simulation_csv(run, ran).splitlines() == lines
    line.seconds[1] += 0.0014
    assert simulation_csv(run, ran).splitlines()[2] == "2021-01-01T00:30:00.001Z,,,7.1234,0.2000,0"


@pytest.mark.parametrize(
    ("change", "columns"),
    [
        (lambda record: without(record, "cabinet_relative_humidity"), ["temperature_degC"]),
        (lambda record: without(record, "ambient_relative_humidity"), ["temperature_degC"]),
        (
            lambda record: replace(record, series=tuple(absolute(one) for one in record.series)),
            ["temperature_degC", "absolute_humidity_g_m3"],
        ),
    ],
    ids=["no humidity inside", "no humidity outside", "absolute humidity"],
)
def test_columns_are_those_that_the_model_has(record, change, columns):
    other = change(record)
    head, _, cells = parsed(csv_of(unfitted(other), other))
    assert head == columns_of(columns)
    assert np.isfinite(cells).all()


def absolute(one: Series) -> Series:
    """A relative humidity of the cabinet as an absolute one at 25 °C [kg/m³]."""
    if one.signal != "cabinet_relative_humidity":
        return one
    return replace(one, signal="cabinet_absolute_humidity", value=0.023 * one.value, resolution=2.3e-5)


def test_a_fit_runs_on_inputs_alone(fit, record):
    """Without any cabinet the run spans the ambient series."""
    inputs = without(record, "cabinet_temperature", "cabinet_relative_humidity")
    _, times, cells = parsed(csv_of(fit, inputs))
    ambient = inputs["ambient_temperature"].time
    assert (times[0], times[-1]) == (ambient[0], ambient[-1])
    assert np.isfinite(cells).all()


@pytest.mark.parametrize("signal", ["ambient_temperature", "ambient_relative_humidity", "active_power"])
def test_a_gap_of_an_input_is_flagged_until_the_state_has_forgotten_it(fit, record, text, signal):
    """Two days without an input: the numbers go on, unknown until the free run has forgotten the gap."""
    _, times, cells = parsed(
        csv_of(fit, changed(record, signal, np.nan, record.start_s + 3 * DAY, record.start_s + 5 * DAY))
    )
    assert np.isfinite(cells).all()
    days = (times - record.start_s) / DAY
    assert not cells[(days > 3.05) & (days < 5.02), -1].any()
    _, before, whole = parsed(text)
    sure = (days < 2.95) | (days > 5.55)
    np.testing.assert_array_equal(cells[sure, -1], np.interp(times[sure], before, whole[:, -1]) == 1.0)


def test_a_model_that_knows_the_power_is_never_sure_without_it(fit, record):
    idle = without(record, "active_power")
    _, _, cells = parsed(csv_of(fit, idle))
    assert np.isfinite(cells).all()
    assert not cells[:, -1].any()
    assert summary_of(fit, idle).share_with_known_inputs == 0.0
    own = unfitted(idle)  # a fit of its own counts the record as standstill, and knows all of that
    assert summary_of(own, idle).share_with_known_inputs == 1.0


def test_inputs_that_the_model_reads_must_be_there(fit, record):
    with pytest.raises(ValueError, match=r"reads an ambient humidity .* which the record does not have"):
        csv_of(fit, without(record, "ambient_relative_humidity"))


def test_loggers_that_average_are_simulated_as_such(fit, record):
    """Hourly means of the cabinet, a fit of instants: the rows at the readings are means of the free run."""
    inside = record["cabinet_temperature"]
    hours = np.arange(record.start_s + HOUR, record.end_s, HOUR)
    means = replace(inside, time=hours, value=np.full(len(hours), 295.0), hold="mean", interval_s=HOUR)
    _, times, averaged = parsed(csv_of(fit, record.replace_series(means)))
    _, base, instants = parsed(csv_of(fit, record))
    place = np.searchsorted(times, hours[(hours > times[0] + HOUR) & (hours <= times[-1])])
    curve = [
        np.interp(times[p] - HOUR * (np.arange(60) + 0.5) / 60, base, instants[:, 0]).mean() for p in place
    ]
    apart = averaged[place, 0] - np.array(curve)
    assert np.sqrt(np.mean(apart**2)) < 0.05
    ends = np.interp(times[place], base, instants[:, 0])
    assert np.sqrt(np.mean((averaged[place, 0] - ends) ** 2)) > 0.2


# --- the summary -----------------------------------------------------------------------------


def test_the_summary_is_that_of_the_file(fit, record, text):
    _, times, cells = parsed(text)
    summary = summary_of(fit, record)
    assert (summary.fit, summary.record) == ("made", "synthetic-turbine-4")
    ends = [datetime.fromisoformat(getattr(summary, key)).timestamp() for key in ("start", "end")]
    np.testing.assert_allclose(ends, [times[0], times[-1]], atol=1.0)
    assert summary.start.endswith("+00:00")
    assert summary.n == len(times)
    assert summary.share_with_known_inputs == pytest.approx(cells[:, 6].mean())
    means = summary.means
    assert list(means) == ["temperature_K", "relative_humidity", "absolute_humidity_g_m3"]
    expected = cells[:, 0].mean() + 273.15, cells[:, 2].mean() / 100, cells[:, 4].mean()
    np.testing.assert_allclose(list(means.values()), expected, atol=1e-4)
    assert plain(structured(SimulationSummary, json.loads(result_text(summary)))) == plain(summary)


def test_mismatches_of_fit_and_record_are_reported(fit, record):
    idle = without(record, "preheating")
    (statement,) = summary_of(fit, idle).statements
    assert statement == FitCode.PREHEATING_NOT_LOGGED()
    assert f"note: {statement}" in " ".join(evaluation_text(evaluate(fit, idle)).split())
    assert summary_of(unfitted(idle), record).statements == (FitCode.PREHEATING_NOT_MODELLED(),)


# --- the evaluation --------------------------------------------------------------------------


def errors(record: Record, text: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From the file alone: times [s] of the temperature readings, their errors and spread [K]."""
    _, times, cells = parsed(text)
    inside = record["cabinet_temperature"]
    known = ~inside.missing & np.isin(inside.time, times)
    place = np.searchsorted(times, inside.time[known])
    sure = cells[place, 6] == 1
    return (
        inside.time[known][sure],
        (inside.value[known] - 273.15 - cells[place, 0])[sure],
        cells[place, 1][sure],
    )


def test_scores_are_those_of_the_file(record, text, found):
    time, error, sd = errors(record, text)
    late = time > record.until_s
    for period, chosen in (("identification", ~late), ("validation", late)):
        cells = found.rmse[period]["temperature_K"]
        assert cells.n.total == chosen.sum() > 100
        assert cells.total == pytest.approx(np.sqrt(np.mean(error[chosen] ** 2)), abs=1e-4)
        parts = (cells.n.operation * cells.operation**2, cells.n.standstill * cells.standstill**2)
        assert sum(parts) == pytest.approx(cells.n.total * cells.total**2)
    band = found.bands["free_run"]["temperature_K"]
    assert band.n == late.sum()
    assert band.coverage == pytest.approx(np.mean(np.abs(error[late]) < 1.959964 * sd[late]), abs=0.005)


def test_the_evaluation_has_everything_and_is_json(found):
    assert found.statements == ()
    assert list(found.bands) == ["1h", "6h", "24h", "free_run"]
    for period in ("identification", "validation"):
        assert set(found.baselines[period]) == {"ambient", "ambient_pressure_balance", "no_dynamics"}
        assert set(found.sensor_share[period]) == {"temperature_K", "absolute_humidity_g_m3"}
    assert plain(structured(Evaluation, json.loads(result_text(found)))) == plain(found)


def tables_of(found: Evaluation) -> dict[str, Table]:
    return {one.heading: one for one in evaluation_blocks(found) if isinstance(one, Table)}


def test_the_tables_show_every_score_under_its_label(found):
    shown = tables_of(found)
    assert list(shown)[:2] == [f"Root mean squared error, {p}" for p in ("identification", "validation")]
    for period in ("identification", "validation"):
        rows = {row[0]: row[1:] for row in shown[f"Root mean squared error, {period}"].rows}
        model = [found.errors(period, quantity) for quantity in SCORED]
        expected = {
            "model, free run": [f"{getattr(e, regime):.2f}" for e in model for regime in REGIMES],
            "readings": [str(getattr(e.n, regime)) for e in model for regime in REGIMES],
            **{
                words: [
                    f"{value:.2f}" if math.isfinite(value) else NONE
                    for quantity in SCORED
                    for regime in REGIMES
                    for value in (getattr(found.rule_errors(period, key, quantity), regime),)
                ]
                for key, words in RULE_NAMES.items()
            },
        }
        assert {label: list(rows[label]) for label in expected} == expected
    bands = shown["Readings inside the 95 % bands"].rows
    assert [row[0] for row in bands] == ["1 h ahead", "6 h ahead", "24 h ahead", "free run"]
    for row, lead in zip(bands, found.bands, strict=True):
        for place, quantity in enumerate(QUANTITY_NAMES):
            one = found.band(lead, quantity)
            cells = (f"{100 * one.coverage:.1f} %", f"{one.scale:.2f}", str(one.n))
            assert row[3 * place + 1 : 3 * place + 4] == cells
    text = evaluation_text(found)
    assert text.startswith("made on synthetic-turbine-4: errors of the free run\n")
    assert all(len(line) <= 100 for line in text.splitlines())


def test_a_record_without_a_validation_period_has_one_table_of_errors(fit, record):
    shown = tables_of(evaluate(fit, replace(record, until_s=None)))
    assert list(shown) == ["Root mean squared error, identification", "Readings inside the 95 % bands"]


def test_a_thermal_fit_scores_the_temperature_alone(record):
    dry = without(record, "cabinet_relative_humidity", "ambient_relative_humidity")
    found = evaluate(unfitted(dry), dry)
    assert found.rmse["validation"]["temperature_K"].total > 0
    assert math.isnan(found.errors("validation", "absolute_humidity_g_m3").total)
    assert set(found.baselines["validation"]) == {"no_dynamics"}
    assert set(found.bands["free_run"]) == {"temperature_K"}
    shown = tables_of(found)
    for row in shown["Root mean squared error, validation"].rows:
        assert set(row[4:]) <= {NONE, "0"}
    (free_run,) = (row for row in shown["Readings inside the 95 % bands"].rows if row[0] == "free run")
    assert free_run[1] != NONE and set(free_run[4:]) == {NONE}


@pytest.mark.parametrize(
    "change",
    [
        lambda record: without(record, "active_power"),
        lambda record: without(record, "cabinet_temperature"),
        lambda record: changed(record, "cabinet_temperature", np.nan),
    ],
    ids=["no power", "no temperature", "no reading"],
)
def test_an_evaluation_without_readings_gives_the_reasons(fit, record, change):
    other = change(record)
    found = evaluate(fit, other)
    shown = evaluation_text(found)
    assert "Nothing to score" in shown and not tables_of(found)
    shown = " ".join(shown.split())
    for words in ("no temperature or absolute humidity of the cabinet", "needs the power", "`hygrokf check`"):
        assert words in shown
    assert csv_of(fit, other).count("\n") > 1000


# --- the public verbs of a fit --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["cascade", pytest.param("joint", marks=pytest.mark.slow)])
def test_the_likelihood_of_a_fit_has_the_value_that_the_fit_states(record, kind) -> None:
    """At the reported values, on the identification part alone, whose last instant is the last one before."""
    found = identify(record, starts=1, profiles=False, kind=kind)
    made = found.likelihood(record)
    assert made.value(found.values) == pytest.approx(found.results.loglik, rel=1e-9)
    assert made.timeline.part == "identification" and "identification" in repr(made)
    assert made.timeline.seconds[-1] <= record.until_s
    assert made.timeline.n_readings == found.results.n_obs
    whole = found.likelihood(record, part="whole")
    assert whole.timeline.part == "whole" and whole.timeline.seconds[-1] > record.until_s
    assert whole.value(found.values) > made.value(found.values) + 100.0
    for name, tau in found.results.time_constants.items():
        parameter = {"thermal": "thermal_time_constant", "hygric": "hygric_k"}[name]
        # a cascade ends beside the maximum of the whole likelihood; both are inside the bounds
        bounds = confidence_intervals(found, record, [parameter], "wald")[parameter]
        scale = found.values[parameter] / tau.value_h
        assert tau.lower_h * scale < bounds.value < tau.upper_h * scale
        assert bounds.lower < found.values[parameter] < bounds.upper
    words = repr(found).splitlines()
    assert len(words) <= 12 and f"{found.results.loglik:.2f}" in words[-1] and "identification" in words[-1]


def test_a_part_that_a_record_does_not_have_is_named(fit, record) -> None:
    with pytest.raises(ValueError, match="part: expected 'identification' or 'whole', found 'late'"):
        fit.likelihood(record, part="late")
    with pytest.raises(
        ValueError, match=r"likelihood: expected a Record, found the path 'case.toml'; read_case"
    ):
        fit.likelihood("case.toml")


def test_simulate_takes_the_fit_and_its_record(fit, record) -> None:
    """What the simulation file has, with the readings beside it."""
    _, run, expected = fit_on_record.simulate_fit(fit, record)
    found = simulate(fit, record)
    assert list(found.value) == [
        "cabinet_temperature", "cabinet_relative_humidity", "cabinet_absolute_humidity",
    ]  # fmt: skip
    for name, quantity in zip(
        found.value, ("temperature_K", "relative_humidity", "absolute_humidity_g_m3"), strict=True
    ):
        pair = expected.of(quantity)
        assert pair is not None
        np.testing.assert_array_equal(found[name][0], pair[0])
        np.testing.assert_array_equal(found[name][1], pair[1])
        np.testing.assert_array_equal(found.reading[name], measured(run)[quantity])
    np.testing.assert_array_equal(found.origin_s + 3600.0 * found.time_h, run.timeline.seconds)
    assert found.to_frame().attrs["units"]["cabinet_temperature_upper"] == "K"


def test_forecast_takes_the_fit_and_its_record(fit, record) -> None:
    """The rows that `hygrokf evaluate` counts, where both quantities are read together."""
    base, run, _ = fit_on_record.simulate_fit(fit, record)
    first = 0
    expected = forecasts(base, fit.values, run, first, (1.0,), count=30)[1.0]["temperature_K"]
    found = forecast(fit, record, leads_h=(1.0,), count=30)
    rows = {float(value): (value, sd) for value, sd in np.column_stack(found["cabinet_temperature"])}
    shared = [(value, sd) for _, value, sd in zip(*expected, strict=True) if value in rows]
    assert len(shared) >= 20
    np.testing.assert_array_equal([rows[value] for value, _ in shared], shared)
    short = replace(record, series=tuple(
        replace(one, time=one.time[:-60], value=one.value[:-60]) if one.signal.startswith("cabinet") else one
        for one in record.series
    ))  # fmt: skip
    single = forecast(fit, short)
    assert single.lead_h.min() > 0.0 and set(single.value) == set(found.value)
    ends = short["cabinet_temperature"].time[-1], record["ambient_temperature"].time[-1]
    assert single.origin_s + 3600.0 * single.time_h[-1] == pytest.approx(ends[1], abs=1800.0)
    assert single.lead_h[-1] == pytest.approx((ends[1] - ends[0]) / 3600.0, abs=0.5)


def test_smoothed_states_and_innovations_of_a_fit_are_those_of_its_likelihood(fit, record) -> None:
    whole = fit.likelihood(record, "whole")
    states = smooth(fit, record)
    np.testing.assert_array_equal(states.mean, smoothed_states(whole, fit.values)[0])
    assert list(states.value) == list(fit.design.model.states)
    errors = innovations(fit, record)
    assert set(errors.error) == {"cabinet_temperature", "cabinet_relative_humidity"}
    assert errors.tests().outputs["cabinet_temperature"].n == np.isfinite(whole.timeline.y[:, 0]).sum()
