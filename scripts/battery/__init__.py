"""What `scripts/discovery_battery` runs and prints."""
