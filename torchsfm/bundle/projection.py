"""The reprojection residual of one observation and its derivatives, as a term for the sparse optimiser.

Cameras are rows of numbers (`torchsfm.geometry.intrinsic_parameters`), poses rows of R and t.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import Distortion
from torchsfm.geometry.intrinsic_parameters import HEAD
from torchsfm.geometry.projection import PixelProjection, turn_slopes


@dataclass(frozen=True)
class Projection:
    """Projection of points `(m, 3)` by poses `(m, 12)` and cameras `(m, 5 + p)`, minus the image points `(m, 2)`.

    A point may have more numbers behind its coordinates; see `RayPoint`.
    """

    model: type[Distortion]
    free: tuple[int, ...]
    """Columns of the camera row that are optimised."""
    skew: bool = True
    """Whether any camera has skew; False saves time."""
    switched: bool = False
    """Whether switches follow the camera's numbers; see `Switched`."""

    @property
    def inside(self) -> PixelProjection:
        """The part behind the pose."""
        return PixelProjection(self.model, self.free, self.skew)

    def residual(self, pose: Tensor, camera: Tensor, point: Tensor, x: Tensor) -> Tensor:
        """Predicted minus measured image points, pixels; finite for all finite points, also behind the camera."""
        return self.residual_of(transform(pose, point), camera, x)

    def residual_of(self, moved: Tensor, camera: Tensor, x: Tensor) -> Tensor:
        """The residual of points in camera coordinates, (3, m)."""
        return (self.inside.pixels(moved, camera.mT) - x.mT).mT

    def linearize(self, pose: Tensor, camera: Tensor, point: Tensor, x: Tensor, out: list[Tensor | None]) -> Tensor:
        """Residuals; `out` gets their derivatives by pose step, free camera numbers and point: the chain rule, written out."""
        moved = transform(pose, point)
        by_pose, by_intrinsics, by_point = (None if o is None else o.permute(1, 2, 0) for o in out)
        # Pixels by camera coordinates, which is pixels by translation: (2, 3, m).
        by_camera = (
            torch.empty((2, 3, moved.shape[1]), dtype=moved.dtype, device=moved.device) if by_pose is None else by_pose[:, 3:]
        )
        residual = self.linearize_at(moved, camera, x, by_camera, by_intrinsics)
        if by_pose is not None:
            turn_slopes(moved, by_camera, by_pose)
        if by_point is not None:
            turn_back(pose, by_camera, by_point)
        return residual

    def linearize_at(self, moved: Tensor, camera: Tensor, x: Tensor, by_camera: Tensor, by_intrinsics: Tensor | None) -> Tensor:
        """Residuals of points in camera coordinates (3, m), and their derivatives by those and by free camera numbers."""
        return (self.slopes(moved, camera.mT, by_camera, by_intrinsics) - x.mT).mT

    def slopes(
        self,
        moved: Float[Tensor, "3 *n"],
        camera: Float[Tensor, "k *#n"],
        by_camera: Float[Tensor, "2 3 *n"],
        by_intrinsics: Float[Tensor, "2 q *n"] | None,
    ) -> Float[Tensor, "2 *n"]:
        """Image points; their derivatives by points in camera coordinates and by free camera numbers."""
        pixels = self.inside.linearize(moved, camera, by_camera, by_intrinsics)
        if by_intrinsics is not None and self.switched:
            by_intrinsics *= camera[HEAD + self.model.num_parameters :]
        return pixels


def transform(pose: Tensor, point: Tensor) -> Tensor:
    """Points (m, 3), or rows that begin with one, after motions (m, 12), as (3, m)."""
    p = pose.mT
    X, Y, Z = point.mT[:3]
    return torch.addcmul(torch.addcmul(torch.addcmul(p[9:], p[0:9:3], X), p[1:9:3], Y), p[2:9:3], Z)


def turn_back(pose: Float[Tensor, "m 12"], by_place: Float[Tensor, "2 3 m"], out: Float[Tensor, "2 3 m"]) -> None:
    """The derivative by a point before the motion."""
    R = pose.mT[:9].reshape(3, 3, -1)
    torch.mul(by_place[:, :1], R[0], out=out)
    out.addcmul_(by_place[:, 1:2], R[1]).addcmul_(by_place[:, 2:], R[2])
