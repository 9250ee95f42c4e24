"""Output for readers: pages, tables and texts of fits, discoveries, climates, comparisons and transfers.

Reads results; computes nothing that a result should hold.
"""
