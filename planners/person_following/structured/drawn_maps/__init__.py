"""Where walls hide things: a map drawn on the way, and a person on it."""
