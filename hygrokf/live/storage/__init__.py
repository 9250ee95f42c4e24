"""What a tracker keeps: one store in SQLite or PostgreSQL, its schema, retention and export."""
