"""Similarities of space: rotation, translation and one scale, and the best one between two point sets."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.geometry.poses import Pose
from torchsfm.linalg import nearest_rotation, svdvals

_MIRRORED = 3.0
"""How much farther a rotation leaves points from each other than a reflection where one is the mirror image of the other."""


@dataclass(frozen=True)
class Similarity:
    """The map `Y = scale R X + t` of space, with any leading batch dimensions.

    Example:
        >>> import torch, torchsfm
        >>> double = torchsfm.Similarity(torch.tensor(2.0), torch.eye(3), torch.tensor([1.0, 0.0, 0.0]))
        >>> double.transform(torch.tensor([[1.0, 1.0, 1.0]]))
        tensor([[3., 2., 2.]])
    """

    scale: Float[Tensor, "*batch"]
    R: Float[Tensor, "*batch 3 3"]
    t: Float[Tensor, "*batch 3"]
    status: Int[Tensor, "*batch"] | None = None
    """`Status` per element where the similarity was estimated; None where it was given."""

    def transform(self, X: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*#batch n 3"]:
        """Map points; batches broadcast."""
        check_tensors(X=(X, "n 3"), R=(self.R, "3 3"))
        return X @ (self.scale[..., None, None] * self.R).mT + self.t[..., None, :]

    def transform_pose(self, pose: Pose) -> Pose:
        """Carry poses over to the new world: `camera from new world`, with camera coordinates scaled by the same factor.

        The image of every transformed point under the transformed pose is what it was.
        """
        R = pose.R @ self.R.mT
        t = self.scale[..., None] * pose.t - (R @ self.t[..., None]).squeeze(-1)
        return Pose(R, t.expand(*R.shape[:-2], 3))

    def inverse(self) -> "Similarity":
        """The map back."""
        scale = 1 / self.scale
        return Similarity(scale, self.R.mT, -scale[..., None] * (self.R.mT @ self.t[..., None]).squeeze(-1), self.status)

    def matrix(self) -> Float[Tensor, "*batch 4 4"]:
        """The homogeneous matrix of the map."""
        top = torch.cat([self.scale[..., None, None] * self.R, self.t[..., None]], -1)
        bottom = torch.zeros_like(top[..., :1, :])
        bottom[..., -1] = 1
        return torch.cat([top, bottom], -2)


def similarity_from_points(
    X: Float[Tensor, "*#batch n 3"], Y: Float[Tensor, "*#batch n 3"], weights: Float[Tensor, "*#batch n"] | None = None
) -> Similarity:
    """Find the similarity that takes X to Y with the least sum of squared distances in Y (Umeyama 1991).

    Args:
        X: Points as rows.
        Y: Where they should come.
        weights: Non-negative; 0 means absent. Pairs with NaN or inf are absent too.

    Returns:
        The similarity, with status: TOO_FEW for fewer than three pairs, DEGENERATE where the points of either set lie on one
        line (the rotation is then one of many, or the identity), or where Y is the mirror image of X: a reflection leaves less
        than a third of the distances.

    Example:
        >>> import torch, torchsfm
        >>> X = torchsfm.random_points(10, generator=torch.Generator().manual_seed(0))
        >>> found = torchsfm.geometry.similarity_from_points(X, 2 * X + 1)
        >>> bool(found.status == torchsfm.Status.OK), round(float(found.scale), 6)
        (True, 2.0)
    """
    check_tensors(X=(X, "n 3"), Y=(Y, "n 3"), weights=(weights, "?n"))
    present = torch.isfinite(X).all(-1) & torch.isfinite(Y).all(-1)
    w = present.to(X.dtype) if weights is None else torch.where(present & torch.isfinite(weights), weights.clamp(min=0), 0.0)
    used = (w > 0)[..., None]
    X, Y = torch.where(used, X, 0.0), torch.where(used, Y, 0.0)
    total = w.sum(-1)
    w = (w / torch.where(total > 0, total, 1.0)[..., None])[..., None]
    x_mean, y_mean = (w * X).sum(-2, keepdim=True), (w * Y).sum(-2, keepdim=True)
    x, y = torch.where(used, X - x_mean, 0.0), torch.where(used, Y - y_mean, 0.0)
    covariance = (w * y).mT @ x
    R = nearest_rotation(covariance)
    variance = (w * x.square()).sum((-2, -1))
    spread = variance > 0
    scale = (R * covariance).sum((-2, -1)) / torch.where(spread, variance, 1.0)
    scale = torch.where(spread & (scale > 0), scale, 1.0)
    t = y_mean.squeeze(-2) - scale[..., None] * (R @ x_mean.mT).squeeze(-1)
    singular, _ = svdvals(covariance.detach())
    rounding = 64 * torch.finfo(X.dtype).eps
    degenerate = ~(singular[..., 1] > rounding * singular[..., 0])
    degenerate = degenerate | _mirrored(
        covariance.detach(), singular, variance.detach(), (w * y.square()).sum((-2, -1)).detach(), rounding
    )
    status = torch.where(degenerate, int(Status.DEGENERATE), int(Status.OK))
    status = torch.where(used.squeeze(-1).sum(-1) < 3, int(Status.TOO_FEW), status).to(torch.int8)
    return Similarity(scale, R, t, status)


def _mirrored(
    covariance: Float[Tensor, "*batch 3 3"],
    singular: Float[Tensor, "*batch 3"],
    x_variance: Float[Tensor, "*batch"],
    y_variance: Float[Tensor, "*batch"],
    rounding: float,
) -> Bool[Tensor, "*batch"]:
    """Whether the best reflection leaves far smaller distances than the best rotation; never so of points in a plane."""
    first, last = singular[..., 0] + singular[..., 1], singular[..., 2]
    x = torch.where(x_variance > 0, x_variance, 1.0)
    turned, reflected = (y_variance - square / x for square in ((first - last).square(), (first + last).square()))
    far = turned > _MIRRORED**2 * torch.maximum(reflected, rounding * y_variance)
    mirrored: Tensor = far & (torch.linalg.det(covariance) < 0)
    return mirrored
