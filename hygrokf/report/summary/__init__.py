"""Results on one page: what stands on it, and how it is drawn as HTML and PDF."""
