"""What codes mean in terms of predicates, and how well rules about that hold."""
