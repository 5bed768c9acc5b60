"""By how much two rotations differ from a relative one, with first and second derivatives.

Rotations a and b from cameras to the world are turned by steps there, `exp(w) a`, so that `b' a` gets the factor `exp(y)` on
the left with `y = b' (w_a - w_b - w_b x w_a / 2)` to second order. With `log(exp(y) exp(e)) = e + J y + Q(y, y) / 2` the second
derivative of the logarithm along a way of constant y is that of J: `e'' = (dJ/de [J y]) y`. All is computed entry by entry,
edges last: a product of many small matrices by the library takes five times as long.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import rotvec_from_rotation
from torchsfm.optim.curvature import product

SMALL = 1e-3
"""Squared angles up to which series do; closed forms cancel there."""


def residual(a: Tensor, b: Tensor, R: Tensor, W: Tensor) -> Tensor:
    """The whitened rotation vector of `b' a R'`, of rotations a and b from the cameras to the world."""
    return _whitened(W, _difference(a, b, R)).mT


def linearize(a: Tensor, b: Tensor, R: Tensor, W: Tensor, *, out: list[Tensor | None]) -> Tensor:
    """The same, and its derivatives by turns of both cameras."""
    e = _difference(a, b, R)
    turned = product(product(W.permute(1, 2, 0), _turn_slope(e)[0]), _rows(b).transpose(0, 1)).permute(2, 0, 1)
    if out[0] is not None:
        out[0].copy_(turned)
    if out[1] is not None:
        torch.neg(turned, out=out[1])
    return _whitened(W, e).mT


def bend(
    a: Tensor, b: Tensor, R: Tensor, W: Tensor, *, by: Float[Tensor, "3 m"], wanted: Sequence[bool]
) -> Float[Tensor, "n n m"]:
    """The second derivatives of `by . residual` by turns of the wanted ones of both cameras; those above the diagonal count."""
    e = _difference(a, b, R)
    J, c, slope = _turn_slope(e)
    h = (W.permute(1, 2, 0) * by[:, None]).sum(0)
    inner, square, eye = (e * h).sum(0), (e * e).sum(0), torch.eye(3, dtype=e.dtype, device=e.device)[:, :, None]
    # h . (dJ/de [J y]) y = y'N y, with [h]x[e]x = e h' - (e . h) I and J'e = e.
    outer = e[:, None] * h
    G = 0.5 * _cross(h) - c * (2 * outer - outer.transpose(0, 1) - inner * eye)
    N = product(J.transpose(0, 1), G) + 2 * slope * e[:, None] * (inner * e - square * h)
    back = _rows(b)
    along = product(product(back, 0.5 * (N + N.transpose(0, 1))), back.transpose(0, 1))
    if not all(wanted):
        return along
    pulled = product(J.transpose(0, 1), h[:, None])
    twist = 0.5 * _cross(product(back, pulled)[:, 0])
    return torch.cat((torch.cat((along, -along - twist), 1), torch.cat((-along + twist, along), 1)), 0)


def _difference(a: Tensor, b: Tensor, R: Tensor) -> Float[Tensor, "3 m"]:
    """The rotation vector of `b' a R'`."""
    turn = product(product(_rows(b).transpose(0, 1), _rows(a)), R.permute(2, 1, 0))
    return rotvec_from_rotation(turn.permute(2, 0, 1)).mT.contiguous()


def _rows(a: Float[Tensor, "m 9"]) -> Float[Tensor, "3 3 m"]:
    """Matrices, their number last."""
    return a.mT.reshape(3, 3, -1)


def _whitened(W: Float[Tensor, "m 3 3"], e: Float[Tensor, "3 m"]) -> Float[Tensor, "3 m"]:
    return (W.permute(1, 2, 0) * e).sum(1)


def _cross(v: Float[Tensor, "3 m"]) -> Float[Tensor, "3 3 m"]:
    """The cross product with v as a matrix."""
    zero = torch.zeros_like(v[0])
    return torch.stack((zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero)).view(3, 3, -1)


def _turn_slope(e: Float[Tensor, "3 m"]) -> tuple[Float[Tensor, "3 3 m"], Float[Tensor, "m"], Float[Tensor, "m"]]:
    """J of `log(exp(y) exp(e)) = e + J y`, `J = I - [e]x / 2 + c [e]x^2`; c, and its derivative by the square of e."""
    square = (e * e).sum(0)
    small = square < SMALL
    safe = torch.where(small, 1.0, square)
    half = 0.5 * safe.sqrt()
    sine = half.sin()
    cot = half.cos() / sine
    c = torch.where(small, 1 / 12 + square * (1 / 720 + square * (1 / 30240 + square / 1209600)), (1 - half * cot) / safe)
    falls = (cot / half - 1 / (sine * sine)) / 8
    slope = torch.where(small, 1 / 720 + square * (1 / 15120 + square / 403200), -(falls + c) / safe)
    J = c * e[:, None] * e - 0.5 * _cross(e)
    J.view(9, -1)[::4] += 1 - c * square
    return J, c, slope
