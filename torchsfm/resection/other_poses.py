"""Does another pose, well apart, fit the rays as well? Four points may have two, and points in a plane that are far away."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg import eigh
from torchsfm.resection.angles import Rays, cost, gauss_newton
from torchsfm.resection.camera_p3p import camera_p3p

_APART = 0.2
"""Rotations that differ by more, in radians, are two answers."""
_WORTH = 1e3
"""Starts that fit so many times worse are not followed."""
_CLEAR = 9.0
"""By how many variances of the noise the others must fit worse: three standard deviations."""
_ROUNDING, _LARGE = 1e-9, 3e-2
"""Least and most noise in radians; more is the misfit of wrong points, as of landmarks that are being learnt."""


def beside_others(
    data: Rays,
    R: Float[Tensor, "b 1 3 3"],
    t: Float[Tensor, "b 1 3"],
    value: Float[Tensor, "b 1"],
    N: Float[Tensor, "b 1 6 6"],
    others_R: Float[Tensor, "b k 3 3"],
    others_t: Float[Tensor, "b k 3"],
    near: Float[Tensor, "b k"],
    steps: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Bool[Tensor, "b"]]:
    """The best of a minimum and the best minimum apart from it, with value and normal matrix, and whether it alone fits.

    Args:
        data: Rays and points.
        R: The rotation of a minimum of the sum of squared sines.
        t: Its translation.
        value: The sum there.
        N: The normal matrix there.
        others_R: Starts of other minima.
        others_t: Theirs.
        near: The sum there.
        steps: How many lead to a minimum.
    """
    mirrored = _mirrored(data, R, t)
    others_R, others_t = torch.cat((others_R, mirrored), 1), torch.cat((others_t, t), 1)
    near = torch.cat((near, cost(data, mirrored, t)), 1)
    unit = 2 * data.number / data.w.sum(-1).clamp_min(1e-300)
    free = (2 * data.number - 6).clamp(min=1)
    least, most = (noise**2 / unit for noise in (_ROUNDING, _LARGE))
    variance = torch.minimum(torch.maximum(value[:, 0] / free, least), most)
    lowest, which = torch.where(_apart(R, others_R), near, torch.inf).min(-1)
    alone = torch.ones_like(data.bad)
    rows = (lowest < _WORTH * free * variance).nonzero()[:, 0]
    if not len(rows):
        return R, t, value, N, alone
    some, pick = tensor_map(lambda a: a[rows], data), which[rows]
    second = gauss_newton(some, others_R[rows, pick][:, None], others_t[rows, pick][:, None], steps)[:4]
    first = tuple(a[rows] for a in (R, t, value, N))
    rival = _apart(first[0], second[0]) & ((second[2] - first[2]).abs() < _CLEAR * variance[rows, None])
    better = (second[2] < first[2])[:, 0]
    R, t, value, N = (
        whole.index_copy(0, rows, torch.where(better.reshape(-1, *(1,) * (a.ndim - 1)), b, a))
        for whole, a, b in zip((R, t, value, N), first, second, strict=True)
    )
    return R, t, value, N, alone.index_copy(0, rows, ~rival[:, 0])


def with_poses_of_three(data: Rays, R: Float[Tensor, "b k 3 3"], t: Float[Tensor, "b k 3"]) -> tuple[Tensor, Tensor]:
    """Starts, and of problems of four points the poses of three of them, one of which is near the answer; (b, k + 4)."""
    (at,) = (data.number == 4).nonzero(as_tuple=True)
    if not len(at):
        return R, t
    three = (data.w[at] > 0).to(torch.int8).argsort(dim=-1, descending=True, stable=True)[:, None, :3].expand(-1, 3, -1)
    found = camera_p3p(data.u[at].gather(2, three).mT, data.X[at].gather(2, three).mT)
    model = torch.where(found.valid[..., None, None], found.model, torch.cat((R[at, :1], t[at, :1, :, None]), -1))
    # What others have one more time changes nothing.
    R, t = (torch.cat((a, a[:, :1].expand(-1, 4, *a.shape[2:])), 1) for a in (R, t))
    R = R.index_copy(0, at, torch.cat((R[at, :-4], model[..., :3]), 1))
    return R, t.index_copy(0, at, torch.cat((t[at, :-4], model[..., 3]), 1))


def _mirrored(data: Rays, R: Float[Tensor, "b 1 3 3"], t: Float[Tensor, "b 1 3"]) -> Float[Tensor, "b 1 3 3"]:
    """The rotation that tilts points near a plane to the other side of the line of sight, which from far away looks alike."""
    flat = eigh((data.X * data.w[:, None]) @ data.X.mT)[1][..., 0]
    sight = t / torch.linalg.vector_norm(t, dim=-1, keepdim=True).clamp_min(1e-300)
    back = R - 2 * (R @ flat[:, None, :, None]) * flat[:, None, None]
    mirrored: Tensor = back - 2 * sight[..., None] * (sight[..., None, :] @ back)
    return mirrored


def _apart(R: Float[Tensor, "b 1 3 3"], others: Float[Tensor, "b k 3 3"]) -> Bool[Tensor, "b k"]:
    """Whether rotations differ by a large angle: the square of their difference is 4 - 4 cos."""
    return (R - others).square().sum((-2, -1)) > 2 * _APART**2
