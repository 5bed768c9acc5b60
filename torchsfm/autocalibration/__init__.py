"""From projective to metric: what are the cameras like inside, as far as the images alone tell?"""

from torchsfm.autocalibration.autocalibrate_points import AssumptionFit, Autocalibration, autocalibrate_points
from torchsfm.autocalibration.calibrate_planes import PlaneCalibration, calibrate_planes
from torchsfm.autocalibration.diagnosis import Motion, diagnose_motion
from torchsfm.autocalibration.focal_from_fundamentals import FocalEstimate, focal_from_fundamentals
from torchsfm.autocalibration.intrinsics_model import Assumption
from torchsfm.autocalibration.orientation import Orientation, orient_projective
from torchsfm.autocalibration.plane_at_infinity import metric_upgrade, plane_at_infinity_from_intrinsics

__all__ = [
    "Assumption",
    "AssumptionFit",
    "Autocalibration",
    "FocalEstimate",
    "Motion",
    "Orientation",
    "PlaneCalibration",
    "autocalibrate_points",
    "calibrate_planes",
    "diagnose_motion",
    "focal_from_fundamentals",
    "metric_upgrade",
    "orient_projective",
    "plane_at_infinity_from_intrinsics",
]
