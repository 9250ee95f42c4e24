"""Which model a record calls for, and the constants that turn a record into its inputs."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record, Series
from hygrokf.data.result_file import result_text
from hygrokf.data.structured import plain
from hygrokf.modelling.design import (
    POWER_BRIDGE_H,
    Design,
    accuracy_of,
    design,
    extended,
    merged,
    observed_humidity,
    power_scale,
    read_as,
    reading_step_h,
)
from hygrokf.texts.fit_codes import FitCode

START_S = 1.6e9
HOURS = 40 * 24
RATED_W = 2.0e6


def series(signal: str, value: np.ndarray | float, step_h: float = 0.25, **more) -> Series:
    time = START_S + 3600.0 * np.arange(0.0, HOURS, step_h)
    return Series(signal, time, np.broadcast_to(value, time.shape), **more)


def power(value: np.ndarray | float, step_h: float = 1 / 6) -> Series:
    made = series("active_power", value, step_h)
    return replace(made, time=made.time + 600.0, hold="mean", interval_s=600.0)


def windy(seed: int = 1) -> np.ndarray:
    """Power [W]: a quarter of it standstill."""
    random = np.random.default_rng(seed)
    slow = np.repeat(random.normal(size=HOURS // 6), 36)
    return RATED_W * np.clip(0.4 + 0.5 * slow, -0.003, 1.0)


def record(*changes: Series, without: tuple[str, ...] = ()) -> Record:
    random = np.random.default_rng(2)
    made = {
        s.signal: s
        for s in (
            series(
                "cabinet_temperature", 290.0 + random.normal(size=HOURS * 4), accuracy=0.4, resolution=0.1
            ),
            series("cabinet_relative_humidity", 0.5, resolution=0.001),
            series("ambient_temperature", 283.0 + np.sin(np.arange(HOURS * 6) / 23.0), 1 / 6),
            series("ambient_relative_humidity", 0.8, 1 / 6),
            power(windy()),
            *changes,
        )
    }
    return Record("made", tuple(s for n, s in made.items() if n not in without), rated_power_W=RATED_W)


def names(base: Design) -> list[str]:
    return [name for name, _ in base.mechanisms]


def settings_of(base: Design, name: str) -> dict:
    return dict(base.mechanisms)[name]


THERMAL = ["thermal_network", "heat_release", "heat_disturbance", "thermal_diffusion", "temperature_sensor"]
HYGRIC = ["hygric_exchange", "vapour_disturbance", "hygric_diffusion", "humidity_sensor"]


def test_the_three_kinds():
    assert names(design(record())) == THERMAL + HYGRIC
    assert names(design(record(), kind="thermal")) == THERMAL
    assert names(design(record(), kind="cascade")) == ["measured_air", *HYGRIC]
    white = names(design(record(), coloured=False))
    assert white == [n for n in THERMAL + HYGRIC if "disturbance" not in n]


def test_without_humidity_on_either_side_there_is_no_hygric_part():
    empty = series("ambient_relative_humidity", np.nan, 1 / 6)
    poor = [record(without=(n,)) for n in ("cabinet_relative_humidity", "ambient_relative_humidity")]
    for one in (*poor, record(empty)):
        for kind in ("joint", "thermal"):
            base = design(one, kind=kind)
            assert names(base) == THERMAL
            assert base.humidity is None
            assert base.statements == (FitCode.NO_HUMIDITY(),)
    assert design(record(), kind="thermal").statements == ()


def test_one_humidity_signal_is_chosen():
    """The logger's own reading first; absolute humidity where it is all there is; fewer than 50 readings are
    none."""
    both = record(series("cabinet_absolute_humidity", 7e-3, accuracy=2e-4, resolution=1e-5))
    assert observed_humidity(prepare(both)) == "cabinet_relative_humidity"
    few = np.full(HOURS * 4, np.nan)
    few[:49] = 0.5
    base = design(both.replace_series(series("cabinet_relative_humidity", few)))
    assert base.humidity == "cabinet_absolute_humidity"
    assert settings_of(base, "absolute_humidity_sensor") == pytest.approx(
        {"accuracy": 0.2, "resolution": 0.01}
    )
    few[49] = 0.5
    enough = prepare(both.replace_series(series("cabinet_relative_humidity", few)))
    assert observed_humidity(enough) is not None


def test_sensors_get_stated_accuracy_and_resolution():
    base = design(record())
    assert settings_of(base, "temperature_sensor") == {"accuracy": 0.4, "resolution": 0.1}
    assert settings_of(base, "humidity_sensor") == {"accuracy": 0.02, "resolution": 0.001}  # the table's 2 %
    assert accuracy_of(series("cabinet_temperature", 290.0)) == 0.3
    assert accuracy_of(series("cabinet_temperature", 290.0, accuracy=0.0)) == 0.0
    assert accuracy_of(series("wind_direction", 1.0)) == 0.0
    exact = design(record(series("cabinet_temperature", 290.0, accuracy=0.0)))
    assert "cabinet_temperature_bias" not in {p.name for p in exact.model.parameters}


def test_interval_means_are_read_as_such():
    averaged = {
        name: replace(record()[name], hold="mean", interval_s=900.0)
        for name in ("cabinet_temperature", "cabinet_relative_humidity")
    }
    base = design(record(*averaged.values()))
    assert base.averaged == {"cabinet_temperature": 0.25, "cabinet_relative_humidity": 0.25}
    assert base.model.states[-2:] == ("mean_cabinet_temperature", "mean_cabinet_relative_humidity")
    half = design(record(averaged["cabinet_relative_humidity"]), kind="cascade")
    assert half.averaged == {"cabinet_relative_humidity": 0.25}
    # another record may be read otherwise: that belongs to its loggers, not to the cabinet
    other = read_as(base, record())
    assert other.averaged == {}
    assert names(other) == names(base)
    assert read_as(base, record(*averaged.values())) is base
    assert read_as(base, record(without=("cabinet_temperature", "cabinet_relative_humidity"))).averaged == {}
    assert read_as(other, record(averaged["cabinet_temperature"])).averaged == {"cabinet_temperature": 0.25}


# --- power ----------------------------------------------------------------------------------


def test_power_counts_in_shares_of_the_rated_power_or_of_its_highest():
    assert power_scale(record()) == RATED_W
    unrated = replace(record(), rated_power_W=None)
    assert power_scale(unrated) == pytest.approx(np.quantile(windy(), 0.999))
    assert power_scale(record(without=("active_power",))) is None
    assert power_scale(replace(record(power(0.0)), rated_power_W=None)) is None
    nothing = np.full(HOURS * 6, np.nan)
    nothing[:9] = 1e5
    assert power_scale(record(power(nothing))) is None


def test_mean_features_stand_for_an_unknown_power():
    base = design(record())
    p = windy() / RATED_W
    on = p > 0
    assert base.power_mean == pytest.approx((on.mean(), (on * p).mean(), (on * p * p).mean()))
    assert base.power_order == 2
    assert base.power_scale_W == RATED_W
    release = settings_of(base, "heat_release")
    assert release["operation"]
    assert release["standstill"]
    assert release["reference_K"] == pytest.approx(record()["ambient_temperature"].value.mean())


def test_without_power_all_of_it_is_standstill():
    for poor in (record(without=("active_power",)), replace(record(power(0.0)), rated_power_W=None)):
        base = design(poor)
        assert base.statements == (FitCode.NO_POWER(),)
        assert base.power_scale_W is None
        assert not settings_of(base, "heat_release")["operation"]
        assert "operating" not in base.model.inputs


def test_power_that_is_never_or_always_there_or_never_varies_is_said():
    never = design(record(power(-3e3)))
    assert FitCode.HARDLY_ANY_OPERATION() in never.statements
    assert not settings_of(never, "heat_release")["operation"]
    always = design(record(power(np.maximum(windy(), 0.01 * RATED_W))))
    assert FitCode.HARDLY_ANY_STANDSTILL() in always.statements
    assert not settings_of(always, "heat_release")["standstill"]
    constant = design(record(power(0.6 * RATED_W)))
    assert FitCode.POWER_CONSTANT() in constant.statements
    assert constant.power_order == 0


def test_a_long_gap_of_the_power_brings_its_covariance_and_correlation_time():
    """An Ornstein–Uhlenbeck power of 10 h: the lag at which its autocorrelation falls to 1/e is about 10
    h."""
    random = np.random.default_rng(4)
    gain = math.exp(-1 / 60)
    value = np.empty(HOURS * 6)
    value[0] = 0.0
    for i, kick in enumerate(random.normal(size=len(value) - 1), 1):
        value[i] = gain * value[i - 1] + math.sqrt(1 - gain**2) * kick
    p = 0.5 + 0.12 * value
    p[1000:1007] = np.nan
    base = design(record(power(RATED_W * p)))
    release = settings_of(base, "heat_release")
    known = p[np.isfinite(p)]
    on = (known > 0).astype(float)
    rows = np.vstack([on, on * known, on * known**2])
    rows = rows - rows.mean(axis=1, keepdims=True)
    expected = rows @ rows.T / rows.shape[1]
    expected[0] = expected[:, 0] = 0.0  # always in operation: no jump between the regimes
    np.testing.assert_allclose(release["gap_covariance"], expected, atol=1e-12)
    assert 4.0 < release["gap_time_h"] < 20.0
    assert "power_unknown" in base.model.inputs
    p = 0.5 + 0.12 * value
    p[1000:1006] = np.nan  # an hour: bridged
    assert POWER_BRIDGE_H == 1.0
    assert "gap_covariance" not in settings_of(design(record(power(RATED_W * p))), "heat_release")


def test_power_that_ends_before_the_cabinet_is_a_gap():
    whole = record()["active_power"]
    short = replace(whole, time=whole.time[:-50], value=whole.value[:-50])
    assert "gap_covariance" in settings_of(design(record(short)), "heat_release")


def test_known_preheating_is_a_term_of_its_own():
    on = np.zeros(HOURS * 6)
    heater = replace(power(on), signal="preheating")
    assert "preheating" not in settings_of(design(record(heater)), "heat_release")
    on[100:130] = 1.0
    heater = replace(heater, value=on)
    assert settings_of(design(record(heater)), "heat_release")["preheating"] is True


def test_options_reach_the_heat_release():
    start = {"heat_release_operation": 6.5}
    base = design(record(), power_order=1, heat_start=start)
    parameters = {p.name: p.start for p in base.model.parameters}
    assert parameters["heat_release_operation"] == 6.5
    assert "heat_release_power_2" not in parameters


# --- disturbances, round trips --------------------------------------------------------------


def test_correlation_times_are_bounded_by_what_the_readings_resolve():
    base = design(record())
    assert settings_of(base, "heat_disturbance") == {"shortest_h": 0.25, "longest_h": HOURS / 10.0}
    fine = design(record(series("cabinet_temperature", 290.0, 1 / 60)))
    assert settings_of(fine, "heat_disturbance")["shortest_h"] == 0.1
    short = record()
    short = short.window(START_S, START_S + 4 * 3600.0)
    found = settings_of(design(short), "heat_disturbance")
    assert found["longest_h"] == pytest.approx(1.0)  # four steps, although a tenth of the record is less


def test_step_of_readings_counts_what_is_there():
    assert reading_step_h(series("cabinet_temperature", 290.0)) == 0.25
    half = np.where(np.arange(HOURS * 4) % 2, np.nan, 290.0)
    assert reading_step_h(series("cabinet_temperature", half)) == 0.5
    assert reading_step_h(Series("cabinet_temperature", [0.0], [290.0])) == 1.0


def test_noise_of_the_ambient_belongs_to_the_design():
    random = np.random.default_rng(6)
    walk = 283.0 + np.cumsum(0.05 * random.normal(size=HOURS * 6))
    noisy = series("ambient_temperature", walk + 0.05 * random.normal(size=HOURS * 6), 1 / 6)
    found = prepare(record(noisy)).noise
    assert found.keys() >= {"ambient_temperature"}
    assert found["ambient_temperature"][1] == pytest.approx(0.05**2, rel=0.2)
    base = design(record(noisy))
    assert base.ambient_noise == found
    assert (
        design(record(series("ambient_temperature", walk, 1 / 6))).ambient_noise.get("ambient_temperature")
        is None
    )


def test_a_design_survives_json():
    gap = windy()
    gap[500:600] = np.nan
    averaged = replace(record()["cabinet_temperature"], hold="mean", interval_s=900.0)
    base = extended(
        design(record(power(gap), averaged)), [("second_heat_disturbance", {})], {"rain": "linear"}
    )
    again = Design.from_json(json.loads(result_text(base.to_json())))
    assert again == base
    assert again.model.states == base.model.states
    assert [p.name for p in again.model.parameters] == [p.name for p in base.model.parameters]
    assert again.model.holds["rain"] == "linear"


def test_a_merged_cascade_is_the_joint_design():
    averaged = {
        name: replace(record()[name], hold="mean", interval_s=900.0)
        for name in ("cabinet_temperature", "cabinet_relative_humidity")
    }
    made = record(*averaged.values())
    joint = design(made)
    found = merged([design(made, kind="thermal"), design(made, kind="cascade")])
    assert found.mechanisms == joint.mechanisms
    assert found == joint
    alone = design(made, kind="thermal")
    assert merged([alone]) == alone


def test_designs_that_call_for_one_model_share_it() -> None:
    """A fleet of fits: other constants, the same equations; compiled once."""
    one = Design((("thermal_network", {}), ("thermal_diffusion", {}), ("temperature_sensor", {})))
    same = Design.from_json(
        json.loads(json.dumps(one.to_json()))
        | {"power_scale_W": 2e6, "statements": plain((FitCode.NO_POWER(),))}
    )
    averaged = replace(one, averaged={"cabinet_temperature": 0.5})
    other = replace(one, mechanisms=(*one.mechanisms[:2], ("temperature_sensor", {"accuracy": 0.5})))
    assert same.model is one.model
    assert averaged.model is not one.model and averaged.model.averaged == {"cabinet_temperature": 0.5}
    assert other.model is not one.model and other.model.parameters != one.model.parameters
