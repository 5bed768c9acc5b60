"""How stiff splines are: of all stiffnesses the one by which what was measured is likeliest.

A spline's third differences are taken for normal, of one unknown variance. The splines that these and the distances leave
possible are integrated over, not only the best one looked at (evidence: MacKay 1992): of bends as large as noise makes them,
the best spline would follow them, and its own bends would then be taken as a reason for it.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg import eigh

_RANGE = (-24, 16)
"""Stiffness against what distances say of control points, powers of two that are tried."""
_ROUNDS = 5
"""Of the noise by the number of what the distances have determined, and the stiffness by the noise."""
_LEFT = 0.1
"""Part of the distances that is left to tell the noise, at least."""


def likeliest_stiffness(
    G: Float[Tensor, "p c l l"],
    slope: Float[Tensor, "p c l"],
    differences: Float[Tensor, "p c k k"],
    control: Float[Tensor, "p c k 3"],
    variance: Float[Tensor, "p"],
    number: Float[Tensor, "p"],
    cameras: int,
) -> Float[Tensor, "p c"]:
    """The weight of squared third differences beside squared distances, of each spline, by the cameras as they are.

    Args:
        G: Normal matrix of control points by distances alone, coordinates of a point one after another,
        slope: and their derivative.
        differences: What takes third differences of control points.
        control: Control points.
        variance: Of the distances from the splines as they are.
        number: Of the distances.
        cameras: How many numbers of cameras these determine besides.
    """
    c, k = control.shape[1:3]
    D = differences
    bend = D @ control
    each = torch.eye(3, dtype=G.dtype, device=G.device)
    S = torch.einsum("pckl,ab->pckalb", D.mT @ D, each).flatten(4, 5).flatten(2, 3)
    size = G.diagonal(dim1=-2, dim2=-1).mean(-1) / S.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-100)
    size = size.clamp_min(1e-100)
    # In axes in which both are diagonal, distances and bending together as unit: 1 - w and w.
    eye = torch.eye(3 * k, dtype=G.dtype, device=G.device)
    both = G + size[..., None, None] * S
    L = torch.linalg.cholesky_ex(both + 1e-12 * both.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * eye)[0]
    half = torch.linalg.solve_triangular(L, size[..., None, None] * S, upper=False)
    w, vectors, _ = eigh(torch.linalg.solve_triangular(L, half.mT, upper=False))
    w = w.clamp(0, 1)[:, :, None]
    pull = (D.mT @ bend).flatten(2) * size[..., None]
    a, b = (vectors.mT @ torch.linalg.solve_triangular(L, t[..., None], upper=False) for t in (slope, pull))
    share = 2.0 ** torch.arange(*_RANGE, dtype=G.dtype, device=G.device)
    stiff = share[:, None]
    inner = 1 - w + stiff * w
    left = (a.mT + stiff * b.mT).square() / inner.clamp_min(1e-100)
    least = share * size[..., None] * bend.square().sum((-2, -1))[..., None] - left.sum(-1)
    # Equal points have no differences: those of a closed spline, of which there are as many as points, depend on each other.
    rank = 3 * (D != 0).any(-1).sum(-1).clamp(max=k - 1)[..., None]
    volume = inner.clamp_min(1e-100).log().sum(-1) - rank * share.log()
    told = ((1 - w) / inner.clamp_min(1e-100)).sum(-1)
    best = torch.zeros(len(G), c, 1, dtype=torch.long, device=G.device)
    for _ in range(_ROUNDS):
        known = cameras + told.gather(-1, best).sum((1, 2))
        noise = variance * number / torch.maximum(number - known, _LEFT * number).clamp_min(1)
        best = (least / noise[:, None, None].clamp_min(1e-100) + volume).nan_to_num(nan=torch.inf).argmin(-1, keepdim=True)
    return share[best[..., 0]] * size
