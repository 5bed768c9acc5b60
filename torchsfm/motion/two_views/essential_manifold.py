"""Newton steps on the manifold of essential matrices within a four-dimensional space, the batch in the last dimension."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.kernel import kernel
from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.motion.two_views.five_points import back_substitute, gone_round, longest, normalised, products_of_minors


def combine(u: Float[Tensor, "4 roots"], basis: Float[Tensor, "4 9 roots"]) -> Float[Tensor, "9 roots"]:
    """The matrix with coordinates u in the basis."""
    return combine_rows(basis, u)


def left_null(C: Float[Tensor, "3 3 *batch"]) -> Float[Tensor, "3 *batch"]:
    """The unit vector u of a matrix s u v', from its longest column."""
    return normalised(longest(add_rows((C * C).unbind(0)).unbind(0), C.unbind(1)))


def polish(u: Float[Tensor, "4 roots"], basis: Float[Tensor, "4 9 roots"]) -> tuple[Tensor, Tensor]:
    """One Newton step on the essential manifold within the null space, and how far the start was from the manifold.

    With u3' E = 0 and u1, u2 orthogonal to u3, E is essential if det E = 0, u1' E E' u1 = u2' E E' u2 and u1' E E' u2 = 0.
    The gradients are the cofactors, u1 v1' - u2 v2' and u1 v2' + u2 v1', where v = E' u: a form f of degree n with gradient g
    asks for g' E_new = (1 - 1 / n) g' E. Three linear equations in (x, y, z, w) remain: the solution is their 4D cross product.
    """
    E = combine(u, basis).view(3, 3, -1)
    C = products_of_minors(gone_round(E))
    u3 = left_null(C)
    # A frame around u3 without branches (Duff et al. 2017).
    x, y, z = u3.unbind(0)
    one = torch.copysign(torch.ones_like(z), z)
    b = (one + z).reciprocal_().neg_()
    a = x * b
    b *= y
    ax = one * a
    frame = torch.stack((torch.addcmul(torch.ones_like(z), ax, x), a * y, ax * y, torch.addcmul(one, y, b), -one * x, -y)).view(
        3, 2, -1
    )
    rows = E.unbind(0)
    v = rows[0] * frame[0, :, None]
    v.addcmul_(rows[1], frame[1, :, None])
    v.addcmul_(rows[2], frame[2, :, None])
    u1, u2 = frame[:, 0, None], frame[:, 1, None]
    v1, v2 = v.unbind(0)
    normals = E.new_empty(3, 3, 3, E.shape[-1])
    normals[0] = C
    torch.mul(u1, v1, out=normals[1]).addcmul_(u2, v2, value=-1)
    torch.mul(u1, v2, out=normals[2]).addcmul_(u2, v1)
    products = combine_rows(normals.view(3, 9, 1, -1).unbind(1), basis.unbind(1))
    values = combine_rows(products.unbind(1), u.unbind(0))
    values *= values.new_tensor([2 / 3, 0.5, 0.5])[:, None]
    products.addcmul_(values[:, None], u, value=-1)
    p, q, r = products.unbind(0)
    p0, p1, p2, p3 = p
    q0, q1, q2, q3 = q
    r0, r1, r2, r3 = r
    m01, m02, m03 = (p0 * q[1:]).addcmul_(p[1:], q0, value=-1)
    m12, m13 = (p1 * q[2:]).addcmul_(p[2:], q1, value=-1)
    m23 = (p2 * q3).addcmul_(p3, q2, value=-1)
    new = torch.empty_like(u)
    torch.mul(m12, r3, out=new[0]).addcmul_(m13, r2, value=-1).addcmul_(m23, r1)
    torch.mul(m03, r2, out=new[1]).addcmul_(m02, r3, value=-1).addcmul_(m23, r0, value=-1)
    torch.mul(m01, r3, out=new[2]).addcmul_(m03, r1, value=-1).addcmul_(m13, r0)
    torch.mul(m02, r1, out=new[3]).addcmul_(m01, r2, value=-1).addcmul_(m12, r0, value=-1)
    return normalised(new), values.abs_().amax(0).mul_(2**0.5)


@kernel(chunk=1 << 20)
def from_roots(rows: Tensor, s: Tensor, t: Tensor, basis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A Newton step from the solution for each root s / t of the determinant: the coordinates, E, and the error before."""
    u, error = polish(back_substitute(rows, s, t), basis)
    return u, combine(u, basis), error
