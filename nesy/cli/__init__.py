"""The command line: one file per command; the only part of nesy that may import planners."""
