"""Common points of two quadrics and a third surface, of degree two or three, in projective 3-space.

For a fixed ratio z : w the two quadrics are conics in (x, y), and polynomials modulo both are combinations of 1, x, y and xy.
Multiplication by the third form is a 4x4 matrix over this basis, whose determinant is a binary form in z and w, of degree eight
or twelve: it is taken at as many points of the circle as it has coefficients. At its real roots the null vector of the matrix
is (1, x, y, xy). Newton's method on the three forms themselves ends it. All arithmetic has the batch in the last dimension.
"""

import math
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.linalg.constants import Constant
from torchsfm.linalg.portions import portions
from torchsfm.linalg.quadric_pencil import Pencil, determinant
from torchsfm.linalg.quaternary_forms import (
    CUBIC,
    QUADRATIC,
    Gradients,
    cubic_of_forms,
    minors,
    product_of_forms,
    triple,
)
from torchsfm.linalg.real_roots import real_root_list
from torchsfm.linalg.rows import combine_rows, take_columns
from torchsfm.linalg.vectors import fma, fms

_CHUNK = 1024
"""Problems at a time where the work is at all points of the circle at once: what is in use stays in the cache."""
_MORE = 6
"""Newton steps for those that two steps do not bring to their end."""
_LONGEST = 0.5
"""Longest step of these."""
_ATTEMPTS = 2
"""Further systems of coordinates for problems of which not every root is a common point."""
_CONVERGED = 1e-7
"""Length of the last Newton step of what is a common point: the error left is about its square."""
_APART = 1e-9
"""Points of one problem that are nearer than this are one point."""
_NEAR = 1e-4
"""Length of the first Newton step from an accurate root."""


class CommonPoints(NamedTuple):
    """Common points one after the other, sorted by the problem they belong to."""

    item: Int[Tensor, " points"]
    point: Float[Tensor, "4 points"]
    """Unit vectors."""

    def slot(self) -> Int[Tensor, " points"]:
        """The number of each point among those of its problem."""
        return torch.arange(len(self.item), device=self.item.device) - torch.searchsorted(self.item, self.item)


def intersect_quadrics(A: Float[Tensor, "10 batch"], B: Float[Tensor, "10 batch"], C: Float[Tensor, "m batch"]) -> CommonPoints:
    """The real common points of quadrics A and B and a quadric (m = 10) or cubic (m = 20) C, at most eight or twelve.

    The coordinates must be in general position: the line z = w = 0 must not meet the curve A = B = 0, and no two common points
    may have the same z : w. Coefficients that are not finite give no points. The list is as long as there are points: its
    shape depends on the data; what is found for one problem does not depend on the others in the batch.
    """
    item, v, unsure = _attempt(A, B, C)
    index = unsure.nonzero()[:, 0]
    if len(index):
        # Other coordinates for the few with a root that led nowhere, all of them at once.
        few, turns = [take_columns(q, index) for q in (A, B, C)], [_rotation(k) for k in range(_ATTEMPTS)]
        turned = [[combine_rows(m[len(q)].on(q.device, q.dtype)[..., None], q) for _, m in turns] for q in few]
        again, u, _ = _attempt(*(torch.cat(q, 1) for q in turned))
        back = torch.stack([turn.on(u.device, u.dtype).T for turn, _ in turns], -1)
        which = torch.div(again, len(index), rounding_mode="floor")
        item, order = torch.cat((item, index.index_select(0, again - which * len(index)))).sort(stable=True)
        v = take_columns(torch.cat((v, combine_rows(take_columns(back, which), u)), 1), order)
        keep = (~_repeated(item, v, torch.ones_like(item, dtype=torch.bool), len(CUBIC) * 2)).nonzero()[:, 0]
        item, v = item.index_select(0, keep), take_columns(v, keep)
    return CommonPoints(item, v)


