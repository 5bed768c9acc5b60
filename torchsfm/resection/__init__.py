"""The structure is known: where is the camera? (Absolute pose, PnP; photogrammetry's resection.)"""

from torchsfm.resection.camera_p3p import camera_p3p
from torchsfm.resection.estimate_camera import CameraEstimator, estimate_camera

ESTIMATORS = (CameraEstimator,)
"""What `ransac` can estimate here; the contract tests and the benchmark run over them."""

__all__ = ["ESTIMATORS", "CameraEstimator", "camera_p3p", "estimate_camera"]
