"""Why something has departed: a cabinet that changed is told from a sensor that is off, on turbines whose
change is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import SyntheticParameters, synthetic_turbine, write_case
from hygrokf.data.record import Record, Series
from hygrokf.identification.identify import identify
from hygrokf.live.alarms import CABINET_CHANGED, shift_levels
from hygrokf.live.defaults import SIGNALS
from hygrokf.live.fault_isolation import (
    CLOSE,
    EXPLAINING_GAIN,
    USUAL,
    CauseFinding,
    finding_from,
    isolate,
    shift_step,
)
from hygrokf.live.plan import Plan, plan
from hygrokf.live.properties import ParameterShift, TrackedState
from hygrokf.live.sources.local import line_form
from hygrokf.live.tracker import Point, offline_course
from hygrokf.physics.psychrometrics import saturation_pressure_water
from hygrokf.texts.live_codes import AlarmCode, CauseCode

SEED, DAYS, FITTED, CHANGE = 21, 75.0, 45.0, 60.0
"""Seed; days of the record, of those from which the model is identified, and until the change."""
USUALLY = USUAL + 5.0
"""Days before the change in which sisters show what is usual."""
DAY_S = 86400.0


def made(folder: Path, parameters: SyntheticParameters) -> Record:
    record = read_case(write_case(synthetic_turbine(seed=SEED, days=DAYS, parameters=parameters), folder))
    return replace(record, series=tuple(s for s in record.series if s.signal in SIGNALS))


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return made(tmp_path_factory.mktemp("turbine"), SyntheticParameters())


@pytest.fixture(scope="module")
def tracked(record: Record) -> Plan:
    """The model is identified on other weeks than those that are searched."""
    fit = identify(record.window(record.start_s, record.start_s + FITTED * DAY_S), starts=1)
    forms = {s.signal: line_form(s) for s in record.series}
    return plan(fit, forms=forms, site=record.site, rated_power_W=record.rated_power_W)


def asked(
    tracked: Plan, record: Record, sisters: Sequence[Record] = (), before: float = 4.0, after: float = 5.0
) -> CauseFinding:
    """The finding on the days around the change."""
    begin, end = (record.start_s + day * DAY_S for day in (CHANGE - before, CHANGE + after))
    beside = [one.window(begin, end) for one in sisters]
    *steps, found = isolate(tracked, record.window(begin, end), sisters=beside)
    assert len(steps) >= 15 and all(step is None for step in steps)
    return found


def misread(record: Record, signal: str, error: Callable[[np.ndarray], np.ndarray]) -> Record:
    """One sensor reads something else from the day of the change on."""

    def wrong(series: Series) -> Series:
        late = series.time >= record.start_s + CHANGE * DAY_S
        return replace(series, value=np.where(late, error(series.value), series.value))

    return replace(record, series=tuple(wrong(s) if s.signal == signal else s for s in record.series))


def changed(record: Record, folder: Path, **parameters: object) -> Record:
    """Another cabinet from the day of the change on, under the same weather and operation.

    Its temperature begins where the other one's was and comes to its own within the time constant, as it
    would have; the air holds the same vapour meanwhile.
    """
    own = replace(SyntheticParameters(), **parameters)
    other = made(folder, own)
    date_s = record.start_s + CHANGE * DAY_S
    old, new = record["cabinet_temperature"], other["cabinet_temperature"]
    jump = float(np.interp(date_s, new.time, new.value) - np.interp(date_s, old.time, old.value))

    def joined(before: Series) -> Series:
        after = other[before.signal]
        early, late = before.time < date_s, after.time >= date_s
        if not before.signal.startswith("cabinet_"):
            return before
        time = after.time[late]
        lag = jump * np.exp(-(time - date_s) / (3600.0 * own.thermal_time_constant_h))
        value = after.value[late] - lag
        if before.signal == "cabinet_relative_humidity":
            kelvin = np.interp(time, new.time, new.value)
            value = (
                after.value[late]
                * saturation_pressure_water(kelvin)
                / saturation_pressure_water(kelvin - lag)
            )
        return replace(
            before,
            time=np.concatenate([before.time[early], time]),
            value=np.concatenate([before.value[early], value]),
        )

    return replace(record, series=tuple(joined(s) for s in record.series))


def test_where_nothing_changed_there_is_no_cause(tracked: Plan, record: Record) -> None:
    assert asked(tracked, record).cause == ""


@pytest.mark.parametrize(
    ("parameters", "cause"),
    [
        ({"thermal_time_constant_h": 2.5}, "thermal_time_constant"),
        ({"hygric_time_constant_h": 0.55}, "hygric_k"),
        (
            {"operation_release": (11.5, 7.0, -2.0, -0.15), "standstill_release": (9.0, -0.10)},
            "heat_release_change",
        ),
    ],
)
def test_a_cabinet_that_changed(
    tracked: Plan, record: Record, tmp_path: Path, parameters: dict, cause: str
) -> None:
    found = asked(tracked, changed(record, tmp_path, **parameters))
    assert found.cause == cause and found.value > 0.0
    assert found.alike == ()


@pytest.mark.parametrize(
    ("signal", "error", "state", "size", "within"),
    [
        ("cabinet_temperature", lambda v: v - 2.5, "temperature_reading_change", -2.5, 1.2),
        ("cabinet_relative_humidity", lambda v: v + 0.08, "humidity_reading_change", 0.08, 0.03),
        ("cabinet_relative_humidity", lambda v: 0.8 * v, "humidity_scale_change", -0.2, 0.06),
    ],
)
def test_a_sensor_that_is_off(
    tracked: Plan, record: Record, signal: str, error: Callable, state: str, size: float, within: float
) -> None:
    found = asked(tracked, misread(record, signal, error))
    assert found.state == state and found.value == pytest.approx(size, abs=within)
    assert found.cause == ("temperature_sensor" if signal == "cabinet_temperature" else "humidity_sensor")


def sisters_of(record: Record) -> list[Record]:
    """Three turbines that read the ambient with own offsets, and differ by 0.3 K and 2 % for hours."""
    random = np.random.default_rng(5)

    def beside(series: Series) -> Series:
        sd = 0.3 if series.signal == "ambient_temperature" else 0.02
        hours = np.arange(series.time[0], series.time[-1] + 7200.0, 7200.0)
        apart = np.interp(series.time, hours, sd * random.standard_normal(len(hours)))
        return replace(series, value=series.value + random.normal(0.0, sd) + apart)

    ambient = [one for one in record.series if one.signal.startswith("ambient_")]
    return [replace(record, series=tuple(map(beside, ambient))) for _ in range(3)]


@pytest.mark.parametrize(
    ("ambient", "error", "size", "within"),
    [
        ("ambient_temperature", lambda v: v + 2.5, 2.5, 1.0),
        ("ambient_relative_humidity", lambda v: v - 0.12, -0.12, 0.05),
    ],
)
def test_sisters_tell_an_ambient_sensor_from_the_cabinets(
    tracked: Plan, record: Record, ambient: str, error: Callable, size: float, within: float
) -> None:
    """One turbine alone cannot."""
    own = ambient.replace("relative_", "")
    pair = (f"{own.removeprefix('ambient_')}_sensor", own)
    wrong = misread(record, ambient, error)
    alone = asked(tracked, wrong)
    assert alone.cause == pair[0] and pair[1] in alone.alike
    found = asked(tracked, wrong, sisters_of(record), USUALLY)
    assert found.cause == pair[1] and pair[0] not in found.alike
    assert found.value == pytest.approx(size, abs=within)


def test_sisters_clear_the_ambient_sensor(tracked: Plan, record: Record) -> None:
    wrong = misread(record, "cabinet_temperature", lambda v: v + 2.5)
    found = asked(tracked, wrong, sisters_of(record), USUALLY)
    assert found.cause == "temperature_sensor" and "ambient_temperature" not in found.alike


def test_without_a_humidity_sensor_a_thermometer_that_drifts_is_like_heat(
    tracked: Plan, record: Record
) -> None:
    """What tells them apart is not there: both stand in the finding."""
    date_s = record.start_s + CHANGE * DAY_S
    air = record["cabinet_temperature"]
    drift = 4.0 * np.clip((air.time - date_s) / (9.0 * DAY_S), 0.0, 1.0)
    warm = replace(air, value=air.value + drift)
    kept = [s for s in record.series if s.signal not in ("cabinet_temperature", "cabinet_relative_humidity")]
    found = asked(tracked, replace(record, series=(warm, *kept)), before=15.0, after=10.0)
    thermal = {"temperature_sensor", "ambient_temperature", "heat_release_change"}
    assert {found.cause, *found.alike} == thermal


def test_a_stated_change_is_followed_at_once_and_is_the_reference(
    tracked: Plan, record: Record, tmp_path: Path
) -> None:
    """After a day the stated change is mostly found; a week later nothing is left to be explained by it, and
    a sensor that goes wrong then is."""
    begin = record.start_s + FITTED * DAY_S
    cabinet = changed(record, tmp_path, thermal_time_constant_h=2.5)
    date_s = record.start_s + CHANGE * DAY_S
    window = cabinet.window(begin, cabinet.end_s)
    place = tracked.model.states.index("log_thermal_change")
    followed = [offline_course(tracked, window, changes) for changes in ((), (date_s,))]
    early, late = (int(np.searchsorted(followed[0].seconds, date_s + n * DAY_S)) for n in (1.0, 7.0))
    without, stated = (course.trace.mean[early, place] for course in followed)
    last = followed[1].trace.mean[-1, place]
    assert stated > 0.5 * last > 2.0 * without > 0.0
    reference = Point(float(followed[1].seconds[late]), followed[1].state(late))
    since = reference.time - tracked.context_s
    *_, found = isolate(tracked, cabinet.window(since, cabinet.end_s), reference)
    assert found.cause == ""
    air = cabinet["cabinet_relative_humidity"]
    off = air.time >= reference.time + DAY_S
    wrong = replace(air, value=np.where(off, air.value + 0.08, air.value))
    kept = [one for one in cabinet.series if one.signal != air.signal]
    *_, found = isolate(
        tracked, replace(cabinet, series=(wrong, *kept)).window(since, cabinet.end_s), reference
    )
    assert found.cause == "humidity_sensor" and 0.02 < found.value < 0.11  # it drifts there within days
    with pytest.raises(ValueError, match="since the stated change"):
        list(isolate(tracked, window, replace(reference, time=cabinet.end_s)))


def test_judgement_at_its_edges() -> None:
    assert finding_from({}, 5.0) == CauseFinding(5.0, "")
    little = CauseFinding(5.0, "hygric_k", "log_hygric_change", 0.4, EXPLAINING_GAIN - 0.01)
    assert finding_from({"hygric_k": little}, 5.0) == CauseFinding(5.0, "")
    two = {
        "hygric_k": CauseFinding(5.0, "hygric_k", "log_hygric_change", 0.4, 20.0),
        "humidity_sensor": CauseFinding(5.0, "humidity_sensor", "humidity_scale_change", 0.1, 18.0),
    }
    found = finding_from(two, 5.0)
    assert (found.cause, found.alike) == ("hygric_k", ("humidity_sensor",))
    far = {**two, "humidity_sensor": replace(two["humidity_sensor"], gain=20.0 - CLOSE - 0.01)}
    assert finding_from(far, 5.0).alike == ()


def test_sisters_decide_between_two_and_water_is_not_ruled_out_without_them() -> None:
    gains = {
        "temperature_sensor": CauseFinding(
            5.0, "temperature_sensor", "temperature_reading_change", 2.0, 90.0
        ),
        "humidity_sensor": CauseFinding(5.0, "humidity_sensor", "humidity_reading_change", 0.05, 80.0),
        "ambient_temperature": CauseFinding(
            5.0, "ambient_temperature", "ambient_temperature_change", -2.0, 100.0
        ),
        "ambient_humidity": CauseFinding(5.0, "ambient_humidity", "ambient_humidity_change", -0.1, 95.0),
    }
    alone = finding_from(gains, 5.0)
    assert (alone.cause, alone.state, alone.gain) == ("humidity_sensor", "humidity_reading_change", 95.0)
    assert alone.alike == ("ambient_humidity",)
    both = {"ambient_temperature": -CLOSE, "ambient_humidity": -CLOSE}
    cleared = finding_from(gains, 5.0, both)
    assert (cleared.cause, cleared.alike) == ("temperature_sensor", ())
    one = finding_from(gains, 5.0, {"ambient_temperature": CLOSE, "ambient_humidity": -CLOSE})
    assert (one.cause, one.alike) == ("ambient_temperature", ())


def test_what_is_said_of_it() -> None:
    lasting = {"heat_release_change": ParameterShift("heat_release_change", 0.0, True, 2.2)}
    step = shift_step(9.0, lasting, {"heat_release_change": TrackedState(2.2, 0.2)}, 0.0)
    assert shift_levels(step, None) == []  # nobody has looked yet
    cabinet = CauseFinding(9.0, "heat_release_change", "release_change", 2.0, 50.0, ("temperature_sensor",))
    (one,) = shift_levels(step, cabinet)
    assert (one.kind, one.subject) == (CABINET_CHANGED.kind, "heat_release_change")
    others = AlarmCode.OR_OTHERS(causes=(CauseCode.TEMPERATURE_SENSOR(),))
    assert one.statements[0].values["others"] == others and "+2.2 (+1.8 … +2.6) K" in one.statements[0].text
    assert shift_levels(shift_step(9.0, {}, {}, 0.0), replace(cabinet, cause="temperature_sensor")) == []
