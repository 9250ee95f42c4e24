"""A record on cells: means of its inputs, its readings, clocks, and what is unknown."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from plants.as_record import to_record
from plants.hidden import hidden_plant
from scipy.integrate import quad

from hygrokf.data.record import Record, Series
from hygrokf.data.shared_clocks import Shift
from hygrokf.discovery.scene import CELL_PARTS, UNKNOWN_K, Scene, driven, over_cells, scene_of
from hygrokf.discovery.starting_model import base_estimate, free_run_error
from hygrokf.modelling.design import CASCADE, design
from hygrokf.physics.psychrometrics import absolute_humidity
from hygrokf.physics.signal_names import CABINET_TEMPERATURE

START_S = 1_700_000_100.0
DAYS = 12.0
HOUR_S = 3600.0


def ambient(time_s: np.ndarray) -> np.ndarray:
    return 285.0 + 4.0 * np.sin(2.0 * np.pi * (time_s - START_S) / 86400.0)


def power(time_s: np.ndarray) -> np.ndarray:
    """[W] the mean over the ten minutes that end at a time, off in some."""
    step = np.ceil((time_s - START_S) / 600.0 - 1e-9)
    return np.where(step % 7 < 2, 0.0, 1e6 * (1.0 + 0.5 * np.sin(step)))


def cabinet(time_s: np.ndarray) -> np.ndarray:
    return 296.0 + 3.0 * np.sin(2.0 * np.pi * (time_s - START_S) / 43200.0)


def series(
    signal: str, step_s: float, course: Callable, hold: str = "linear", source: str = "SCADA"
) -> Series:  # fmt: skip
    time = START_S + np.arange(0.0 if hold != "mean" else step_s, DAYS * 86400.0 + 1.0, step_s)
    return Series(
        signal=signal, time=time, value=course(time), hold=hold, source=source,
        interval_s=step_s if hold == "mean" else 0.0,
    )  # fmt: skip


def record(*changed: Series) -> Record:
    own = [
        series("cabinet_temperature", 900.0, cabinet, source="logger"),
        series("cabinet_relative_humidity", 900.0, lambda t: 0.5 + 0.1 * np.sin(t / 2e4), source="logger"),
        series("ambient_temperature", 600.0, ambient),
        series("ambient_relative_humidity", 600.0, lambda t: 0.7 + 0.0 * t),
        series("active_power", 600.0, power, "mean"),
    ]
    by = {one.signal: one for one in (*own, *changed)}
    return Record("made", tuple(by.values()), rated_power_W=2e6)


def scene(one: Record) -> Scene:
    heat, vapour = (design(one, kind=kind, coloured=False) for kind in ("thermal", CASCADE))
    return scene_of(one, heat, vapour)


def without(one: Series, first_h: float, last_h: float) -> Series:
    hours = (one.time - START_S) / HOUR_S
    kept = (hours < first_h) | (hours > last_h)
    return replace(one, time=one.time[kept], value=one.value[kept])


# -- means over cells ----------------------------------------------------------------------------------------
def edges_of(one: Scene) -> np.ndarray:
    return one.first_s + np.arange(one.count + 1) * one.cell_h * HOUR_S


def test_cells_last_half_a_reading_and_readings_stand_at_their_edges():
    one = scene(record())
    assert one.cell_h == pytest.approx(0.125)
    places = one.readings["temperature"].end
    assert_allclose(places, np.round(places), atol=1e-6)
    assert_allclose(edges_of(one)[places.round().astype(int)], one.readings["temperature"].time_s, atol=1e-3)


@pytest.mark.parametrize(("step_s", "cell_s"), [(60.0, 180.0), (600.0, 300.0), (7200.0, 1200.0)])
def test_cells_are_neither_shorter_nor_longer_than_their_limits(step_s, cell_s):
    logger = [series(n, step_s, f, source="logger") for n, f in (
        ("cabinet_temperature", cabinet), ("cabinet_relative_humidity", lambda t: 0.5 + 0.0 * t)
    )]  # fmt: skip
    assert scene(record(*logger)).cell_h * HOUR_S == pytest.approx(cell_s)


def test_a_linear_input_has_the_means_and_edges_of_its_straight_lines():
    """Exact integrals of the lines between ten-minute readings; a corner within a part of a cell is cut by
    at most a fourth of the part times the change of slope: here 0.003 K."""
    one = scene(record())
    cells = one.cells(("ambient_temperature",), (one.heat,))
    readings = one.record["ambient_temperature"]
    edges = edges_of(one)

    def exact(a: float, b: float) -> float:
        corners = readings.time[(readings.time > a) & (readings.time < b)]
        at = np.concatenate([[a], corners, [b]])
        return float(np.trapezoid(np.interp(at, readings.time, readings.value), at)) / (b - a)

    expected = [exact(a, b) for a, b in pairwise(edges)]
    assert_allclose(cells.means[:, 0], expected, rtol=0, atol=3e-3)
    assert_allclose(cells.edges[:, 0], np.interp(edges, readings.time, readings.value), rtol=0, atol=1e-9)


@pytest.mark.parametrize("hold", ["mean", "previous"])
def test_a_held_input_has_the_means_of_its_steps(hold):
    """Each change is off by at most a part of a cell; in the mean over all cells they cancel to a tenth of
    that."""
    held = series("active_power", 600.0, power, "mean")
    if hold == "previous":
        held = replace(held, time=held.time - 600.0, interval_s=0.0, hold=hold)
    one = scene(record(held))
    found = one.cells(("operating",), (one.heat,)).means[:, 0]
    edges = edges_of(one)
    stamps = START_S + 600.0 * np.arange(0, DAYS * 144 + 1)
    on = np.append(0.0, np.cumsum(600.0 * (power(stamps[1:]) > 0.0)))
    expected = np.diff(np.interp(edges, stamps, on)) / np.diff(edges)
    inside = edges[1:] <= stamps[-1] - 600.0
    assert np.abs(found - expected)[inside].max() <= 1.0 / CELL_PARTS + 1e-9
    assert abs((found - expected)[inside].mean()) < 0.1 / CELL_PARTS


def test_cells_of_values_at_the_edges_of_parts():
    value = np.arange(2.0 * CELL_PARTS + 1.0)
    means, edges = over_cells(value, True)
    assert_allclose(means, [CELL_PARTS / 2.0, 1.5 * CELL_PARTS])
    assert_allclose(edges, [0.0, CELL_PARTS, 2.0 * CELL_PARTS])
    means, edges = over_cells(value, False)
    assert_allclose(means, [(CELL_PARTS + 1.0) / 2.0, (3.0 * CELL_PARTS + 1.0) / 2.0])
    assert_allclose(edges, [means[0], *means])


# -- readings ------------------------------------------------------------------------------------------------
def test_readings_of_instants_are_what_is_shown_at_the_end_of_their_cell():
    one = scene(record())
    shown = np.arange(1.0, one.count + 1.0)[:, None] * np.array([1.0, -2.0])
    r = one.readings["temperature"]
    kept = r.end >= 1.0
    assert_allclose(r.sampled(shown)[kept], r.end[kept, None] * np.array([1.0, -2.0]), rtol=1e-9)


def test_readings_of_interval_means_are_means():
    """Of what is shown in straight lines between the ends of cells: exactly the mean of the lines."""
    logger = [series(n, 3600.0, f, "mean", "logger") for n, f in (
        ("cabinet_temperature", cabinet), ("cabinet_relative_humidity", lambda t: 0.5 + 0.0 * t)
    )]  # fmt: skip
    one = scene(record(*logger))
    r = one.readings["temperature"]
    assert_allclose(r.end - r.begin, 3.0)
    rng = np.random.default_rng(3)
    shown = rng.standard_normal((one.count, 2))
    found = r.sampled(shown)
    place = np.arange(1.0, one.count + 1.0)
    for k in (0, 1, 20, 100):
        course = lambda x, i: np.interp(x, place, shown[:, i])  # noqa: E731
        for i in (0, 1):
            points = np.arange(math.ceil(r.begin[k]), r.end[k])
            expected = quad(course, r.begin[k], r.end[k], args=(i,), points=points)[0] / 3.0
            assert found[k, i] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("hours", [-30.0, -1.5, 1.5, 30.0])
@pytest.mark.parametrize("hold", ["linear", "mean"])
def test_moved_readings_beyond_the_cells_are_what_is_shown_at_their_ends(hold, hours):
    logger = [series(n, 3600.0, f, hold, "logger") for n, f in (
        ("cabinet_temperature", cabinet), ("cabinet_relative_humidity", lambda t: 0.5 + 0.0 * t)
    )]  # fmt: skip
    one = scene(record(*logger)).moved(Shift("logger", hours * HOUR_S))
    found = one.readings["temperature"].sampled(np.linspace(290.0, 300.0, one.count)[:, None])
    assert 290.0 <= found.min() < found.max() <= 300.0 + 1e-9
    assert (np.diff(found[:, 0]) > -1e-9).all()


def test_vapour_is_humidity_times_saturation_over_the_interval():
    """Simulated humidity is turned into vapour at the mean temperature of the reading's interval."""
    for step_s, hold in ((900.0, "linear"), (3600.0, "mean")):
        logger = [series(n, step_s, f, hold, "logger") for n, f in (
            ("cabinet_temperature", cabinet), ("cabinet_relative_humidity", lambda t: 0.5 + 0.0 * t)
        )]  # fmt: skip
        one = scene(record(*logger))
        r = one.readings["vapour"]
        inside = slice(5, -5)
        assert_allclose(r.saturated[inside] * 0.5, r.value[inside], rtol=2e-4)
        warmer = driven(one, one.drive + 2.0).readings["vapour"]
        mean = one.record["cabinet_temperature"].value
        at = np.searchsorted(one.record["cabinet_temperature"].time, r.time_s)
        expected = 1e3 * absolute_humidity(1.0, mean[at] + 2.0)
        assert_allclose(warmer.saturated[inside], expected[inside], rtol=2e-4)
        assert_allclose(warmer.value, r.value)


