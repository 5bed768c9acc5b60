"""Pose of a calibrated camera from two points and a line: one quadratic equation.

With `g = R'l`, the normal of the plane of sight in the world, and depths a1, a2 along unit rays, `g'V = 0`, `g'(A - X1) =
-a1 l'x1` and `g'D = a2 l'x2 - a1 l'x1` with `D = X2 - X1` are linear in (a1, a2, g): two numbers are left. `|g| = 1` and
`|a2 x2 - a1 x1| = |D|` are quadratic forms in them, whose difference has two directions as its zeros.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.nullspace import nullspace_columns
from torchsfm.linalg.rows import add_rows
from torchsfm.linalg.vectors import across
from torchsfm.resection.candidate_poses import Candidates, solve_poses
from torchsfm.resection.points_and_lines import Sample
from torchsfm.resection.vector_rows import dot_rows, frame_rows, norm_rows, outer_rows


def camera_2p1l(
    d: Float[Tensor, "*#batch 2 3"],
    X: Float[Tensor, "*#batch 2 3"],
    l: Float[Tensor, "*#batch 1 3"],  # noqa: E741
    L: Float[Tensor, "*#batch 1 6"],
) -> Solutions[Float[Tensor, "*batch 2 3 4"]]:
    """The up to two poses `[R | t]` that see two points along rays, with positive depths, and a line in a plane of sight.

    Computed in float64 whatever comes in; derivatives by the implicit function theorem. Of the four solutions of the equations
    two lie behind the camera. No slot is valid where the points coincide, the line says nothing more (it passes through
    both), or anything is not finite.

    Args:
        d: Rays in the camera frame, of any length, from the camera towards the points.
        X: The points in the world.
        l: Image lines as normals of their planes of sight in the camera frame, `K'l` of a line in pixels; of any scale.
        L: The lines in the world, Pluecker vectors (d, m); what is no line (d'm is not 0) has no solution.

    Returns:
        Two slots of `cam_from_world` and which of them are solutions.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(4, generator=g), torchsfm.random_poses(generator=g)
        >>> L = torchsfm.geometry.pluecker_from_points(X[2:3], X[3:4])  # a line
        >>> l = torchsfm.geometry.project_lines(pose.matrix(), L)
        >>> poses = torchsfm.resection.camera_2p1l(pose.transform(X[:2]), X[:2], l, L)
        >>> bool((poses.model[poses.valid] - pose.matrix()).abs().amax((-2, -1)).min() < 1e-6)  # the true one is there
        True
    """
    batch = check_tensors(d=(d, "2 3"), X=(X, "2 3"), l=(l, "1 3"), L=(L, "1 6"))
    return solve_poses(_candidates, 2, batch, d, X, l, L)


def _candidates(s: Sample) -> list[Candidates]:
    (x1, x2), l, V, A, D = s.d.unbind(1), s.l[:, 0], s.V[:, 0], s.A[:, 0], s.X[:, 0]  # noqa: E741
    # The first point is the origin; lengths in units of D.
    length = norm_rows(D)
    A, D = A / length, D / length
    side = V - dot_rows(V, D) * D
    along = dot_rows(side, side) < 1e-20
    e1, e2, e3 = frame_rows(D, torch.where(along, across(D)[0], V))
    v1, v2 = dot_rows(e1, V), dot_rows(e2, V)
    w1, w2, w3 = dot_rows(e1, A), dot_rows(e2, A), dot_rows(e3, A)
    k1, k2 = -dot_rows(l, x1), dot_rows(l, x2)
    # Of (a1, a2, g2, g3) with g1 = k1 a1 + k2 a2.
    columns = (v1 * k1, (w1 - 1) * k1, v1 * k2, w1 * k2, v2, w2, torch.zeros_like(k1), w3)
    basis, _ = nullspace_columns(torch.stack(columns).view(4, 2, -1))
    a1, a2, g2, g3 = basis.unbind(0)
    g1 = (k1 * a1).addcmul_(k2, a2)
    c = dot_rows(x1, x2)
    # Of each pair of basis vectors: |g|^2, and the difference to |a2 x2 - a1 x1|^2.
    n11, n12, n22 = _products((g1, g2, g3))
    q11, q12, q22 = _products((a1, a2))
    e11, e22 = (n - q + 2 * c * m for n, q, m in ((n11, q11, a1[0] * a2[0]), (n22, q22, a1[1] * a2[1])))
    e12 = n12 - q12 + c * (a1[0] * a2[1] + a2[0] * a1[1])
    root = e12 * e12 - e11 * e22
    real = root >= -1e-13 * (e12 * e12 + (e11 * e22).abs())
    z = -(e12 + torch.copysign(root.clamp_min(0).sqrt(), e12))
    first, second = torch.stack((z, e22)), torch.stack((e11, z))
    scale = (n11 * first**2 + 2 * n12 * first * second + n22 * second**2).rsqrt()
    # In front of the camera.
    scale = torch.copysign(scale, first * (a1 + a2)[0] + second * (a1 + a2)[1])
    first, second = torch.where(real, scale, torch.nan) * torch.stack((first, second))
    a1, a2, g2, g3 = (first * v[0] + second * v[1] for v in (a1, a2, g2, g3))
    # The normal g across D.
    size = (g2 * g2 + g3 * g3).rsqrt_()
    g2, g3 = g2 * size, g3 * size
    e1, e2, e3, x1, x2, l = (v[:, None] for v in (e1, e2, e3, x1, x2, l))  # noqa: E741
    world = e1.expand(3, *g2.shape), g2 * e2 + g3 * e3, g2 * e3 - g3 * e2
    R = outer_rows(frame_rows(a2 * x2 - a1 * x1, l.expand(3, *g2.shape)), world)
    slot, item = torch.meshgrid(*(torch.arange(k, device=l.device) for k in g2.shape), indexing="ij")
    t = a1 * length * x1
    return [Candidates(item.flatten(), slot.flatten(), R.flatten(2), t.flatten(1), s.times(2))]


def _products(rows: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Scalar products of two vectors: of the first with itself, of both, of the second with itself."""
    first, both, second = (add_rows([row[i] * row[j] for row in rows]) for i, j in ((0, 0), (0, 1), (1, 1)))
    return first, both, second
