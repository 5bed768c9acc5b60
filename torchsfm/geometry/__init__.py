"""What are points, poses and cameras, and how far is a measurement from what they predict? Nothing is estimated here."""

from torchsfm.geometry.bundle_problem import BundleProblem
from torchsfm.geometry.cameras import (
    Camera,
    camera_centre,
    camera_from_krt,
    intrinsics,
    krt_from_camera,
    point_depths,
    project_points,
)
from torchsfm.geometry.distortion import (
    DISTORTION_MODELS,
    BrownConrady,
    Distortion,
    DistortionModel,
    KannalaBrandt,
    NoDistortion,
    Radial,
    SimpleRadial,
)
from torchsfm.geometry.flatness import least_number_off, line_and_plane_distances
from torchsfm.geometry.homogeneous import (
    from_homogeneous,
    normalize_sphere,
    normalizing_similarity,
    to_homogeneous,
    transform_points,
)
from torchsfm.geometry.poses import Pose
from torchsfm.geometry.residuals import epipolar_distance, reprojection_distance, sampson_distance, transfer_distance
from torchsfm.geometry.rotations import (
    cross_matrix,
    quaternion_wxyz_from_rotation,
    random_rotation,
    rotation_angle,
    rotation_from_euler,
    rotation_from_quaternion_wxyz,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from torchsfm.geometry.shape import affine_shape, balanced_frame, depth_space, normalize_shape, principal_angles
from torchsfm.geometry.similarity import Similarity, similarity_from_points

__all__ = [
    "DISTORTION_MODELS",
    "BrownConrady",
    "BundleProblem",
    "Camera",
    "Distortion",
    "DistortionModel",
    "KannalaBrandt",
    "NoDistortion",
    "Pose",
    "Radial",
    "Similarity",
    "SimpleRadial",
    "affine_shape",
    "balanced_frame",
    "camera_centre",
    "camera_from_krt",
    "cross_matrix",
    "depth_space",
    "epipolar_distance",
    "from_homogeneous",
    "intrinsics",
    "krt_from_camera",
    "least_number_off",
    "line_and_plane_distances",
    "normalize_shape",
    "normalize_sphere",
    "normalizing_similarity",
    "point_depths",
    "principal_angles",
    "project_points",
    "quaternion_wxyz_from_rotation",
    "random_rotation",
    "reprojection_distance",
    "rotation_angle",
    "rotation_from_euler",
    "rotation_from_quaternion_wxyz",
    "rotation_from_rotvec",
    "rotvec_from_rotation",
    "sampson_distance",
    "similarity_from_points",
    "to_homogeneous",
    "transfer_distance",
    "transform_points",
]
