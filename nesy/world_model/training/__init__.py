"""Training of the world model, its gates, its logs."""
