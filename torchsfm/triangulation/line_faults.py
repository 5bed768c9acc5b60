"""Why views leave no line: rare, so that only lines that may be among them are looked at closely, the lines first."""

from enum import IntEnum

import torch
from torch import Tensor

from torchsfm.geometry import to_homogeneous
from torchsfm.linalg import adjugate_3x3, eigh, eigvalsh
from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.linalg.vectors import cross
from torchsfm.triangulation.line_views import ByLine, LineViews

_NOISE = 1.5
"""Distances, in units of noise, that say nothing."""
_CHANCE = 1e-6
"""How likely planes of one direction must fit so much worse than a line for it to be chance."""


class LineFault(IntEnum):
    """Why views do not determine a line.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.triangulation import LineFault
        >>> t = torch.tensor([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]).double()  # two cameras side by side
        >>> pose = torchsfm.Pose(torch.eye(3).double().expand(2, 3, 3), t)
        >>> K = torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])).double()
        >>> P = K @ pose.matrix()
        >>> upright, level = [[0.0, -1.0, 5.0], [0.0, 1.0, 5.0]], [[-1.0, 0.5, 5.0], [1.0, 0.5, 5.0]]
        >>> x = torchsfm.project_points(P[:, None], torch.tensor([upright, level]).double())
        >>> [LineFault(k).name for k in torchsfm.triangulate_lines(x, P).fault.tolist()]
        ['NONE', 'EPIPOLAR_PLANE']
    """

    NONE = 0
    TOO_FEW = 1
    """Fewer than two views see it."""
    ONE_CENTRE = 2
    """The views that see it have one centre."""
    EPIPOLAR_PLANE = 3
    """Two centres, and the line lies in a plane through both: both see it in corresponding epipolar lines."""
    COLLINEAR_CENTRES = 4
    """More centres, all in one line, and the line lies in a plane with them."""
    PLANE_OF_CENTRES = 5
    """The line lies in the one plane of all centres."""
    SHORT = 6
    """Segments so short, for their noise and for how far the views are apart, that they leave its direction open."""


def faults(views: LineViews, lost: Tensor, short: Tensor) -> Tensor:
    """The fault of lines that are lost (n), some of them as their segments are short (n), 0 elsewhere."""
    fault = torch.zeros_like(lost, dtype=torch.int64)
    (at,) = lost.nonzero(as_tuple=True)
    return fault.index_put((at,), _why(views.some(at).by_line(), short[at])) if len(at) else fault


def _why(views: ByLine, short: Tensor) -> Tensor:
    """The fault of lines whose segments are short (n), or whose planes of sight are one, from the centres of the views (n)."""
    centre, finite = views.centre, views.near
    counted = (finite & views.used)[..., None]
    number = counted.sum(1).clamp_min(1)
    mean = torch.where(counted, centre, 0.0).sum(1) / number
    reach = torch.where(counted, centre.square(), 0.0).sum((1, 2)).div(number[:, 0])
    apart = torch.where(counted, centre - mean[:, None], 0.0)
    values, _ = eigvalsh(apart.mT @ apart)
    # Eigenvalues are squares: a part in 1e10 is five digits.
    several = (values[:, 2] > 1e-22 * reach) | (views.used & ~finite).any(1)
    collinear = values[:, 1] <= 1e-10 * values[:, 2]
    distinct = _number_of_centres(centre, views.used, values[:, 2])
    fault = torch.where(collinear, int(LineFault.COLLINEAR_CENTRES), int(LineFault.PLANE_OF_CENTRES))
    fault = torch.where(distinct <= 2, int(LineFault.EPIPOLAR_PLANE), fault)
    fault = torch.where(short, int(LineFault.SHORT), fault)
    fault = torch.where(several, fault, int(LineFault.ONE_CENTRE))
    return torch.where(views.used.sum(1) < 2, int(LineFault.TOO_FEW), fault)


def _number_of_centres(centre: Tensor, used: Tensor, size: Tensor) -> Tensor:
    """How many different centres the views in use have (n)."""
    gap = (centre[:, :, None] - centre[:, None]).square().sum(-1)
    before = torch.ones(gap.shape[1:], dtype=torch.bool, device=gap.device).tril(-1)
    earlier = before & used[:, None]
    repeated = (earlier & (gap <= 1e-14 * size[:, None, None])).any(-1)
    return (used & ~repeated).sum(-1)


def one_plane(views: LineViews, error: Tensor) -> Tensor:
    """Whether all rays to the ends of segments lie in planes of one direction, but for noise of a unit or less (n).

    Then the planes of sight are one, or parallel, as far as can be told, and meet anywhere.

    Args:
        views: The views.
        error: The root-mean-square distance of the ends from the images of the lines (n).
    """
    found = _nearly_flat(views)
    (at,) = found.nonzero(as_tuple=True)
    return found.index_put((at,), _one_plane(views.some(at).by_line(), error[at])) if len(at) else found


def _nearly_flat(views: LineViews) -> Tensor:
    """Where the scatter of the rays does not rule out that they lie in planes of one direction (n).

    The distance of an end from the image of a direction of planes is at least the product of its ray and the normal, over the
    length of two rows of the camera's cofactors.
    """
    a, b, c = views.P[:, :3].unbind(0)
    first, second, third = cross(b, c), cross(c, a), cross(a, b)
    x, y = views.ends.unbind(0)
    rays = torch.addcmul(torch.addcmul(third[:, None], first[:, None], x), second[:, None], y).unbind(0)
    weight = views.w * views.near / (combine_rows(first, first) + combine_rows(second, second)).clamp_min(1e-300)

    def scatter(i: int, j: int) -> Tensor:
        return combine_rows(torch.addcmul(rays[i][0] * rays[j][0], rays[i][1], rays[j][1]), weight)

    s00, s01, s02, s11, s12, s22 = (scatter(i, j) for i in range(3) for j in range(i, 3))
    determinant = s00 * (s11 * s22 - s12 * s12) - s01 * (s01 * s22 - s12 * s02) + s02 * (s01 * s12 - s11 * s02)
    # No eigenvalue is less than the determinant over the greatest product of two others of the same trace.
    least = 4 * determinant / (s00 + s11 + s22).square().clamp_min(1e-300)
    number = add_rows((views.used & views.near).to(least.dtype))
    return ~(least > 2.1 * _NOISE**2 * number)


def _one_plane(views: ByLine, error: Tensor) -> Tensor:
    """The same of some lines, from the direction of planes that fits best."""
    cofactors, h = adjugate_3x3(views.P[..., :3]).mT, to_homogeneous(views.ends)
    rays = h @ cofactors
    rays = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True).clamp_min(1e-300)
    weighted = rays * torch.where(views.near, views.w, 0.0)[..., None, None]
    _, vectors, _ = eigh(weighted.flatten(1, 2).mT @ rays.flatten(1, 2))
    line = (cofactors.flatten(1, 2) @ vectors[..., :1]).view(*h.shape[:2], 1, 3)
    away = (h * line).sum(-1).square() / line[..., :2].square().sum(-1).clamp_min(1e-300)
    square = torch.where(views.near, views.w * away.mean(-1), 0.0).sum(-1)
    number = (views.used & views.near).sum(-1).to(square.dtype)
    # Of noise of any size, a line having two parameters more: a ratio of sums of squares whose distribution is a power.
    ratio = number * error.square() / square.clamp_min(1e-300)
    chance = ratio.clamp(max=1) ** (number - 2).clamp_min(0)
    return (square <= _NOISE**2 * number) & (chance >= _CHANCE) & (views.used <= views.near).all(-1)