def _attempt(A: Tensor, B: Tensor, C: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Problems and unit vectors of common points, and which problems may have more of them."""
    degree = 8 if C.shape[0] == 10 else 12
    nodes, to_coefficients = (t.on(A.device, A.dtype) for t in _circle(degree))
    forms, pencil = [], Pencil.of(A, B, C)
    for some in portions(max(A.shape[1], 1), _CHUNK, A.device):
        values = determinant(pencil.some(some).multiply(nodes[0][:, None], nodes[1][:, None]))
        forms.append(combine_rows(values, to_coefficients.mT[..., None]))
    form = torch.cat(forms, 1)
    roots = real_root_list(torch.where(torch.isfinite(form).all(0), form, torch.nan))
    # A root s : t is z : w.
    v = pencil.take(roots.item).common_point(roots.s, roots.t)
    A, B, C = (take_columns(q, roots.item) for q in (A, B, C))
    v, found, sure = _polished(v, Gradients((A, B, C), None) if degree == 8 else Gradients((A, B), C))
    found = found & ~_repeated(roots.item, v, found, degree)
    # The number of roots is even; a root far from its point comes from an inaccurate form, which may have lost others.
    number = torch.zeros(form.shape[1], dtype=torch.int32, device=form.device)
    number.index_add_(0, roots.item, torch.where(found & sure, 1, 1001).to(number.dtype))
    unsure = (number > 1000) | (number % 2 == 1)
    keep = found.nonzero()[:, 0]
    return roots.item.index_select(0, keep), take_columns(v, keep), unsure


@cache
def _circle(degree: int) -> tuple[Constant, Constant]:
    """Points (z, w) on the half circle, and the matrix from values of a binary form there to coefficients of z^k w^(n-k)."""
    angle = math.pi * torch.arange(degree + 1, dtype=torch.float64) / (degree + 1)
    z, w = angle.sin(), angle.cos()
    k = torch.arange(degree + 1)
    monomials = z[:, None] ** k * w[:, None] ** (degree - k)
    return Constant(torch.stack((z, w))), Constant(torch.linalg.inv(monomials))


@cache
def _rotation(number: int) -> tuple[Constant, dict[int, Constant]]:
    """One of a few fixed rotations of 4-space, and what it does to the coefficients of quadrics and cubics, as [from, to]."""
    generator = torch.Generator().manual_seed(number)
    turn = torch.linalg.qr(torch.randn(4, 4, generator=generator, dtype=torch.float64, device="cpu")).Q
    quadratic = torch.stack([product_of_forms(turn[i], turn[j]) for i, j in QUADRATIC])
    cubic = torch.stack([cubic_of_forms(product_of_forms(turn[i], turn[j]), turn[k]) for i, j, k in CUBIC])
    return Constant(turn), {10: Constant(quadratic), 20: Constant(cubic)}


def _polished(v: Tensor, gradients: Gradients) -> tuple[Tensor, Tensor, Tensor]:
    """Newton's method on the unit sphere, longer for those that need it; where it came to an end, and where it began near."""
    v, first = _newton(v, gradients)
    size = first
    rest = (first > _CONVERGED).nonzero()[:, 0]
    u, few = take_columns(v, rest), gradients.take(rest)
    for _ in range(_MORE):
        if len(rest) == 0:
            break
        u, last = _newton(u, few)
        v, size = v.index_copy(1, rest, u), size.index_copy(0, rest, last)
        going = (last > _CONVERGED).nonzero()[:, 0]
        rest, u, few = rest.index_select(0, going), take_columns(u, going), few.take(going)
    return v, size <= _CONVERGED, first <= _NEAR


def _newton(v: Tensor, gradients: Gradients) -> tuple[Tensor, Tensor]:
    """One step orthogonal to v, and its length: Cramer's rule on the rows p, q, r, v."""
    (p, q, r), (a, b, c) = gradients(v)
    rv, pq = minors(r, v), minors(p, q)
    first, second, third = triple(q, rv), triple(p, rv), triple(v, pq)
    step = fma(c, third, fms(b, second, a * first)).div_(combine_rows(p, first))
    size = combine_rows(step, step).sqrt()
    v = v - step * (_LONGEST / size).clamp_max(1)
    return v * combine_rows(v, v).rsqrt(), size


def _repeated(item: Tensor, v: Tensor, found: Tensor, degree: int) -> Tensor:
    """Whether a point is one of those before it of the same problem: different points have different z : w."""
    ratio = v[2] / v[3]
    close = _APART * (1 + ratio * ratio)
    repeated = torch.zeros_like(found)
    for lag in range(1, min(degree, len(item))):
        same = (item[lag:] == item[:-lag]) & ((ratio[lag:] - ratio[:-lag]).abs() < close[lag:])
        repeated[lag:] |= same & found[:-lag]
    return repeated
