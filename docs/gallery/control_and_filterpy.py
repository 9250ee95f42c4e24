"""
Export to python-control and filterpy
=====================================

An identified model is not locked in. `to_statespace` gives the network as a `control.StateSpace`;
`to_filterpy` gives the whole model as an extended Kalman filter of filterpy, which reaches the same
log-likelihood.
"""

import tempfile
from dataclasses import replace

import control
import matplotlib.pyplot as plt
import numpy as np

import hygrokf

turbine = hygrokf.synthetic_turbine(seed=1, days=12)
record = hygrokf.read_case(hygrokf.write_case(turbine, tempfile.mkdtemp()))
record = replace(record, series=tuple(s for s in record.series if s.signal != "cabinet_relative_humidity"))
fit = hygrokf.identify(record, starts=1, profiles=False)
system = hygrokf.to_statespace(fit)
print(system)

# %%
# filterpy's filter over the first day, beside the package's own.

likelihood = fit.likelihood(record)
own = likelihood.trace(fit.values)
other = hygrokf.to_filterpy(likelihood, fit.values)
time = likelihood.timeline.time
days = time[: np.searchsorted(time, 24.0)]
course = []
for k in range(len(days)):
    if k:
        other.advance(k)
    other.observe(k)
    course.append(other.x[0])
largest = np.max(np.abs(np.array(course) - own.mean[: len(days), 0]))
print(f"largest difference of the converter temperature: {largest:.1e} K")

figure, axes = plt.subplots(1, 2, figsize=(9, 3.8))
hours = np.linspace(0.0, 10.0, 200)
labels = {"heat_release": "heat release + 1 K", "ambient_temperature": "ambient + 1 K"}
for place, (name, label) in enumerate(labels.items()):
    step = control.step_response(system, hours, input=system.input_index[name], squeeze=True)
    axes[0].plot(step.time, np.ravel(step.outputs), color=f"C{place}", label=label)
axes[0].set_xlabel("time [h]")
axes[0].set_ylabel("cabinet air [K]")
axes[0].set_title("python-control: step response")
axes[0].legend()
axes[1].plot(days, own.mean[: len(days), 0] - 273.15, color="C0", linewidth=3, alpha=0.4, label="hygrokf")
axes[1].plot(days, np.array(course) - 273.15, color="C3", linewidth=1, label="filterpy")
axes[1].set_xlabel("time [h]")
axes[1].set_ylabel("converter temperature [°C]")
axes[1].set_title("the same filter in filterpy")
axes[1].legend()
figure.tight_layout()
