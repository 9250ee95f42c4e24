"""Energy-balance models of k boxes against the maxima that another program found on the same readings.

Model: Cummins, Stephenson & Stott 2020, doi:10.1175/JCLI-D-19-0589.1, equations 9 to 15; likelihoods,
estimates and standard errors by the R package EBM (FitKalman) on abrupt4xCO2 runs of CMIP5, in years.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective, fit_mle
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "reference" / "ebm"
STARTS = {"gamma": 2.0, "C1": 5.0, "C2": 20.0, "C3": 100.0, "kappa1": 1.0, "kappa2": 2.0, "kappa3": 1.0,
          "epsilon": 1.0, "sigma_eta": 0.5, "sigma_xi": 0.5, "F": 5.0}  # fmt: skip
FITS = [("CNRM", 2), ("CSIRO", 3), ("CNRM", 3), ("CSIRO", 2), ("MOHC", 2), ("MOHC", 3)]
QUICK = 1


def boxes(model: str, k: int) -> Likelihood:
    """Forcing with noise n, temperatures T1 … Tk; readings of T1 and of the net flux at the top, both without
    noise of their own."""
    temperatures = [f"T{i + 1}" for i in range(k)]
    starts = {name: v for name, v in STARTS.items() if name[-1] not in "123" or int(name[-1]) <= k}
    parameters = [
        Parameter(n, "1", v, 1e-7 if n == "epsilon" else 1e-3 * v, 1e4 * v, True, noise=n[:5] == "sigma")
        for n, v in starts.items()
    ]

    def exchanges(p, x, u):
        """Fluxes into the first box, and from each to the next."""
        warm = [getattr(x, name) for name in temperatures]
        down = [getattr(p, f"kappa{i + 1}") * (warm[i - 1] - warm[i]) for i in range(1, k)]
        return p.F * u.step + x.n - p.kappa1 * x.T1, down

    def rates(p, x, u):
        top, down = exchanges(p, x, u)
        found = {"n": -p.gamma * x.n}
        for i, name in enumerate(temperatures):
            into = top if i == 0 else down[i - 1]
            out = 0.0 if i == k - 1 else (p.epsilon if i == k - 2 else 1.0) * down[i]
            found[name] = (into - out) / getattr(p, f"C{i + 1}")
        return found

    def flux(p, x, u):
        top, down = exchanges(p, x, u)
        return top + (1.0 - p.epsilon) * down[-1], 0.0 * p.F

    made = linear_network(
        "boxes",
        parameters,
        ["n", *temperatures],
        ["step"],
        rates,
        {"temperature": lambda p, x, u: (x.T1, 0.0 * p.F), "flux": flux},
        lambda p: {"n": p.sigma_eta * p.sigma_eta, "T1": (p.sigma_xi / p.C1) * (p.sigma_xi / p.C1)},
        lambda p, u: dict.fromkeys(["n", *temperatures], (0.0, 1.0)),
    )
    read = np.loadtxt(FOLDER / f"cmip5_{model}.csv", delimiter=",", skiprows=1)
    time = np.arange(len(read) + 1.0)
    network = compose([made], {"step": "mean"})
    readings = {name: np.append(np.nan, read[:, i]) for i, name in enumerate(("temperature", "flux"))}
    line = timeline(network, time, {"step": (time > 0.0).astype(float)}, readings)
    return Likelihood(network, line, "stationary")


def promised(likelihood: Likelihood, found: Estimate) -> float:
    """½ g' H⁻¹ g of the coordinates inside their bounds, H by central differences of the score."""
    objective = Objective(likelihood, found.coordinates)
    inside = [i for i, name in enumerate(found.coordinates.names) if name not in found.at_bounds]
    at = objective.information(found.z)
    steps = np.diag(0.02 / np.sqrt(np.diag(at.information)).clip(1.0))
    rows = [
        -(objective.score(found.z + s)[1] - objective.score(found.z - s)[1])[inside] / (2.0 * s.max())
        for s in steps[inside]
    ]
    gradient, curvature = at.score[inside], 0.5 * (np.array(rows) + np.array(rows).T)
    return 0.5 * float(gradient @ np.linalg.solve(curvature, gradient))


@pytest.mark.parametrize(
    ("model", "k"),
    [pytest.param(*fit, marks=() if i < QUICK else pytest.mark.slow) for i, fit in enumerate(FITS)],
)
def test_the_maximum_is_the_other_programs_or_above(model: str, k: int) -> None:
    if not FOLDER.is_dir():
        pytest.skip("the reference data are not beside the repository")
    fits = json.loads((FOLDER / "expected.json").read_text(encoding="utf-8"))["fits"]
    stated = next(fit for fit in fits if (fit["model"], fit["k"]) == (model, k))
    likelihood = boxes(model, k)
    found = fit_mle(likelihood)
    assert found.converged and promised(likelihood, found) <= 1e-9
    # the other program stopped at a lower maximum of one of them
    least = stated["loglik"] + (17.7 if (model, k) == ("CSIRO", 3) else 0.0)
    assert found.loglik >= least - 1e-7
    if found.loglik - stated["loglik"] <= 1e-4:
        for name, value in stated["log_parameters"].items():
            assert math.log(found.values[name]) == pytest.approx(value, abs=0.02 * stated["se_log"][name])
