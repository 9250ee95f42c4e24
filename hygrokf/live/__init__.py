"""Live tracking of cabinets: the tracker, its alarms and forecasts, and the service around them.

`sources`, `storage`, `web` and `doctor` hold what touches networks, databases and browsers; nothing else
does.
"""
