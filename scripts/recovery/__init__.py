"""What `scripts/coverage` runs and prints."""
