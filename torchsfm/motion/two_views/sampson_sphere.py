"""Sampson's distance of rays to a relative pose on the unit sphere, and its Gauss-Newton equations.

With the rotated ray p = R d1 the residual is e = d2' [t]x p, and its gradient g over the tangents of both unit rays has the
squared length 2 - (t'd1')^2 - (t'd2)^2 - 2 e^2, where t'd1' stands for t'p: each ray's distance to the epipole, less what
points along the rays. All forms are linear in the products d2_i d1_j and in the coordinates.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg import damped_solve
from torchsfm.motion.two_views.epipolar_fit import apply_rows, one_data_set_for_many, product, sums_of_products
from torchsfm.motion.two_views.forms_of_models import ONE, Forms, Term
from torchsfm.motion.two_views.sampson_plane import MANY, infinite_where_positive
from torchsfm.robust import Weigh

_TINY = 1e-30


def unit_rows(d: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch 3 n"]:
    """The coordinates of rays made of length 1."""
    rows = d.mT.contiguous()
    return rows * (rows * rows).sum(-2, keepdim=True).clamp(min=_TINY).rsqrt()


def squared_distance(
    model: Float[Tensor, "*#batch 3 4"],
    d1: Float[Tensor, "*#batch n 3"],
    d2: Float[Tensor, "*#batch n 3"],
    slack: Float[Tensor, "*#batch"],
) -> Float[Tensor, "*batch n"]:
    """The squared distance of rays to poses [R | t]; infinite for those that miss the front by a slack and more."""
    h1, h2 = unit_rows(d1), unit_rows(d2)
    if one_data_set_for_many(model, d1[..., 0]) and model.shape[-3] >= MANY:
        e, cosine, middle, half = SCORING.of(
            model.flatten(-2), torch.cat((h1, h2, torch.ones_like(h1[..., :1, :])), -2)[..., 0, :, :]
        )
        size = torch.addcmul(torch.addcmul(e * e, middle, middle), half, half)
        along = middle.abs()
        # The smaller of t'd2 cos - t'd1' and t'd2 - t'd1' cos.
        least = torch.addcmul(half - along, cosine, half + along)
        squared = e * e / torch.rsub(size, 2, alpha=2).clamp(min=_TINY)
        return infinite_where_positive(squared, -slack[..., None] - least)
    squared, behind, *_ = _forms(model, h1, h2, slack)
    return infinite_where_positive(squared, behind)


def _scoring_forms() -> Forms:
    """d2' [t]x R d1, d2' R d1, (t'd2 + t'd1') / 2 and (t'd2 - t'd1') / 2, in the coordinates of d1 and d2, and 1."""
    three = range(3)
    # Those of d1 come twice, for the sums of three products.
    monomials = [(3 + i, j) for i in three for j in three] + [(i, 6) for i in (0, 1, 2, 0, 1, 2, 3, 4, 5)]
    terms: list[Term] = [(1, 3 * i + j, 4 * i + j, ONE, 1.0) for i in three for j in three]
    for i in three:
        up, down = (i + 1) % 3, (i + 2) % 3
        for j in three:
            terms += [(0, 3 * i + j, 4 * up + 3, 4 * down + j, 1.0), (0, 3 * i + j, 4 * down + 3, 4 * up + j, -1.0)]
        for form, sign in ((2, 0.5), (3, -0.5)):
            terms += [(form, 15 + i, 4 * i + 3, ONE, 0.5)]
            terms += [(form, (12 if k == 2 else 9) + i, 4 * k + i, 4 * k + 3, sign) for k in three]
    return Forms(7, 12, tuple(monomials), tuple(terms))


SCORING = _scoring_forms()


def _forms(
    model: Float[Tensor, "*#batch 3 4"],
    h1: Float[Tensor, "*#batch 3 n"],
    h2: Float[Tensor, "*#batch 3 n"],
    slack: Float[Tensor, "*#batch"],
) -> tuple[Tensor, ...]:
    """The squared distance, how far beyond the slack rays miss the front, e, |g|^2, t'd1', t'd2, the cosine, p and p x d2."""
    R, t = model[..., :3], model[..., 3]
    first = apply_rows(torch.cat((R, product(t[..., None, :], R)), -2), h1)
    p, along1 = first[..., :3, :], first[..., 3, :]
    along2 = apply_rows(t[..., None, :], h2)[..., 0, :]
    p0, p1, p2 = p.unbind(-2)
    q0, q1, q2 = h2.unbind(-2)
    cosine = (p * h2).sum(-2)
    pairs = ((p1, q2, p2, q1), (p2, q0, p0, q2), (p0, q1, p1, q0))
    normal = torch.stack([torch.addcmul(a * d, b, c, value=-1) for a, d, b, c in pairs], -2)
    e = (t[..., None] * normal).sum(-2)
    square = e * e
    size = torch.addcmul(torch.addcmul(2 * square, along1, along1), along2, along2)
    size = (2 - size).clamp(min=_TINY)
    missed = torch.maximum(torch.addcmul(along1, along2, cosine, value=-1), along1 * cosine - along2)
    return square / size, missed - slack[..., None], e, size, along1, along2, cosine, p, normal


