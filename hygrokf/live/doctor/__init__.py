"""What is wrong with a tracker's surroundings, and what to do: one module for each thing that is looked at."""
