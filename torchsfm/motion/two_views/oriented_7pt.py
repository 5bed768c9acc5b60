"""Seven points that cameras have in front of them: F with its left epipole (Chum, Werner & Matas 2004).

All arithmetic has the batch in the last dimension.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.kernel import kernel
from torchsfm.linalg.rows import combine_rows
from torchsfm.linalg.vectors import cross, fma, fms
from torchsfm.motion.two_views.epipolar_fit import MIXTURE, with_left_epipole
from torchsfm.motion.two_views.fundamental_7pt import batch_last, equations, solve
from torchsfm.optim import attach_implicit, for_slots, wants_derivative


def oriented_7pt(
    x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]
) -> Solutions[Float[Tensor, "*batch 3 3 4"]]:
    """The [F | e2] of `fundamental_7pt` whose seven points can be in front of both cameras, |F| = |e2| = 1.

    Args:
        x1: Seven points in the first image, of moderate size around 0.
        x2: The corresponding points in the second image.

    Returns:
        Three slots, valid as those of `fundamental_7pt` where e2 x h2 and F h1 point the same way for all seven points.
    """
    batch = check_tensors(x1=(x1, "7 2"), x2=(x2, "7 2"))
    with torch.no_grad():
        points = batch_last(x1, batch), batch_last(x2, batch)
        F, valid = solve(*points)
        rows, valid = _orient(F, valid, *points)
        model = rows.permute(2, 1, 0).reshape(*batch, 3, 3, 4).to(x1.dtype)
        valid = valid.mT.reshape(*batch, 3)
    if wants_derivative(x1, x2):
        F = attach_implicit(equations, model[..., :3], for_slots(x1, batch), for_slots(x2, batch), dims=2, valid=valid)
        model = with_left_epipole(F, model[..., 3])
    return Solutions(model, valid)


@kernel(chunk=2048)
def _orient(
    F: Float[Tensor, "9 3 batch"],
    valid: Bool[Tensor, "3 batch"],
    x1: Float[Tensor, "2 7 batch"],
    x2: Float[Tensor, "2 7 batch"],
) -> tuple[Tensor, Tensor]:
    """[F | e2] as (12, 3, batch) and valid as (3, batch)."""
    rows = F.view(3, 3, *F.shape[1:])
    first, second, third = rows.unbind(1)
    # The left epipole is across all columns: across two mixtures of them, so that no choice is needed.
    e = cross(torch.add(first, third, alpha=MIXTURE[0]), torch.add(second, third, alpha=MIXTURE[1]))
    e *= combine_rows(e, e).clamp(min=1e-200).rsqrt()
    f0, f1, f2, f3, f4, f5, *_ = F.unbind(0)
    e0, e1, e2 = e
    (u, v), (a, b) = x1[:, :, None].unbind(0), x2[:, :, None].unbind(0)
    # e2 x h2 and F h1 are parallel: two of their coordinates tell whether they point the same way.
    same = fms(e2, b, e1) * fma(f0, u, fma(f1, v, f2))
    same = fms(fms(e2, a, e0), fma(f3, u, fma(f4, v, f5)), same)
    plus, minus = same.amin(0) >= 0, same.amax(0) <= 0
    e = torch.where(plus, e, -e)
    return torch.cat((rows, e[:, None]), 1).flatten(0, 1), valid & (plus | minus)
