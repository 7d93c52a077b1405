"""Tree search: one simulation kernel, PO-UCT, search with bounds, drawings."""