def test_readings_at_the_ends_of_the_sensors_range_are_left_out():
    def ends(time: np.ndarray) -> np.ndarray:
        k = np.arange(len(time))
        return np.where((k >= 100) & (k < 110), 1.0, np.where((k >= 200) & (k < 203), 0.0, 0.5))

    humid = series("cabinet_relative_humidity", 900.0, ends, source="logger")
    r = scene(record(humid)).readings["vapour"]
    at = np.searchsorted(humid.time, r.time_s)
    gone = np.isin(at, [*range(100, 110), *range(200, 203)])
    assert gone.sum() == 13
    assert np.isnan(r.value[gone]).all()
    assert np.isfinite(r.value[~gone][1:]).all()
    # they say nothing of the inputs: the error goes on
    assert np.count_nonzero(r.added) == 1


# -- clocks --------------------------------------------------------------------------------------------------
def test_a_moved_source_shifts_its_inputs_and_nothing_else():
    one = scene(record())
    later = one.moved(Shift("SCADA", 1800.0))
    names = ("ambient_temperature", "operating", CABINET_TEMPERATURE)
    before, after = (x.cells(names, (one.heat, one.vapour)).means for x in (one, later))  # type: ignore[arg-type]
    shift = round(1800.0 / (one.cell_h * HOUR_S))
    for c in (0, 1):
        assert_allclose(after[shift + 1 :, c], before[1:-shift, c], rtol=0, atol=1e-9)
    assert_allclose(after[:, 2], before[:, 2], rtol=0, atol=0)
    assert later.readings["temperature"] is one.readings["temperature"]
    back = later.moved(Shift("SCADA", -1800.0)).cells(names, (one.heat, one.vapour)).means  # type: ignore[arg-type]
    assert_allclose(back, before)


