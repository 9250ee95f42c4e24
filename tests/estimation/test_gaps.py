"""A gap of the inputs: the state is unknown at its end and known again by its own covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from plants import plant
from plants.as_record import to_record

from hygrokf.data.record import Record, Series
from hygrokf.engine.gaps import gap_variances
from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.estimation.reference_filter import reference_filter
from hygrokf.evaluation.simulation import settled
from hygrokf.modelling.design import design, extended
from hygrokf.modelling.inputs import Run, model_inputs

GAPS_H = ((20.0, 30.0), (50.0, 61.0))
DRIFT = ("wandering_exchange", {"rate": 0.02})


def cut(series: Series, start_s: float) -> Series:
    hours = (series.time - start_s) / 3600.0
    kept = ~np.any([(hours > first) & (hours < last) for first, last in GAPS_H], axis=0)
    return replace(series, time=series.time[kept], value=series.value[kept])


@pytest.fixture(scope="module")
def whole() -> Record:
    return to_record(plant(11, days=4))


@pytest.fixture(scope="module")
def holed(whole: Record) -> Record:
    ambient = (one for one in whole.series if one.signal.startswith("ambient_"))
    return whole.replace_series(*(cut(one, whole.start_s) for one in ambient))


def filtered(record: Record, kind: str) -> tuple[Likelihood, dict[str, float], Run]:
    made = design(record, kind=kind)
    run = model_inputs(made, record)
    return Likelihood(made.model, run.timeline), {p.name: p.start for p in made.model.parameters}, run


def test_the_compiled_filter_widens_as_the_plain_one(holed):
    likelihood, values, _ = filtered(holed, "thermal")
    first = int(np.flatnonzero(likelihood.timeline.ends)[0])
    part = likelihood.timeline.window(first - 12, first + 12)
    likelihood = replace(likelihood, timeline=part)
    total, states = reference_filter(likelihood, values)
    trace = likelihood.trace(values)
    assert total == pytest.approx(likelihood.value(values), rel=1e-9)
    assert_allclose([s.covariance for s in states], trace.covariance, rtol=1e-9, atol=1e-12)
    air = np.sqrt(trace.prior_covariance[:, 0, 0])
    # 5 K is what the network's first state is known to; a reading or two know it again
    assert 4.0 < air[12] < 5.0 + air[11] and air[-1] < 0.3


@pytest.mark.parametrize("kind", ["joint", "cascade"])
def test_score_and_tangents_pass_the_ends_of_gaps(holed, kind):
    likelihood, values, _ = filtered(holed, kind)
    assert likelihood.timeline.ends.sum() == len(GAPS_H)
    value, score = likelihood.score(values)
    found = likelihood.sensitivities(values, np.eye(len(score)))
    assert_allclose(found.score, score, rtol=1e-9, atol=1e-7)
    for name in ("hygric_k", "vapour_disturbance_sd"):
        step = 1e-5 * values[name]
        up, down = (likelihood.value({**values, name: values[name] + h}) for h in (step, -step))
        place = [p.name for p in likelihood.model.parameters].index(name)
        assert score[place] == pytest.approx((up - down) / (2.0 * step), rel=1e-4)
    assert value == pytest.approx(likelihood.value(values), rel=1e-12)


def test_a_run_continued_within_and_after_a_gap_is_the_whole_run(holed):
    likelihood, values, _ = filtered(holed, "joint")
    t, trace = likelihood.timeline, likelihood.trace(values)
    for cut_at in (np.flatnonzero(t.ends)[0] - 5, *np.flatnonzero(t.ends)):
        first = replace(likelihood, timeline=t.window(0, cut_at)).trace(values).last
        rest = replace(likelihood, timeline=t.window(cut_at, len(t)))
        again = rest.trace(values, start=Gaussian(first.mean, first.covariance))
        assert_array_equal(again.covariance, trace.covariance[cut_at:])
        assert_array_equal(again.mean, trace.mean[cut_at:])


def test_a_slow_cabinet_remembers_a_gap_longer_than_a_fast_one(holed, whole):
    made = design(holed, kind="thermal")
    run = model_inputs(made, holed)
    values = {p.name: p.start for p in made.model.parameters} | {"heat_disturbance_sd": 0.3}
    lost = {}
    for hours in (0.5, 2.0, 8.0):
        after = settled(made, values | {"thermal_time_constant": hours}, run)
        assert not (after.scored & ~run.scored).any()
        lost[hours] = int((run.scored & ~after.scored).sum())
    assert 0 < lost[0.5] < 0.5 * lost[2.0] < 0.25 * lost[8.0]
    plain = model_inputs(made, whole)
    assert settled(made, values, plain) is plain


def test_a_slow_sensor_and_a_wall_are_unknown_after_a_gap_but_no_random_walk(holed):
    """What follows an input through other states is as unknown as the input; what drifts by itself is not."""
    made = design(holed)
    sensors = [
        (name, settings | {"response_h": 0.1} if name.endswith("humidity_sensor") else settings)
        for name, settings in made.mechanisms
    ]
    wider = extended(replace(made, mechanisms=tuple(sensors)), [("wall_thermal_mass", {}), DRIFT])
    line = model_inputs(wider, holed).timeline
    gained = gap_variances(wider.model, Likelihood(wider.model, line).recursion, line)
    added = dict(zip(wider.model.states, next(iter(gained.values())), strict=True))
    follow = {"converter_temperature", "vapour", "wall_temperature", "cabinet_relative_humidity_sensor"}
    assert {name for name, value in added.items() if value > 0.0} == follow
