"""Many turbines: the same task for each, on one machine or on several, one table and one page of all."""
