"""What `scripts/live_trials` runs and prints."""
