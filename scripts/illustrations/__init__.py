"""What `scripts/pictures` draws and fills in."""
