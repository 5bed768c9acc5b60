"""All poses of a camera that sees one known ellipse as a given conic.

A plane with unit normal N cuts an ellipse from the cone `d'Cd = 0` of the rays, whose semi-axes are as 1 / sqrt(p) to
1 / sqrt(q), where p >= q > 0 are the eigenvalues of C restricted to the plane. These lie between the eigenvalues of C,
`a >= p >= b >= q >= c`, and any such pair belongs to a plane: the square of N along the first eigenvector of C is
`(a - p)(a - q) / ((a - b)(a - c))`, and so on. The ratio p / q is known, which leaves a curve of planes with q as its
parameter; size, place and, but for the symmetries of an ellipse, the turn in the plane follow.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg import adjugate_3x3, cross, eigh
from torchsfm.linalg.constants import Constant

_ALONG = 16
"""Poses on each quarter of the curve."""
_ROUND = 1e-4
"""Ratios of eigenvalues nearer to 1 are taken for this: the turn of a circle is free, and all turns are then on the curve."""
_AXES = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
_FLIPS = Constant(_AXES)
"""Of the axes of an ellipse."""
_SIGNS = Constant(torch.nn.functional.pad(_AXES, (1, 0), value=1.0))
"""Of a normal, which has none of its own."""


def ellipse_poses(
    c: Float[Tensor, "batch 2"],
    D: Float[Tensor, "batch 2 2"],
    c0: Float[Tensor, "batch 2"],
    D0: Float[Tensor, "batch 2 2"],
) -> tuple[Float[Tensor, "batch 4 16 4 3 3"], Float[Tensor, "batch 4 16 4 3"]]:
    """R and t from which an ellipse of the plane z = 0, of centre c0 and shape D0, looks like that of centre c and shape D.

    Four pieces of the curve, by the signs of the normal; sixteen places along each; the four symmetries of the ellipse, two of
    which show its other side. A circle is taken for an ellipse that is not quite round.
    """
    corner = torch.nn.functional.pad(c, (0, 1), value=1.0)
    flat = torch.nn.functional.pad(D, (0, 1, 0, 1))
    values, axes, _ = eigh(-adjugate_3x3(corner[..., :, None] * corner[..., None, :] - flat))
    low, middle, high = (values[..., None] / values[..., 1:2, None]).unbind(-2)
    high = high.clamp_min((1 + _ROUND) ** 2)
    shape, turn, _ = eigh(D0)
    ratio = (shape[..., 1:] / shape[..., :1]).clamp_min(1 + _ROUND)
    # q runs to and fro between its limits, where one coordinate of the normal changes its sign.
    begin, end = 1 / ratio, torch.minimum(torch.ones_like(high), high / ratio)
    angle = (torch.arange(_ALONG, dtype=c.dtype, device=c.device) + 0.5) * (math.pi / _ALONG)
    q = begin + 0.5 * (end - begin) * (1 - angle.cos())
    p = ratio * q
    C = torch.stack((low, middle, high), -1)
    below, above, whole = low - middle, middle - high, low - high
    gaps = torch.stack((below * whole, -below * above, whole * above), -1)
    off_p, off_q = C - p[..., None], C - q[..., None]
    N = _SIGNS.on(c.device, c.dtype)[:, None] * (off_p * off_q / gaps).clamp_min(0.0).sqrt()[:, None]
    major, N = (v / torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in (N / off_q[:, None], N))
    height = -(N.square() / C[:, None]).sum(-1, keepdim=True)
    centre = (N / C[:, None]) * (shape[:, None, None, 1:] * q[:, None, :, None] / height.clamp_min(1e-300)).sqrt()
    to_camera = axes.mT[:, None, None]
    centre, major, minor = ((v[..., None, :] @ to_camera)[..., 0, :] for v in (centre, major, cross(N, major)))
    centre = torch.where(centre[..., 2:] < 0, -centre, centre)
    across = (
        _FLIPS.on(c.device, c.dtype)[:, None] * torch.stack((minor, major), -1)[..., None, :, :] @ turn.mT[:, None, None, None]
    )
    R = torch.cat((across, cross(across[..., 0], across[..., 1])[..., None]), -1)
    return R, centre[..., None, :] - (across @ c0[:, None, None, None, :, None])[..., 0]
