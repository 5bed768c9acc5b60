"""The structure is known: where is the camera? Absolute pose, PnP; resection in photogrammetry."""

from torchsfm.resection.camera_1p2l import camera_1p2l
from torchsfm.resection.camera_2p1l import camera_2p1l
from torchsfm.resection.camera_3l import camera_3l
from torchsfm.resection.camera_circle import camera_circle
from torchsfm.resection.camera_conics import ConicPoses, camera_conics
from torchsfm.resection.camera_dlt import CameraEstimate, camera_dlt
from torchsfm.resection.camera_epnp import camera_epnp
from torchsfm.resection.camera_gp3p import camera_gp3p
from torchsfm.resection.camera_p3p import camera_p3p
from torchsfm.resection.camera_p4pf import camera_p4pf
from torchsfm.resection.camera_p35pf import camera_p35pf
from torchsfm.resection.camera_planar import PlanarPoses, camera_planar
from torchsfm.resection.camera_pnp import PoseEstimate, camera_pnp
from torchsfm.resection.camera_up2p import camera_up2p
from torchsfm.resection.estimate_camera import CameraEstimator, estimate_camera
from torchsfm.resection.estimate_camera_focal import FocalCameraEstimator, estimate_camera_focal
from torchsfm.resection.estimate_camera_projective import ProjectiveCameraEstimator, estimate_camera_projective
from torchsfm.resection.point_line_camera import PointLineCameraEstimator
from torchsfm.resection.refine_camera import CameraRefinement, refine_camera
from torchsfm.resection.resect_cameras import ResectedCameras, resect_cameras

ESTIMATORS = (CameraEstimator, FocalCameraEstimator, PointLineCameraEstimator, ProjectiveCameraEstimator)
"""What `ransac` can estimate here; the contract tests and the benchmark run over them."""
SOLVERS = (
    camera_1p2l,
    camera_2p1l,
    camera_3l,
    camera_circle,
    camera_gp3p,
    camera_p3p,
    camera_p4pf,
    camera_p35pf,
    camera_up2p,
)
"""What returns `Solutions` of a sample here; the contract tests run over them, on the scenes of `bench/cases/`."""

__all__ = [
    "ESTIMATORS",
    "SOLVERS",
    "CameraEstimate",
    "CameraEstimator",
    "CameraRefinement",
    "ConicPoses",
    "FocalCameraEstimator",
    "PlanarPoses",
    "PointLineCameraEstimator",
    "PoseEstimate",
    "ProjectiveCameraEstimator",
    "ResectedCameras",
    "camera_1p2l",
    "camera_2p1l",
    "camera_3l",
    "camera_circle",
    "camera_conics",
    "camera_dlt",
    "camera_epnp",
    "camera_gp3p",
    "camera_p3p",
    "camera_p4pf",
    "camera_p35pf",
    "camera_planar",
    "camera_pnp",
    "camera_up2p",
    "estimate_camera",
    "estimate_camera_focal",
    "estimate_camera_projective",
    "refine_camera",
    "resect_cameras",
]
