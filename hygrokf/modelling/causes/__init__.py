"""Causes that `discover` tries: what a cause is, its forms as models, and the package's own."""
