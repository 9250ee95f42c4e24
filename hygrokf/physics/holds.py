"""Holds: how an input runs between two instants, in models, records and the filter."""

LINEAR = "linear"
"""Joined by straight lines: readings of an instant."""
ZERO_ORDER = "zero-order"
"""Held over the step that ends at the instant: interval means."""
REGIME = "regime"
"""Piecewise constant with few distinct values, so that steps of the same length share their matrices."""
