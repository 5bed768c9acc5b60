"""Four and many views: the quadrifocal tensor, affine and projective factorisation, averaging over view graphs."""
