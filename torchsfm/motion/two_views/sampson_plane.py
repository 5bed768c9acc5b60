"""Sampson's distance of points to an oriented fundamental matrix, and its Gauss-Newton equations.

With e = h2' F h1 and its gradient g over the four coordinates, the distance is e / |g| (Sampson 1982; Luong & Faugeras 1996). A
point is behind one of the cameras if h2' [e2]x F h1 > 0 (Chum, Werner & Matas 2004). All three forms are linear in monomials of
a datum, of degree two at most in either point: for many models of the same data one matrix product gives them.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.motion.two_views.epipolar_fit import apply_rows, one_data_set_for_many, product
from torchsfm.motion.two_views.forms_of_models import ONE, Forms, Term, coordinates_of_pairs
from torchsfm.robust import Weigh

_TINY = 1e-30
MANY = 4
"""From how many models of the same data on monomials pay."""

_DEGREE_TWO = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Which coordinates make the monomials of degree two of a point."""
_SQUARES = ((0, 0), (0, 1), (1, 1))


def homogeneous_rows(x: Float[Tensor, "*batch n 2"]) -> Float[Tensor, "*batch 3 n"]:
    """The coordinates x, y, 1 of points."""
    return _with_ones(x.mT)


def _with_ones(rows: Float[Tensor, "*batch 2 n"]) -> Float[Tensor, "*batch 3 n"]:
    return torch.nn.functional.pad(rows, (0, 0, 0, 1), value=1.0)


def infinite_where_positive(squared: Float[Tensor, "*batch n"], behind: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """Squared distances, infinite where another number is positive: a maximum, many times as fast as a choice."""
    most = torch.finfo(squared.dtype).max
    if torch.is_grad_enabled():
        behind = behind.detach()
    return torch.maximum(squared, behind * most * most)


def squared_distance(
    model: Float[Tensor, "*#batch 3 4"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*batch n"]:
    """The squared distance of points to models [F | e2]; infinite behind a camera."""
    if one_data_set_for_many(model, x1[..., 0]) and model.shape[-3] >= MANY:
        return _squared_distances(model, x1, x2)
    F, epipole = torch.split(model, [3, 1], -1)
    e, side, _, _, size = _forms(F, epipole, homogeneous_rows(x1), homogeneous_rows(x2))
    return infinite_where_positive(e * e / size, side)


def _scoring_forms() -> Forms:
    """h2' F h1, h2' [e2]x F h1 and the squared length of the gradient, in the coordinates x1, y1, x2, y2, 1."""
    h1, h2, three = (0, 1, 4), (2, 3, 4), range(3)
    # After the products of both points those of one; 1 comes twice, for the sums of four squares.
    monomials = [(h2[i], h1[j]) for i in three for j in three]
    monomials += [(h[i], h[j]) for h in (h1, h2) for i, j in _SQUARES] + [(4, 4)]
    of_first, of_second = [9, 10, 6, 11, 7, 8], [12, 13, 2, 14, 5, 15]
    terms: list[Term] = [(0, 3 * i + j, 4 * i + j, ONE, 1.0) for i in three for j in three]
    for i in three:
        up, down = (i + 1) % 3, (i + 2) % 3
        for j in three:
            terms += [(1, 3 * i + j, 4 * up + 3, 4 * down + j, 1.0), (1, 3 * i + j, 4 * down + 3, 4 * up + j, -1.0)]
    for (a, b), first, second in zip(_DEGREE_TWO, of_first, of_second, strict=True):
        factor = 1.0 if a == b else 2.0
        terms += [(2, first, 4 * k + a, 4 * k + b, factor) for k in (0, 1)]
        terms += [(2, second, 4 * a + k, 4 * b + k, factor) for k in (0, 1)]
    return Forms(5, 12, tuple(monomials), tuple(terms))


SCORING = _scoring_forms()


def _squared_distances(model: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    """The same for many models of the same data.

    In float32 the square of the gradient's length is off by about 1e-7 of the squares of the entries of F and the coordinates.
    """
    e, side, size = SCORING.of(model.flatten(-2), coordinates_of_pairs(x1, x2))
    return infinite_where_positive(e * e / size.clamp(min=_TINY), side)


def _forms(
    F: Float[Tensor, "*#batch 3 3"],
    epipole: Float[Tensor, "*#batch 3 1"],
    h1: Float[Tensor, "*#batch 3 n"],
    h2: Float[Tensor, "*#batch 3 n"],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The residual, the side, the gradients over the first and (the first two rows) the second point, their squared length."""
    lines = apply_rows(torch.cat((F, torch.linalg.cross(epipole, F, dim=-2)), -2), h1)
    u, v, w, a, b, c = lines.unbind(-2)
    first = apply_rows(F[..., :2].mT, h2)
    u1, v1 = first.unbind(-2)
    x, y, _ = h2.unbind(-2)
    e = torch.addcmul(torch.addcmul(w, x, u), y, v)
    side = torch.addcmul(torch.addcmul(c, x, a), y, b)
    size = torch.addcmul(torch.addcmul(torch.addcmul(u * u, v, v), u1, u1), v1, v1)
    return e, side, first, lines, size.clamp(min=_TINY)


def step_equations(
    F: Float[Tensor, "*#batch 3 3"],
    epipole: Float[Tensor, "*#batch 3 1"],
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    weigh: Weigh,
) -> tuple[Float[Tensor, "*batch 9 9"], Float[Tensor, "*batch 9"]]:
    """J' C J and J' W r of the distance over the nine entries of F, in float64, W and C as `weigh` has them."""
    h1, h2 = homogeneous_rows(x1), homogeneous_rows(x2)
    e, side, first, second, size = _forms(F, epipole, h1, h2)
    share = e / size
    weights, curvature = weigh(infinite_where_positive(share * e, side))
    # |g| times the derivative of e / |g|: that of e, less e / |g|^2 times that of |g|^2 / 2.
    row = share[..., None, :]
    left = _with_ones(torch.addcmul(x2.mT, row, second[..., :2, :], value=-1))
    J = left[..., :, None, :] * h1[..., None, :, :]
    J[..., :2, :].addcmul_(h2[..., :, None, :], (row * first)[..., None, :, :], value=-1)
    J = J.flatten(-3, -2)
    # A product with a single column would be rounded otherwise for one problem than for several.
    both = product(torch.cat(((curvature / size)[..., None, :] * J, (weights * share)[..., None, :]), -2), J.mT).double()
    return both[..., :9, :], both[..., 9, :]
