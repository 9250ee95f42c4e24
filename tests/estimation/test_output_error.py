"""The free run's own fit: exact where nothing disturbs, honest about its bounds where something does."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from plants import plant
from plants.as_record import to_record

from hygrokf.data.record import Record
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.output_error import OutputError, fit_output_error
from hygrokf.modelling.design import design
from hygrokf.modelling.inputs import model_inputs

EXACT = {"sensor_errors": "none", "missing": 0.0, "ambient_humidity": "absolute", "disturbance": "none"}
PLANTS = 30


def likelihood_of(record: Record, kind: str) -> Likelihood:
    base = design(record, kind=kind, coloured=False)
    return Likelihood(base.model, model_inputs(base, record).timeline)


def starts(likelihood: Likelihood) -> dict[str, float]:
    return {p.name: p.start for p in likelihood.model.parameters}


def fit(record: Record, kind: str) -> OutputError:
    likelihood = likelihood_of(record, kind)
    return fit_output_error(likelihood, starts(likelihood))


@pytest.mark.parametrize("seed", [1, 2])
def test_noise_free_plants_give_their_parameters_back(seed):
    """What is left are the plant's minute steps (thermal) and its other saturation formula (hygric)."""
    made = plant(seed, days=20, **EXACT)
    record, truth = to_record(made), made.truth
    thermal, hygric = fit(record, "thermal"), fit(record, "cascade")
    assert thermal.converged
    assert hygric.converged
    assert thermal.values["thermal_time_constant"] == pytest.approx(truth.tau_h, rel=2e-4)
    assert thermal.values["resistance_ratio"] == pytest.approx(truth.rho, abs=2e-4)
    assert hygric.values["hygric_k"] == pytest.approx(truth.hygric_constant_h, rel=1e-3)
    reference = record["ambient_temperature"].value.mean() - 283.15
    a0, a1, a2, slope = truth.operation_K
    expected = {
        "heat_release_operation": a0 + slope * reference,
        "heat_release_power_1": a1,
        "heat_release_power_2": a2,
        "heat_release_operation_ambient": slope,
        "heat_release_standstill": truth.standstill_K[0] + truth.standstill_K[1] * reference,
        "heat_release_standstill_ambient": truth.standstill_K[1],
    }
    for name, value in expected.items():
        assert thermal.values[name] == pytest.approx(value, abs=2e-3), name
    likelihood = likelihood_of(record, "thermal")
    error = likelihood.timeline.y - likelihood.trace(thermal.values, gain=False).prediction
    assert np.nanstd(error[likelihood.timeline.time >= 24.0]) < 1e-3


def test_the_guess_at_the_start_is_no_evidence():
    """The first day's state is not known: readings of it, however wrong, do not move the fit."""
    record = to_record(plant(4, days=20, **EXACT))
    likelihood = likelihood_of(record, "thermal")
    y = likelihood.timeline.y.copy()
    y[likelihood.timeline.time < 23.9] += 8.0
    spoilt = replace(likelihood, timeline=likelihood.timeline.with_readings(y))
    plain = fit_output_error(likelihood, starts(likelihood)).values
    assert fit_output_error(spoilt, starts(likelihood)).values == plain
    y[likelihood.timeline.time < 30.0] += 8.0
    later = replace(likelihood, timeline=likelihood.timeline.with_readings(y))
    assert fit_output_error(later, starts(likelihood)).values != plain


def test_noise_and_biases_are_held():
    record = to_record(plant(5, days=10))
    likelihood = likelihood_of(record, "thermal")
    given = starts(likelihood) | {"cabinet_temperature_bias": 0.2, "thermal_diffusion": 0.3}
    found = fit_output_error(likelihood, given)
    assert found.values["cabinet_temperature_bias"] == 0.0
    assert found.values["thermal_diffusion"] == 0.3
    assert not {"cabinet_temperature_bias", "cabinet_temperature_noise", "thermal_diffusion"} & set(
        found.names
    )
    assert found.covariance.shape == (len(found.names),) * 2


def test_no_neighbour_fits_better():
    """The sum of squares, taken from scratch, grows along every coordinate."""
    record = to_record(plant(6, days=15))
    likelihood = likelihood_of(record, "thermal")
    found = fit_output_error(likelihood, starts(likelihood))
    late = likelihood.timeline.time >= 24.0

    def squares(values: dict[str, float]) -> float:
        trace = likelihood.trace(values, gain=False)
        error = (likelihood.timeline.y - trace.prediction)[late]
        return float(np.nansum(error**2))

    best = squares(found.values)
    for name in found.names:
        for factor in (0.97, 1.03):
            assert squares(found.values | {name: factor * found.values[name]}) > best * (1 + 1e-7), name


def test_bounds_are_symmetric_in_the_coordinate():
    found = OutputError({"a": 2.0, "b": -1.0}, ("a", "b"), np.diag([0.04, 0.25]), True)
    low, high = found.bounds("a", positive=True)
    assert (low, high) == pytest.approx((2 * math.exp(-0.2 * 1.959964), 2 * math.exp(0.2 * 1.959964)))
    assert found.bounds("b", positive=False, level=0.6827) == pytest.approx((-1.5, -0.5), abs=1e-3)
    vague = OutputError({"a": 2.0}, ("a",), np.array([[1e12]]), True)
    low, high = vague.bounds("a", positive=True)
    assert 0.0 < low < 1e-20
    assert math.isfinite(high)


def test_sandwich_bounds_cover_about_as_often_as_they_say():
    """Thirty plants of 20 days with Ornstein–Uhlenbeck disturbances: of 95 % bounds at least 24 hold with
    99.9 % (binomial); and the standardised errors have the spread of one, within what 30 of them tell."""
    inside, standard = np.zeros(2, int), []
    for seed in range(200, 200 + PLANTS):
        made = plant(seed, days=20)
        record, row = to_record(made), []
        for i, (kind, name, truth) in enumerate(
            (
                ("thermal", "thermal_time_constant", made.truth.tau_h),
                ("cascade", "hygric_k", made.truth.hygric_constant_h),
            )
        ):
            found = fit(record, kind)
            low, high = found.bounds(name, positive=True)
            inside[i] += low <= truth <= high
            row.append(math.log(found.values[name] / truth) / (math.log(high / low) / (2 * 1.96)))
        standard.append(row)
    assert np.all(inside >= 25), inside
    spread = np.std(standard, axis=0)
    assert np.all((spread > 0.6) & (spread < 1.4)), spread


def test_a_fit_that_is_cut_short_says_so():
    record = to_record(plant(7, days=10))
    likelihood = likelihood_of(record, "thermal")
    assert not fit_output_error(likelihood, starts(likelihood), passes=1).converged
    assert fit_output_error(likelihood, starts(likelihood)).converged
