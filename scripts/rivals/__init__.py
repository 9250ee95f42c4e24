"""What `scripts/head_to_head` runs and prints."""
