"""The synthetic turbine: its physics, its size, its loggers' faults and its four files."""

from __future__ import annotations

import ast
import csv
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hygrokf.cases import synthetic
from hygrokf.cases.synthetic import (
    SyntheticParameters,
    SyntheticTable,
    SyntheticTurbine,
    synthetic_turbine,
    write_case,
)

QUIET = SyntheticParameters(
    heat_disturbance_K=0.0,
    vapour_disturbance_kg_m3=0.0,
    temperature_diffusion_K=0.0,
    humidity_diffusion_kg_m3=0.0,
)
MINUTE_H = 1.0 / 60.0


@pytest.fixture(scope="module")
def turbine() -> SyntheticTurbine:
    return synthetic_turbine(1)


@pytest.fixture(scope="module")
def quiet() -> SyntheticTurbine:
    return synthetic_turbine(1, parameters=QUIET)


def root_mean_square(values: np.ndarray) -> float:
    return math.sqrt(float(np.mean(values**2)))


def hourly_integral(rate: np.ndarray) -> np.ndarray:
    """Trapezoidal integral over each hour of a rate [1/h] given each minute."""
    middle = 0.5 * (rate[:-1] + rate[1:]) * MINUTE_H
    return middle[: middle.size // 60 * 60].reshape(-1, 60).sum(axis=1)


def test_thermal_truth_obeys_equations_2_and_3(quiet: SyntheticTurbine) -> None:
    truth, parameters = quiet.truth, quiet.truth.parameters
    tau, rho = parameters.thermal_time_constant_h, parameters.resistance_ratio
    exchange = (truth.ambient_temperature - truth.converter_temperature) / tau
    # 1/(C R_AT) = 1/(tau rho); the release holds over the minute, as the power does.
    heating = truth.heat_release[:-1] * MINUTE_H / (tau * rho)
    heating = heating[: heating.size // 60 * 60].reshape(-1, 60).sum(axis=1)
    change = np.diff(truth.converter_temperature[::60])
    np.testing.assert_allclose(change, hourly_integral(exchange) + heating, atol=2e-4)
    mixed = rho * truth.converter_temperature + (1.0 - rho) * truth.ambient_temperature
    np.testing.assert_allclose(truth.cabinet_temperature, mixed, rtol=1e-14)


def test_hygric_truth_obeys_equations_4_and_5(quiet: SyntheticTurbine) -> None:
    truth = quiet.truth
    speed = truth.cabinet_temperature * truth.ambient_temperature**0.8 / 273.0**1.8
    rate = 3600.0 * speed / truth.hygric_constant_s
    flow = rate * (truth.ambient_absolute_humidity - truth.equivalent_humidity)
    change = np.diff(truth.equivalent_humidity[::60])
    np.testing.assert_allclose(change, hourly_integral(flow), atol=6e-7)
    assert root_mean_square(change) > 1e-4
    shifted = truth.equivalent_humidity * truth.ambient_temperature / truth.cabinet_temperature
    np.testing.assert_allclose(truth.cabinet_absolute_humidity, shifted, rtol=1e-14)


def test_stated_time_constants_are_the_true_ones(turbine: SyntheticTurbine) -> None:
    truth = turbine.truth
    assert truth.parameters.thermal_time_constant_h == 1.5
    assert truth.parameters.resistance_ratio == 0.85
    cabinet, ambient = truth.cabinet_temperature.mean(), truth.ambient_temperature.mean()
    hours = truth.hygric_constant_s / 3600.0 * 273.0**1.8 / (cabinet * ambient**0.8)
    assert hours == pytest.approx(0.30, rel=1e-12)


def test_release_spans_about_five_kelvin_from_part_load_to_full_load() -> None:
    b0, b1, b2, _ = SyntheticParameters().operation_release
    idle, full = b0, b0 + b1 + b2
    assert full - idle == pytest.approx(5.0, abs=0.5)
    assert SyntheticParameters().standstill_release[0] < idle


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bare_free_run_errs_as_in_the_paper(seed: int) -> None:
    disturbed = synthetic_turbine(seed).truth
    bare = synthetic_turbine(seed, parameters=QUIET).truth
    kelvin = root_mean_square(disturbed.cabinet_temperature - bare.cabinet_temperature)
    grams = 1e3 * root_mean_square(disturbed.cabinet_absolute_humidity - bare.cabinet_absolute_humidity)
    assert 1.2 < kelvin < 1.65
    assert 0.34 < grams < 0.46


def test_weather_and_operation_resemble_an_english_site(turbine: SyntheticTurbine) -> None:
    truth = turbine.truth
    celsius = truth.ambient_temperature - 273.15
    assert 8.5 < celsius.mean() < 12.0
    assert -12.0 < celsius.min() < 2.0
    assert 22.0 < celsius.max() < 36.0
    summer, winter = celsius[: 30 * 1440], celsius[-30 * 1440 :]
    assert summer.mean() - winter.mean() > 8.0
    days = celsius[: 30 * 1440].reshape(30, 1440)
    assert 5.0 < (days.max(axis=1) - days.min(axis=1)).mean() < 14.0
    rise = truth.cabinet_temperature - truth.ambient_temperature
    assert 6.0 < rise.mean() < 11.0
    assert 0.2 < truth.active_power.mean() / truth.parameters.rated_power_W < 0.4
    assert 0.1 < np.mean(truth.active_power <= 0.0) < 0.3
    ratio = truth.cabinet_absolute_humidity.mean() / truth.ambient_absolute_humidity.mean()
    assert 0.95 < ratio < 1.0


def test_fault_standstills_end_with_preheating(turbine: SyntheticTurbine) -> None:
    truth = turbine.truth
    on = truth.preheating > 0.0
    assert np.all(truth.active_power[on] <= 0.0)
    starts = np.flatnonzero(np.diff(on.astype(int)) == 1) + 1
    ends = np.flatnonzero(np.diff(on.astype(int)) == -1) + 1
    assert starts.size == ends.size == 3
    for start, end in zip(starts, ends, strict=True):
        assert 4 * 60 < end - start < 12 * 60
        assert np.all(truth.active_power[start - 2 * 1440 : start] <= 0.0)
        warmed = truth.heat_release[start] - truth.heat_release[start - 1]
        assert warmed == pytest.approx(truth.parameters.preheating_release_K, abs=0.1)


def test_the_three_clocks_differ(turbine: SyntheticTurbine) -> None:
    midnight = float(np.datetime64("2020-07-15", "s").astype(int))
    for table, step, offset in (
        (turbine.cabinet, 900.0, 200.0),
        (turbine.ambient, 600.0, 400.0),
        (turbine.scada, 600.0, 0.0),
    ):
        assert np.all((table.time - midnight) % step == offset), table.file
        steps = np.diff(table.time)
        assert steps.min() == step
        assert steps.max() > 2.0 * step, f"{table.file} has no gap"
        assert np.mean(steps == step) > 0.99


def test_readings_are_truth_plus_bias_noise_and_resolution(turbine: SyntheticTurbine) -> None:
    truth = turbine.truth
    biases = dict(truth.sensor_bias)
    for table, column, true, accuracy in (
        (turbine.cabinet, "T_cab_degC", truth.cabinet_temperature, 0.3),
        (turbine.ambient, "T_amb_degC", truth.ambient_temperature, 0.3),
    ):
        error = table[column] - (np.interp(table.time, truth.time, true) - 273.15)
        bias = biases[f"{table.file.removesuffix('.csv')}.{column}"]
        assert abs(bias) <= accuracy
        assert error.mean() == pytest.approx(bias, abs=2e-3)
        assert 0.03 < error.std() < 0.06
    assert abs(biases["cabinet.RH_cab_pct"]) <= 2.0
    assert abs(biases["ambient.RH_amb_pct"]) <= 2.0
    for table in (turbine.cabinet, turbine.ambient):
        for name, values, decimals in table.columns:
            known = values[np.isfinite(values)]
            np.testing.assert_allclose(known, np.round(known, decimals), atol=1e-9, err_msg=name)


def test_humidity_reading_follows_from_absolute_humidity(turbine: SyntheticTurbine) -> None:
    truth, table = turbine.truth, turbine.cabinet
    kelvin = np.interp(table.time, truth.time, truth.cabinet_temperature)
    concentration = np.interp(table.time, truth.time, truth.cabinet_absolute_humidity)
    celsius = kelvin - 273.15
    magnus = 611.2 * np.exp(17.62 * celsius / (243.12 + celsius))
    percent = 100.0 * concentration * 461.5 * kelvin / magnus
    error = table["RH_cab_pct"] - percent
    known = np.isfinite(error)
    bias = dict(truth.sensor_bias)["cabinet.RH_cab_pct"]
    # Magnus itself is off by up to 0.3 % of the value at these temperatures.
    assert error[known].mean() == pytest.approx(bias, abs=0.2)
    assert error[known].std() < 0.3
    assert np.nanmin(table["RH_cab_pct"]) >= 0.0
    assert np.nanmax(turbine.ambient["RH_amb_pct"]) <= 100.0


def test_scada_values_are_means_over_the_interval_that_starts_at_the_stamp(turbine: SyntheticTurbine) -> None:
    truth, table = turbine.truth, turbine.scada
    for place in (100, 5000, table.time.size - 1):
        inside = (truth.time >= table.time[place]) & (truth.time < table.time[place] + 600.0)
        assert inside.sum() == 10
        kilowatts = truth.active_power[inside].mean() / 1e3
        assert table["P_kW"][place] == pytest.approx(kilowatts, abs=0.051)
        assert table["preheating"][place] == pytest.approx(truth.preheating[inside].mean())


def test_gaps_are_where_the_demo_promises_them(turbine: SyntheticTurbine) -> None:
    assert np.diff(turbine.scada.time).max() == pytest.approx(2 * 86400.0, abs=1200.0)
    missing = np.isnan(turbine.cabinet["RH_cab_pct"])
    assert 3.0 < missing.sum() * 900.0 / 86400.0 < 4.0
    assert 0 < np.isnan(turbine.scada["P_kW"]).sum() < 200
    assert not np.isnan(turbine.cabinet["T_cab_degC"]).any()


def test_the_record_runs_from_july_to_january_and_keeps_its_last_month(turbine: SyntheticTurbine) -> None:
    start, end = turbine.truth.time[[0, -1]].astype(np.int64).astype("datetime64[s]")
    assert (str(start), str(end)) == ("2020-07-15T00:00:00", "2021-02-01T00:00:00")
    assert turbine.until_s == float(np.datetime64("2021-01-01", "s").astype(int))


def test_the_same_seed_gives_the_same_turbine(turbine: SyntheticTurbine) -> None:
    again, other = synthetic_turbine(1, days=20.0), synthetic_turbine(2, days=20.0)
    twin = synthetic_turbine(1, days=20.0)
    for one, two in ((again.cabinet, twin.cabinet), (again.scada, twin.scada)):
        np.testing.assert_array_equal(one.time, two.time)
        for (_, values, _), (_, same, _) in zip(one.columns, two.columns, strict=True):
            np.testing.assert_array_equal(values, same)
    assert not np.array_equal(again.cabinet["T_cab_degC"], other.cabinet["T_cab_degC"])
    # A change of the cabinet leaves the weather as it was.
    changed = replace(SyntheticParameters(), thermal_time_constant_h=3.0)
    slower = synthetic_turbine(1, days=20.0, parameters=changed)
    np.testing.assert_array_equal(slower.truth.ambient_temperature, again.truth.ambient_temperature)


def test_the_case_file_has_the_fixed_form(turbine: SyntheticTurbine, tmp_path: Path) -> None:
    case = write_case(turbine, tmp_path / "made")
    assert case == tmp_path / "made" / "case.toml"
    names = sorted(path.name for path in case.parent.iterdir())
    assert names == ["ambient.csv", "cabinet.csv", "case.toml", "scada.csv"]
    table = tomllib.loads(case.read_text(encoding="utf-8"))
    assert set(table) == {"name", "provenance", "rated_power_kW", "site", "source", "identification"}
    assert table["name"] == turbine.name
    assert table["rated_power_kW"] == 2050.0
    assert set(table["site"]) == {"latitude_deg", "longitude_deg"}
    assert table["identification"] == {"until": "2021-01-01T00:00:00Z"}
    cabinet, ambient, scada = table["source"]
    assert set(cabinet) == set(ambient) == {"file", "time", "signals"}
    assert scada["stamp"] == "start"
    assert cabinet["signals"] == {
        "cabinet_temperature": {"column": "T_cab_degC", "unit": "degC"},
        "cabinet_relative_humidity": {"column": "RH_cab_pct", "unit": "%"},
    }
    for source in table["source"]:
        with (case.parent / source["file"]).open(encoding="utf-8", newline="") as stream:
            header = next(csv.reader(stream))
        assert source["time"] in header
        for signal in source["signals"].values():
            assert signal["column"] in header


def test_files_give_back_the_tables(turbine: SyntheticTurbine, tmp_path: Path) -> None:
    write_case(turbine, tmp_path)

    def check(table: SyntheticTable) -> None:
        with (tmp_path / table.file).open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        stamps = np.array([row["time"].removesuffix("Z") for row in rows], dtype="datetime64[s]")
        assert all(row["time"].endswith("Z") for row in rows)
        np.testing.assert_array_equal(stamps.astype(float), table.time)
        for name, values, decimals in table.columns:
            read = np.array([float(row[name] or "nan") for row in rows])
            np.testing.assert_allclose(read, values, atol=0.51 * 10.0**-decimals, err_msg=name)

    for table in (turbine.cabinet, turbine.ambient, turbine.scada):
        check(table)


def test_every_file_says_that_it_is_synthetic(turbine: SyntheticTurbine, tmp_path: Path) -> None:
    write_case(turbine, tmp_path)
    assert "synthetic" in turbine.name
    for path in tmp_path.iterdir():
        first = path.read_text(encoding="utf-8").splitlines()[0]
        assert "synthetic" in first.lower(), path.name


def test_a_record_without_seasons_is_refused() -> None:
    with pytest.raises(ValueError, match="days >= 2"):
        synthetic_turbine(1, days=1.0)
    with pytest.raises(ValueError, match="found days = nan"):
        synthetic_turbine(1, days=math.nan)


def test_an_unknown_column_names_those_that_exist(turbine: SyntheticTurbine) -> None:
    with pytest.raises(KeyError, match="T_cab_degC, RH_cab_pct"):
        turbine.cabinet["T_cab"]


def test_no_estimation_code_is_imported() -> None:
    tree = ast.parse(Path(synthetic.__file__).read_text(encoding="utf-8"))
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    assert {name for name in imported if name.startswith("hygrokf")} == {
        "hygrokf.data.files",
        "hygrokf.data.timestamps",
        "hygrokf.physics.psychrometrics",
    }
