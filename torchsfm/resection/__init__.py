"""The structure is known: where is the camera? Absolute pose, PnP; resection in photogrammetry."""

from torchsfm.resection.camera_dlt import CameraEstimate, camera_dlt
from torchsfm.resection.camera_p3p import camera_p3p
from torchsfm.resection.estimate_camera import CameraEstimator, estimate_camera
from torchsfm.resection.refine_camera import CameraRefinement, refine_camera

ESTIMATORS = (CameraEstimator,)
"""What `ransac` can estimate here; the contract tests and the benchmark run over them."""

__all__ = [
    "ESTIMATORS",
    "CameraEstimate",
    "CameraEstimator",
    "CameraRefinement",
    "camera_dlt",
    "camera_p3p",
    "estimate_camera",
    "refine_camera",
]
