"""Learning a 2DBN: from a world model, from experience, its structure, its step tables."""
