"""Cabinets tracked online: from readings as they come in to condition, risk and warning."""
