"""Batched, differentiable multiple-view geometry on PyTorch tensors.

Objects, doors with their results, readers and writers, losses, scorings and samplers stand here; everything else is reached by
its room: `torchsfm.motion.fundamental_7pt`, `torchsfm.tensors.trifocal_from_cameras`.
"""

from typing import TYPE_CHECKING, Any

import torchsfm.autocalibration as autocalibration
import torchsfm.bundle as bundle
import torchsfm.formats as formats
import torchsfm.geometry as geometry
import torchsfm.images as images
import torchsfm.motion as motion
import torchsfm.optim as optim
import torchsfm.plot as plot
import torchsfm.reconstruction as reconstruction
import torchsfm.resection as resection
import torchsfm.robust as robust
import torchsfm.simulation as simulation
import torchsfm.tensors as tensors
import torchsfm.triangulation as triangulation
from torchsfm._types import Solutions as Solutions
from torchsfm._types import Status as Status
from torchsfm.autocalibration import (
    Autocalibration as Autocalibration,
    PlaneCalibration as PlaneCalibration,
    ViewGraphFocals as ViewGraphFocals,
    autocalibrate_curves as autocalibrate_curves,
    autocalibrate_points as autocalibrate_points,
    calibrate_planes as calibrate_planes,
    calibrate_view_graph as calibrate_view_graph,
)
from torchsfm.bundle import (
    AdjustedModel as AdjustedModel,
    BundleCovariance as BundleCovariance,
    BundleConics as BundleConics,
    BundleCurves as BundleCurves,
    BundleLines as BundleLines,
    BundleModel as BundleModel,
    BundleResult as BundleResult,
    CentrePrior as CentrePrior,
    Gauge as Gauge,
    PointPrior as PointPrior,
    PosePrior as PosePrior,
    Prior as Prior,
    ProjectiveBundleResult as ProjectiveBundleResult,
    Rig as Rig,
    bundle_adjust as bundle_adjust,
    bundle_adjust_model as bundle_adjust_model,
    bundle_adjust_projective as bundle_adjust_projective,
    bundle_covariance as bundle_covariance,
)
from torchsfm.formats import (
    PointCloud as PointCloud,
    export_model as export_model,
    read_bal as read_bal,
    read_bundler as read_bundler,
    read_kapture as read_kapture,
    read_colmap as read_colmap,
    read_database as read_database,
    read_hloc as read_hloc,
    read_model as read_model,
    read_nerfstudio as read_nerfstudio,
    read_nvm as read_nvm,
    read_openmvg as read_openmvg,
    read_opensfm as read_opensfm,
    read_conics as read_conics,
    read_lines as read_lines,
    read_ply as read_ply,
    write_bal as write_bal,
    write_bundler as write_bundler,
    write_kapture as write_kapture,
    write_colmap as write_colmap,
    write_database as write_database,
    write_gltf as write_gltf,
    write_kitti as write_kitti,
    write_model as write_model,
    write_nerfstudio as write_nerfstudio,
    write_nvm as write_nvm,
    write_openmvg as write_openmvg,
    write_opensfm as write_opensfm,
    write_conics as write_conics,
    write_curves as write_curves,
    write_lines as write_lines,
    write_ply as write_ply,
    write_tum as write_tum,
)
from torchsfm.geometry import (
    BrownConrady as BrownConrady,
    BundleProblem as BundleProblem,
    Camera as Camera,
    Curve as Curve,
    Distortion as Distortion,
    Ellipse as Ellipse,
    Ellipsoid as Ellipsoid,
    KannalaBrandt as KannalaBrandt,
    NoDistortion as NoDistortion,
    PlaneConic as PlaneConic,
    Pose as Pose,
    Radial as Radial,
    Similarity as Similarity,
    SimpleRadial as SimpleRadial,
    intrinsics as intrinsics,
    project_points as project_points,
)
from torchsfm.images import (
    Edges as Edges,
    EllipseFit as EllipseFit,
    Ellipses as Ellipses,
    Features as Features,
    ImageError as ImageError,
    Photograph as Photograph,
    Segments as Segments,
    TrackedCurves as TrackedCurves,
    Tracks as Tracks,
    detect_edges as detect_edges,
    detect_ellipses as detect_ellipses,
    detect_features as detect_features,
    detect_segments as detect_segments,
    fit_ellipse as fit_ellipse,
    list_images as list_images,
    match_features as match_features,
    match_segments as match_segments,
    read_image as read_image,
    track_curves as track_curves,
    track_points as track_points,
    track_sequence as track_sequence,
)
from torchsfm.motion import (
    AffineFactorization as AffineFactorization,
    AveragedRotations as AveragedRotations,
    CurveFactorization as CurveFactorization,
    ConicEpipolarFit as ConicEpipolarFit,
    Factorization as Factorization,
    GlobalPositions as GlobalPositions,
    average_rotations as average_rotations,
    estimate_essential as estimate_essential,
    estimate_fundamental as estimate_fundamental,
    estimate_fundamentals as estimate_fundamentals,
    estimate_homographies as estimate_homographies,
    estimate_homography as estimate_homography,
    estimate_trifocal as estimate_trifocal,
    estimate_upright as estimate_upright,
    factorize_affine as factorize_affine,
    factorize_curves as factorize_curves,
    factorize_points as factorize_points,
    fundamental_from_conics as fundamental_from_conics,
    position_globally as position_globally,
)
from torchsfm.optim import (
    Cauchy as Cauchy,
    GemanMcClure as GemanMcClure,
    Huber as Huber,
    Loss as Loss,
    SoftL1 as SoftL1,
    Truncated as Truncated,
    Tukey as Tukey,
)
from torchsfm.plot import (
    plot_cameras as plot_cameras,
    plot_epipolar_lines as plot_epipolar_lines,
    plot_matches as plot_matches,
    plot_lines_3d as plot_lines_3d,
    plot_points_3d as plot_points_3d,
    show_image as show_image,
    write_page as write_page,
)
from torchsfm.reconstruction import (
    MatchedImages as MatchedImages,
    Conics as Conics,
    Curves as Curves,
    Lines as Lines,
    Reconstruction as Reconstruction,
    ReconstructionError as ReconstructionError,
    Report as Report,
    SfmResult as SfmResult,
    reconstruct as reconstruct,
    reconstruct_matches as reconstruct_matches,
    reconstruct_tracks as reconstruct_tracks,
    triangulate_photographs as triangulate_photographs,
)
from torchsfm.resection import (
    CameraEstimate as CameraEstimate,
    CameraRefinement as CameraRefinement,
    PlanarPoses as PlanarPoses,
    PoseEstimate as PoseEstimate,
    ResectedCameras as ResectedCameras,
    camera_planar as camera_planar,
    camera_pnp as camera_pnp,
    estimate_camera as estimate_camera,
    estimate_camera_focal as estimate_camera_focal,
    estimate_camera_projective as estimate_camera_projective,
    refine_camera as refine_camera,
    resect_cameras as resect_cameras,
)
from torchsfm.robust import (
    Degeneracy as Degeneracy,
    Estimator as Estimator,
    InlierCount as InlierCount,
    LeastMedian as LeastMedian,
    Magsac as Magsac,
    Msac as Msac,
    Neighbours as Neighbours,
    Prosac as Prosac,
    RansacOptions as RansacOptions,
    RobustResult as RobustResult,
    SoftSelection as SoftSelection,
    Structures as Structures,
    Uniform as Uniform,
    find_structures as find_structures,
    ransac as ransac,
    soft_ransac as soft_ransac,
)
from torchsfm.simulation import (
    SimulatedBundle as SimulatedBundle,
    SimulatedImages as SimulatedImages,
    random_bundle_problem as random_bundle_problem,
    random_intrinsics as random_intrinsics,
    random_points as random_points,
    random_poses as random_poses,
    render_sequence as render_sequence,
    render_shapes as render_shapes,
    simulate_images as simulate_images,
)
from torchsfm.triangulation import (
    ConicTriangulation as ConicTriangulation,
    CurveTriangulation as CurveTriangulation,
    LineTriangulation as LineTriangulation,
    RobustLineTriangulation as RobustLineTriangulation,
    RobustTriangulation as RobustTriangulation,
    Triangulation as Triangulation,
    triangulate_conics as triangulate_conics,
    triangulate_curves as triangulate_curves,
    triangulate_lines as triangulate_lines,
    triangulate_lines_robust as triangulate_lines_robust,
    triangulate_points as triangulate_points,
    triangulate_points_robust as triangulate_points_robust,
    triangulate_quadrics as triangulate_quadrics,
)

__version__: str
"""That of the installed package, looked up when asked for."""

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """The version; and what once stood here too and is a room's: found there, without being listed."""
        if name == "__version__":
            from importlib.metadata import version

            return version("torchsfm")
        for room in (
            geometry, robust, motion, resection, triangulation, autocalibration, bundle, optim, images, tensors, reconstruction,
            formats, simulation, plot,
        ):  # fmt: skip
            if name in room.__all__:
                return getattr(room, name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
