"""
One function from frame to row, for Spark or pandas
===================================================

A fit is a function of one turbine's frame that returns one row. `DataFrame.groupby(…).apply` runs it
here; Spark's `groupBy("turbine").applyInPandas(fit_row, schema)` runs the same function on a cluster.
"""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import hygrokf


def fit_row(frame: pd.DataFrame) -> pd.DataFrame:
    """The thermal time constant of one turbine as one row; a fault becomes text in the row."""
    row = {
        "turbine": frame["turbine"].iloc[0],
        **dict.fromkeys(("tau_h", "lower_h", "upper_h"), np.nan),
        "fault": "",
    }
    try:
        record = hygrokf.read_frames(
            frame.drop(columns="turbine").set_index("time"),
            units={"cabinet_temperature": "degC", "ambient_temperature": "degC"},
        )
        tau = hygrokf.identify(record, starts=1, profiles=False).results.time_constants["thermal"]
        row.update(tau_h=tau.value_h, lower_h=tau.lower_h, upper_h=tau.upper_h)
    except (hygrokf.HygrokfError, ValueError) as fault:
        row["fault"] = " ".join(str(fault).split())
    return pd.DataFrame([row])


schema = "turbine string, tau_h double, lower_h double, upper_h double, fault string"

# %%
# A long table of eight turbines; the last one's logger was never connected.

random = np.random.default_rng(21)
hours = np.arange(0.0, 8 * 24.0, 1 / 6)
made = dict(zip([f"WT{n}" for n in range(1, 9)], random.uniform(1.2, 3.0, 8), strict=True))
tables = []
for name, tau in made.items():
    ambient = 9.0 + 4.0 * np.sin(2 * np.pi * hours / 24.0) + np.cumsum(0.08 * random.normal(size=len(hours)))
    cabinet = np.empty_like(ambient)
    cabinet[0] = ambient[0] + 5.0
    for k in range(1, len(hours)):
        cabinet[k] = cabinet[k - 1] + (ambient[k] + 5.0 - cabinet[k - 1]) / (6 * tau) + 0.04 * random.normal()
    readings = cabinet + 0.05 * random.normal(size=len(hours))
    tables.append(
        pd.DataFrame(
            {
                "turbine": name,
                "time": pd.date_range("2024-05-01", periods=len(hours), freq="10min", tz="UTC"),
                "cabinet_temperature": np.nan if name == "WT8" else readings,
                "ambient_temperature": ambient,
            }
        )
    )
long = pd.concat(tables, ignore_index=True)

rows = pd.concat([fit_row(frame) for _, frame in long.groupby("turbine")], ignore_index=True)
print(rows.to_string(index=False, float_format="{:.2f}".format, max_colwidth=60))

figure, axis = plt.subplots(figsize=(8, 3.8))
known = rows[rows["fault"] == ""].sort_values("tau_h").reset_index(drop=True)
for place, row in known.iterrows():
    axis.plot([row["lower_h"], row["upper_h"]], [place, place], color="C0", linewidth=4, alpha=0.35)
    axis.plot(row["tau_h"], place, "o", color="C0", label="estimate, 95 % bounds" if place == 0 else None)
    axis.plot(made[row["turbine"]], place, "x", color="C3", label="made with" if place == 0 else None)
axis.set_yticks(range(len(known)), known["turbine"])
axis.set_xlabel("thermal time constant [h]")
axis.set_title(f"{len(known)} rows with a fit, {len(rows) - len(known)} with a fault")
axis.legend(loc="lower right")
figure.tight_layout()
