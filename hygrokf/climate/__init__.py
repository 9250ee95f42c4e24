"""Years of weather through a fitted model: statistics with bounds, limits, a test profile.

Science only: pages and tables are in `report`.
"""
