"""Fits compared, and a fit on another turbine's record: which parameters carry over, which differ.

Science only: pages are in `report`.
"""
