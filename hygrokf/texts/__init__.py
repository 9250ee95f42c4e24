"""Codes of what results say, the template of each, and how numbers are written."""
