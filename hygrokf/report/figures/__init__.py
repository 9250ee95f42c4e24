"""The pictures: one module for each kind, drawn from the data of a result."""
