"""Cameras, poses, points and image points together: what bundle adjustment starts from and ends with."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.cameras import Camera
from torchsfm.geometry.poses import Pose


@dataclass(frozen=True)
class BundleProblem:
    """Views of points, with estimates of everything; the smallest thing that can be adjusted.

    A `Reconstruction` is one, and has more (names, sizes, colours).

    Example:
        >>> import torchsfm
        >>> problem = torchsfm.random_bundle_problem(4, 50, 150, noise=0.0).truth
        >>> problem.X.shape, problem.x.shape
        (torch.Size([50, 3]), torch.Size([150, 2]))
        >>> bool(problem.residuals().max() < 1e-9)
        True
    """

    poses: Pose
    """Camera from world of each view, batch (v,)."""
    cameras: Camera
    """The distinct cameras, batch (g,)."""
    camera_index: Int[Tensor, "v"]
    """Which camera took each view."""
    X: Float[Tensor, "n 3"]
    """Points in the world."""
    x: Float[Tensor, "m 2"]
    """Image points, pixels."""
    view: Int[Tensor, "m"]
    """Which view shows each image point."""
    point: Int[Tensor, "m"]
    """Which point it shows."""

    def __post_init__(self) -> None:
        check_tensors(
            poses=(self.poses.R, "v 3 3"),
            cameras=(self.cameras.K, "g 3 3"),
            camera_index=(self.camera_index, "v: int"),
            X=(self.X, "n 3"),
            x=(self.x, "m 2"),
            view=(self.view, "m: int"),
            point=(self.point, "m: int"),
        )

    @classmethod
    def of(
        cls,
        poses: Pose,
        cameras: Camera,
        X: Float[Tensor, "n 3"],
        x: Float[Tensor, "m 2"],
        view: Int[Tensor, "m"],
        point: Int[Tensor, "m"],
        *,
        camera_index: Int[Tensor, "v"] | None = None,
    ) -> "BundleProblem":
        """The problem of views that one camera took, or each one of its own, unless `camera_index` says which.

        Args:
            poses: Of the views, world to camera.
            cameras: One for all views, one for each, or those that `camera_index` chooses from.
            X: Points in space.
            x: Observations in pixels.
            view: The view of each observation.
            point: The point of each observation.
            camera_index: The camera of each view.

        Raises:
            ValueError: `camera_index` is missing where there are several cameras, but not one for each view.
        """
        if camera_index is None:
            views, groups = poses.t.shape[0], cameras.K.shape[0]
            if groups not in (1, views):
                got = f"{groups} cameras and {views} views"
                raise ValueError(f"camera_index: wanted the camera of each view, since there are {got}")
            camera_index = torch.arange(views, device=X.device) if groups == views else view.new_zeros(views)
        return cls(poses, cameras, camera_index, X, x, view, point)

    def projections(self) -> Float[Tensor, "m 2"]:
        """Where each observed point projects, in pixels; finite but meaningless behind the camera."""
        X_cam = self.poses[self.view].transform(self.X[self.point, None])
        return self.cameras[self.camera_index[self.view]].project(X_cam)[:, 0]

    def residuals(self) -> Float[Tensor, "m"]:
        """Distance of each observation from its point's projection, in pixels."""
        distance: Tensor = torch.linalg.vector_norm(self.projections() - self.x, dim=-1)
        return distance

    def depths(self) -> Float[Tensor, "m"]:
        """Depth of each observed point in its view, negative behind the camera."""
        return self.poses[self.view].transform(self.X[self.point, None])[:, 0, 2]
