"""
First fit
=========

A synthetic turbine stands in for three exports: a logger in the cabinet, a weather series and 10-minute
SCADA data. `identify` estimates the time constants of the cabinet; the last days of the record are held
out and only scored. The free run knows the inputs alone: weather and power, but no reading from the
cabinet.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import hygrokf

turbine = hygrokf.synthetic_turbine(seed=1, days=30)
record = hygrokf.read_case(hygrokf.write_case(turbine, tempfile.mkdtemp()))
fit = hygrokf.identify(record, starts=1, profiles=False)
print(fit.to_frame().iloc[:, :5].round(3))

# %%
# The same model, driven by the inputs of the whole record. Standard deviations come with every value.

free_run = hygrokf.simulate(fit, record)
day = free_run.time_h / 24.0
held_out = day > (record.until_s - free_run.origin_s) / 86400.0

figure, axes = plt.subplots(2, sharex=True, figsize=(9, 5.2))
panels = (
    (axes[0], "cabinet_temperature", 273.15, 1.0, "temperature [°C]"),
    (axes[1], "cabinet_relative_humidity", 0.0, 100.0, "relative humidity [%]"),
)
for axis, signal, zero, scale, label in panels:
    series, mean = record[signal], free_run.value[signal]
    time = (series.time - free_run.origin_s) / 86400.0
    axis.plot(time, scale * (series.value - zero), color="C0", linewidth=1.0, label="measured (synthetic)")
    axis.plot(day, scale * (mean - zero), color="C1", linewidth=1.0, label="free run")
    low, high = (scale * (end - zero) for end in free_run.bounds(signal))
    axis.fill_between(day, low, high, color="C1", alpha=0.18, linewidth=0, label="95 % band")
    axis.set_ylabel(label)
axes[1].set_ylim(0, 100)
axes[1].set_xlim(day[np.argmax(held_out)], day[-1])
axes[1].set_xlabel("day of the record")
axes[0].legend(ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
figure.tight_layout()
