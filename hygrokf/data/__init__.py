"""The record: signals with units, series on their own clocks, time stamps, masks, values between readings.

Nothing here knows a model.
"""
