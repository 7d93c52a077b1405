"""Hand-structured local models of person following: the agent `structured`."""
