"""Ellipses through edge points: algebraic without bias, then least squares on orthogonal distances."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.geometry import Ellipse, normalizing_similarity, transform_points
from torchsfm.geometry.conic_distance import foot_normal, root_slopes, signed_distance, square_root
from torchsfm.geometry.conics import ellipse_of_shape
from torchsfm.images.ellipse_moments import extreme, monomials, shape_of_conic
from torchsfm.linalg import eigh, inverse
from torchsfm.linalg.rows import inner
from torchsfm.optim import levenberg_marquardt

_UNSURE = 0.2
"""The standard deviation of a semi-axis, relative to it, from which an ellipse is not determined."""
_THICK = 0.1
"""The scatter, relative to the shorter semi-axis, from which points may be those of a line or of anything."""
_ROUNDING = 1e-14
"""Of a distance, relative to the ellipse."""
_RANK = 1e-12
"""Eigenvalues of moments below this, relative to the largest, are rounding."""


@dataclass(frozen=True)
class EllipseFit:
    """Ellipses and what is known about them.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> truth = torchsfm.Ellipse(torch.tensor([50.0, 40.0]), torch.tensor([30.0, 20.0]), torch.tensor(0.5))
        >>> arcs = torch.stack([truth.points(torch.linspace(0, end, 50)) for end in (6.0, 1.0)])  # most of it, and a sixth
        >>> found = torchsfm.fit_ellipse(arcs + 0.1 * torch.randn(2, 50, 2, generator=g))
        >>> [torchsfm.Status(k).name for k in found.status.tolist()]  # too short an arc is told
        ['OK', 'DEGENERATE']
        >>> sigma = found.covariance[0].diagonal().sqrt()
        >>> bool(((found.model.centre[0] - truth.centre).abs() < 4 * sigma[:2]).all())
        True
    """

    model: Ellipse
    """The ellipses, finite always; where `status` is not OK they may mean little."""
    status: Int8[Tensor, "*batch"]
    """OK; NOT_FINITE: a wanted point is not finite; TOO_FEW: fewer than five points; DEGENERATE: the points lie on a line, or
    their arc is so short, for their scatter, that a semi-axis is not known to a fifth of its length, or they scatter by
    more than a tenth of it; NOT_CONVERGED."""
    covariance: Float[Tensor, "*batch 5 5"]
    """Of centre, semi-axes and angle, in this order, for independent noise of variance 1 / weight in every coordinate (1 pixel
    where no weights are given); zero where DEGENERATE or worse. The angle of what is nearly a circle has a huge variance."""
    error: Float[Tensor, "*batch"]
    """Root-mean-square distance (weighted) of the points from the ellipse, in pixels."""


def fit_ellipse(
    x: Float[Tensor, "*#batch n 2"],
    *,
    weights: Float[Tensor, "*#batch n"] | None = None,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    max_iterations: int = 50,
) -> EllipseFit:
    """Fit ellipses to points, each with the least sum of squared orthogonal distances.

    The start is hyper least squares, whose bias is of fourth order in the noise (Kanatani & Rangarajan 2011), or where that is
    a hyperbola the direct ellipse of Fitzgibbon, Pilu & Fisher (1999). Levenberg-Marquardt then moves centre and root of the
    shape matrix, which know no special case at circles.

    Computed in float64 whatever comes in. The derivative of `model` with respect to points and weights is that of the optimum
    (implicit function theorem with the exact Hessian).

    Args:
        x: Points.
        weights: Factors of the squared distances (inverse variances), 0 for absent.
        mask: Which points count; all by default.
        max_iterations: Of Levenberg-Marquardt, for each ellipse.

    Returns:
        The ellipses with status, covariance and error.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> truth = torchsfm.Ellipse(torch.tensor([5.0, 1.0]), torch.tensor([3.0, 2.0]), torch.tensor(0.5))
        >>> found = torchsfm.fit_ellipse(truth.points(torch.linspace(0, 6, 20)))
        >>> found.model.centre, found.model.semi_axes
        (tensor([5.0000, 1.0000]), tensor([3.0000, 2.0000]))
    """
    batch = check_tensors(x=(x, "n 2"), weights=(weights, "?n"), mask=(mask, "?n: bool"))
    check_options(max_iterations=(max_iterations, "int >= 0"))
    dtype, n = x.dtype, x.shape[-2]
    x = x.double().expand(*batch, n, 2)
    w = torch.ones_like(x[..., 0]) if weights is None else weights.double().expand(*batch, n)
    wanted = torch.ones_like(w, dtype=torch.bool) if mask is None else mask.expand(*batch, n)
    wanted = wanted & (w.detach() != 0)
    sound = (x.detach().abs() < 1e12).all(-1) & (w.detach() > 1e-30) & (w.detach() < 1e30)
    broken = (wanted & ~sound).any(-1)
    seen = wanted & sound & ~broken[..., None]
    w, x = torch.where(seen, w, 0.0), torch.where(seen[..., None], x, 0.0)
    with torch.no_grad():
        T = normalizing_similarity(x, w)
        # Points no farther apart than this are one.
        apart = T[..., 0, 0] < 1e30
        T = torch.where(apart[..., None, None], T, torch.eye(3, dtype=x.dtype, device=x.device))
        scale = T[..., 0, 0]
        centre, D, spread = _start(transform_points(T, x), w, seen)
        root = square_root(D)
        start = torch.cat((centre, root[..., 0, :], root[..., 1, 1:]), -1)
    y = torch.where(seen[..., None], transform_points(T, x), 0.0)
    found = levenberg_marquardt(
        _residual, start, y, weights=w, linearize=_linearize, max_iterations=max_iterations, function_tolerance=1e-14
    )
    centre, root = found.x[..., :2], _root(found.x)
    with torch.no_grad():
        count = seen.sum(-1)
        total = w.sum(-1)
        information = _information(found.x, y, w)
        squares = 2 * found.cost
        variance = squares / (count - 5).clamp_min(1)
        covariance, deviation, regular = _covariance(found.x, information)
        axes = _semi_axes(root)
        unsure = deviation * variance.sqrt()[..., None] > _UNSURE * axes
        thick = variance.sqrt() > _THICK * axes[..., 1] * total.clamp_min(1e-300).div(count.clamp_min(1)).sqrt()
        degenerate = ~apart | ~spread | ~regular | unsure.any(-1) | thick
        # A long ellipse has distances that are rounding of its size.
        rounding = _ROUNDING * torch.maximum(axes[..., 0], torch.linalg.vector_norm(centre, dim=-1))
        settled = (found.status == Status.OK) | (squares <= rounding.square() * total)
        status = torch.full(batch, int(Status.OK), dtype=torch.int8, device=x.device)
        for condition, code in (
            (~settled, Status.NOT_CONVERGED),
            (degenerate, Status.DEGENERATE),
            (count < 5, Status.TOO_FEW),
            (broken, Status.NOT_FINITE),
        ):
            status = torch.where(condition, int(code), status)
        one = torch.ones_like(scale)
        known = (status == Status.OK) | (status == Status.NOT_CONVERGED)
        # Noise of one pixel, and lengths, in the units of y.
        pixels = torch.stack([one, one, one, one, scale], -1)
        covariance = covariance * (pixels[..., :, None] * pixels[..., None, :])
        covariance = torch.where(known[..., None, None], covariance, 0.0)
        error = (squares / torch.where(total > 0, total, 1.0)).sqrt() / scale
    shift = T[..., :2, 2]
    # Where there is nothing to go by the start stands: the circle of the points' scatter.
    ellipse = ellipse_of_shape((centre - shift) / scale[..., None], _shape(root))
    model = Ellipse(ellipse.centre.to(dtype), (ellipse.semi_axes / scale[..., None]).to(dtype), ellipse.angle.to(dtype))
    return EllipseFit(model, status, covariance.to(dtype), torch.where(total > 0, error, 0.0).to(dtype))


def _root(p: Tensor) -> Tensor:
    """The symmetric matrix S of parameters (centre, S11, S12, S22)."""
    return torch.stack((p[..., 2:4], p[..., 3:5]), -2)


def _shape(root: Tensor) -> Tensor:
    return root @ root


def _residual(p: Tensor, y: Tensor) -> Tensor:
    """Signed distances, with their first and second derivatives."""
    return signed_distance(p[..., :2], _shape(_root(p)), y)[..., None]


def _linearize(p: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """The distances and their derivatives: -n by the centre, -n' dS q by the root S, with q = S n / |S n|."""
    n, q, distance = _normals(p, y)
    return distance[..., None], -root_slopes(n, q)[..., None, :]


