"""Episodes played again with everything recorded, which ones, and why an agent chose an action."""
