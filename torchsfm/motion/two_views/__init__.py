"""Two views: fundamental and essential matrices, homographies, relative poses, and how well data determine them."""
