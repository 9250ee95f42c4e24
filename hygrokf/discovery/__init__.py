"""The errors of a model's simulation, the causes that may explain them, and the gain of naming a cause.

Pages and tables are in `report`.
"""
