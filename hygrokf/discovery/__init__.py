"""What a model gets wrong, and the physical cause of it."""
