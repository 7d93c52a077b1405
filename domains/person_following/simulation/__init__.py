"""The rules as compiled kernels: maps, people, paths, views, and batches of episodes."""
