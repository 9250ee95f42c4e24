"""Claims of docs/validation and what measures each: `scripts/validate CLAIM` runs one."""
