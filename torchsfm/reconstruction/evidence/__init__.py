"""What pairs of images and points that are missing say of a model, for it or against it."""
