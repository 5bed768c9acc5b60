"""Four views: the quadrifocal tensor from six points or more (HZ 17.3, chapter 16's method with four cameras)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.motion.three_views.multilinear_fit import (
    NormalizedViews,
    combined_status,
    fit_cameras,
    inverse_similarity,
    least_vector,
    normalized_views,
    tensor_uncertainty,
)
from torchsfm.tensors import cameras_from_quadrifocal, canonical_cameras, quadrifocal_from_cameras, transform_quadrifocal
from torchsfm.tensors.quadrifocal import quadrifocal_jacobian
from torchsfm.tensors.trifocal import unit_tensor


@dataclass(frozen=True)
class QuadrifocalFit:
    """A quadrifocal tensor fitted to points.

    Attributes:
        Q: The tensor with norm 1, in the coordinates of the input; it is that of the cameras.
        P: The cameras in the frame of `canonical_cameras`.
        error: Root mean square of the algebraic residuals, without unit.
        uncertainty: Standard deviation of the tensor of norm 1 in its least determined direction, in normalised coordinates,
            estimated from the residuals; at most 1.
        status: OK; TOO_FEW points with weight; DEGENERATE: they leave more than one tensor (points in a plane, centres that
            coincide), exactly or within their noise; NOT_CONVERGED; NOT_FINITE: numbers with weight that
            are not.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(8, generator=g), torchsfm.random_poses(4, generator=g).matrix()
        >>> found = torchsfm.motion.quadrifocal_6pt(torchsfm.project_points(P, X))
        >>> found.Q.shape, bool(found.error.max() < 1e-6), torchsfm.Status(found.status.item()).name
        (torch.Size([3, 3, 3, 3]), True, 'OK')
        >>> seen = torchsfm.triangulate_points(torchsfm.project_points(P, X), found.P)  # in the frame of these cameras
        >>> bool((seen.error < 1e-6).all())
        True
    """

    Q: Float[Tensor, "*batch 3 3 3 3"]
    P: Float[Tensor, "*batch 4 3 4"]
    error: Float[Tensor, "*batch"]
    uncertainty: Float[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]


def quadrifocal_6pt(
    x: Float[Tensor, "*#batch 4 n 2"], *, weights: Float[Tensor, "*#batch n"] | None = None, max_iterations: int = 50
) -> QuadrifocalFit:
    """The quadrifocal tensor of least algebraic error among those that four cameras can have.

    Sixteen equations a point, linear in Q, in normalised coordinates; their least-squares solution (six points leave one, the
    rank is 80) is brought to the nearest quadrifocal tensor, from where |A q| with |q| = 1 is minimised over the cameras.
    Computed in float64 whatever the dtype.

    Args:
        x: At least six points in the four images.
        weights: Weight of each point's squared errors, >= 0; 0 means absent, and what stands there is not looked at.
        max_iterations: Most steps of the minimisation.

    Returns:
        Tensor, cameras, error, uncertainty and status; all finite always. Differentiable in points and weights through the
        minimum.

    Raises:
        ValueError: Wrong shape, dtype or device, or n < 6.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(8, generator=g), torchsfm.random_poses(4, generator=g).matrix()
        >>> found = torchsfm.motion.quadrifocal_6pt(torchsfm.project_points(P, X))
        >>> bool(found.P.allclose(torchsfm.tensors.canonical_cameras(P), atol=1e-6))
        True
    """
    batch = check_tensors(x=(x, "4 n>=6 2"), weights=(weights, "?n"))
    check_options(max_iterations=(max_iterations, "int >= 0"))
    n = x.shape[-2]
    views = normalized_views(x.expand(*batch, 4, n, 2), x.new_zeros(*batch, 4, 0, 3), weights, None)
    A = _equations(views)
    q = least_vector(A)
    start = cameras_from_quadrifocal(q.reshape(*batch, 3, 3, 3, 3))
    fit = fit_cameras(_tensor_of, A, start.P[..., 1:, :, :], max_iterations)
    inverse = inverse_similarity(views.S)
    Q = transform_quadrifocal(fit.tensor.reshape(*batch, 3, 3, 3, 3), *inverse.unbind(-3))
    Q = unit_tensor(Q, 4)[0]
    eye = torch.eye(3, 4, dtype=Q.dtype, device=Q.device).expand(*batch, 1, 3, 4)
    P = canonical_cameras(inverse @ torch.cat((eye, fit.P), -3))
    number = 16 * (views.root > 0).sum(-1)
    uncertainty, determined = tensor_uncertainty(_tensor_of, A, fit, number)
    status = combined_status(views.finite, number >= 96, determined & (start.status == Status.OK), fit.status == Status.OK)
    error = (2 * fit.cost / A.shape[-2]).sqrt()
    return QuadrifocalFit(Q.to(x.dtype), P.to(x.dtype), error.to(x.dtype), uncertainty.to(x.dtype), status)


def _equations(views: NormalizedViews) -> Tensor:
    """The sixteen equations a point: a vertical or horizontal line through it in each view."""
    one, zero = torch.ones_like(views.x[..., 0]), torch.zeros_like(views.x[..., 0])
    vertical = torch.stack((one, zero, -views.x[..., 0]), -1)
    horizontal = torch.stack((zero, one, -views.x[..., 1]), -1)
    axes = torch.stack((vertical, horizontal), -2)
    first, *rest = axes.unbind(-4)
    first = first * views.root[..., None, None]
    rows = torch.einsum("...nap,...nbq,...ncr,...nds->...nabcdpqrs", first, *rest)
    return rows.flatten(-9, -5).flatten(-4)


def _tensor_of(P: Tensor) -> tuple[Tensor, Tensor]:
    """Q of the cameras [I | 0] and P, and its derivative by the entries of P."""
    eye = torch.eye(3, 4, dtype=P.dtype, device=P.device).expand(*P.shape[:-3], 3, 4)
    Q = quadrifocal_from_cameras(eye, *P.unbind(-3))
    return Q.flatten(-4), quadrifocal_jacobian(torch.cat((eye[..., None, :, :], P), -3))
