"""Case files and frames: from tables to a record with its doubts; one message lists all faults of a case.

Nothing here estimates; `synthetic` writes a made-up turbine as a case.
"""
