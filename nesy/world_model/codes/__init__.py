"""The search for a code book: which factors a view has, and which values."""
