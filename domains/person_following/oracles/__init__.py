"""Exact optima: with the full state, from observations (Bayes), and under wrong models of the person."""
