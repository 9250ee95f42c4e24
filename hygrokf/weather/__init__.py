"""Weather files (ERA5, EPW) as records, brought to a site's height and clock; clocks of sources held against
each other.

Nothing here knows a model or a case file.
"""
