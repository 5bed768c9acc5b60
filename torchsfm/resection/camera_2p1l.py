"""Pose of a calibrated camera from two points and a line: one quadratic equation.

With `g = R'l`, the normal of the plane of sight in the world, and depths a1, a2 along unit rays, `g'V = 0`, `g'(A - X1) =
-a1 l'x1` and `g'D = a2 l'x2 - a1 l'x1` with `D = X2 - X1` are linear in (a1, a2, g): two numbers are left. `|g| = 1` and
`|a2 x2 - a1 x1| = |D|` are quadratic forms in them, whose difference has two directions as its zeros.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.nullspace import nullspace_rows
from torchsfm.resection.points_and_lines import Candidates, Sample, frame, solve_poses


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


def _candidates(s: Sample) -> Candidates:
    d, X, l, V, A = (v.permute(2, 1, 0).contiguous() for v in s[:5])  # noqa: E741
    (x1, x2), l, V, A = d.unbind(1), l[:, 0], V[:, 0], A[:, 0]  # noqa: E741
    D = X[:, 1]
    length = D.square().sum(-1).sqrt()
    # The first point is the origin; lengths in units of D.
    A = A / length[:, None]
    D = D / length[:, None]
    axis = torch.nn.functional.one_hot(D.abs().argmin(-1), 3).to(D.dtype)
    side = V - (V * D).sum(-1, keepdim=True) * D
    along = side.square().sum(-1, keepdim=True) < 1e-20
    world = frame(D, torch.where(along, axis, V))
    v1, v2, _ = (world.mT @ V[..., None])[..., 0].unbind(-1)
    w1, w2, w3 = (world.mT @ A[..., None])[..., 0].unbind(-1)
    k1, k2 = -(l * x1).sum(-1), (l * x2).sum(-1)
    zero = torch.zeros_like(k1)
    # Of (a1, a2, g2, g3) with g1 = k1 a1 + k2 a2.
    rows = torch.stack((v1 * k1, v1 * k2, v2, zero, w1 * k1 - k1, w1 * k2, w2, w3)).reshape(2, 4, -1)
    basis, _ = nullspace_rows(rows)
    a1, a2, g2, g3 = basis.unbind(1)
    g1 = k1 * a1 + k2 * a2
    c = (x1 * x2).sum(-1)

    def forms(i: int, j: int) -> tuple[Tensor, Tensor]:
        normal = g1[i] * g1[j] + g2[i] * g2[j] + g3[i] * g3[j]
        return normal, a1[i] * a1[j] + a2[i] * a2[j] - c * (a1[i] * a2[j] + a2[i] * a1[j])

    (n11, q11), (n12, q12), (n22, q22) = forms(0, 0), forms(0, 1), forms(1, 1)
    e11, e12, e22 = n11 - q11, n12 - q12, n22 - q22
    root = e12 * e12 - e11 * e22
    real = root >= -1e-13 * (e12 * e12 + (e11 * e22).abs())
    z = -(e12 + torch.copysign(root.clamp_min(0).sqrt(), e12))
    first, second = torch.stack((z, e22), 1), torch.stack((e11, z), 1)
    scale = (n11[:, None] * first**2 + 2 * n12[:, None] * first * second + n22[:, None] * second**2).rsqrt()
    scale = torch.where(real[:, None], scale, torch.nan)

    def at(v: Tensor) -> Tensor:
        return (first * v[0][:, None] + second * v[1][:, None]) * scale

    a1, a2 = at(a1), at(a2)
    sign = torch.where(a1 + a2 < 0, -1.0, 1.0)
    a1, a2 = a1 * sign, a2 * sign
    g = torch.stack((at(g1), at(g2), at(g3)), -1) * sign[..., None]
    g = (world[:, None] @ g[..., None])[..., 0]
    y = a2[..., None] * x2[:, None] - a1[..., None] * x1[:, None]
    R = frame(y, l[:, None].expand_as(y)) @ frame(D[:, None].expand_as(g), g).mT
    return Candidates.of_slots(R, (a1 * length[:, None])[..., None] * x1[:, None])
