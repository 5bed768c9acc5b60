"""The `Reconstruction`: what a finished model holds, and what is done with it without its photographs."""
