"""Agents x worlds x seeds: the grid of cells, where they run, their episodes, statistics and tables."""
