"""Distances of the ends of segments from images of Pluecker lines, one problem a line, lines first."""

import torch
from torch import Tensor

from torchsfm.geometry.line_manifold import line_tangents
from torchsfm.linalg import adjugate_3x3, cross

_POINT = 1e-9
"""Length of an image line, over those of the line and of its projection, that is rounding."""


def line_forms(P: Tensor) -> Tensor:
    """The matrices (*batch, 3, 6) that take Pluecker vectors to image lines, of size 1 whatever the rows of the cameras are."""
    M, p = P[..., :3], P[..., 3]
    direct = torch.stack([cross(p, column) for column in M.unbind(-1)], -1)
    forms = torch.cat((direct, adjugate_3x3(M).mT), -1)
    return forms / forms.detach().abs().amax((-2, -1), keepdim=True).clamp_min(1e-300)


def through_centre(l: Tensor, line: Tensor, projections: Tensor) -> Tensor:  # noqa: E741
    """Whether lines pass through the centres of views, but for rounding: what is seen of them is then a point (*batch, v).

    Args:
        l: Their images (*batch, v, 3).
        line: The lines (*batch, 6).
        projections: The matrices (*#batch, v, 3, 6) between them.
    """
    size = projections.square().sum((-2, -1)) * line.square().sum(-1, keepdim=True)
    return l.square().sum(-1) <= _POINT**2 * size


def image_rows(forms: Tensor, ends: Tensor) -> Tensor:
    """What gives of a Pluecker vector e1'l, e2'l, l1, l2 for its image l and homogeneous ends e (*batch, v, 4, 6)."""
    return torch.cat((ends @ forms, forms[..., :2, :]), -2)


def residuals(line: Tensor, rows: Tensor) -> Tensor:
    """Signed distances (n, v, 2) of the ends of segments from images of lines, in pixels."""
    l = _images(rows, line[..., None])[..., 0]  # noqa: E741
    scale = l[..., 2:].square().sum(-1, keepdim=True).clamp_min(1e-200).rsqrt()
    return l[..., :2] * scale


def linearize(line: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The residuals and their derivatives (n, v, 2, 4) along the tangents of `Line3D`."""
    return slopes_along(line, line_tangents(line), rows)


def slopes_along(line: Tensor, tangents: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The residuals (*batch, v, 2) and their derivatives (*batch, v, 2, k) along tangents (*batch, 6, k) of lines."""
    l = _images(rows, torch.cat((line[..., None], tangents), -1))  # noqa: E741
    first, second = l[..., 2:3, :], l[..., 3:, :]
    l1, l2 = first[..., :1], second[..., :1]
    scale = (l1 * l1 + l2 * l2).clamp_min(1e-200).rsqrt()
    r = l[..., :2, :1] * scale
    stretch = (l1 * first[..., 1:] + l2 * second[..., 1:]) * (scale * scale)
    return r[..., 0], l[..., :2, 1:] * scale - r * stretch


def _images(rows: Tensor, vectors: Tensor) -> Tensor:
    """Rows (*batch, v, 4, 6) times columns (*batch, 6, k): one product for all views."""
    product = rows.flatten(-3, -2) @ vectors
    return product.reshape(*product.shape[:-2], *rows.shape[-3:-1], product.shape[-1])


def in_world(line: Tensor, origin: Tensor, unit: Tensor) -> Tensor:
    """Lines (n, 6) of the frame as lines of the world, of unit direction."""
    d = line[..., :3]
    L = torch.cat((d, unit[..., None] * line[..., 3:] + cross(origin, d)), -1)
    size = d.square().sum(-1, keepdim=True)
    return L * torch.where(size > 0, torch.where(size > 0, size, 1.0).rsqrt(), 0.0)
