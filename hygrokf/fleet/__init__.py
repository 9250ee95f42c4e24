"""One task for many turbines, on processes or a cluster, restartable, with one table and one page."""
