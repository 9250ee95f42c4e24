"""
Forecast and restart advice
===========================

The tracker filters readings as they come. From its state the model runs ahead under scenarios of the
last weeks' weather and operation: will water condense, and how long must the cabinet be pre-heated
before the turbine restarts?
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import hygrokf
from hygrokf.live.condition import Surface
from hygrokf.live.forecast import forecast, heating_sd, restart
from hygrokf.live.plan import plan
from hygrokf.live.scenarios import persistence
from hygrokf.live.tracker import Reading

turbine = hygrokf.synthetic_turbine(seed=1, days=30)
record = hygrokf.read_case(hygrokf.write_case(turbine, tempfile.mkdtemp()))
fit = hygrokf.identify(record, starts=1, profiles=False)

# %%
# Now is the damp hour of a standstill: readings after it are not known yet.

power, humidity = record["active_power"], record["cabinet_relative_humidity"]
standing = np.interp(humidity.time, power.time, np.nan_to_num(power.value, nan=1e6)) <= 0.0
late = humidity.time > record.start_s + 12 * 86400.0
now = humidity.time[np.argmax(np.where(standing & late, np.nan_to_num(humidity.value), 0.0))]
tracker = hygrokf.Tracker(plan(fit))
for series in record.series:
    known = np.isfinite(series.value) & (series.time <= now)
    pairs = zip(series.time[known], series.value[known], strict=True)
    tracker.take(Reading(series.signal, time, value) for time, value in pairs)
tracker.advance()
state, surface = tracker.newest_state, Surface(follows=0.5)
scenarios = persistence(record, state.time)  # ignores what came later
ahead = forecast(tracker.plan, state, scenarios, surface)
advice = restart(tracker.plan, state, scenarios, surface, heating_sd_K=heating_sd(fit))
print(scenarios.basis, advice.statement, sep="\n")

air = ahead.condition
when = pd.to_datetime(air.time_s, unit="s")
figure, axes = plt.subplots(2, sharex=True, figsize=(9, 5.2), height_ratios=(2, 1))
past = (humidity.time > now - 24 * 3600.0) & (humidity.time <= now)
later = (humidity.time > now) & (humidity.time < air.time_s[-1])
for chosen, colour, label in ((past, "C0", "readings"), (later, "0.6", "what came")):
    time = pd.to_datetime(humidity.time[chosen], unit="s")
    axes[0].plot(time, 100 * humidity.value[chosen], color=colour, linewidth=1.2, label=label)
axes[0].plot(when, 100 * air.relative_humidity.value, color="C3", label="forecast")
low, high = (100 * np.clip(one, 0, 1) for one in (air.relative_humidity.lower, air.relative_humidity.upper))
axes[0].fill_between(when, low, high, color="C3", alpha=0.18, linewidth=0, label="95 %")
axes[0].axhline(100 * ahead.limit, color="0.4", linestyle=":", linewidth=0.9)
axes[0].set_ylabel("relative humidity [%]")
axes[0].legend(ncols=4, loc="lower left", bbox_to_anchor=(0, 1))
axes[1].plot(when, 100 * ahead.above, color="C1", label="above 80 %")
axes[1].plot(when, 100 * air.condensation, color="C0", label="condensation on the cold surface")
axes[1].set_ylabel("probability [%]")
axes[1].set_ylim(0, 100)
axes[1].set_title(advice.statement, fontsize=8.5)
axes[1].legend(ncols=2)
figure.tight_layout()
