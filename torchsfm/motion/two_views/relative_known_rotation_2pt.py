"""Two rays in two calibrated cameras whose relative rotation is known: t is perpendicular to both (R d1) x d2.

Rotation may come from a gyroscope, from vanishing points or from points far away (Hartley & Zisserman 2004, 9.3.1).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import cross
from torchsfm.linalg.rows import combine_rows
from torchsfm.motion.two_views.sample_rows import (
    cross_columns,
    in_chunks,
    longest_vector,
    rows_of,
    towards_the_front,
    unit_rays,
)
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_CHUNK = 4096
"""Problems at a time: their numbers fit the cache."""
_NOTHING = 1e-14
"""Sine of the angle between two planes that coincide."""


def equations(
    t: Float[Tensor, "*#batch 3"],
    d1: Float[Tensor, "*#batch 2 3"],
    d2: Float[Tensor, "*#batch 2 3"],
    R: Float[Tensor, "*#batch 3 3"],
) -> Float[Tensor, "*batch 3"]:
    """The three equations of t: d2' [t]x R d1 = 0 for both rays and |t|^2 = 1."""
    epipolar = (cross(d1 @ R.mT, d2) * t[..., None, :]).sum(-1)
    gauge = (t * t).sum(-1, keepdim=True) - 1
    return torch.cat((epipolar, gauge.expand(*epipolar.shape[:-1], 1)), -1)


def relative_known_rotation_2pt(
    d1: Float[Tensor, "*#batch 2 3"], d2: Float[Tensor, "*#batch 2 3"], R: Float[Tensor, "*#batch 3 3"]
) -> Solutions[Float[Tensor, "*batch 1 3 4"]]:
    """The pose [R | t], |t| = 1, of a second camera from two rays and its rotation, `d2 ~ R d1 + t`.

    Args:
        d1: Two rays of the first camera, of any length but 0.
        d2: The corresponding rays of the second camera.
        R: The rotation of the second camera relative to the first.

    Returns:
        One slot, with the R that came. Of t and -t the one is returned for which more of the four depths are positive. Not
        valid where the epipolar planes coincide (both rays in a plane with the baseline, the rays coincide), where a ray has no
        parallax (no baseline, a point at infinity), or where a number is not finite. Computed in float64 whatever the dtype.
        Differentiable in all arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> d1 = torch.tensor([[0.0, 0.0, 5.0], [1.0, 0.5, 4.0]])
        >>> t = torch.tensor([0.6, 0.0, 0.8])
        >>> found = torchsfm.motion.relative_known_rotation_2pt(d1, d1 + t, torch.eye(3))
        >>> found.model[0, :, 3]
        tensor([0.6000, 0.0000, 0.8000])
    """
    batch = check_tensors(d1=(d1, "2 3"), d2=(d2, "2 3"), R=(R, "3 3"))
    with torch.no_grad():
        t, valid = in_chunks(_solve, _CHUNK, *rows_of(batch, d1, d2, R))
        t, valid = t.mT.to(d1.dtype).reshape(*batch, 1, 3), valid.reshape(*batch, 1)
    if wants_derivative(d1, d2, R):
        t = attach_implicit(equations, t, for_slots(d1, batch), for_slots(d2, batch), for_slots(R, batch), valid=valid)
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    kept = torch.where(valid[..., None, None], R[..., None, :, :], eye)
    return Solutions(torch.cat((kept, t[..., None]), -1), valid)


def _solve(d1: Tensor, d2: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
    """Translations as (3, batch) and valid as (batch)."""
    fine = torch.isfinite(R).all(0).all(0)
    (d1, fine1), (d2, fine2) = unit_rays(d1), unit_rays(d2)
    R = torch.where(fine, R, 1)
    turned = torch.stack([combine_rows(R.unbind(1), d) for d in d1])
    normal = cross_columns(turned, d2)
    t, sine = longest_vector(cross_columns(normal[0], normal[1])[None])
    length = combine_rows(normal.unbind(1), normal.unbind(1)).sqrt().amin(0)
    t = towards_the_front(t, turned, d2)
    valid = fine & fine1 & fine2 & (length > _NOTHING) & (sine > _NOTHING * length) & torch.isfinite(t).all(0)
    ahead = torch.tensor([0.0, 0, 1], dtype=t.dtype, device=t.device)[:, None]
    return torch.where(valid, t, ahead), valid
