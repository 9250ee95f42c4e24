"""From a record to a fit: stages of the estimation, forms that compete, time constants with composed bounds,
the verdict.

The wings meet here; nothing here knows of discovery, fleets, climates or pages.
"""
