"""From images alone: how did the camera move?"""

from torchsfm.motion.essential_5pt import essential_5pt
from torchsfm.motion.estimate_essential import RelativePoseEstimator, estimate_essential
from torchsfm.motion.estimate_fundamental import FundamentalEstimator, estimate_fundamental
from torchsfm.motion.estimate_homography import HomographyEstimator, estimate_homography
from torchsfm.motion.factorization_points import Factorization, factorize_points
from torchsfm.motion.fundamental_7pt import fundamental_7pt
from torchsfm.motion.fundamental_8pt import fundamental_8pt
from torchsfm.motion.homography_4pt import homography_4pt
from torchsfm.motion.homography_dlt import homography_dlt

ESTIMATORS = (FundamentalEstimator, HomographyEstimator, RelativePoseEstimator)
"""What `ransac` can estimate here; the contract tests and the benchmark run over them."""

__all__ = [
    "ESTIMATORS",
    "Factorization",
    "FundamentalEstimator",
    "HomographyEstimator",
    "RelativePoseEstimator",
    "essential_5pt",
    "estimate_essential",
    "estimate_fundamental",
    "estimate_homography",
    "factorize_points",
    "fundamental_7pt",
    "fundamental_8pt",
    "homography_4pt",
    "homography_dlt",
]
