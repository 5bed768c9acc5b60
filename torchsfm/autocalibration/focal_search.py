"""Where to start: every focal length on a grid, each with its plane at infinity, as one batch.

Two focal lengths, with the rest of the intrinsics as expected, give the plane at infinity of two views in closed form; the
departure of all views from metric ones then tells how good the guess was (Gherardi & Fusiello, "Practical autocalibration",
ECCV 2010). A search in two bounded unknowns cannot be led astray by the linear methods' artificial minima.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.autocalibration.plane_at_infinity import plane_at_infinity_from_intrinsics
from torchsfm.autocalibration.upgrade_residual import departure, metric_blocks
from torchsfm.geometry.intrinsic_parameters import intrinsics_from_relative
from torchsfm.linalg import determinant_3x3

FOCAL_RANGE = (0.2, 12.0)
"""Focal lengths searched, over the longer side of the image: views of 136 to 5 degrees."""
_SCALE = 0.05
"""Departure of a view at which it starts to count as disagreeing."""
_VIEWS = 60_000
"""Views of candidates scored at once; bounds memory, changes no result."""


def search_focal(
    P: Float[Tensor, "b v 3 4"],
    X: Float[Tensor, "b n 4"],
    seen: Float[Tensor, "b n"],
    base: Float[Tensor, "b v 5"],
    present: Float[Tensor, "b v"],
    *,
    varying: bool,
    starts: int,
    partners: int = 4,
) -> tuple[Float[Tensor, "b k v"], Float[Tensor, "b k 3"], Float[Tensor, "b k"]]:
    """The best places of the grid, one per local minimum along the first view's focal length.

    Args:
        P: Oriented cameras, the first [I | 0].
        X: Oriented points.
        seen: 1 for points that any view sees.
        base: Expected intrinsic parameters; their focal length is where the range is centred.
        present: 1 for views that take part.
        varying: Whether focal lengths differ from view to view.
        starts: Number k of places.
        partners: Number of views tried as the second one.

    Returns:
        Logarithms of focal lengths per view relative to `base`, planes at infinity, and scores (the smaller the better).
    """
    b, v = P.shape[:2]
    low, high = (torch.tensor(f, dtype=P.dtype, device=P.device).log() for f in FOCAL_RANGE)
    first = torch.linspace(0, 1, 32 if varying else 64, dtype=P.dtype, device=P.device) * (high - low) + low
    second = first[::2] if varying else first.new_zeros(1)
    partner = _partners(P, present, partners)
    F, J, S = len(first), partner.shape[1], len(second)
    log1 = first[:, None, None].expand(F, J, S).reshape(1, -1)
    log2 = (second if varying else first[:, None, None]).expand(F, J, S).reshape(1, -1)
    other = partner[:, None, :, None].expand(b, F, J, S).flatten(1)
    k = F * J * S
    chunk = max(1, _VIEWS // (k * v))
    pieces = []
    for s in range(0, max(b, 1), chunk):
        part = slice(s, s + chunk)
        pieces.append(_score(P[part], X[part], seen[part], base[part], present[part], log1, log2, other[part], varying))
    score, log_f, p = (torch.cat(t) for t in zip(*pieces, strict=True))
    best = score.view(b, F, J * S).min(-1)
    along = best.values
    # Local minima first, then whatever else is low.
    padded = torch.nn.functional.pad(along, (1, 1), value=torch.inf)
    minimum = (along <= padded[:, :-2]) & (along <= padded[:, 2:])
    order = torch.where(minimum, along, along + 10 * v).argsort(-1)[:, :starts]
    chosen = order * (J * S) + best.indices.gather(1, order)
    rows = torch.arange(b, device=P.device)[:, None]
    return log_f[rows, chosen], p[rows, chosen], score[rows, chosen]


def _partners(P: Tensor, present: Tensor, count: int) -> Tensor:
    """Views spread evenly over those that take part and have their centre off the first one's."""
    v = P.shape[1]
    able = (present > 0) & (P[..., 3].norm(dim=-1) > 1e-9 * P.flatten(-2).norm(dim=-1))
    able[:, 0] = False
    number = able.sum(-1, keepdim=True)
    ranked = torch.argsort((~able).long(), dim=-1, stable=True)
    count = min(count, max(v - 1, 1))
    # The last ones first: in a sequence they are the farthest.
    place = (number - 1 - (torch.arange(count, device=P.device) * number) // count).clamp_min(0)
    return ranked.gather(1, place)


def _score(
    P: Tensor, X: Tensor, seen: Tensor, base: Tensor, present: Tensor, log1: Tensor, log2: Tensor, other: Tensor, varying: bool
) -> tuple[Tensor, Tensor, Tensor]:
    b, v = P.shape[:2]
    k = log1.shape[1]
    rows = torch.arange(b, device=P.device)[:, None]
    zero = torch.zeros(1, 1, 4, dtype=P.dtype, device=P.device)

    def at(parameters: Tensor, log_f: Tensor) -> Tensor:
        rest = parameters * torch.tensor([0.0, 1, 1, 1, 1], dtype=P.dtype, device=P.device)
        return intrinsics_from_relative(rest + torch.cat((log_f[..., None], zero.expand(*log_f.shape, 4)), -1))

    K1 = at(base[:, None, 0].expand(b, k, 5), log1.expand(b, k))
    K2 = at(base[rows, other], log2.expand(b, k))
    p = plane_at_infinity_from_intrinsics(P[rows, other], K1, K2)
    blocks = metric_blocks(P[:, None], at(base, torch.zeros_like(base[..., 0]))[:, None], K1, p)
    if varying:
        # With principal point and aspect removed the dual conic of each view is diag(f^2, f^2, 1).
        squares = blocks.square().sum(-1)
        log_f = 0.5 * (0.5 * (squares[..., 0] + squares[..., 1]) / squares[..., 2].clamp_min(1e-30)).clamp(1e-6, 1e6).log()
    else:
        log_f = log1[..., None].expand(b, k, v)
    shrink = torch.stack(((-log_f).exp(), (-log_f).exp(), torch.ones_like(log_f)), -1)
    M = blocks * shrink[..., None]
    g2 = departure(M).square().sum(-1)
    low, high = (torch.tensor(f, dtype=P.dtype, device=P.device).log() for f in FOCAL_RANGE)
    loss = g2 / (g2 + _SCALE**2) + (determinant_3x3(M) < 0).to(P.dtype) + ((log_f < low) | (log_f > high)).to(P.dtype)
    total = (torch.nan_to_num(loss, 3.0) * present[:, None]).sum(-1)
    # Points on both sides of the plane at infinity cannot all have been seen.
    side = (torch.cat((p, torch.ones_like(p[..., :1])), -1) @ X.mT).sign()
    share = (side * seen[:, None]).sum(-1).abs() / seen.sum(-1, keepdim=True).clamp_min(1)
    return total + (1 - share) * v, log_f, p
