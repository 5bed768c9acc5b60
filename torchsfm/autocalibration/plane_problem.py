"""Views of one plane, or of a board that is nearly one, as residuals of a camera and its poses, with their derivatives."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.autocalibration.board_shape import NAMES, shape_slopes, shaped
from torchsfm.autocalibration.circle_outlines import centre_weights, outline_centres
from torchsfm.autocalibration.plane_start import CameraAndPoses
from torchsfm.geometry.projection import PixelProjection, turn_slopes
from torchsfm.optim import rotation_exponential


@dataclass(frozen=True)
class PlaneProblem:
    """Reprojection of the plane's points, or of the outlines of its circles, and its derivatives.

    A step holds the free numbers of the camera, those of the board's shape if that is free, and six of each view.
    """

    projection: PixelProjection
    circles: bool
    bent: bool

    @property
    def shared(self) -> int:
        """Numbers that all views have in common."""
        return len(self.projection.free) + (len(NAMES) if self.bent else 0)

    def retract(self, u: CameraAndPoses, delta: Tensor) -> CameraAndPoses:
        """Where a step leads."""
        free = self.projection.free
        q, shared = len(free), self.shared
        pose = delta[..., shared:].reshape(*u.t.shape[:-1], 6)
        turn = rotation_exponential(pose[..., :3])
        moved = (turn @ u.t[..., None])[..., 0] + pose[..., 3:]
        place = torch.tensor(free, device=delta.device)
        row = u.row + torch.zeros_like(u.row).index_add(-1, place, delta[..., :q])
        shape = u.shape + delta[..., q:shared] if self.bent else u.shape
        return CameraAndPoses(row, turn @ u.R, moved, shape)

    def residual(self, u: CameraAndPoses, x: Tensor, X: Tensor) -> Tensor:
        """Pixels from what is seen to what should be."""
        pixels = self.projection.pixels(*self._seen(u, X))
        if self.circles:
            pixels = outline_centres(centre_weights(pixels), pixels)
        return (pixels.movedim(0, -1) - x).flatten(-3, -2)

    def linearize(self, u: CameraAndPoses, x: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals and Jacobian; every view depends on its own pose alone, so that all poses are differentiated at once."""
        b, v, n = x.shape[:3]
        q, shared = len(self.projection.free), self.shared
        ray, row = self._seen(u, X)
        local = x.new_empty(2, 6 + shared, b, v, ray.shape[-1])
        pixels = self.projection.linearize(ray, row, local[:, 3:6], local[:, 6 : 6 + q])
        if self.bent:
            # How the rays move with the board, (3, 5, b, v, m).
            moved = torch.einsum("bvij,kjbm->ikbvm", u.R, shape_slopes(X))
            local[:, 6 + q :] = (local[:, 3:6, None] * moved).sum(1)
        turn_slopes(ray, local[:, 3:6], local)
        if self.circles:
            K = centre_weights(pixels)
            pixels, local = outline_centres(K, pixels), outline_centres(K[:, :, None], local)
        J = x.new_zeros(b, v, n, 2, shared + 6 * v)
        J[..., :shared] = local[:, 6:].permute(2, 3, 4, 0, 1)
        J[..., shared:].view(b, v, n, 2, v, 6).diagonal(dim1=1, dim2=4).copy_(local[:, :6].permute(2, 4, 0, 1, 3))
        return (pixels.movedim(0, -1) - x).flatten(1, 2), J.flatten(1, 2)

    def _seen(self, u: CameraAndPoses, X: Tensor) -> tuple[Tensor, Tensor]:
        """The board's points in the frames of the views (3, *batch, v, n), and the rows of the cameras (k, *batch, 1, 1)."""
        flat, R = (shaped(X, u.shape), u.R) if self.bent else (X, u.R[..., :2])
        Y = R @ flat.mT[..., None, :, :] + u.t[..., None]
        return Y.movedim(-2, 0), u.row.movedim(-1, 0)[..., None, None]
