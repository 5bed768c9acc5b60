"""Linear equations for a multilinear tensor, minimised over the cameras that can have it (HZ 16.3).

The tensor t(P) of cameras [I | 0], P2, ... minimises |A t| / |t|, A the linear equations in normalised coordinates. The cameras
move along the directions that change more than scales and the projective frame of space.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.linalg import null_vector, qr, svdvals, triangular_factor
from torchsfm.optim import levenberg_marquardt

_OPEN = 0.65
"""Norm of the noise in all equations, relative to the least singular value along the tensors, above which that may be noise."""
TensorOf = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From cameras (*batch, u, 3, 4) after the first the tensor, flat, and its derivative (*batch, entries, 12 u)."""


class CameraFit(NamedTuple):
    """Cameras after the first, their tensor with norm 1, and what became of the minimisation."""

    P: Float[Tensor, "*batch u 3 4"]
    tensor: Float[Tensor, "*batch entries"]
    cost: Float[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]


def fit_cameras(tensor_of: TensorOf, A: Float[Tensor, "*batch m k"], P: Float[Tensor, "*batch u 3 4"], steps: int) -> CameraFit:
    """Minimise |A t(P)|^2 / |t(P)|^2 from a start; differentiable in A."""
    views = P.shape[-3]

    def cameras(x: Tensor) -> Tensor:
        return x.reshape(*x.shape[:-1], views, 3, 4)

    def unit(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        t, J = tensor_of(cameras(x))
        size = (t * t).sum(-1, keepdim=True)
        size = torch.where(size > 0, size, 1).sqrt()
        return t / size, J, size

    def residual(x: Tensor, A: Tensor) -> Tensor:
        return A @ unit(x)[0][..., None]

    def linearize(x: Tensor, A: Tensor) -> tuple[Tensor, Tensor]:
        t, J, size = unit(x)
        J = J @ free_directions(cameras(x)) / size[..., None]
        J = J - t[..., None] * (t[..., None, :] @ J)
        return A @ t[..., None], (A @ J)[..., :, None, :]

    def retract(x: Tensor, delta: Tensor) -> Tensor:
        moved: Tensor = x + (free_directions(cameras(x)) @ delta[..., None])[..., 0]
        return moved

    result = levenberg_marquardt(
        residual, P.detach().flatten(-3), A, retract=retract, size=11 * views - 4, linearize=linearize, max_iterations=steps,
        function_tolerance=1e-14,
    )  # fmt: skip
    return CameraFit(cameras(result.x), unit(result.x)[0], result.cost, result.status)


def frame_directions(P: Float[Tensor, "*batch u 3 4"]) -> Float[Tensor, "*batch k g"]:
    """The directions, k = 12 u numbers each, that change no tensor: scales of cameras, and the four of the frame.

    The first camera [I | 0] stays under the maps X -> (X_1..3, w'X_1..3 + X_4 s).
    """
    u = P.shape[-3]
    scales = torch.einsum("...urc,uv->...urcv", P, torch.eye(u, dtype=P.dtype, device=P.device)).flatten(-4, -2)
    frame = torch.einsum("...ur,cg->...urcg", P[..., 3], torch.eye(4, dtype=P.dtype, device=P.device)).flatten(-4, -2)
    return torch.cat((scales, frame), -1)


def free_directions(P: Float[Tensor, "*batch u 3 4"]) -> Float[Tensor, "*batch k f"]:
    """An orthonormal basis of the directions across those of `frame_directions`, without derivative."""
    with torch.no_grad():
        G = frame_directions(P.detach())
        Q, _, _ = qr(G, complete=True)
    return Q[..., G.shape[-1] :]


class NormalizedViews(NamedTuple):
    """Points and lines of several views in coordinates of moderate size.

    Attributes:
        x: Points; 0 where absent.
        l: Lines with unit normal; 0 where absent.
        root: Square roots of the weights of the points, 0 where absent.
        line_root: Square roots of the weights of the lines.
        S: The similarities from the caller's coordinates, (*batch, v, 3, 3).
        finite: Whether all that counts is finite.
    """

    x: Float[Tensor, "*batch v n 2"]
    l: Float[Tensor, "*batch v m 3"]  # noqa: E741
    root: Float[Tensor, "*batch n"]
    line_root: Float[Tensor, "*batch m"]
    S: Float[Tensor, "*batch v 3 3"]
    finite: Float[Tensor, "*batch"]


def normalized_views(x: Tensor, l: Tensor, weights: Tensor | None, line_weights: Tensor | None) -> NormalizedViews:  # noqa: E741
    """In each view: the weighted centre at the origin, which is nearest to all points and lines, and mean square distance 1."""
    x, l = x.double(), l.double()  # noqa: E741
    w = torch.ones_like(x[..., 0, :, 0]) if weights is None else weights.double().expand(x[..., 0, :, 0].shape)
    k = torch.ones_like(l[..., 0, :, 0]) if line_weights is None else line_weights.double().expand(l[..., 0, :, 0].shape)
    normal = (l[..., :2] * l[..., :2]).sum(-1)
    fine_points = torch.isfinite(x).all(-1).all(-2) & torch.isfinite(w) & (w >= 0)
    fine_lines = (torch.isfinite(l).all(-1) & (normal > 0)).all(-2) & torch.isfinite(k) & (k >= 0)
    finite = (fine_points | (w == 0)).all(-1) & (fine_lines | (k == 0)).all(-1)
    w = torch.where(fine_points & (w > 0), w, 0)
    k = torch.where(fine_lines & (k > 0), k, 0)
    x = torch.where((w > 0)[..., None, :, None], x, 0)
    straight = (k > 0)[..., None, :]
    l = torch.where(straight[..., None], l, 0) / torch.where(straight, normal, 1).sqrt()[..., None]  # noqa: E741
    pw, lw = w[..., None, :, None], k[..., None, :, None]
    # The normal equations of the centre: I for a point, n n' for a line.
    n, offset = l[..., :2], l[..., 2:]
    eye = torch.eye(2, dtype=x.dtype, device=x.device)
    N = pw.sum((-2, -1))[..., None, None] * eye + (lw * n).mT @ n
    b = (pw * x).sum(-2) - (lw * n * offset).sum(-2)
    det = N[..., 0, 0] * N[..., 1, 1] - N[..., 0, 1] * N[..., 1, 0]
    good = det > 0
    adjugate = torch.stack((N[..., 1, 1], -N[..., 0, 1], -N[..., 1, 0], N[..., 0, 0]), -1).reshape(N.shape)
    c = (adjugate @ b[..., None])[..., 0] / torch.where(good, det, 1)[..., None]
    c = torch.where(good[..., None], c, 0)
    x = torch.where((w > 0)[..., None, :, None], x - c[..., None, :], 0)
    offset = offset + n @ c[..., None]
    total = pw.sum((-2, -1)) + lw.sum((-2, -1))
    spread = (pw * x * x).sum((-2, -1)) + 2 * (lw * offset * offset).sum((-2, -1))
    some = (spread > 0) & (total > 0)
    s = torch.where(some, (torch.where(some, total, 1) / torch.where(some, spread, 1)).sqrt(), 1)
    zero = torch.zeros_like(s)
    S = torch.stack((s, zero, -s * c[..., 0], zero, s, -s * c[..., 1], zero, zero, torch.ones_like(s)), -1).reshape(
        *s.shape, 3, 3
    )
    lines = torch.cat((n, offset * s[..., None, None]), -1)
    return NormalizedViews(x * s[..., None, None], lines, _root(w), _root(k), S, finite)


def inverse_similarity(S: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The inverse of [s I, c]."""
    s, c = S[..., :1, :1], S[..., :2, 2:]
    eye = torch.eye(2, dtype=S.dtype, device=S.device)
    return torch.cat((torch.cat((eye / s, -c / s), -1), S[..., 2:, :]), -2)


def least_vector(A: Float[Tensor, "*batch m k"]) -> Float[Tensor, "*batch k"]:
    """The unit vector v with the least |A v|, without derivative: also where A'A has lost it among the next ones."""
    with torch.no_grad():
        A = A.detach()
        v, _ = null_vector(A)
        if A.shape[-2] < A.shape[-1]:
            return v
        # Inverse iteration with the triangular factor of A itself.
        R, _ = triangular_factor(A)
        pivots = R.diagonal(dim1=-2, dim2=-1)
        floor = torch.finfo(A.dtype).eps * pivots.abs().amax(-1, keepdim=True)
        small = pivots.abs() <= floor
        R = R + torch.diag_embed(torch.where(small, torch.where(floor > 0, floor, 1) - pivots, 0))
        w = v[..., None]
        for _ in range(4):
            w = torch.linalg.solve_triangular(R.mT, w, upper=False)
            w = torch.linalg.solve_triangular(R, w / w.norm(dim=-2, keepdim=True), upper=True)
            w = w / w.norm(dim=-2, keepdim=True)
        w = w[..., 0]
        better = torch.isfinite(w).all(-1) & ((A @ w[..., None]).norm(dim=(-2, -1)) <= (A @ v[..., None]).norm(dim=(-2, -1)))
        return torch.where(better[..., None], w, v)


def tensor_uncertainty(
    tensor_of: TensorOf, A: Float[Tensor, "*batch m k"], fit: CameraFit, number: Int[Tensor, "*batch"]
) -> tuple[Tensor, Tensor]:
    """How well the equations determine a fitted tensor: without derivative.

    Args:
        tensor_of: As for `fit_cameras`.
        A: The linear equations.
        fit: The fitted cameras.
        number: How many of the equations are not empty.

    Returns:
        The standard deviation of the tensor of norm 1 in its least determined direction, by the residuals, at most 1; and
        whether the equations determine it at all: where they do not, they have low rank along the tensors, or in a direction
        that they leave open nothing but the noise has given them rank, as little as the noise has left of residuals.
    """
    with torch.no_grad():
        A = A.detach()
        _, J = tensor_of(fit.P.detach())
        t = fit.tensor.detach()
        J = J @ free_directions(fit.P)
        J = J - t[..., None] * (t[..., None, :] @ J)
        Q, _, _ = qr(J)
        values, _ = svdvals(triangular_factor(A @ Q)[0])
        least, largest = values[..., -1], values[..., 0]
        noise = (2 * fit.cost / (number - J.shape[-1]).clamp(min=1)).sqrt()
        ratio = noise / torch.where(least > 0, least, 1)
        spread = noise * number.clamp(min=1).to(noise.dtype).sqrt()
        determined = (least > 1e-10 * largest) & (spread < _OPEN * least)
        return torch.where(least > 0, ratio, 1).clamp(max=1), determined


def combined_status(finite: Tensor, enough: Tensor, determined: Tensor, converged: Tensor) -> Tensor:
    """The first reason that applies, in the order not finite, too few, degenerate, not converged."""
    status = torch.where(converged, int(Status.OK), int(Status.NOT_CONVERGED))
    status = torch.where(determined, status, int(Status.DEGENERATE))
    status = torch.where(enough, status, int(Status.TOO_FEW))
    return torch.where(finite, status, int(Status.NOT_FINITE)).to(torch.int8)


def _root(w: Tensor) -> Tensor:
    return torch.where(w > 0, torch.where(w > 0, w, 1).sqrt(), 0)
