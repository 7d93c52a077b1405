"""How well a 2DBN predicts: fidelity, recovery of known structures, roll-outs, the validity of codes."""
