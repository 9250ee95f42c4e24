"""Case files drafted from exports: the layout of a table, its stamps, and the signals of its columns.

Nothing here reads a record; what is not certain becomes a doubt that the drafted file states.
"""
