"""What `scripts/discovery_trials` runs and prints."""
