"""Newton's method for an essential matrix among the combinations of three matrices, with the focal length of both cameras."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.rows import add_rows, combine_rows


class Roots(NamedTuple):
    """Solutions one after the other, in the last dimension."""

    u: Tensor
    """(x, y, z), of length 1."""
    g: Tensor
    """1 / f."""
    error: Tensor
    """Distance from the essential matrices before the last Newton step."""
    step: Tensor
    """Length of that step, in u and in log g."""
    slope: Tensor
    """Of the three conditions, in the direction in which they change least."""


def with_focal(basis: Float[Tensor, "3 9 roots"], g: Float[Tensor, " roots"]) -> Float[Tensor, "3 9 roots"]:
    """D F D with D = diag(1, 1, g): the matrices between rays (x / f, 1), times g, for g = 1 / f."""
    one = torch.ones_like(g)
    return basis * torch.stack((one, one, g, one, one, g, g, g, g * g))


def newton_step(u: Tensor, g: Tensor, basis: Tensor) -> Roots:
    """A Newton step on the three conditions of an essential matrix in (x, y, z) and log g.

    Around E = U diag(1, 1, 0) V' the manifold's normal space is spanned by u3 v3', u1 v1' - u2 v2' and u1 v2' + u2 v1'. They
    are linear in (x, y, z) and the change of log g: four homogeneous unknowns.
    """
    scaled = with_focal(basis, g)
    e = combine_rows(scaled, u)
    f = combine_rows(basis, u)
    zero = torch.zeros_like(g)
    slope = g * torch.stack((zero, zero, f[2], zero, zero, f[5], f[6], f[7], 2 * g * f[8]))
    size = combine_rows(e, e).rsqrt()
    columns = (torch.cat((scaled, slope[None])) * size).view(4, 3, 3, -1)
    p, q, r = _normal_products(e.view(3, 3, -1) * size, columns)
    weights = (*u.unbind(0), zero)
    error = torch.stack([combine_rows(row, weights).abs() for row in (p, q, r)]).amax(0)
    p0, p1, p2, p3 = p
    q0, q1, q2, q3 = q
    r0, r1, r2, r3 = r
    m01, m02, m03 = p0 * q1 - p1 * q0, p0 * q2 - p2 * q0, p0 * q3 - p3 * q0
    m12, m13, m23 = p1 * q2 - p2 * q1, p1 * q3 - p3 * q1, p2 * q3 - p3 * q2
    x, y, z = m12 * r3 - m13 * r2 + m23 * r1, m03 * r2 - m02 * r3 - m23 * r0, m01 * r3 - m03 * r1 + m13 * r0
    change = m02 * r1 - m01 * r2 - m12 * r0
    new = torch.stack((x, y, z))
    square = combine_rows(new, new)
    along = combine_rows(new, u)
    ratio = change / along
    # Never so far that the sign of f changes.
    g = g * (1 + ratio.clamp(-0.6, 1.5))
    new = new * square.rsqrt() * torch.sign(along)
    step = torch.maximum(ratio.abs(), add_rows((new - u).abs().unbind(0)))
    # The product of the three principal slopes is a volume; that of the greater two is about the largest area.
    area = torch.stack([_area(a, b) for a, b in ((p, q), (q, r), (r, p))]).amax(0)
    return Roots(new, g, error, step, ((square + change * change) / area).sqrt())


def _area(a: Tensor, b: Tensor) -> Tensor:
    """The squared area between two vectors given by their coordinates; not less than rounding may make of 0."""
    most = combine_rows(a, a) * combine_rows(b, b)
    return torch.maximum(most - combine_rows(a, b) ** 2, 1e-15 * most)


def _normal_products(e: Float[Tensor, "3 3 roots"], columns: Float[Tensor, "4 3 3 roots"]) -> tuple[Tensor, Tensor, Tensor]:
    """The three normals of the essential manifold at the point nearest to e, times four matrices."""
    cofactors = torch.stack((_cross(e[1], e[2]), _cross(e[2], e[0]), _cross(e[0], e[1])))
    squares = cofactors * cofactors
    i, j = add_rows(squares.unbind(1)).max(0).indices, add_rows(squares).max(0).indices
    v3 = _normalised(cofactors.gather(0, i.expand(1, 3, -1))[0])
    u3 = _normalised(cofactors.gather(1, j.expand(3, 1, -1))[:, 0])
    # A frame around u3 without branches (Duff et al. 2017).
    sign = torch.copysign(torch.ones_like(u3[2]), u3[2])
    a = -1 / (sign + u3[2])
    b = u3[0] * u3[1] * a
    u1 = (1 + sign * u3[0] * u3[0] * a, sign * b, -sign * u3[0])
    u2 = (b, sign + u3[1] * u3[1] * a, -u3[1])
    v1 = combine_rows(e, u1)
    v1 = _normalised(v1 - v3 * combine_rows(v1, v3))
    v2 = _cross(v3, v1)
    v2 = v2 * torch.copysign(torch.ones_like(sign), combine_rows(combine_rows(e, u2), v2))
    by_column = columns.permute(2, 1, 0, 3)
    Bv1, Bv2, Bv3 = (combine_rows(by_column, v) for v in (v1, v2, v3))
    return (
        combine_rows(Bv3, u3),
        combine_rows(Bv1, u1) - combine_rows(Bv2, u2),
        combine_rows(Bv2, u1) + combine_rows(Bv1, u2),
    )


def _normalised(v: Tensor) -> Tensor:
    return v * combine_rows(v, v).rsqrt()


def _cross(a: Tensor | tuple[Tensor, ...], b: Tensor | tuple[Tensor, ...]) -> Tensor:
    a0, a1, a2 = a
    b0, b1, b2 = b
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))
