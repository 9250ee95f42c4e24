"""Weather files (ERA5, MERRA-2, Open-Meteo, EPW, TRY) as records, converted to a site's height and clock;
comparison of the clocks of two sources.

Nothing here knows a model or a case file.
"""
