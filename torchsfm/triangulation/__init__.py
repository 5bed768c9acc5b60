"""The cameras are known: where are the points? Photogrammetry calls it intersection."""

from torchsfm.triangulation.optimal_correction import correct_matches
from torchsfm.triangulation.triangulate_points import Triangulation, triangulate_points
from torchsfm.triangulation.triangulate_points_dlt import triangulate_points_dlt

__all__ = ["Triangulation", "correct_matches", "triangulate_points", "triangulate_points_dlt"]
