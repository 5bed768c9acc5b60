"""Where curves of an image are in the next one, by the motion of what is along them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.images.dense_motion import DenseMotion
from torchsfm.linalg import solve

_WIDE = 5.0
"""Samples around one, by whose motion its own is smoothed: standard deviation."""
_SCALES = (16.0, 8.0, 4.0, 2.0, 2.0, 2.0)
"""Pixels beyond which motions do not count for that, from one round to the next."""
_AGREE = 4.0
"""Pixels, the most, between the motion of a sample and the smoothed one, where it is right, and"""
_SURE = 0.5
"""share of the samples for which it must be."""


def predicted(
    x: Float[Tensor, "k m 2"], motion: DenseMotion, back: bool
) -> tuple[Float[Tensor, "k m 2"], Float[Tensor, "k m 2"], Bool[Tensor, " k"]]:
    """Where samples of curves are in the next image, normals there, and for which curves enough of them are sure and agree.

    Motions along a curve are smoothed by lines through those of neighbours (Cleveland's regression, JASA 1979).
    """
    y, sure = motion.moved(x, back)
    shift, m = y - x, x.shape[1]
    s = torch.arange(m, dtype=x.dtype, device=x.device) - (m - 1) / 2
    rows = torch.stack((torch.ones_like(s), s / _WIDE), -1)
    near = torch.exp(-0.5 * ((s[:, None] - s) / _WIDE).square())
    products = (rows[:, :, None] * rows[:, None, :]).flatten(1)
    slack = torch.diag(torch.tensor([1e-6, 1e-2], dtype=x.dtype, device=x.device))
    weight, smooth = sure.to(x.dtype), shift
    for scale in _SCALES:
        w = near * weight[:, None]
        A = (w @ products).reshape(*w.shape[:-1], 2, 2) + slack
        b = torch.stack([w @ (rows[:, i, None] * shift) for i in range(2)], -2)
        c, _ = solve(A, b)
        smooth = (rows[:, :, None] * c).sum(-2)
        off = torch.linalg.vector_norm(smooth - shift, dim=-1)
        weight = sure / (1 + (off / scale).square()).square()
    agree = (sure & (off < _AGREE)).to(x.dtype).mean(-1) > _SURE
    y = x + smooth
    tangent = torch.nn.functional.normalize(
        torch.cat((y[:, 2:3] - y[:, :1], y[:, 2:] - y[:, :-2], y[:, -1:] - y[:, -3:-2]), 1), dim=-1
    )
    return y, torch.stack((tangent[..., 1], -tangent[..., 0]), -1), agree
