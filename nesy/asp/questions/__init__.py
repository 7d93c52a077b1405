"""Questions to the model, one module per kind."""
