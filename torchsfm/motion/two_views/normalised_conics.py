"""Dual conics as six numbers with covariances, in images that are moved and scaled to them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.geometry import to_homogeneous
from torchsfm.geometry.conic_distance import root_slopes, square_root
from torchsfm.geometry.conics import ellipse_of_shape, shape_of_dual_conic
from torchsfm.geometry.quadrics import dual_of_shape
from torchsfm.linalg import adjugate_3x3, inverse, unit_scale

_POINTS = 16
"""Edge points, one pixel off, that a conic is taken to come from if its covariance is not given."""


@dataclass(frozen=True)
class NormalisedConics:
    """One image, moved and scaled to the ellipses in it."""

    T: Tensor
    c: Tensor
    S: Tensor
    x: Tensor
    ellipse: Tensor


def normalised_conics(C: Tensor, covariance: Tensor | None, seen: Tensor, x: Tensor, broken: Tensor) -> NormalisedConics:
    """Move and scale each image so that its ellipses and points lie about the origin at distance sqrt(2)."""
    centre, D, ellipse = shape_of_dual_conic(adjugate_3x3(C * unit_scale(C)))
    with torch.no_grad():
        w = (seen & ellipse).to(C.dtype)[..., None]
        total = w.sum(-2).clamp_min(1)
        middle = (w * centre).sum(-2) / total
        square = (w[..., 0] * ((centre - middle[..., None, :]).square().sum(-1) + D.diagonal(dim1=-2, dim2=-1).sum(-1))).sum(-1)
        scale = (2 / (square / total[..., 0]).clamp_min(1e-300)).sqrt()
        usual = (scale > 1e-30) & (scale < 1e30)
        scale, middle = torch.where(usual, scale, 1.0), torch.where(usual[..., None], middle, 0.0)
    zero, one = torch.zeros_like(scale), torch.ones_like(scale)
    rows = (scale, zero, -scale * middle[..., 0]), (zero, scale, -scale * middle[..., 1]), (zero, zero, one)
    T = torch.stack([torch.stack(row, -1) for row in rows], -2)
    centre, D = scale[..., None, None] * (centre - middle[..., None, :]), scale.square()[..., None, None, None] * D
    with torch.no_grad():
        root = square_root(D)
        S5 = _five(centre, D, covariance, scale)
        J = _six_by_five(centre.detach(), root.detach())
        S6 = J @ S5 @ J.mT
    x = torch.where(broken[..., None, None], 0.0, x)
    return NormalisedConics(T, _six(dual_of_shape(centre, D)), S6, to_homogeneous(x) @ T.mT, ellipse & usual[..., None])


def _five(centre: Tensor, D: Tensor, covariance: Tensor | None, scale: Tensor) -> Tensor:
    """The covariance of centre and root of the shape, S11, S12, S22."""
    root = square_root(D)
    unit = scale.square()[..., None, None, None]
    if covariance is None:
        t = torch.arange(_POINTS, dtype=D.dtype, device=D.device) * (2 * torch.pi / _POINTS)
        q = torch.stack((t.cos(), t.sin()), -1).expand(*D.shape[:-2], _POINTS, 2)
        n = torch.linalg.solve_ex(root[..., None, :, :], q[..., None])[0][..., 0]
        n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
        J = root_slopes(n, q)
        information = J.mT @ J
        eye = torch.eye(5, dtype=D.dtype, device=D.device)
        return unit * inverse(information + 1e-12 * eye)[0]
    e = ellipse_of_shape(centre, D / unit)
    a, b = e.semi_axes.unbind(-1)
    cos, sin = e.angle.cos(), e.angle.sin()
    turn = torch.maximum(a - b, 1e-9 * a)
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    rows = [
        [one, zero, zero, zero, zero],
        [zero, one, zero, zero, zero],
        [zero, zero, cos * cos, sin * sin, -2 * turn * cos * sin],
        [zero, zero, cos * sin, -cos * sin, turn * (cos * cos - sin * sin)],
        [zero, zero, sin * sin, cos * cos, 2 * turn * cos * sin],
    ]
    G = torch.stack([torch.stack(row, -1) for row in rows], -2)
    return unit * (G @ covariance @ G.mT)


def _six_by_five(c: Tensor, S: Tensor) -> Tensor:
    """The derivative of the dual conic's six numbers by centre and root."""
    columns = []
    for k in range(5):
        dc, dS = torch.zeros_like(c), torch.zeros_like(S)
        if k < 2:
            dc[..., k] = 1
        else:
            i, j = ((0, 0), (0, 1), (1, 1))[k - 2]
            dS[..., i, j] = dS[..., j, i] = 1
        outer = dc[..., :, None] * c[..., None, :]
        top = torch.cat((dS @ S + S @ dS - outer - outer.mT, -dc[..., None]), -1)
        bottom = torch.nn.functional.pad(-dc, (0, 1))
        columns.append(_six(torch.cat((top, bottom[..., None, :]), -2)))
    return torch.stack(columns, -1)


def _six(M: Tensor) -> Tensor:
    return torch.stack([M[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], -1)


def conic_of_six(c: Tensor) -> Tensor:
    """The symmetric matrix whose upper triangle is given row by row."""
    a, b, d, e, f, g = c.unbind(-1)
    return torch.stack([torch.stack(row, -1) for row in ((a, b, d), (b, e, f), (d, f, g))], -2)
