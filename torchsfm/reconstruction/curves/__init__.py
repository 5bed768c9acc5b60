"""Curves of a model from the edges of its photographs, and cameras from curves alone."""
