"""Known points and lines as a camera sees them, in one table: distances in the image and Gauss-Newton steps on them.

A row is a point or a line. In the image it has the four numbers of a segment's ends, or of the point twice; in the world the
six of a Pluecker vector (d, m), |d| = 1, or the point and zeros; and it says which. With P = [M | p] and c = M X or M d, a
point is seen at `c + p`, a line as `cof(M) m + p x c`. Two distances belong to each row: the coordinates of the point from its
image, the ends of the segment from the line's image.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.geometry.image_distance import positive_depth, squared_in_front
from torchsfm.linalg import cross, damped_solve
from torchsfm.robust import Weigh

POINT, SEGMENT, LINE = 0, 1, 2
"""What a row is; the ends of a `LINE` do not say which part of it is seen."""


class Sight(NamedTuple):
    """What cameras see of a table, coordinates in front of the rows of the table."""

    M: Float[Tensor, "*batch 3 3"]
    p: Float[Tensor, "*batch 3 1"]
    cofactors: Float[Tensor, "*batch 3 3"]
    line: Tensor
    """Which rows are lines (*#batch, 1, n)."""
    image: Float[Tensor, "*batch 3 n"]
    """Homogeneous point or line."""
    scale: Float[Tensor, "*batch 1 n"]
    """One over the depth of a point, or over the length of a line's normal."""
    distance: Float[Tensor, "*batch 2 n"]
    depth: Float[Tensor, "*batch 1 n"]
    """Has the sign of the depth of the point, or of what is seen of the line in the middle of the segment."""


def look(
    P: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 4"], X: Float[Tensor, "*#batch n 6"],
    kind: Float[Tensor, "*#batch n 1"],
) -> Sight:  # fmt: skip
    """What cameras see of rows."""
    M, p = P[..., :3], P[..., 3:]
    cofactors = torch.stack([cross(M[..., (i + 1) % 3, :], M[..., (i + 2) % 3, :]) for i in range(3)], -2)
    x, kind = x.mT, kind.mT
    line = kind > 0.5 * SEGMENT
    c, normal = _product(M, X[..., :3].mT), _product(cofactors, X[..., 3:].mT)
    image = torch.where(line, normal + _cross(p, c), c + p)
    middle = 0.5 * (x[..., :2, :] + x[..., 2:, :])
    # The point of the line on the ray of an image point h has the depth det(image, h, c) / |h x c|^2.
    u, v = middle[..., :1, :], middle[..., 1:, :]
    c1, c2, c3 = c[..., :1, :], c[..., 1:2, :], c[..., 2:, :]
    first, second, third = image[..., :1, :], image[..., 1:2, :], image[..., 2:, :]
    ahead = first * (v * c3 - c2) + second * (c1 - u * c3) + third * (u * c2 - v * c1)
    depth = torch.where(line, torch.where(kind > 0.5 * (SEGMENT + LINE), 1.0, ahead), third)
    z, _ = positive_depth(third)
    square = first * first + second * second
    scale = torch.where(line, square.clamp_min(torch.finfo(square.dtype).tiny ** 0.8).rsqrt(), 1 / z)
    ends = [first * x[..., i : i + 1, :] + second * x[..., i + 1 : i + 2, :] + third for i in (0, 2)]
    moved = torch.where(line, torch.cat(ends, -2), image[..., :2, :]) * scale
    return Sight(M, p, cofactors, line, image, scale, torch.where(line, moved, moved - x[..., :2, :]), depth)


def squared_distance(sight: Sight) -> Float[Tensor, "*batch n"]:
    """The sum of the squares of both distances; infinite behind the camera."""
    z, _ = positive_depth(sight.depth)
    e = sight.distance
    return squared_in_front(e[..., :1, :], e[..., 1:, :], sight.depth, z)[..., 0, :]


def slopes(
    sight: Sight, x: Float[Tensor, "*#batch n 4"], X: Float[Tensor, "*#batch n 6"]
) -> tuple[Float[Tensor, "*batch 6 n"], Float[Tensor, "*batch 6 n"]]:
    """The derivatives of both distances by (w, v), the world moved by exp(w) X + v before the camera."""
    x, X = x.mT, X.mT
    y, e, s = sight.image, sight.distance, sight.scale
    zero, one = torch.zeros_like(s), torch.ones_like(s)
    X1, X2 = X[..., :3, :], X[..., 3:, :]
    found = []
    for i in (0, 1):
        end = torch.cat((x[..., 2 * i : 2 * i + 2, :].expand(*s.shape[:-2], 2, s.shape[-1]), one), -2)
        across = torch.cat((y[..., :2, :] * s, zero), -2)
        # By the image, which is the point or the line.
        of_line = (end - e[..., i : i + 1, :] * across) * s
        of_point = torch.cat((*((one, zero) if i == 0 else (zero, one)), -y[..., i : i + 1, :] * s), -2) * s
        g = torch.where(sight.line, of_line, of_point)
        A = sight.cofactors.mT @ g
        B = sight.M.mT @ torch.where(sight.line, _cross(g, sight.p), g)
        turn = _cross(X1, B) + _cross(X2, A)
        found.append(torch.cat((turn, torch.where(sight.line, _cross(X1, A), B)), -2))
    return found[0], found[1]


def sight_step(
    P: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 4"], X: Float[Tensor, "*#batch n 6"],
    kind: Float[Tensor, "*#batch n 1"], weigh: Weigh,
) -> tuple[Float[Tensor, "b 6 1"], torch.Size]:  # fmt: skip
    """The step (w, v) of cameras P exp(w, v), and the batch that b stands for."""
    sight = look(P, x, X, kind)
    weights, curvature = (w[..., None, :] for w in weigh(squared_distance(sight)))
    J = torch.cat(slopes(sight, x, X), -1)
    batch = broadcast_shapes(J.shape[:-2], weights.shape[:-2])
    weights, curvature = (torch.cat((w, w), -1) for w in (weights, curvature))
    r = torch.cat((sight.distance[..., 0, :], sight.distance[..., 1, :]), -1)[..., None]
    N, g = (J * curvature) @ J.mT, (J * weights) @ r
    N, g = N.double().expand(*batch, 6, 6).reshape(-1, 6, 6), g.double().expand(*batch, 6, 1).reshape(-1, 6, 1)
    return damped_solve(N, -g), batch


def seen_ends(
    P: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 4"], X: Float[Tensor, "*#batch n 6"],
    kind: Float[Tensor, "*#batch n 1"],
) -> tuple[Float[Tensor, "*batch n 3"], Float[Tensor, "*batch n 3"]]:  # fmt: skip
    """Where on the lines the ends of the segments are seen; points twice. Finite always."""
    line = kind > 0.5 * SEGMENT
    d, m = X[..., :3], X[..., 3:]
    foot = cross(d, m)
    c = d @ P[..., :3].mT
    b = foot @ P[..., :3].mT + P[..., None, :, 3]
    ends = []
    for i in (0, 2):
        h = torch.cat((x[..., i : i + 2], torch.ones_like(x[..., :1])), -1).expand(c.shape)
        across = cross(c, h)
        along = -(cross(b, h) * across).sum(-1, keepdim=True) / across.square().sum(-1, keepdim=True)
        ends.append(torch.where(line, (foot + along * d).nan_to_num(0, 0, 0), d))
    return ends[0], ends[1]


def _product(A: Tensor, X: Tensor) -> Tensor:
    """A X; data that several models share are not copied for each."""
    if A.ndim > 3 and X.ndim > 2 and A.shape[-3] > 1 == X.shape[-3]:
        k = A.shape[-3]
        flat = A.reshape(*A.shape[:-3], 3 * k, 3) @ X[..., 0, :, :]
        return flat.reshape(*flat.shape[:-2], k, 3, flat.shape[-1])
    return A @ X


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """The cross product along the last dimension but one."""
    a1, a2, a3 = (a[..., i : i + 1, :] for i in range(3))
    b1, b2, b3 = (b[..., i : i + 1, :] for i in range(3))
    return torch.cat((a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1), -2)
