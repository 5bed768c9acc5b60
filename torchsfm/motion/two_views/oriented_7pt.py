"""Seven points that cameras have in front of them: F with its left epipole (Chum, Werner & Matas 2004).

With e2 the left epipole, F h1 and e2 x h2 have to point the same way for all points. Where the first point is the origin of
both images, that is so for it if e2 = (-F23, F13, .), and for another if (F31 x1 + F32 y1) (F13 x2 + F23 y2) < 0: it is on
corresponding sides of the epipolar lines of the first. That takes no epipole, and leaves few of the F of wrong points, of
which alone the rest is computed. All arithmetic has the batch in the last dimension.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.portions import portions
from torchsfm.linalg.rows import combine_rows, take_columns
from torchsfm.linalg.vectors import cross, fma, fms
from torchsfm.motion.two_views.epipolar_fit import MIXTURE, with_left_epipole
from torchsfm.motion.two_views.fundamental_7pt import Pencil, batch_last, equations, members, pencil
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_CHUNK = 16384
"""Samples at a time: their matrices fit the cache."""
_DIGITS = 10.0
"""How much more than rounding, of a point on the line of the first one, may be on its wrong side."""


def oriented_7pt(
    x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]
) -> Solutions[Float[Tensor, "*batch 3 3 4"]]:
    """The [F | e2] of `fundamental_7pt` whose seven points can be in front of both cameras, |F| = |e2| = 1.

    Args:
        x1: Seven points in the first image, of moderate size around 0.
        x2: The corresponding points in the second image.

    Returns:
        Three slots, valid as those of `fundamental_7pt` where e2 x h2 and F h1 point the same way for all seven points.
        Computed in the type of the points, in float32 at least.
    """
    batch = check_tensors(x1=(x1, "7 2"), x2=(x2, "7 2"))
    with torch.no_grad():
        dtype = torch.promote_types(x1.dtype, torch.float32)
        first, second = batch_last(x1.to(dtype), batch), batch_last(x2.to(dtype), batch)
        size = first.shape[-1]
        model, valid = first.new_zeros(size * 3, 12), torch.zeros(size * 3, dtype=torch.bool, device=x1.device)
        # An empty slot holds diag(1, 1, 0) and its epipole.
        model[:, 0:6:5], model[:, 11] = 0.5**0.5, 1.0
        for part in portions(size, _CHUNK, x1.device):
            slot, rows = _oriented(first[..., part], second[..., part])
            slot += 3 * part.start
            model.index_copy_(0, slot, rows.mT)
            valid.index_fill_(0, slot, True)
        model, valid = model.to(x1.dtype).view(*batch, 3, 3, 4), valid.view(*batch, 3)
    if wants_derivative(x1, x2):
        F = attach_implicit(equations, model[..., :3], for_slots(x1, batch), for_slots(x2, batch), dims=2, valid=valid)
        model = with_left_epipole(F, model[..., 3])
    return Solutions(model, valid)


def _oriented(x1: Float[Tensor, "2 7 batch"], x2: Float[Tensor, "2 7 batch"]) -> tuple[Tensor, Tensor]:
    """The slots, three for each sample, that hold some [F | e2], and these as (12, found)."""
    some = pencil(x1, x2)
    slot, column = (some.real & ~_on_wrong_sides(some)).nonzero(as_tuple=True)
    basis, moves = take_columns(some.basis, column), take_columns(some.moves, column)
    F, unit = members(basis, some.roots[:, slot, column], moves)
    rows = F.view(3, 3, -1)
    first, second, third = rows.unbind(1)
    # The left epipole is across all columns: across two mixtures of them, so that no choice is needed.
    e = cross(torch.add(first, third, alpha=MIXTURE[0]), torch.add(second, third, alpha=MIXTURE[1]))
    e *= combine_rows(e, e).clamp(min=1e-30).rsqrt()
    f0, f1, f2, f3, f4, f5, *_ = F.unbind(0)
    e0, e1, e2 = e
    (u, v), (a, b) = take_columns(x1, column), take_columns(x2, column)
    # e2 x h2 and F h1 are parallel: two of their coordinates tell whether they point the same way.
    same = fms(e2, b, e1) * fma(f0, u, fma(f1, v, f2))
    same = fms(fms(e2, a, e0), fma(f3, u, fma(f4, v, f5)), same)
    plus, minus = same.amin(0) >= 0, same.amax(0) <= 0
    e = torch.where(plus, e, -e)
    (good,) = (unit & (plus | minus)).nonzero(as_tuple=True)
    model = torch.cat((rows, e[:, None]), 1).flatten(0, 1)
    return (3 * column + slot).index_select(0, good), take_columns(model, good)


def _on_wrong_sides(some: Pencil) -> Tensor:
    """Where a point cannot be in front of both cameras, beyond rounding, as (3, batch)."""
    s, t = some.roots
    f2, f5, f6, f7 = (some.basis[4:, 0, None] * s).addcmul_(some.basis[4:, 1, None], t)[:, None]
    (u, v), (a, b) = some.points[0][:, :, None], some.points[1][:, :, None]
    side = fma(f7, v, f6 * u).mul_(fma(f5, b, f2 * a)).amax(0)
    return side > _DIGITS * torch.finfo(side.dtype).eps * fma(s, s, t * t)
