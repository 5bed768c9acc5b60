"""Three views: the trifocal tensor from seven points or more, thirteen lines or more, or both (HZ 16.2, 16.3)."""

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
from torchsfm.tensors import cameras_from_trifocal, canonical_cameras, transform_trifocal
from torchsfm.tensors.trifocal import unit_tensor


@dataclass(frozen=True)
class TrifocalFit:
    """A trifocal tensor fitted to points and lines.

    Attributes:
        T: The tensor with norm 1, in the coordinates of the input; it meets all internal constraints.
        P: The cameras in the frame of `canonical_cameras`, whose tensor it is.
        error: Root mean square of the algebraic residuals, without unit.
        uncertainty: Standard deviation of the tensor of norm 1 in its least determined direction, in normalised coordinates,
            estimated from the residuals; at most 1.
        status: OK; TOO_FEW points and lines with weight; DEGENERATE: they leave more than one tensor (points in a plane,
            centres that coincide, lines that meet), exactly or within their noise; NOT_CONVERGED;
            NOT_FINITE: numbers with weight that are not.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(10, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> x = torchsfm.project_points(P, X)
        >>> found = torchsfm.motion.trifocal_7pt(x)
        >>> torchsfm.Status(found.status.item()).name, bool(found.error.max() < 1e-6)
        ('OK', True)
        >>> again = torchsfm.tensors.trifocal_from_cameras(*found.P)  # the tensor and the cameras say the same
        >>> bool((again / again.norm()).abs().allclose((found.T / found.T.norm()).abs(), atol=1e-6))
        True
    """

    T: Float[Tensor, "*batch 3 3 3"]
    P: Float[Tensor, "*batch 3 3 4"]
    error: Float[Tensor, "*batch"]
    uncertainty: Float[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]


def trifocal_7pt(
    x: Float[Tensor, "*#batch 3 n 2"],
    l: Float[Tensor, "*#batch 3 m 3"] | None = None,  # noqa: E741
    *,
    ends: Float[Tensor, "*#batch m 2 2"] | None = None,
    weights: Float[Tensor, "*#batch n"] | None = None,
    line_weights: Float[Tensor, "*#batch m"] | None = None,
    max_iterations: int = 50,
) -> TrifocalFit:
    """The trifocal tensor of least algebraic error among those that three cameras can have.

    Four equations a point and two a line, linear in T, in normalised coordinates; their least-squares solution is brought to
    the nearest trifocal tensor, from where |A t| with |t| = 1 is minimised over the cameras (Levenberg-Marquardt; the minimum
    of HZ's algorithm 16.2, with the cameras in place of the epipoles as parameters). Computed in float64 whatever the dtype.

    Args:
        x: Points in the three images; n may be 0.
        l: Lines in the three images, homogeneous, of any scale. 4 n + 2 m must be at least 26.
        ends: Two points on each line in the first image, where the line's equations are set: the end points of the measured
            segment, for far from it a line is not known well. A unit left and right of the point next to the centre of the
            image, if not given.
        weights: Weight of each point's squared errors, >= 0; 0 means absent, and what stands there is not looked at.
        line_weights: The same for lines.
        max_iterations: Most steps of the minimisation.

    Returns:
        Tensor, cameras, error, uncertainty and status; all finite always. Differentiable in points, lines and weights through
        the minimum.

    Raises:
        ValueError: Wrong shape, dtype or device, or too few points and lines.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(10, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> found = torchsfm.motion.trifocal_7pt(torchsfm.project_points(P, X))
        >>> bool(found.P.allclose(torchsfm.tensors.canonical_cameras(P), atol=1e-6))
        True
    """
    batch = check_tensors(
        x=(x, "3 n 2"), l=(l, "?3 m 3"), ends=(ends, "?m 2 2"), weights=(weights, "?n"), line_weights=(line_weights, "?m")
    )
    check_options(max_iterations=(max_iterations, "int >= 0"))
    if l is None and (ends is not None or line_weights is not None):
        raise ValueError("l: wanted the lines to which ends or line_weights belong, got None")
    lines = x.new_zeros(*x.shape[:-3], 3, 0, 3) if l is None else l
    n, m = x.shape[-2], lines.shape[-2]
    if 4 * n + 2 * m < 26:
        raise ValueError(f"x, l: wanted 4 n + 2 m >= 26 for n points and m lines, got n = {n} and m = {m}")
    views = normalized_views(x.expand(*batch, 3, n, 2), lines.expand(*batch, 3, m, 3), weights, line_weights)
    on_first = _points_on_lines(views, None if ends is None else ends.expand(*batch, m, 2, 2))
    finite = views.finite & torch.isfinite(on_first).flatten(-3).all(-1)
    A = _equations(views, torch.where(finite[..., None, None, None], on_first, 0))
    t = least_vector(A)
    start = cameras_from_trifocal(t.reshape(*batch, 3, 3, 3))
    fit = fit_cameras(_tensor_of, A, start.P[..., 1:, :, :], max_iterations)
    inverse = inverse_similarity(views.S)
    T = transform_trifocal(fit.tensor.reshape(*batch, 3, 3, 3), *inverse.unbind(-3))
    T = unit_tensor(T, 3)[0]
    eye = torch.eye(3, 4, dtype=T.dtype, device=T.device).expand(*batch, 1, 3, 4)
    P = canonical_cameras(inverse @ torch.cat((eye, fit.P), -3))
    number = 4 * (views.root > 0).sum(-1) + 2 * (views.line_root > 0).sum(-1)
    uncertainty, determined = tensor_uncertainty(_tensor_of, A, fit, number)
    status = combined_status(finite, number >= 26, determined & (start.status == Status.OK), fit.status == Status.OK)
    error = (2 * fit.cost / A.shape[-2]).sqrt()
    return TrifocalFit(T.to(x.dtype), P.to(x.dtype), error.to(x.dtype), uncertainty.to(x.dtype), status)


