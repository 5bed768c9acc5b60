"""A model while it is made: cameras, points and tracks, and the single steps that change them."""
