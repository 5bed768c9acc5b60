"""Are points enough, and far enough apart, to tell a pose, as far as their noise lets anybody see?"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg import eigvalsh
from torchsfm.linalg.farthest_points import farthest_points
from torchsfm.resection.angles import Rays, seen

_POINTS = 4
"""Fewer points have several poses."""
_APART, _OFF = 5.0, 2.0
"""How far apart points are two, and how far they are off a line, in root mean squares of the angles between rays and points."""
_ROUNDING, _LARGE, _LARGE_OF_FOUR = 1e-9, 3e-2, 3e-3
"""Least and most noise, in radians: more is the misfit of wrong points, as of landmarks that are being learnt, or, of four
points, that of a minimum that is not the least."""
_NO_FIT = 0.2
"""Misfit in radians of a pose that fits nothing."""
_OPEN = 0.2
"""Standard deviation of a rotation that is not known, in radians."""


def tells_pose(
    data: Rays,
    R: Float[Tensor, "b 3 3"],
    t: Float[Tensor, "b 3"],
    value: Float[Tensor, "b"],
    N: Float[Tensor, "b 6 6"],
    *,
    plane: bool = False,
) -> Bool[Tensor, "b"]:
    """Whether there are four points apart from each other that the pose fits, and the noise leaves no rotation open.

    Points nearly on a line may turn about it, and three points, however often they are seen, have up to four poses.

    Args:
        data: Rays and points.
        R: The rotation that was found.
        t: The translation.
        value: The sum of squared sines there.
        N: The normal matrix there.
        plane: Whether two points must be off every line, too, as homographies want it.
    """
    counts, total = data.w > 0, data.w.sum(-1).clamp_min(1e-300)
    free = (2 * data.number - 6).clamp(min=1)
    # Of one coordinate of an angle, where the weight is 1; and of the average angle, both coordinates.
    unit = 2 * data.number / total
    misfit = (value / free * unit).sqrt()
    noise = torch.where(data.number > _POINTS, misfit.clamp_max(_LARGE), misfit.clamp_max(_LARGE_OF_FOUR)).clamp_min(_ROUNDING)
    variance = noise.square() / unit
    Y = seen(data, R[:, None], t[:, None])[:, 0]
    away = torch.linalg.vector_norm(Y, dim=1).clamp_min(1e-300)
    place = torch.cat((data.u.mT, away.log()[..., None]), -1)
    picked, squares = farthest_points(place, counts, _POINTS - 1)
    enough = squares[:, -1] > (_APART * noise).square()
    # What the rotation is known by where the translation is free.
    A, B, C = N[:, :3, :3], N[:, :3, 3:], N[:, 3:, 3:]
    known = eigvalsh(A - B @ torch.linalg.solve_ex(C, B.mT)[0])[0][:, 0]
    fixed = variance <= _OPEN**2 * known
    if plane:
        fixed = fixed & (_number_off(data.X, away, picked, counts, _OFF * noise) > 1)
    fits = (misfit < _NO_FIT) | (data.number <= _POINTS)
    return enough & fixed & fits


def _number_off(X: Tensor, away: Tensor, picked: Tensor, counts: Tensor, reach: Tensor) -> Tensor:
    """How many points are seen off the lines through two of three points, for the line that has most.

    Where all points but one are on a line, two of the three are, too.
    """
    corners = X.gather(2, picked[:, None].expand(-1, 3, -1))
    start = corners[..., [0, 0, 1]].mT
    along = corners[..., [1, 2, 2]].mT - start
    along = along / torch.linalg.vector_norm(along, dim=-1, keepdim=True).clamp_min(1e-300)
    apart = X.mT[:, None] - start[:, :, None]
    across = torch.linalg.vector_norm(torch.linalg.cross(apart, along[:, :, None].expand_as(apart), dim=-1), dim=-1)
    off = (across > (reach[:, None] * away)[:, None]) & counts[:, None]
    number: Tensor = off.sum(-1).amin(-1)
    return number
