"""From photographs, or from what other programs found in them, to verified pairs of images."""
