"""One module per command: `run` is `nesy run`."""
