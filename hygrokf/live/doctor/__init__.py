"""The doctor: checks of everything that a tracker needs, with a remedy for each fault."""
