"""
A fleet with Dask
=================

`run_fleet` does one task for many turbines, on processes of this machine or on a Dask cluster. Here a
cluster of two workers fits four synthetic cabinets, one of which stores heat much longer.
"""

import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from distributed import LocalCluster

import hygrokf
from hygrokf.cases.synthetic import SyntheticParameters
from hygrokf.fleet.fleet_plan import read_plan

os.environ["OMP_NUM_THREADS"] = "1"  # a worker takes one thread for linear algebra
folder, truth = Path(tempfile.mkdtemp()), {}
for number in range(1, 5):
    truth[f"WT{number:02}"] = tau = 3.2 if number == 4 else 1.5
    turbine = hygrokf.synthetic_turbine(
        seed=number, days=12, parameters=SyntheticParameters(thermal_time_constant_h=tau)
    )
    case = hygrokf.write_case(turbine, folder / f"WT{number:02}")
    text = case.read_text(encoding="utf-8")
    case.write_text(text.replace(f"synthetic-turbine-{number}", f"WT{number:02}"), encoding="utf-8")
(folder / "fleet.toml").write_text(
    'name = "Four cabinets"\ntask = "fit"\ncases = ["WT*/case.toml"]\n'
    "[options]\nstarts = 1\nprofiles = false\n",
    encoding="utf-8",
)
# threads start sooner; a cluster of processes, the default, uses all cores
settings = {"processes": False, "n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
with LocalCluster(**settings) as cluster:
    plan, address = read_plan(folder / "fleet.toml"), cluster.scheduler_address
    found = hygrokf.run_fleet(plan, folder / "out", cluster=address)
print(found)

# %%
# The table of the run as a picture: time constants with bounds, beside the values that they were made
# with.

rows = sorted((row for row in found.rows if row["status"] == "done"), key=lambda row: row["turbine"])
figure, axis = plt.subplots(figsize=(8, 3.6))
for place, row in enumerate(rows):
    low, high = (float(row[f"thermal_{end}_h"]) for end in ("lower", "upper"))
    axis.plot([low, high], [place, place], color="C0", linewidth=4, alpha=0.35)
    label = "estimate, 95 % bounds" if place == 0 else None
    axis.plot(float(row["thermal_value_h"]), place, "o", color="C0", label=label)
    axis.plot(truth[row["turbine"]], place, "x", color="C3", label="made with" if place == 0 else None)
axis.set_yticks(range(len(rows)), [row["turbine"] for row in rows])
axis.set_xlabel("thermal time constant [h]")
axis.set_title(str(found))
axis.legend(loc="upper right")
figure.tight_layout()
