"""
Your own DataFrames
===================

`read_frames` takes pandas frames as they are: each with its own clock, step, time zone and units. Here a
cabinet logger writes degrees Fahrenheit in local time every five minutes, and a mast reports hourly.
"""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import hygrokf

random = np.random.default_rng(7)
hours = np.arange(0.0, 14 * 24.0, 1 / 12)
ambient = (
    8.0 + 5.0 * np.sin(2 * np.pi * (hours - 9.0) / 24.0) + np.cumsum(0.04 * random.normal(size=len(hours)))
)
cabinet = np.empty_like(ambient)
cabinet[0] = ambient[0] + 6.0
for k in range(1, len(hours)):  # one heat capacity, time constant 2.5 h, a constant release of 6 K
    cabinet[k] = cabinet[k - 1] + (ambient[k] + 6.0 - cabinet[k - 1]) / (2.5 * 12) + 0.02 * random.normal()

logger = pd.DataFrame(
    {"T_F": 32.0 + 1.8 * (cabinet + 0.05 * random.normal(size=len(hours)))},
    index=pd.date_range("2024-03-04", periods=len(hours), freq="5min", tz="Europe/Berlin"),
)
mast = pd.DataFrame(
    {"t2m": ambient[::12] + 273.15},
    index=pd.date_range("2024-03-03T23:00", periods=14 * 24, freq="h", tz="UTC"),
)
print(logger.head(3), mast.head(3), sep="\n\n")

# %%
# Columns are mapped to signals, and every column states its unit. Nothing is resampled.

record = hygrokf.read_frames(
    {"logger": logger, "mast": mast},
    signals={"T_F": "cabinet_temperature", "t2m": "ambient_temperature"},
    units={"T_F": "degF", "t2m": "K"},
)
fit = hygrokf.identify(record, starts=1, profiles=False)
tau = fit.results.time_constants["thermal"]
print(f"{tau.value_h:.2f} h ({tau.lower_h:.2f} … {tau.upper_h:.2f}), made with 2.5 h")

figure, axis = plt.subplots(figsize=(9, 3.8))
for signal, label, style in (
    ("ambient_temperature", "ambient, hourly", {"color": "C2", "marker": ".", "markersize": 3}),
    ("cabinet_temperature", "cabinet, every 5 min", {"color": "C0"}),
):
    series = record[signal]
    axis.plot(pd.to_datetime(series.time, unit="s"), series.value - 273.15, label=label, **style)
axis.set_ylabel("temperature [°C]")
axis.set_title(f"Two frames, one record: τ = {tau.value_h:.2f} h ({tau.lower_h:.2f} … {tau.upper_h:.2f} h)")
axis.legend(ncols=2)
figure.autofmt_xdate(rotation=0, ha="center")
figure.tight_layout()