def _normals(p: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    root, offset = _root(p), y - p[..., None, :2]
    n = foot_normal(_shape(root), offset)
    q = n @ root
    support = torch.linalg.vector_norm(q, dim=-1)
    q = q / support.clamp_min(1e-300)[..., None]
    return n, q, inner(n, offset) - support


def _information(p: Tensor, y: Tensor, w: Tensor) -> Tensor:
    _, J = _linearize(p, y)
    return (w[..., None] * J[..., 0, :]).mT @ J[..., 0, :]


def _semi_axes(root: Tensor) -> Tensor:
    return ellipse_of_shape(root[..., 0], _shape(root)).semi_axes


def _covariance(p: Tensor, information: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of (centre, semi-axes, angle), the standard deviations of the semi-axes, and where the data determine them."""
    size = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    scaled = information * size[..., :, None] * size[..., None, :]
    values, _, ok = eigh(scaled)
    regular = ok & (values[..., 0] > _RANK)
    eye = torch.eye(5, dtype=p.dtype, device=p.device)
    inner, _ = inverse(torch.where(regular[..., None, None], scaled, eye))
    inner = inner * size[..., :, None] * size[..., None, :]
    ellipse = ellipse_of_shape(p[..., :2], _shape(_root(p)))
    a, b = ellipse.semi_axes.unbind(-1)
    cos, sin = ellipse.angle.cos(), ellipse.angle.sin()
    turn = 1 / torch.maximum(a - b, 1e-9 * a)
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    # e_a' dS e_a, e_b' dS e_b and e_a' dS e_b / (a - b), with e_a = (cos, sin).
    rows = [
        [one, zero, zero, zero, zero],
        [zero, one, zero, zero, zero],
        [zero, zero, cos * cos, 2 * cos * sin, sin * sin],
        [zero, zero, sin * sin, -2 * cos * sin, cos * cos],
        [zero, zero, -turn * cos * sin, turn * (cos * cos - sin * sin), turn * cos * sin],
    ]
    G = torch.stack([torch.stack(row, -1) for row in rows], -2)
    covariance = G @ inner @ G.mT
    return covariance, covariance.diagonal(dim1=-2, dim2=-1)[..., 2:4].clamp_min(0).sqrt(), regular


def _start(y: Tensor, w: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centre and shape matrix of the algebraic ellipse, and whether the points are on no line."""
    count = seen.sum(-1).clamp_min(1)[..., None, None]
    w = (w * count[..., 0] / w.sum(-1, keepdim=True).clamp_min(1e-300))[..., None]
    xi = monomials(y)
    x, z = y.unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    slopes = (2 * x, 2 * z, zero, 2 * one, zero, zero), (zero, 2 * x, 2 * z, zero, 2 * one, zero)
    gradient = torch.stack([torch.stack(row, -1) for row in slopes], -1)
    M = xi.mT @ (w * xi) / count
    values, vectors, _ = eigh(M)
    whiten = vectors / values.clamp_min(1e-16 * values[..., -1:]).clamp_min(1e-300).sqrt()[..., None, :]
    # The pseudo-inverse of rank five; V of each point is gradient gradient'.
    steady = whiten[..., 1:] @ whiten[..., 1:].mT
    present = seen[..., None].to(y.dtype)
    V = (present[..., None] * gradient @ gradient.mT).sum(-3) / count
    e = torch.zeros(6, dtype=y.dtype, device=y.device)
    e[[0, 2]] = 1.0
    mean = (present * xi).sum(-2) / count[..., 0]
    N = V + mean[..., :, None] * e + e[:, None] * mean[..., None, :]
    pulled = steady[..., None, :, :] @ gradient
    trace = (gradient * pulled).sum((-2, -1))[..., None]
    length = ((xi @ steady) * xi).sum(-1)[..., None]
    mixed = gradient @ (gradient.mT @ (xi @ steady)[..., None])
    cross = (w[..., None] * mixed * xi[..., None, :]).sum(-3)
    weighted = (w * length)[..., None] * gradient @ gradient.mT
    N = N - (xi.mT @ (w * trace * xi) + weighted.sum(-3) + cross + cross.mT) / count.square()
    hyper = extreme(whiten, N, signed=False)
    ellipses = torch.zeros(6, 6, dtype=y.dtype, device=y.device)
    ellipses[[0, 2], [2, 0]] = 0.5
    ellipses[1, 1] = -1.0
    direct = extreme(whiten, ellipses.expand_as(N), signed=True)
    centre, D, good = shape_of_conic(hyper)
    other_centre, other_D, other = shape_of_conic(direct)
    centre = torch.where(good[..., None], centre, torch.where(other[..., None], other_centre, 0.0))
    circle = torch.eye(2, dtype=y.dtype, device=y.device)
    D = torch.where(good[..., None, None], D, torch.where(other[..., None, None], other_D, circle))
    return centre, D, values[..., 1] > 1e-15 * values[..., -1]
