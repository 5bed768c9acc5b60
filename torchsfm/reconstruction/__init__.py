"""How do images become a model? The `Reconstruction`, and the doors from photographs and from tracks.

Its parts, none of which knows of those after it: `model` is the `Reconstruction` and what is done with it; `matching` makes
verified pairs of photographs; `mapping` holds a model while it is made, and the steps that change it; `evidence` judges it by
its pairs; `mappers` make models of all images; `lines` and `curves` add what edges show; `merging` joins models. The doors
stand beside them.
"""

from torchsfm.reconstruction.curves.from_edges import reconstruct_curves
from torchsfm.reconstruction.curves.pose_check import PoseCheck, check_poses
from torchsfm.reconstruction.known_poses import triangulate_photographs
from torchsfm.reconstruction.localise import register_photographs
from torchsfm.reconstruction.matched import MatchedImages, reconstruct_matches
from torchsfm.reconstruction.matching.known_features import KnownFeatures, saved_features
from torchsfm.reconstruction.matching.view_graph import Verdict
from torchsfm.reconstruction.merging.merge import MergedModel, merge_models
from torchsfm.reconstruction.messages import ReconstructionError
from torchsfm.reconstruction.model.alignment import Alignment, ControlPoints, align_models, align_to_points, align_to_positions
from torchsfm.reconstruction.model.conics import Conics
from torchsfm.reconstruction.model.control import ControlledModel, adjust_to_points
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.gps import GpsAlignment, align_to_gps
from torchsfm.reconstruction.model.lines import Lines
from torchsfm.reconstruction.model.parts import part_of_model
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.model.similarities import Certainty
from torchsfm.reconstruction.model.upright import Levelling, align_to_ground, align_upright, up_direction
from torchsfm.reconstruction.photographs import reconstruct
from torchsfm.reconstruction.report import ImageReport, PairReport, Report, SfmResult
from torchsfm.reconstruction.tracked import reconstruct_tracks

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
    "PoseCheck",
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
    "check_poses",
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
