"""Agents that act over the factored belief: belief DQN, POMDP planners, baselines, and their comparison."""
