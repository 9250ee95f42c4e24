"""Weather files (ERA5, EPW) as records, converted to a site's height and clock; comparison of the clocks of
two sources.

Nothing here knows a model or a case file.
"""
