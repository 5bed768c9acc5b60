"""From images alone: how did the camera move?"""

from torchsfm.motion.essential_5pt import essential_5pt
from torchsfm.motion.fundamental_7pt import fundamental_7pt
from torchsfm.motion.fundamental_8pt import fundamental_8pt
from torchsfm.motion.homography_4pt import homography_4pt
from torchsfm.motion.homography_dlt import homography_dlt

__all__ = ["essential_5pt", "fundamental_7pt", "fundamental_8pt", "homography_4pt", "homography_dlt"]
