"""Many runs of one model, one step at a time, against each run's own filter."""

from __future__ import annotations

import numpy as np
import pytest
from builders.live_case import live_fit, live_record
from builders.mechanism_case import host, some_run, some_values

from hygrokf.data.record import Record
from hygrokf.engine.llvm_writer import RUNS
from hygrokf.estimation.batch_filter import SideBySide
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.smoother import to_filterpy, transition
from hygrokf.live.plan import Plan, plan
from hygrokf.live.tracker import TrackedCourse, offline_course
from hygrokf.physics.expression import maximum, minimum
from hygrokf.physics.model import Mechanism

SEEDS = (3, 4, 5)
COUNT = 120
CLOSE = 2e-7
"""Sub-steps of runs side by side are equal parts, those of one run are not."""


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    return [live_record(tmp_path_factory.mktemp("turbine"), seed, days=2.0) for seed in SEEDS]


def planned(record: Record, tau_h: float) -> Plan:
    made = plan(live_fit(record), site=record.site, rated_power_W=record.rated_power_W)
    return Plan(
        made.name,
        made.design,
        {**made.values, "thermal_time_constant": tau_h},
        forms=made.forms,
    )


def at(course: TrackedCourse, name: str, i: int) -> float:
    return float(course.run.timeline.input(name)[i])


def test_every_run_is_its_own_filter(records: list[Record]) -> None:
    """Three turbines with other weather, other steps and other parameters; sub-steps differ, and their errors
    of 1e-7 standard deviations."""
    plans = [planned(records[0], tau_h) for tau_h in (0.9, 1.5, 2.6)]
    courses = [offline_course(p, r) for p, r in zip(plans, records, strict=True)]
    model, begin = plans[0].model, 20
    runs = SideBySide(model, [p.values for p in plans])
    runs.begin({n: np.array([at(c, n, begin) for c in courses]) for n in model.inputs})
    own = [Likelihood(model, c.run.timeline) for c in courses]
    for i in range(begin + 1, begin + COUNT):
        hours = np.array([c.run.timeline.time[i] - c.run.timeline.time[i - 1] for c in courses])
        inputs = {n: np.array([at(c, n, i) for c in courses]) for n in model.inputs}
        before = np.array([c.trace.mean[i - 1] for c in courses])
        mean, gained = runs.step(before, hours, inputs)
        for r, (one, likelihood) in enumerate(zip(plans, own, strict=True)):
            expected, _, spread = transition(likelihood, one.values, i, before[r])
            assert mean[r] == pytest.approx(expected, rel=CLOSE, abs=CLOSE)
            assert gained[r] == pytest.approx(spread, rel=CLOSE, abs=CLOSE)
    assert len({round(float(h), 6) for h in hours}) > 1  # the steps differ


def test_faults_in_words(records: list[Record]) -> None:
    one = planned(records[0], 1.5)
    runs = SideBySide(one.model, [one.values])
    inputs = {name: np.array([280.0]) for name in one.model.inputs}
    with pytest.raises(ValueError, match="ambient_temperature"):
        runs.step(
            np.zeros((1, len(one.model.states))), 0.1, {**inputs, "ambient_temperature": np.array([np.nan])}
        )


def test_filterpy_and_the_tracker_agree(records: list[Record]) -> None:
    """The tracked model, all its wandering properties included, in filterpy's own algebra: to 1e-9 over 150
    instants."""
    one = planned(records[1], 1.7)
    course = offline_course(one, records[1])
    object_ = to_filterpy(Likelihood(one.model, course.run.timeline.window(0, 150)), one.values)
    for k in range(150):
        object_.advance(k)
        object_.observe(k)
        assert object_.x == pytest.approx(course.trace.mean[k], rel=CLOSE, abs=CLOSE)
        assert object_.P == pytest.approx(course.trace.covariance[k], rel=CLOSE, abs=CLOSE)


def drying_above(limit: float) -> Mechanism:
    """Vapour that is taken out above a limit [g/m³], at most 3 g/(m³ h): comparisons that fall differently in
    every run."""
    return Mechanism(
        name="drying_above",
        contributions=lambda p, x, u, q: {
            "vapour_release": -minimum(2.0 * maximum(x.vapour - limit, 0.0), 3.0)
        },
        meaning="a drier",
    )


@pytest.mark.parametrize("count", [1, 2 * RUNS, 2 * RUNS + 3])
def test_runs_differ_in_everything(count: int) -> None:
    """Parameters, numbers of sub-steps, inputs and comparisons; blocks of lanes that are full and not."""
    model = host(drying_above(7.2))
    timelines = [some_run(model, seed) for seed in range(count)]
    values = [{**some_values(model), "hygric_k": 0.1 + 0.07 * (seed % 5)} for seed in range(count)]
    own = [Likelihood(model, t) for t in timelines]
    traces = [one.trace(v) for one, v in zip(own, values, strict=True)]
    runs = SideBySide(model, values)
    rows = [{n: t.input(n) for n in model.inputs} for t in timelines]
    runs.begin({n: np.array([row[n][0] for row in rows]) for n in model.inputs})
    for k in range(1, len(timelines[0])):
        inputs = {n: np.array([row[n][k] for row in rows]) for n in model.inputs}
        before = np.array([t.mean[k - 1] for t in traces])
        mean, gained = runs.step(before, timelines[0].time[k] - timelines[0].time[k - 1], inputs)
        assert len(mean) == len(gained) == count
        expected = [transition(one, v, k, m) for one, v, m in zip(own, values, before, strict=True)]
        moved, spread = (np.array([e[i] for e in expected]) for i in (0, 2))
        # where the drier begins within the step, the noise of this one step is right to some percent
        assert mean == pytest.approx(moved, rel=3e-6)
        assert np.median(np.abs(mean - moved)) < CLOSE
        size = np.sqrt(np.einsum("rii->ri", spread)) + CLOSE
        assert np.abs((gained - spread) / (size[:, :, None] * size[:, None, :])).max() < 0.1
        assert np.median(np.abs(gained - spread)) < CLOSE


def test_a_first_step_that_takes_no_time_changes_nothing() -> None:
    """What is kept between steps is computed at it, too: it is not what the memory held before."""
    model = host(drying_above(7.2))
    t, values = some_run(model, 3), some_values(model)
    begin = Likelihood(model, t).first_gaussian(values).mean[None]
    for _ in range(20):  # fresh memory is zero at times
        np.full(5000, 1e6)
        runs = SideBySide(model, [values])
        inputs = {n: t.input(n)[:1] for n in model.inputs}
        runs.begin(inputs)
        mean, gained = runs.step(begin, 0.0, inputs)
        assert mean == pytest.approx(begin, rel=1e-12) and not gained.any()
