"""A fit elsewhere: beside others, on other records, and what several turbines of a type have in common."""
