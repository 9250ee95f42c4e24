"""
Climate of three sites
======================

A fitted cabinet under the weather of three places: how warm and how damp is the air in it, over the
year, with bounds? The turbine stands still, and two weeks of synthetic weather stand for a year to
keep this quick; `read_region` reads ERA5 and EPW files.
"""

import tempfile
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import hygrokf
from hygrokf.climate.region import Region

turbine = hygrokf.synthetic_turbine(seed=1, days=10)
record = hygrokf.read_case(hygrokf.write_case(turbine, tempfile.mkdtemp()))
fit = hygrokf.identify(record, starts=1, profiles=False)
place = hygrokf.synthetic_turbine(seed=2, days=14)
here = hygrokf.read_case(hygrokf.write_case(place, tempfile.mkdtemp()))


def moved(record: hygrokf.Record, warmer_K: float, moister: float) -> hygrokf.Record:
    """The weather of a warmer or a moister place, from that of `record`."""
    warm = record["ambient_temperature"]
    damp = record["ambient_relative_humidity"]
    return record.replace_series(
        replace(warm, value=warm.value + warmer_K),
        replace(damp, value=np.clip(damp.value * moister, 0.05, 1.0)),
    )


sites = {"midlands": here, "coast": moved(here, 2.0, 1.12), "dry upland": moved(here, -3.0, 0.7)}
regions = [Region(name, weather) for name, weather in sites.items()]
study = hygrokf.climate_profile(fit, regions, members=2, seed=3)
for region in study.regions:
    damp = region.year["condensation_h"]
    print(f"{region.name}: condensation on {damp.value:.0f} h a year ({damp.lower:.0f} … {damp.upper:.0f})")

# %%
# For what share of the year is a value exceeded? Solid: in the cabinet, with bounds; dashed: the
# weather.

figure, axes = plt.subplots(1, 2, figsize=(9, 4))
panels = (("temperature_degC", "temperature [°C]"), ("relative_humidity_percent", "relative humidity [%]"))
for axis, (quantity, label) in zip(axes, panels, strict=True):
    for place, region in enumerate(study.regions):
        curve, colour = region.duration[quantity], f"C{place}"
        share = 100.0 * curve.share_beyond
        axis.fill_between(share, curve.lower, curve.upper, color=colour, alpha=0.2, linewidth=0)
        axis.plot(share, curve.value, color=colour, label=region.name)
        axis.plot(share, curve.outside, color=colour, linestyle=(0, (4, 2)), linewidth=0.9)
    axis.set_xlabel("share of the time in which it is exceeded [%]")
    axis.set_ylabel(label)
    axis.set_xlim(0, 100)
axes[0].legend()
figure.tight_layout()
