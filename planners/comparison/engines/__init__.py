"""Where the cells of a comparison run: in this process, in several on this machine, or on a Ray cluster."""
