"""How do images become a model? The `Reconstruction`, and the doors from photographs and from tracks."""

from torchsfm.reconstruction.conics import Conics
from torchsfm.reconstruction.curves import CurveReconstruction, reconstruct_curves
from torchsfm.reconstruction.known_poses import triangulate_photographs
from torchsfm.reconstruction.lines import Lines
from torchsfm.reconstruction.matched import MatchedImages, reconstruct_matches
from torchsfm.reconstruction.models import reconstruct_tracks
from torchsfm.reconstruction.photographs import reconstruct
from torchsfm.reconstruction.reconstruction import Reconstruction
from torchsfm.reconstruction.report import ImageReport, PairReport, ReconstructionError, Report, SfmResult
from torchsfm.reconstruction.view_graph import Verdict

__all__ = [
    "Conics",
    "CurveReconstruction",
    "ImageReport",
    "Lines",
    "MatchedImages",
    "PairReport",
    "Reconstruction",
    "ReconstructionError",
    "Report",
    "SfmResult",
    "Verdict",
    "reconstruct",
    "reconstruct_curves",
    "reconstruct_matches",
    "reconstruct_tracks",
    "triangulate_photographs",
]
