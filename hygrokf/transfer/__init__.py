"""Fits side by side, and a fit on another turbine's record: what travels, what differs.

Science only: pages are in `report`.
"""
