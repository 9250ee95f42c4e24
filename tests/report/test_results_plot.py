"""Results draw themselves: axes in, axes out, and nothing else of matplotlib changes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from builders.climate_case import study_of
from builders.discovery_case import discovery_case, empty_case, residuals_case, typed
from builders.fit_case import bare_fit
from builders.report_case import report_case, results, write_case
from matplotlib import pyplot, rcParams
from matplotlib.figure import Figure

from hygrokf.discovery.discovery_results import Discovered
from hygrokf.errors import HygrokfError
from hygrokf.evaluation.responses import FrequencyResponse, StepResponse, bode, step_response
from hygrokf.identification.fit import Fit, read_series
from hygrokf.identification.fit_results import Covariance, FitResults
from hygrokf.modelling.design import Design


def fit() -> Fit:
    data, series = report_case()
    found = results(data)
    assert found.design is not None
    return Fit(found.name, found.design, {}, found, series)


def discovered() -> Discovered:
    return Discovered(typed(discovery_case()), residuals_case(), residuals_case(0.2))


def empty() -> Discovered:
    return Discovered(typed(empty_case()), residuals_case(0.0))


def network() -> Fit:
    """A thermal network whose time constant is known to 10 %."""
    made = Design((("thermal_network", {}), ("thermal_diffusion", {})))
    values = {p.name: p.start for p in made.model.parameters}
    known = Covariance(("thermal_time_constant",), np.array([[0.04]]))
    return Fit("made", made, values | {"thermal_time_constant": 2.0}, FitResults(covariance=known))


def frequency() -> FrequencyResponse:
    return bode(network())


def step() -> StepResponse:
    return step_response(network())


PANELS: dict[Callable[[], Any], int] = {
    fit: 2, discovered: 6, empty: 8, study_of: 2, frequency: 4, step: 2,
}  # fmt: skip
"""How a result is made, and the panels of its picture; an empty discovery: two quantities, four drivers."""


@pytest.fixture(autouse=True)
def headless() -> Iterator[None]:
    pyplot.switch_backend("Agg")
    yield
    pyplot.close("all")


@pytest.mark.parametrize("make", PANELS, ids=lambda make: make.__name__)
def test_a_result_draws_on_the_axes_that_it_is_given(make) -> None:
    axes = Figure().add_subplot()
    assert make().plot(axes) == (axes,)
    assert axes.has_data() and pyplot.get_fignums() == []
    several = tuple(Figure().subplots(1, PANELS[make]))
    assert make().plot(several) == several and all(one.has_data() for one in several)
    with pytest.raises(ValueError, match=f"1 … {PANELS[make]} axes"):
        make().plot(Figure().subplots(1, PANELS[make] + 1))


@pytest.mark.parametrize("make", PANELS, ids=lambda make: make.__name__)
def test_without_axes_a_figure_of_pyplot_shows_all_panels(make) -> None:
    before = dict(rcParams)
    axes = make().plot()
    assert len(axes) == PANELS[make] and len(pyplot.get_fignums()) == 1
    assert {one.get_figure() for one in axes} == {pyplot.gcf()} and dict(rcParams) == before
    pyplot.gcf().canvas.draw()
    page = pyplot.gcf().bbox.padded(1.0)
    for box in (one.get_tightbbox() for one in axes):
        assert box is not None and page.x0 < box.x0 < box.x1 < page.x1 and page.y0 < box.y0 < box.y1 < page.y1


def test_the_picture_of_a_fit_shows_its_readings_in_its_units() -> None:
    shown = fit()
    warm, damp = shown.plot()
    labels = [axes.get_ylabel().split("\n") for axes in (warm, damp)]
    assert labels == [["temperature", "[°C]"], ["absolute humidity", "[g/m³]"]]
    late = shown.series["time_s"] >= float(shown.series["until_s"])
    top = np.nanmax(shown.series["temperature_measured"][late]) - 273.15
    drawn = np.concatenate([np.asarray(line.get_ydata(), float) for line in warm.get_lines()])
    assert np.nanmin(np.abs(drawn - top)) < 1e-9


def test_a_fit_without_series_says_how_to_read_them() -> None:
    design = Design((("thermal_network", {}),))
    with pytest.raises(HygrokfError, match="series=True"):
        bare_fit("bare", design, {}).plot()


def test_series_are_read_where_they_are_asked_for(tmp_path) -> None:
    folder = write_case(tmp_path, *report_case())
    assert read_series(folder)["time_s"].shape == report_case()[1]["time_s"].shape
    (folder / "series.npz").unlink()
    with pytest.raises(HygrokfError, match=r"series\.npz: no such file; run `hygrokf fit`"):
        read_series(folder)


def test_a_discovery_without_residuals_has_nothing_to_plot() -> None:
    with pytest.raises(HygrokfError, match="tower 7: nothing to plot"):
        Discovered(typed(discovery_case())).plot()


def test_a_missing_matplotlib_is_told(monkeypatch) -> None:
    shown = empty()
    shown.plot(Figure().add_subplot())
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(HygrokfError, match="pip install matplotlib"):
        shown.plot()
