"""Parts of `scripts/reproduce_paper`: the paper's three experiments on simulated cabinets under measured
drivers."""
