"""Independent programs that read our files: Storm, pyAgrum, Fast Downward."""
