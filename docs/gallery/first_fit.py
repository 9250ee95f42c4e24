"""
First fit
=========

A synthetic turbine stands in for three exports: a logger in the cabinet, a weather series and 10-minute SCADA data. `identify`
estimates its time constants; the last tenth of the record is held out and only scored. The picture shows readings
and the free run, which knows the inputs alone, over the held-out days.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import hygrokf

turbine = hygrokf.synthetic_turbine(seed=1, days=30)
record = hygrokf.read_case(hygrokf.write_case(turbine, tempfile.mkdtemp()))
fit = hygrokf.identify(record, starts=1, profiles=False)
print(fit.to_frame())
