"""The cameras are known: where are the points, lines, conics and curves? Photogrammetry calls it intersection."""

from torchsfm.triangulation.conics_2view import conics_2view
from torchsfm.triangulation.line_faults import LineFault
from torchsfm.triangulation.optimal_correction import correct_matches
from torchsfm.triangulation.triangulate_conics import ConicTriangulation, triangulate_conics, triangulate_quadrics
from torchsfm.triangulation.triangulate_curves import CurveTriangulation, triangulate_curves
from torchsfm.triangulation.triangulate_lines import LineTriangulation, triangulate_lines
from torchsfm.triangulation.triangulate_lines_robust import (
    LineEstimator,
    RobustLineTriangulation,
    triangulate_lines_robust,
)
from torchsfm.triangulation.triangulate_points import Triangulation, triangulate_points
from torchsfm.triangulation.triangulate_points_dlt import triangulate_points_dlt
from torchsfm.triangulation.triangulate_points_robust import (
    PointEstimator,
    RobustTriangulation,
    triangulate_points_robust,
)

ESTIMATORS = (LineEstimator, PointEstimator)
"""What `ransac` can estimate here; the contract tests run over them."""

__all__ = [
    "ESTIMATORS",
    "ConicTriangulation",
    "CurveTriangulation",
    "LineEstimator",
    "LineFault",
    "LineTriangulation",
    "PointEstimator",
    "RobustLineTriangulation",
    "RobustTriangulation",
    "Triangulation",
    "conics_2view",
    "correct_matches",
    "triangulate_conics",
    "triangulate_curves",
    "triangulate_lines",
    "triangulate_lines_robust",
    "triangulate_points",
    "triangulate_points_dlt",
    "triangulate_points_robust",
    "triangulate_quadrics",
]
