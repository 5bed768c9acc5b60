"""What the solver bench measures, one thing a file."""
