"""What `scripts/live_faults` does to a live tracker, and what it finds afterwards."""