def step_equations(
    model: Float[Tensor, "*#batch 3 4"],
    d1: Float[Tensor, "*#batch n 3"],
    d2: Float[Tensor, "*#batch n 3"],
    slack: Float[Tensor, "*#batch"],
    weigh: Weigh,
) -> tuple[Float[Tensor, "*batch 6 6"], Float[Tensor, "*batch 6"]]:
    """J' C J and J' W r of the distance over a turn w of R <- exp(w) R and a move of t, in float64.

    W and C as `weigh` has them of the distances. The right side is exact; in the matrix the measured rays stand for those
    corrected to first order. A move along t counts for nothing in the right side.
    """
    h1, h2 = unit_rows(d1), unit_rows(d2)
    squared, behind, e, size, along1, along2, cosine, p, normal = _forms(model, h1, h2, slack)
    weights, curvature = weigh(infinite_where_positive(squared, behind))
    t = model[..., 3]
    # The derivatives of e: by the turn p x (d2 x t), by the move p x d2.
    J = torch.cat((along1[..., None, :] * h2 - cosine[..., None, :] * t[..., None], normal), -2)
    scale = weights / size
    share = scale * squared
    slope = e * (scale + 2 * share)
    # A product with a single column would be rounded otherwise for one problem than for several.
    both = product(torch.cat(((curvature / size)[..., None, :] * J, slope[..., None, :]), -2), J.mT)
    A, (turn, move) = both[..., :6, :].double(), both[..., 6, :].double().chunk(2, -1)
    pair = torch.stack((share * along1, share * along2), -2)
    near, far, t = product(pair, p.mT)[..., 0, :].double(), sums_of_products(pair, h2)[..., 1, :].double(), t.double()
    turn, move = turn + torch.linalg.cross(near, t), move + near + far
    return A, torch.cat((turn, move - t * (t * move).sum(-1, keepdim=True)), -1)


def turned(w: Float[Tensor, "*#batch 3"], R: Float[Tensor, "*#batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """R turned by w up to third order (Cayley's map), and what it lacked to a rotation made good, to second order."""
    half = 0.5 * w
    once = torch.linalg.cross(half[..., None], R, dim=-2)
    twice = torch.linalg.cross(half[..., None], once, dim=-2)
    share = 2 / (1 + (half * half).sum(-1))
    R = R + share[..., None, None] * (once + twice)
    return torch.sub(1.5 * R, product(R, product(R.mT, R)), alpha=0.5)


def pose_step(
    A: Float[Tensor, "*batch k k"], b: Float[Tensor, "*batch k"], t: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch k"]:
    """The step, the last three of whose unknowns move t, across t: a move along it changes nothing but the length of E."""
    along = torch.nn.functional.pad(t, (A.shape[-1] - 3, 0))
    size = A.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
    A = torch.addcmul(A, (size * along)[..., None], along[..., None, :])
    return -damped_solve(A, b[..., None])[..., 0]
