"""A 2DBN for people: text, trees, graphs, pictures."""
