"""Inference in a 2DBN: exact, factored, sampled; plans of actions."""
