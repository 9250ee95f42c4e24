"""Case files and frames: from tables to a record with its doubts, every fault of a case in one message.

Nothing here estimates; `synthetic` writes a made-up turbine as a case.
"""