def test_a_moved_logger_shifts_its_readings():
    """The readings stay the same ones; they are compared with a later simulation, and the temperature that
    drives the vapour comes with them."""
    one = scene(record())
    later = one.moved(Shift("logger", 1800.0))
    shift = 1800.0 / (one.cell_h * HOUR_S)
    for q in ("temperature", "vapour"):
        assert_allclose(later.readings[q].end, one.readings[q].end + shift)
        assert_allclose(later.readings[q].begin, one.readings[q].begin + shift)
        assert later.readings[q].value is one.readings[q].value
    drive = [x.cells((CABINET_TEMPERATURE,), (one.heat,)).means[:, 0] for x in (one, later)]
    assert_allclose(drive[1][5:], drive[0][5 - round(shift) : -round(shift)], rtol=0, atol=1e-9)


def test_a_clock_that_is_off_in_summer_time_moves_summer_alone():
    """The record's site has the summer time of Europe, which ends on 25 October 2020 at 01:00 UTC."""
    one = scene(record())
    end = 1603587600.0
    turned = replace(one, first_s=end - 0.5 * one.count * one.cell_h * HOUR_S)
    later = turned._delay(Shift("SCADA", -3600.0, summer=True), turned.edges_s)
    assert (later[turned.edges_s < end] == -3600.0).all() and (later[turned.edges_s >= end] == 0.0).all()


