"""From images alone: how did the camera move?"""

from torchsfm.motion.many_views.average_rotations import AveragedRotations, average_rotations
from torchsfm.motion.many_views.average_similarities import AveragedSimilarities, average_similarities
from torchsfm.motion.many_views.factorization_affine import AffineFactorization, factorize_affine
from torchsfm.motion.many_views.factorization_curves import CurveFactorization, factorize_curves
from torchsfm.motion.many_views.factorization_points import Factorization, factorize_points
from torchsfm.motion.many_views.position_globally import GlobalPositions, position_globally
from torchsfm.motion.many_views.quadrifocal_6pt import QuadrifocalFit, quadrifocal_6pt
from torchsfm.motion.three_views.estimate_trifocal import TrifocalEstimator, estimate_trifocal
from torchsfm.motion.three_views.point_line_trifocal import PointLineTrifocalEstimator
from torchsfm.motion.three_views.trifocal_4p3l import trifocal_4p3l
from torchsfm.motion.three_views.trifocal_6pt import trifocal_6pt
from torchsfm.motion.three_views.trifocal_7pt import TrifocalFit, trifocal_7pt
from torchsfm.motion.two_views.essential_5pt import essential_5pt
from torchsfm.motion.two_views.essential_6pt import essential_6pt
from torchsfm.motion.two_views.estimate_essential import RelativePoseEstimator, estimate_essential
from torchsfm.motion.two_views.estimate_fundamental import FundamentalEstimator, estimate_fundamental
from torchsfm.motion.two_views.estimate_homography import HomographyEstimator, estimate_homography
from torchsfm.motion.two_views.estimate_structures import estimate_fundamentals, estimate_homographies
from torchsfm.motion.two_views.estimate_upright import UprightPoseEstimator, estimate_upright
from torchsfm.motion.two_views.fundamental_7pt import fundamental_7pt
from torchsfm.motion.two_views.fundamental_8pt import fundamental_8pt
from torchsfm.motion.two_views.fundamental_affine_4pt import fundamental_affine_4pt
from torchsfm.motion.two_views.fundamental_from_conics import ConicEpipolarFit, fundamental_from_conics
from torchsfm.motion.two_views.homography_4pt import homography_4pt
from torchsfm.motion.two_views.homography_dlt import homography_dlt
from torchsfm.motion.two_views.motions_from_homography import (
    PlaneMotion,
    SelectedMotion,
    motion_from_homography,
    motions_from_homography,
)
from torchsfm.motion.two_views.relative_6pt_focal import FocalMotion, relative_6pt_focal
from torchsfm.motion.two_views.relative_known_rotation_2pt import relative_known_rotation_2pt
from torchsfm.motion.two_views.relative_upright_3pt import relative_upright_3pt

ESTIMATORS = (
    FundamentalEstimator,
    HomographyEstimator,
    PointLineTrifocalEstimator,
    RelativePoseEstimator,
    TrifocalEstimator,
    UprightPoseEstimator,
)
"""What `ransac` can estimate here; the contract tests and the benchmark run over them."""
SOLVERS = (
    essential_5pt,
    essential_6pt,
    fundamental_7pt,
    fundamental_affine_4pt,
    homography_4pt,
    motions_from_homography,
    relative_6pt_focal,
    relative_known_rotation_2pt,
    relative_upright_3pt,
    trifocal_4p3l,
    trifocal_6pt,
)
"""What returns `Solutions` of a sample here; the contract tests run over them, on the scenes of `bench/cases/`."""

__all__ = [
    "ESTIMATORS",
    "SOLVERS",
    "AffineFactorization",
    "AveragedRotations",
    "AveragedSimilarities",
    "ConicEpipolarFit",
    "CurveFactorization",
    "Factorization",
    "FocalMotion",
    "FundamentalEstimator",
    "GlobalPositions",
    "HomographyEstimator",
    "PlaneMotion",
    "PointLineTrifocalEstimator",
    "QuadrifocalFit",
    "RelativePoseEstimator",
    "SelectedMotion",
    "TrifocalEstimator",
    "TrifocalFit",
    "UprightPoseEstimator",
    "average_rotations",
    "average_similarities",
    "essential_5pt",
    "essential_6pt",
    "estimate_essential",
    "estimate_fundamental",
    "estimate_fundamentals",
    "estimate_homographies",
    "estimate_homography",
    "estimate_trifocal",
    "estimate_upright",
    "factorize_affine",
    "factorize_curves",
    "factorize_points",
    "fundamental_7pt",
    "fundamental_8pt",
    "fundamental_affine_4pt",
    "fundamental_from_conics",
    "homography_4pt",
    "homography_dlt",
    "motion_from_homography",
    "motions_from_homography",
    "position_globally",
    "quadrifocal_6pt",
    "relative_6pt_focal",
    "relative_known_rotation_2pt",
    "relative_upright_3pt",
    "trifocal_4p3l",
    "trifocal_6pt",
    "trifocal_7pt",
]
