"""Equations: moist air, mechanisms with their parameters, and models composed of them.

Every function takes numbers or traced expressions alike.  Nothing here knows a record, an estimate or a
compiler.
"""
