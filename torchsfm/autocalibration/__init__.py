"""From projective to metric: what are the cameras like inside, as far as the images alone tell?"""

from torchsfm.autocalibration.algebraic_fit import IntrinsicsEstimate
from torchsfm.autocalibration.assumption_fit import AssumptionFit
from torchsfm.autocalibration.autocalibrate_curves import autocalibrate_curves
from torchsfm.autocalibration.autocalibrate_points import autocalibrate_points
from torchsfm.autocalibration.calibrate_planes import PlaneCalibration, calibrate_planes
from torchsfm.autocalibration.calibrate_view_graph import ViewGraphFocals, calibrate_view_graph
from torchsfm.autocalibration.constant_intrinsics import constant_intrinsics, intrinsics_from_modulus
from torchsfm.autocalibration.diagnosis import Motion, diagnose_motion
from torchsfm.autocalibration.dual_quadric import DualQuadric, dual_quadric_linear
from torchsfm.autocalibration.focal_from_fundamentals import FocalEstimate, focal_from_fundamentals
from torchsfm.autocalibration.intrinsics_model import Assumption
from torchsfm.autocalibration.kruppa import intrinsics_from_kruppa
from torchsfm.autocalibration.orientation import Orientation, orient_projective
from torchsfm.autocalibration.planar_scene import intrinsics_from_plane
from torchsfm.autocalibration.plane_at_infinity import metric_upgrade, plane_at_infinity_from_intrinsics
from torchsfm.autocalibration.rotating_camera import intrinsics_from_rotations
from torchsfm.autocalibration.upgrade_cameras import Autocalibration

__all__ = [
    "Assumption",
    "AssumptionFit",
    "Autocalibration",
    "DualQuadric",
    "FocalEstimate",
    "IntrinsicsEstimate",
    "Motion",
    "Orientation",
    "PlaneCalibration",
    "ViewGraphFocals",
    "autocalibrate_curves",
    "autocalibrate_points",
    "calibrate_planes",
    "calibrate_view_graph",
    "constant_intrinsics",
    "diagnose_motion",
    "dual_quadric_linear",
    "focal_from_fundamentals",
    "intrinsics_from_kruppa",
    "intrinsics_from_modulus",
    "intrinsics_from_plane",
    "intrinsics_from_rotations",
    "metric_upgrade",
    "orient_projective",
    "plane_at_infinity_from_intrinsics",
]
