"""Maximum likelihood over the innovations: value and score, the optimiser, bounds, the smoother, the
output-error fit.

Works on any model and timeline; knows no cabinet and no file.
"""
