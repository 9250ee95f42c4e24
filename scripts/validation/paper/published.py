"""What the paper states, and where."""

from __future__ import annotations

TIME_CONSTANTS_H = {"thermal": 1.5, "hygric": 0.3}
"""[h] "approx. 1.5 h" and "approx. 0.3 h", below Fig. 8."""

PERIODS = {
    "identification": {"temperature_K": 1.95, "absolute_humidity_g_m3": 0.45},
    "validation": {"temperature_K": 1.43, "absolute_humidity_g_m3": 0.26},
}
"""RMSE of the first 5.5 months and of the month after them, with the measured ambient; text below Fig. 7 and
Fig. 8."""

WHOLE = {
    "measured": {"temperature_K": 1.87, "absolute_humidity_g_m3": 0.43},
    "era5": {"temperature_K": 2.34, "absolute_humidity_g_m3": 0.60},
}
"""Table III: total RMSE of the whole record by the source of the ambient air."""

SISTER = {"temperature_K": 2.53, "absolute_humidity_g_m3": 0.32}
"""RMSE of the model of the UK turbine on its sister in Germany, with ERA5's air; text below Fig. 9."""
