"""Sampson's distance of pairs of points to a homography (Chum, Pajdla & Sturm 2005).

The constraint c = y - w x2, (y, w) = H x1, has the derivatives B = H_2x2 - x2 h3' over x1 and -w I over x2, and the squared
distance is c' S^-1 c with S = B B' + w^2 I. The two entries of c and the three of S are linear in monomials of a pair, of
degree two at most: for many models of the same data one matrix product gives them.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.motion.two_views.epipolar_fit import one_data_set_for_many
from torchsfm.motion.two_views.forms_of_models import ONE, Forms, Term, coordinates_of_pairs
from torchsfm.motion.two_views.sampson_plane import MANY

_TINY = 1e-30
_X, _Y, _U, _V, _1 = range(5)


def squared_distance(
    H: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*batch n"]:
    """The squared distance of pairs of points to homographies."""
    if one_data_set_for_many(H, x1[..., 0]) and H.shape[-3] >= MANY:
        c0, c1, s00, s01, s11 = SCORING.of(H.flatten(-2), coordinates_of_pairs(x1, x2))
    else:
        c0, c1, _, (s00, s01, s11), _ = constraint(H, *x1.unbind(-1), *x2.unbind(-1))
    # The determinant and the numerator are positive but for rounding.
    det = (s00 * s11).addcmul_(s01, s01, value=-1).clamp_(min=_TINY)
    first = (s11 * c0).addcmul_(s01, c1, value=-1)
    second = (s00 * c1).addcmul_(s01, c0, value=-1)
    return first.mul_(c0).addcmul_(second, c1).div_(det).abs_()


def constraint(
    H: Float[Tensor, "*#batch 3 3"],
    x: Float[Tensor, "*#batch n"],
    y: Float[Tensor, "*#batch n"],
    u: Float[Tensor, "*#batch n"],
    v: Float[Tensor, "*#batch n"],
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]:
    """The constraint c, the depth w, S, and B row by row, for the pairs (x, y), (u, v)."""
    h00, h01, h02, h10, h11, h12, h20, h21, h22 = H.flatten(-2).unsqueeze(-1).unbind(-2)
    w = torch.addcmul(h22, h20, x).addcmul_(h21, y)
    b00, b01 = torch.addcmul(h00, h20, u, value=-1), torch.addcmul(h01, h21, u, value=-1)
    b10, b11 = torch.addcmul(h10, h20, v, value=-1), torch.addcmul(h11, h21, v, value=-1)
    c0 = torch.addcmul(h02, h22, u, value=-1).addcmul_(b00, x).addcmul_(b01, y)
    c1 = torch.addcmul(h12, h22, v, value=-1).addcmul_(b10, x).addcmul_(b11, y)
    ww = w * w
    s00, s01 = torch.addcmul(ww, b00, b00).addcmul_(b01, b01), (b00 * b10).addcmul_(b01, b11)
    s11 = ww.addcmul_(b10, b10).addcmul_(b11, b11)
    return c0, c1, w, (s00, s01, s11), (b00, b01, b10, b11)


def _scoring_forms() -> Forms:
    """The entries of c and of S, in the coordinates x, y, u, v, 1."""
    # 1 comes twice, for the sums of more than two products.
    monomials = [(_1, _1), (_1, _1)] + [(a, b) for a in range(5) for b in range(a, 5) if (a, b) != (_1, _1)]
    place = {pair: i for i, pair in enumerate(monomials)} | {(_1, _1): 0}
    h = [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    terms: list[Term] = []

    def add(form: int, pair: tuple[int, int], first: int, second: int, factor: float) -> None:
        terms.append((form, place[min(pair), max(pair)], first, second, factor))

    for i, other in enumerate((_U, _V)):
        for j, one in enumerate((_X, _Y, _1)):
            add(i, (one, _1), h[i][j], ONE, 1.0)
            add(i, (one, other), h[2][j], ONE, -1.0)
    for form, i, k in ((2, 0, 0), (3, 0, 1), (4, 1, 1)):
        left, right = ((_U, _V)[row] for row in (i, k))
        for j in (0, 1):
            # b = h_ij - h_2j times u or v.
            terms.append((form, 1, h[i][j], h[k][j], 1.0))
            add(form, (right, _1), h[i][j], h[2][j], -2.0 if i == k else -1.0)
            if i != k:
                add(form, (left, _1), h[k][j], h[2][j], -1.0)
            add(form, (left, right), h[2][j], h[2][j], 1.0)
        if i == k:
            for a, one in enumerate((_X, _Y, _1)):
                for b, two in list(enumerate((_X, _Y, _1)))[a:]:
                    add(form, (one, two), h[2][a], h[2][b], 1.0 if a == b else 2.0)
    return Forms(5, 9, tuple(monomials), tuple(terms))


SCORING = _scoring_forms()
