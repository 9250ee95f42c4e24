"""The model of a record and its inputs: the design, derived inputs, and users' own mechanisms.

Chooses mechanisms and prepares courses; estimates nothing.
"""
