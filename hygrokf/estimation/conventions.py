"""Choices that all estimates of the package share: their starts, and the levels of their bounds and tests."""

STARTS = 5
"""Start points of the maximisation, unless the user chooses another number."""
CONFIDENCE = 0.95
"""[1] confidence level: probability with which bounds hold the true value."""
SIGNIFICANCE = 0.05
"""[1] significance level: probability of any false rejection among the tests of one question, or the share of
false ones among its discoveries."""
