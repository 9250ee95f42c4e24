"""Judges a model with given parameters: free run, forecasts, scores, tests of the innovations, effects of
actuators.

Estimates nothing; the wings judge by it too.
"""
