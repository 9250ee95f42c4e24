"""Which model describes a record, and what drives it: the design, its inputs, and what users bring of their
own.

Chooses mechanisms and prepares courses; estimates nothing.
"""
