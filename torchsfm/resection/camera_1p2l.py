"""Pose of a calibrated camera from a point and two lines: one quartic equation.

The normals `g_i = R'l_i` of the planes of sight are across the lines' directions: with the foot F_i of the point X on line i,
w_i the unit vector from X to F_i and `u_i = V_i x w_i`, `g_i = depth (a_i w_i + b_i u_i)`, of which the line's place gives
`a_i = -l_i'x / |F_i - X|`. Unit normals at the angle of l_1 and l_2 leave two conics in (b_1, b_2), one of them a hyperbola: in
the product form `(b_1 + b_2)(b_1 - b_2) = a_2^2 - a_1^2` one of the factors is the unknown of a quartic.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.quartic import quartic_rows
from torchsfm.linalg.rows import take_columns
from torchsfm.resection.candidate_poses import Candidates, solve_poses
from torchsfm.resection.points_and_lines import Sample
from torchsfm.resection.vector_rows import cross_rows, dot_rows, frame_rows, norm_rows, outer_rows

_LEAST = 1e-6
"""What is zero counts as so much: no root is infinite or double then, and Newton's method on poses makes up for it."""


def camera_1p2l(
    d: Float[Tensor, "*#batch 1 3"],
    X: Float[Tensor, "*#batch 1 3"],
    l: Float[Tensor, "*#batch 2 3"],  # noqa: E741
    L: Float[Tensor, "*#batch 2 6"],
) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
    """The up to four poses `[R | t]` that see a point along a ray, with positive depth, and two lines in planes of sight.

    Computed in float64 whatever comes in; derivatives by the implicit function theorem. Of the eight solutions of the
    equations four lie behind the camera. No slot is valid where the point lies on one of the lines, the planes of sight are
    one, or anything is not finite.

    Args:
        d: Ray in the camera frame, of any length, from the camera towards the point.
        X: The point in the world.
        l: Image lines as normals of their planes of sight in the camera frame, `K'l` of a line in pixels; of any scale.
        L: The lines in the world, Pluecker vectors (d, m); what is no line (d'm is not 0) has no solution.

    Returns:
        Four slots of `cam_from_world` and which of them are solutions.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(5, generator=g), torchsfm.random_poses(generator=g)
        >>> L = torchsfm.geometry.pluecker_from_points(X[1:3], X[3:5])  # two lines
        >>> l = torchsfm.geometry.project_lines(pose.matrix(), L)
        >>> poses = torchsfm.resection.camera_1p2l(pose.transform(X[:1]), X[:1], l, L)
        >>> bool((poses.model[poses.valid] - pose.matrix()).abs().amax((-2, -1)).min() < 1e-6)  # the true one is there
        True
    """
    batch = check_tensors(d=(d, "1 3"), X=(X, "1 3"), l=(l, "2 3"), L=(L, "2 6"))
    return solve_poses(_candidates, 4, batch, d, X, l, L)


def _candidates(s: Sample) -> list[Candidates]:
    # The point is the origin.
    l1, l2 = s.l.unbind(1)
    distance = norm_rows(s.A)
    w = s.A / distance
    u = cross_rows(s.V, w)
    a1, a2 = (-dot_rows(s.l, s.d.expand_as(s.l)) / distance).unbind(0)
    (w1, w2), (u1, u2) = w.unbind(1), u.unbind(1)
    k, ww, uu = dot_rows(l1, l2), dot_rows(w1, w2), dot_rows(u1, u2)
    by1, by2 = dot_rows(u1, w2) * a2, dot_rows(w1, u2) * a1
    # In p = b1 + b2 and q = b1 - b2 = product / p, scaled to the size of the a's.
    size = (a1 * a1).addcmul_(a2, a2).sqrt_()
    a1, a2, by1, by2 = (v / size for v in (a1, a2, by1, by2))
    product = _not_zero((a2 - a1) * (a2 + a1))
    c = torch.stack(
        (
            -0.25 * (uu + k) * product * product,
            0.5 * (by1 - by2) * product,
            ww * a1 * a2 - 0.5 * k,
            0.5 * (by1 + by2),
            0.25 * (uu - k),
        )
    )
    # The inverse of p where that has the larger leading coefficient.
    turn = c[0].abs() > c[4].abs()
    c = torch.where(turn, c.flip(0), c)
    c[4] = _not_zero(c[4], c.abs().amax(0))
    roots, real = quartic_rows(c)
    item, slot = real.mT.nonzero(as_tuple=True)
    turn, roots = turn[item], roots[slot, item]
    product, a1, a2, size = take_columns(torch.stack((product, a1, a2, size)), item).unbind(0)
    p = torch.where(turn, 1 / roots, roots)
    q = product / p
    b1, b2 = 0.5 * (p + q), 0.5 * (p - q)
    depth = (a1 * a1).addcmul_(b1, b1).rsqrt_()
    w1, w2, u1, u2 = take_columns(torch.cat((w, u), 1), item).unbind(1)
    # A frame does not depend on how long the vectors are.
    world = frame_rows(a1 * w1 + b1 * u1, a2 * w2 + b2 * u2)
    R = outer_rows(take_columns(torch.stack(frame_rows(l1, l2)), item).unbind(0), world)
    one = s.of(item)
    return [Candidates(item, slot, R, depth / size * one.d[:, 0], one)]


def _not_zero(x: Tensor, size: Tensor | None = None) -> Tensor:
    """Numbers of some size, or of 1, at least a little off zero."""
    least = x.abs().clamp_min(_LEAST) if size is None else x.abs().maximum(_LEAST * size)
    return torch.copysign(least, x)
