"""What a model's simulation gets wrong, the causes that may explain it, and what naming one gains.

Science only: pages and tables are in `report`.
"""
