"""Three views: the trifocal tensor from points, minimal, linear and robust."""