# -- what is unknown -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("signal", ["ambient_temperature", "active_power"])
def test_readings_in_a_gap_of_an_input_are_left_out_and_the_error_begins_anew(signal):
    whole = record()
    one = scene(record(without(whole[signal], 100.0, 130.0)))
    r = one.readings["temperature"]
    hours = (r.time_s - START_S) / HOUR_S
    gone = np.isnan(r.value)
    assert gone[(hours > 102.0) & (hours < 129.5)].all()
    # a mean of the power says nothing of the instant at which the record begins
    assert not gone[1:][((hours < 99.0) | (hours > 131.0))[1:]].any()
    begun = np.flatnonzero(r.added)
    first = np.flatnonzero(~gone & (hours > 115.0))[0]
    assert begun.tolist() == [np.flatnonzero(~gone)[0], first]
    assert_allclose(r.added[begun], UNKNOWN_K)


def test_a_short_gap_of_an_input_is_bridged():
    whole = record()
    one = scene(record(without(whole["ambient_temperature"], 100.0, 101.0)))
    r = one.readings["temperature"]
    assert np.isfinite(r.value[1:]).all()
    assert np.count_nonzero(r.added) == 1


def test_a_gap_of_the_logger_is_no_gap_of_the_heat():
    """Its error goes on; the vapour's begins anew, since what drives it was unknown."""
    whole = record()
    logger = [without(whole[n], 100.0, 130.0) for n in ("cabinet_temperature", "cabinet_relative_humidity")]
    one = scene(record(*logger))
    assert all(np.isfinite(r.value[1:]).mean() > 0.998 for r in one.readings.values())
    assert np.isfinite(one.readings["temperature"].value[1:]).all()
    begun = {q: np.flatnonzero(r.added) for q, r in one.readings.items()}
    assert begun["temperature"].tolist() == [1]
    later = (one.readings["vapour"].time_s[begun["vapour"]] - START_S) / HOUR_S
    assert later.tolist() == pytest.approx([0.25, 130.5], abs=0.26)


def test_readings_after_the_identification_period_are_marked():
    until = START_S + 8.0 * 86400.0
    r = scene(replace(record(), until_s=until)).readings["temperature"]
    assert np.array_equal(r.identified, r.time_s <= until)
    assert 0.6 < r.identified.mean() < 0.7


@pytest.mark.parametrize("options", [{}, {"logger_mean": True}], ids=["instants", "means"])
def test_the_base_model_of_a_plant_is_found_from_its_cells(options):
    """With gaps of logger and power, from instants and from interval means alike."""
    made = hidden_plant(8702, "none", days=60.0, **options)
    found = base_estimate(to_record(made))
    assert found.values["thermal_time_constant"] == pytest.approx(made.truth.tau_h, rel=0.1)
    assert found.values["hygric_k"] == pytest.approx(made.truth.hygric_constant_h, rel=0.1)
    for quantity, largest in (("temperature", 2.0), ("vapour", 0.7)):
        assert free_run_error(found, quantity) < largest
        assert np.isfinite(found.deviances[quantity])