def _points_on_lines(views: NormalizedViews, ends: Tensor | None) -> Tensor:
    """Two points (*batch, m, 2, 2) on each line of the first image, in normalised coordinates; 0 for absent lines."""
    normal, offset = views.l[..., 0, :, None, :2], views.l[..., 0, :, None, 2:]
    present = (views.line_root > 0)[..., None, None]
    if ends is None:
        along = torch.stack((-normal[..., 1], normal[..., 0]), -1)
        both = -offset * normal + along * torch.tensor([[1.0], [-1.0]], dtype=along.dtype, device=along.device)
    else:
        S = views.S[..., 0, None, None, :2, :]
        ends = torch.where(present, ends.double(), 0)
        both = (S[..., :2] @ ends[..., None])[..., 0] + S[..., 2]
        both = both - ((both * normal).sum(-1, keepdim=True) + offset) * normal
    return torch.where(present, both, 0)


def _equations(views: NormalizedViews, on_first: Tensor) -> Tensor:
    """The linear equations in T_i^jk, flat: four a point and two a line."""
    one, zero = torch.ones_like(views.x[..., 0]), torch.zeros_like(views.x[..., 0])
    # The vertical and the horizontal line through each point.
    vertical = torch.stack((one, zero, -views.x[..., 0]), -1)
    horizontal = torch.stack((zero, one, -views.x[..., 1]), -1)
    axes = torch.stack((vertical, horizontal), -2)
    h1 = torch.stack((views.x[..., 0, :, 0], views.x[..., 0, :, 1], one[..., 0, :]), -1) * views.root[..., None]
    by_points = torch.einsum("...ni,...naj,...nbk->...nabijk", h1, axes[..., 1, :, :, :], axes[..., 2, :, :, :])
    ends = torch.nn.functional.pad(on_first, (0, 1), value=1.0) * views.line_root[..., None, None]
    by_lines = torch.einsum("...nei,...nj,...nk->...neijk", ends, *views.l[..., 1:, :, :].unbind(-3))
    return torch.cat((by_points.flatten(-6, -4).flatten(-3), by_lines.flatten(-5, -4).flatten(-3)), -2)


def _tensor_of(P: Tensor) -> tuple[Tensor, Tensor]:
    """T of the cameras [I | 0] and P, and its derivative by the entries of P."""
    (A, e2), (B, e3) = ((M[..., :3], M[..., 3]) for M in P.unbind(-3))
    T = A.mT[..., :, :, None] * e3[..., None, None, :] - e2[..., None, :, None] * B.mT[..., :, None, :]
    eye = torch.eye(3, dtype=P.dtype, device=P.device)
    # dT_i^jk / dP2_rc = delta_jr M2_ikc and dT_i^jk / dP3_rc = delta_kr M3_ijc.
    M2 = torch.cat((torch.einsum("ic,...k->...ikc", eye, e3), -B.mT[..., None]), -1)
    M3 = torch.cat((-torch.einsum("ic,...j->...ijc", eye, e2), A.mT[..., None]), -1)
    J2 = torch.einsum("jr,...ikc->...ijkrc", eye, M2)
    J3 = torch.einsum("kr,...ijc->...ijkrc", eye, M3)
    J = torch.stack((J2, J3), -3).flatten(-3).flatten(-4, -2)
    return T.flatten(-3), J
