"""Newton steps on the manifold of essential matrices within a four-dimensional space, the batch in the last dimension."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.compilation import kernel
from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.motion._five_points import back_substitute, cross, longest, normalised


def combine(u: Float[Tensor, "4 roots"], basis: Float[Tensor, "4 9 roots"]) -> Float[Tensor, "9 roots"]:
    return combine_rows(basis, u)


def polish(u: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """One Newton step on the essential manifold within the null space, and how far the start was from the manifold.

    Around E = U diag(1, 1, 0) V' the manifold's normal space is spanned by u3 v3', u1 v1' - u2 v2' and u1 v2' + u2 v1', for any
    u1, u2 and v1 = E' u1, v2 = E' u2. Three linear equations in (x, y, z, w) remain: the solution is their 4D cross product.
    """
    e = combine(u, basis)
    cofactors = torch.stack((cross(e[3:6], e[6:]), cross(e[6:], e[:3]), cross(e[:3], e[3:6])))
    squares = cofactors * cofactors
    v3 = normalised(longest(add_rows(squares.unbind(1)).unbind(0), cofactors.unbind(0)))
    u3 = normalised(longest(add_rows(squares).unbind(0), cofactors.unbind(1)))
    # A frame around u3 without branches (Duff et al. 2017).
    sign = torch.copysign(torch.ones_like(u3[2]), u3[2])
    a = -1 / (sign + u3[2])
    b = u3[0] * u3[1] * a
    u1 = (1 + sign * u3[0] * u3[0] * a, sign * b, -sign * u3[0])
    u2 = (b, sign + u3[1] * u3[1] * a, -u3[1])
    rows = e.view(3, 3, -1)
    v1 = combine_rows(rows, u1)
    v1 = normalised(v1 - v3 * combine_rows(v1, v3))
    v2 = cross(v3, v1)
    v2 = v2 * torch.copysign(torch.ones_like(sign), combine_rows(combine_rows(rows, u2), v2))
    # The normals' products with the basis, by rows of the basis matrices: B v, then u' B v.
    columns = basis.view(4, 3, 3, -1).permute(2, 1, 0, 3)
    Bv1, Bv2, Bv3 = (combine_rows(columns, v) for v in (v1, v2, v3))
    p = combine_rows(Bv3, u3)
    q = combine_rows(Bv1, u1).sub_(combine_rows(Bv2, u2))
    r = combine_rows((*Bv2, *Bv1), (*u1, *u2))
    error = torch.maximum(torch.maximum(*(combine_rows(f, u).abs_() for f in (p, q))), combine_rows(r, u).abs_())
    p0, p1, p2, p3 = p
    q0, q1, q2, q3 = q
    r0, r1, r2, r3 = r
    m01, m02, m03 = p0 * q1 - p1 * q0, p0 * q2 - p2 * q0, p0 * q3 - p3 * q0
    m12, m13, m23 = p1 * q2 - p2 * q1, p1 * q3 - p3 * q1, p2 * q3 - p3 * q2
    x, y, z = m12 * r3 - m13 * r2 + m23 * r1, m03 * r2 - m02 * r3 - m23 * r0, m01 * r3 - m03 * r1 + m13 * r0
    return normalised(torch.stack((x, y, z, m02 * r1 - m01 * r2 - m12 * r0))), error


@kernel(chunk=1 << 20)
def from_roots(x: Tensor, y: Tensor, w: Tensor, s: Tensor, t: Tensor, basis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A Newton step from the solution for each root s / t of the determinant: the coordinates, E, and the error before."""
    u, error = polish(back_substitute(x, y, w, s, t), basis)
    return u, combine(u, basis), error
