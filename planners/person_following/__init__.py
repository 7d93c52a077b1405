"""Planning with another person: the influence-augmented local model and what plans in it."""
