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
from torchsfm.geometry.conic_distance import conic_distance, ellipse_distance
from torchsfm.geometry.conic_intersections import intersect_conics, intersect_line_conic, tangent_lines
from torchsfm.geometry.conics import (
    Ellipse,
    conic_from_ellipse,
    dual_conic,
    ellipse_from_conic,
    polar_lines,
    transform_conic,
)
from torchsfm.geometry.curve_crossings import Crossings, curve_crossings
from torchsfm.geometry.curves import Curve, curve_from_samples
from torchsfm.geometry.distortion import (
    DISTORTION_MODELS,
    BrownConrady,
    KannalaBrandt,
    NoDistortion,
    Radial,
    SimpleRadial,
)
from torchsfm.geometry.distortion_model import Distortion
from torchsfm.geometry.flatness import least_number_off, line_and_plane_distances
from torchsfm.geometry.foot_points import FootPoints, foot_points
from torchsfm.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from torchsfm.geometry.homogeneous import (
    from_homogeneous,
    normalize_sphere,
    normalizing_similarity,
    to_homogeneous,
    transform_points,
)
from torchsfm.geometry.line_manifold import Line3D
from torchsfm.geometry.lines import (
    intersect_line_plane,
    line_from_points,
    line_to_line_distance,
    nearest_on_line,
    nearest_pluecker,
    pluecker_from_planes,
    pluecker_from_points,
    point_line_distance,
    point_to_line_distance,
    project_lines,
    transform_lines,
    unproject_onto_lines,
    viewing_planes,
)
from torchsfm.geometry.poses import Pose
from torchsfm.geometry.quadrics import (
    Ellipsoid,
    PlaneConic,
    dual_quadric,
    dual_quadric_from_ellipsoid,
    ellipsoid_from_dual_quadric,
    plane_conic_from_dual_quadric,
    project_quadric,
    transform_quadric,
    viewing_cone,
)
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
from torchsfm.geometry.splines import Spline, fit_spline

__all__ = [
    "DISTORTION_MODELS",
    "BrownConrady",
    "BundleProblem",
    "Camera",
    "Crossings",
    "Curve",
    "Distortion",
    "Ellipse",
    "Ellipsoid",
    "FootPoints",
    "KannalaBrandt",
    "Line3D",
    "NoDistortion",
    "PlaneConic",
    "Pose",
    "Radial",
    "Similarity",
    "SimpleRadial",
    "Spline",
    "affine_shape",
    "balanced_frame",
    "camera_centre",
    "camera_from_krt",
    "conic_distance",
    "conic_from_ellipse",
    "cross_matrix",
    "curve_crossings",
    "curve_from_samples",
    "depth_space",
    "dual_conic",
    "dual_quadric",
    "dual_quadric_from_ellipsoid",
    "ellipse_distance",
    "ellipse_from_conic",
    "ellipsoid_from_dual_quadric",
    "enu_from_geodetic",
    "epipolar_distance",
    "fit_spline",
    "foot_points",
    "from_homogeneous",
    "geodetic_from_enu",
    "intersect_conics",
    "intersect_line_conic",
    "intersect_line_plane",
    "intrinsics",
    "krt_from_camera",
    "least_number_off",
    "line_and_plane_distances",
    "line_from_points",
    "line_to_line_distance",
    "nearest_on_line",
    "nearest_pluecker",
    "normalize_shape",
    "normalize_sphere",
    "normalizing_similarity",
    "plane_conic_from_dual_quadric",
    "pluecker_from_planes",
    "pluecker_from_points",
    "point_depths",
    "point_line_distance",
    "point_to_line_distance",
    "polar_lines",
    "principal_angles",
    "project_lines",
    "project_points",
    "project_quadric",
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
    "tangent_lines",
    "to_homogeneous",
    "transfer_distance",
    "transform_conic",
    "transform_lines",
    "transform_points",
    "transform_quadric",
    "unproject_onto_lines",
    "viewing_cone",
    "viewing_planes",
]
