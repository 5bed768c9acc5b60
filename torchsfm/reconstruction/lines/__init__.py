"""Lines of a model from the segments of its photographs."""
