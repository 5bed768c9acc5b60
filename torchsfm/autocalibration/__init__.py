"""From projective to metric: what are the cameras like inside, as far as the images alone tell?"""

from torchsfm.autocalibration.focal_from_fundamentals import FocalEstimate, focal_from_fundamentals

__all__ = ["FocalEstimate", "focal_from_fundamentals"]
