"""
Transfer to a sister
====================

Does the model of one turbine hold on another one? Of two further cabinets one is a sister, the other
stores heat longer and releases more of it. `transfer_fit` tells which parameters carry over and which
must be estimated again.
"""

import tempfile
from dataclasses import replace

import matplotlib.pyplot as plt

import hygrokf
from hygrokf.cases.synthetic import SyntheticParameters


def record_of(seed: int, parameters: SyntheticParameters | None = None) -> hygrokf.Record:
    """Temperature, weather and power of a synthetic turbine."""
    turbine = hygrokf.synthetic_turbine(seed=seed, days=20, parameters=parameters)
    record = hygrokf.read_case(hygrokf.write_case(turbine, tempfile.mkdtemp()))
    return replace(record, series=tuple(s for s in record.series if s.signal != "cabinet_relative_humidity"))


longer = SyntheticParameters(thermal_time_constant_h=2.6)
fit = hygrokf.identify(record_of(41), starts=1, profiles=False)
others = {"the sister": record_of(42), "the other cabinet": record_of(43, longer)}
found = {name: hygrokf.transfer_fit(fit, record, fits=False).results for name, record in others.items()}
for name, one in found.items():
    print(f"{name}: {one.statement}")

# %%
# Each parameter's own estimate beside the one that was carried over; red: the groups that must be
# estimated again.

figure, axes = plt.subplots(1, 2, sharex=True, sharey=True, figsize=(9, 3.8))
for axis, (name, one) in zip(axes, found.items(), strict=True):
    rows = {n: p for n, p in one.parameters.items() if p.difference is not None and p.own_se}
    for place, row in enumerate(rows.values()):
        spread = (row.own_se**2 + (row.original_se or 0.0) ** 2) ** 0.5
        shift = (row.own - row.original) / spread
        colour = "C3" if row.group in one.re_estimate else "C0"
        axis.plot([shift - 1.96, shift + 1.96], [place, place], color=colour, linewidth=3, alpha=0.4)
        axis.plot(shift, place, "o", color=colour)
    axis.axvline(0.0, color="0.4", linewidth=0.8)
    axis.set_yticks(range(len(rows)), [n.replace("_", " ") for n in rows])
    axis.set_title(f"{name}: {one.verdict}\n{', '.join(one.re_estimate)}", fontsize=9)
    axis.set_xlabel("difference, in its standard errors")
figure.tight_layout()
