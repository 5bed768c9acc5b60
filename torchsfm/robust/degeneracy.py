"""Why the data, although they agree on a model, may not determine it."""

from enum import IntEnum


class Degeneracy(IntEnum):
    """What the inliers of a model lack; results hold it as an int8 tensor over the batch.

    Which of these are found, and what they mean for the model, is said where the model is estimated.
    """

    NONE = 0
    """Nothing was found."""
    TOO_FEW = 1
    """No more inliers than a sample: they agree with any model through them."""
    COLLINEAR = 2
    """All points on a line, but for so few as chance explains."""
    PLANAR = 3
    """All points in a plane, or a camera that only turned, but for so few as chance explains."""
    ROTATION = 4
    """The camera only turned: there is no parallax."""
    UNDETERMINED = 5
    """No sample determined a model, for a reason that is none of the others."""
