"""From a 2DBN to an ASP program and its answers: facts, encodings, checked sources, the solver."""
