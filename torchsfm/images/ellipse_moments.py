"""Ellipses from sums over points: batches of sets of any size, the sums of unions being sums."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry.conics import shape_of_dual_conic
from torchsfm.linalg import adjugate_3x3, eigh

_ROUNDING = 1e-16
"""Smallest eigenvalues of moments, relative to the largest."""


def monomials(x: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 6"]:
    """`(x^2, 2 x y, y^2, 2 x, 2 y, 1)`, which a conic's six entries are products with."""
    x, y = x.unbind(-1)
    return torch.stack((x * x, 2 * x * y, y * y, 2 * x, 2 * y, torch.ones_like(x)), -1)


def conic_moments(x: Float[Tensor, "n 2"], number: Int[Tensor, " n"], sets: int) -> Float[Tensor, "sets 6 6"]:
    """The sums of products of monomials over the points of each set; points of size 1 or so keep their digits."""
    rows = monomials(x)
    M = [rows.new_zeros(sets, 6).index_add(0, number, rows[:, i, None] * rows) for i in range(6)]
    return torch.stack(M, -2)


def ellipse_of_moments(
    M: Float[Tensor, "n 6 6"],
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"], Bool[Tensor, " n"], Float[Tensor, "n 6"]]:
    """Centre, shape matrix, whether there is an ellipse, and the conic's entries by Taubin's method (1991).

    Where that is a hyperbola it is the direct ellipse of Fitzgibbon, Pilu & Fisher (1999).
    """
    count = M[..., 5, 5].clamp_min(1e-300)
    mean = 0.5 * M[..., 3:5, 5] / count[..., None]
    square = (M[..., 0, 5] + M[..., 2, 5]) / count - mean.square().sum(-1)
    size = square.clamp_min(1e-16).sqrt()
    A = _moved(mean, size)
    moved = A @ (M / count[..., None, None]) @ A.mT
    values, vectors, ok = eigh(0.5 * (moved + moved.mT))
    floor = _ROUNDING * values[..., -1:]
    whiten = vectors / values.clamp_min(0).maximum(floor).clamp_min(1e-300).sqrt()[..., None, :]
    ellipses = M.new_zeros(6, 6)
    ellipses[[0, 2], [2, 0]] = 0.5
    ellipses[1, 1] = -1.0
    answers = []
    for N, signed in ((slopes(moved), False), (ellipses.expand_as(M), True)):
        v = extreme(whiten, N, signed=signed)
        # Back to where the points are: v' A xi.
        v = (v[..., None, :] @ A)[..., 0, :]
        answers.append((*shape_of_conic(v), v))
    (centre, D, good, v), (other_centre, other_D, other, other_v) = answers
    centre = torch.where(good[..., None], centre, other_centre)
    D = torch.where(good[..., None, None], D, other_D)
    return centre, D, (good | other) & ok, torch.where(good[..., None], v, other_v)


def residual(M: Float[Tensor, "n 6 6"], v: Float[Tensor, "n 6"]) -> Float[Tensor, " n"]:
    """Root-mean-square distance, to first order and with one gradient for all, of sets of points from conics."""
    value = ((v[..., None, :] @ M)[..., 0, :] * v).sum(-1)
    slope = ((v[..., None, :] @ slopes(M))[..., 0, :] * v).sum(-1)
    return (value.clamp_min(0) / slope.clamp_min(1e-300)).sqrt()


def slopes(M: Float[Tensor, "*n 6 6"]) -> Float[Tensor, "*n 6 6"]:
    """The sums of `gx gx' + gy gy'` over the points, gx and gy being the derivatives of the monomials."""
    xx, yy, xy = M[..., 0, 5], M[..., 2, 5], 0.5 * M[..., 1, 5]
    x, y, one, zero = 0.5 * M[..., 3, 5], 0.5 * M[..., 4, 5], M[..., 5, 5], torch.zeros_like(M[..., 0, 0])
    rows = (
        (xx, xy, zero, x, zero, zero),
        (xy, xx + yy, xy, y, x, zero),
        (zero, xy, yy, zero, y, zero),
        (x, y, zero, one, zero, zero),
        (zero, x, y, zero, one, zero),
        (zero, zero, zero, zero, zero, zero),
    )
    return 4 * torch.stack([torch.stack(row, -1) for row in rows], -2)


def extreme(whiten: Float[Tensor, "*n 6 k"], N: Float[Tensor, "*n 6 6"], *, signed: bool) -> Float[Tensor, "*n 6"]:
    """The vector that makes v'Nv / v'Mv largest, or largest in size, where `whiten` is a root of the inverse of M."""
    values, vectors, _ = eigh(whiten.mT @ N @ whiten)
    index = (values if signed else values.abs()).argmax(-1)
    best = vectors.gather(-1, index[..., None, None].expand(*index.shape, vectors.shape[-2], 1))
    return (whiten @ best)[..., 0]


def shape_of_conic(
    v: Float[Tensor, "*n 6"],
) -> tuple[Float[Tensor, "*n 2"], Float[Tensor, "*n 2 2"], Bool[Tensor, "*n"]]:
    """Centre and shape matrix of a conic `a x^2 + 2 b x y + c y^2 + 2 d x + 2 e y + f`, and whether it is an ellipse."""
    a, b, c, d, e, f = v.unbind(-1)
    C = torch.stack([torch.stack(row, -1) for row in ((a, b, d), (b, c, e), (d, e, f))], -2)
    return shape_of_dual_conic(adjugate_3x3(C))


def _moved(mean: Tensor, size: Tensor) -> Tensor:
    """The matrix that makes monomials of x those of (x - mean) / size."""
    m, n = mean.unbind(-1)
    zero, one = torch.zeros_like(m), torch.ones_like(m)
    rows = (
        (one, zero, zero, -m, zero, m * m),
        (zero, one, zero, -n, -m, 2 * m * n),
        (zero, zero, one, zero, -n, n * n),
        (zero, zero, zero, size, zero, -2 * m * size),
        (zero, zero, zero, zero, size, -2 * n * size),
        (zero, zero, zero, zero, zero, size * size),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2) / size.square()[..., None, None]
