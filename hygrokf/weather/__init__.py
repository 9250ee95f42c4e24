"""Weather of a site: reanalyses and typical years as records, and how two weather series differ."""
