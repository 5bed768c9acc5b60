"""Orientation and place of a calibrated camera from three lines: one equation of degree eight.

In frames of the camera and the world where `l_1 = e_1` and `V_1 = e_3`, the rotations with `l_1'R V_1 = 0` are `Rx(alpha)
Rz(beta)`, and `l_i'R V_i = 0` is bilinear in (1, cos alpha, sin alpha) and (1, cos beta, sin beta). Two lines give the latter
as a cross product; that it is a point of the unit circle is of degree four in cos and sin of alpha, eight in the tangent of its
half.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import cross, inverse
from torchsfm.linalg.constants import Constant
from torchsfm.linalg.real_roots import real_root_list
from torchsfm.resection.points_and_lines import Sample, frame, solve_poses

CONCURRENT = 1e-7
"""Volume that the unit normals of three planes of sight span, at which they meet in a line but for rounding."""
_DEGREE = 8
_ANGLES = 2 * math.pi * torch.arange(_DEGREE + 1, dtype=torch.float64) / (_DEGREE + 1) + 0.3
_POWERS = torch.arange(_DEGREE + 1)
_NODES = Constant(torch.stack((_ANGLES.cos(), _ANGLES.sin())))
_TO_COEFFICIENTS = Constant(
    inverse((0.5 * _ANGLES).sin()[:, None] ** _POWERS * (0.5 * _ANGLES).cos()[:, None] ** (_DEGREE - _POWERS))[0]
)
"""From values at the angles to coefficients of sin^k cos^(8 - k) of the half angle."""


def camera_3l(
    l: Float[Tensor, "*#batch 3 3"],  # noqa: E741
    L: Float[Tensor, "*#batch 3 6"],
) -> Solutions[Float[Tensor, "*batch 8 3 4"]]:
    """The up to eight poses `[R | t]` that see three lines in planes of sight.

    Lines have no depths: what is seen of them tells which poses have it in front. Computed in float64 whatever comes in;
    derivatives by the implicit function theorem. No slot is valid where all lines are parallel, the planes of sight meet in a
    line (concurrent image lines, which leave a shift open), or anything is not finite.

    Args:
        l: Image lines as normals of their planes of sight in the camera frame, `K'l` of a line in pixels; of any scale.
        L: The lines in the world, Pluecker vectors (d, m); what is no line (d'm is not 0) has no solution.

    Returns:
        Eight slots of `cam_from_world` and which of them are solutions.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(6, generator=g), torchsfm.random_poses(generator=g)
        >>> L = torchsfm.geometry.pluecker_from_points(X[:3], X[3:])  # three lines
        >>> poses = torchsfm.resection.camera_3l(torchsfm.geometry.project_lines(pose.matrix(), L), L)
        >>> bool((poses.model[poses.valid] - pose.matrix()).abs().amax((-2, -1)).min() < 1e-6)  # the true one is there
        True
    """
    batch = check_tensors(l=(l, "3 3"), L=(L, "3 6"))
    none = l.new_zeros(0, 3)
    return solve_poses(_candidates, 8, batch, none, none, l, L)


def _candidates(s: Sample) -> tuple[Tensor, Tensor]:
    s = _ordered(s)
    (l1, l2, l3), (V1, V2, V3) = s.l.unbind(1), s.V.unbind(1)
    camera = frame(l1, l2)
    # Columns 2, 3, 1 of the world's frame, so that V1 is the third axis.
    world = frame(V1, V2).roll(-1, -1)
    p = [(camera.mT @ l[..., None])[..., 0] for l in (l2, l3)]  # noqa: E741
    q = [(world.mT @ V[..., None])[..., 0] for V in (V2, V3)]
    cos, sin = _NODES.on(l1.device)[:, :, None]
    w = _circle_point(p, q, cos, sin)
    c = _TO_COEFFICIENTS.on(l1.device) @ (w[1].square() + w[2].square() - w[0].square())
    roots = real_root_list(torch.where(c.isfinite().all(0), c, torch.nan))
    slot, item = roots.slot().clamp_max(7), roots.item
    # tan(alpha / 2) = s / t.
    size = 1 / (roots.s.square() + roots.t.square())
    cos, sin = (roots.t.square() - roots.s.square()) * size, 2 * roots.s * roots.t * size
    w = _circle_point([v[item] for v in p], [v[item] for v in q], cos, sin)
    length = torch.copysign((w[1].square() + w[2].square()).sqrt(), w[0])
    cos_b, sin_b = w[1] / length, w[2] / length
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    about_x = torch.stack((one, zero, zero, zero, cos, -sin, zero, sin, cos), -1).reshape(-1, 3, 3)
    about_z = torch.stack((cos_b, -sin_b, zero, sin_b, cos_b, zero, zero, zero, one), -1).reshape(-1, 3, 3)
    turn = camera[item] @ (about_x @ about_z @ world.mT[item])
    # Concurrent image lines: three planes of sight through one line, along which nothing is told.
    volume = (l1 * cross(l2, l3)).sum(-1)
    told = (volume.abs() > CONCURRENT)[:, None]
    edges = (
        torch.stack((cross(l2, l3), cross(l3, l1), cross(l1, l2)), -1)
        / torch.where(told, volume[:, None], torch.nan)[..., None]
    )
    offset = (s.l[item] * (s.A[item] @ turn.mT)).sum(-1, keepdim=True)
    R, t = l1.new_full((len(l1), 8, 3, 3), torch.nan), l1.new_full((len(l1), 8, 3), torch.nan)
    R[item, slot], t[item, slot] = turn, -(edges[item] @ offset)[..., 0]
    return R, t


def _circle_point(p: list[Tensor], q: list[Tensor], cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The vector along (1, cos beta, sin beta) for alpha, as three tensors."""
    rows = []
    for normal, direction in zip(p, q, strict=True):
        p1, p2, p3 = normal.unbind(-1)
        q1, q2, q3 = direction.unbind(-1)
        y = p2 * cos + p3 * sin
        rows.append(((p3 * cos - p2 * sin) * q3, p1 * q1 + y * q2, y * q1 - p1 * q2))
    (a0, a1, a2), (b0, b1, b2) = rows
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


def _ordered(s: Sample) -> Sample:
    """The line whose direction is least like another one's first: two of the lines may be parallel."""
    sine = cross(s.V[:, [0, 0, 1]], s.V[:, [1, 2, 2]]).square().sum(-1)
    least = torch.stack([sine[:, [0, 1]].amin(-1), sine[:, [0, 2]].amin(-1), sine[:, [1, 2]].amin(-1)], -1)
    order = (least.argmax(-1, keepdim=True) + torch.arange(3, device=sine.device)) % 3

    def taken(v: Tensor) -> Tensor:
        return v.gather(1, order[..., None].expand_as(v))

    return s._replace(l=taken(s.l), V=taken(s.V), A=taken(s.A))
