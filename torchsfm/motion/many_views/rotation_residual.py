"""By how much two rotations differ from a relative one, with first and second derivatives.

Rotations a and b from cameras to the world are turned by steps there, `exp(w) a`, so that `b' a` gets the factor `exp(y)` on
the left with `y = b' (w_a - w_b - w_b x w_a / 2)` to second order. With `log(exp(y) exp(e)) = e + J y + Q(y, y) / 2` the second
derivative of the logarithm along a way of constant y is that of J: `e'' = (dJ/de [J y]) y`.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import cross_matrix, rotvec_from_rotation

SMALL = 1e-3
"""Squared angles up to which series do; closed forms cancel there."""


def residual(a: Tensor, b: Tensor, R: Tensor, W: Tensor) -> Tensor:
    """The whitened rotation vector of `b' a R'`, of rotations a and b from the cameras to the world."""
    e = rotvec_from_rotation(b.reshape(-1, 3, 3).mT @ a.reshape(-1, 3, 3) @ R.mT)
    return (W @ e[..., None])[..., 0]


def linearize(a: Tensor, b: Tensor, R: Tensor, W: Tensor, *, out: list[Tensor | None]) -> Tensor:
    """The same, and its derivatives by turns of both cameras."""
    back = b.reshape(-1, 3, 3).mT
    e = rotvec_from_rotation(back @ a.reshape(-1, 3, 3) @ R.mT)
    turned = W @ _turn_slope(e)[0] @ back
    if out[0] is not None:
        out[0].copy_(turned)
    if out[1] is not None:
        out[1].copy_(-turned)
    return (W @ e[..., None])[..., 0]


def bend(
    a: Tensor, b: Tensor, R: Tensor, W: Tensor, *, by: Float[Tensor, "3 m"], wanted: Sequence[bool]
) -> Float[Tensor, "n n m"]:
    """The second derivatives of `by . residual` by turns of the wanted ones of both cameras; those above the diagonal count."""
    b = b.reshape(-1, 3, 3)
    e = rotvec_from_rotation(b.mT @ a.reshape(-1, 3, 3) @ R.mT)
    J, c, slope = _turn_slope(e)
    h = W.mT @ by.mT[..., None]
    E, H = cross_matrix(e), cross_matrix(h[..., 0])
    HE = H @ E
    # h . (dJ/de [J y]) y, with J'e = e.
    N = J.mT @ (0.5 * H - c * (2 * HE - E @ H)) + 2 * slope * e[..., None] * (E @ (E @ h)).mT
    along = b @ (N + N.mT) @ b.mT / 2
    twist = 0.5 * cross_matrix((b @ J.mT @ h)[..., 0])
    whole = torch.cat((torch.cat((along, -along - twist), -1), torch.cat((-along + twist, along), -1)), -2)
    chosen = torch.tensor([k for k in range(6) if wanted[k // 3]], device=e.device)
    return whole[:, chosen[:, None], chosen].movedim(0, -1).contiguous()


def _turn_slope(e: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 1 1"], Float[Tensor, "m 1 1"]]:
    """J of `log(exp(y) exp(e)) = e + J y`, `J = I - [e]x / 2 + c [e]x^2`; c, and its derivative by the square of e."""
    square = (e * e).sum(-1)[:, None, None]
    small = square < SMALL
    safe = torch.where(small, 1.0, square)
    half = 0.5 * safe.sqrt()
    cot = half.cos() / half.sin()
    c = torch.where(small, 1 / 12 + square * (1 / 720 + square * (1 / 30240 + square / 1209600)), (1 - half * cot) / safe)
    falls = (cot / half - 1 / half.sin().square()) / 8
    slope = torch.where(small, 1 / 720 + square * (1 / 15120 + square / 403200), -(falls + c) / safe)
    cross = cross_matrix(e)
    eye = torch.eye(3, dtype=e.dtype, device=e.device)
    return eye - 0.5 * cross + c * (cross @ cross), c, slope
