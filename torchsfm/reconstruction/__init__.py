"""How do images become a model? The `Reconstruction`, and the doors from photographs and from tracks."""

from torchsfm.reconstruction.alignment import Alignment, ControlPoints, align_models, align_to_points, align_to_positions
from torchsfm.reconstruction.conics import Conics
from torchsfm.reconstruction.control import ControlledModel, adjust_to_points
from torchsfm.reconstruction.curves import reconstruct_curves
from torchsfm.reconstruction.gps import GpsAlignment, align_to_gps
from torchsfm.reconstruction.known_features import KnownFeatures, saved_features
from torchsfm.reconstruction.known_poses import triangulate_photographs
from torchsfm.reconstruction.lines import Lines
from torchsfm.reconstruction.localise import register_photographs
from torchsfm.reconstruction.matched import MatchedImages, reconstruct_matches
from torchsfm.reconstruction.merge import MergedModel, merge_models
from torchsfm.reconstruction.model_curves import Curves
from torchsfm.reconstruction.parts import part_of_model
from torchsfm.reconstruction.photographs import reconstruct
from torchsfm.reconstruction.reconstruction import Reconstruction
from torchsfm.reconstruction.report import ImageReport, PairReport, ReconstructionError, Report, SfmResult
from torchsfm.reconstruction.similarities import Certainty
from torchsfm.reconstruction.tracked import reconstruct_tracks
from torchsfm.reconstruction.upright import Levelling, align_to_ground, align_upright, up_direction
from torchsfm.reconstruction.view_graph import Verdict

__all__ = [
    "Alignment",
    "Certainty",
    "Conics",
    "ControlPoints",
    "ControlledModel",
    "Curves",
    "GpsAlignment",
    "ImageReport",
    "KnownFeatures",
    "Levelling",
    "Lines",
    "MatchedImages",
    "MergedModel",
    "PairReport",
    "Reconstruction",
    "ReconstructionError",
    "Report",
    "SfmResult",
    "Verdict",
    "adjust_to_points",
    "align_models",
    "align_to_gps",
    "align_to_ground",
    "align_to_points",
    "align_to_positions",
    "align_upright",
    "merge_models",
    "part_of_model",
    "reconstruct",
    "reconstruct_curves",
    "reconstruct_matches",
    "reconstruct_tracks",
    "register_photographs",
    "saved_features",
    "triangulate_photographs",
    "up_direction",
]
