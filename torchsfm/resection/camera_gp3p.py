"""Pose of a rig of cameras (a generalised camera) from three rays with origins of their own to three known points.

The points at depths l along the rays, `Y_i = p_i + l_i d_i`, have the distances of the world points: three quadrics in
(l_1, l_2, l_3), which have up to eight real points in common (Nister & Stewenius, "A minimal solution to the generalised
3-point pose problem", JMIV 2007). They are intersected in coordinates turned to general position, so that symmetric rigs lose
nothing.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes, check_tensors
from torchsfm.linalg import qr
from torchsfm.linalg.constants import Constant
from torchsfm.linalg.portions import portions
from torchsfm.linalg.quadric_intersection import intersect_quadrics
from torchsfm.linalg.quaternary_forms import product_of_forms
from torchsfm.linalg.rows import combine_rows, take_columns
from torchsfm.optim import attach_implicit, for_slots, wants_derivative
from torchsfm.resection.triangle import ASIDE, NEAREST

_CHUNK = 8192
"""Problems at a time: what is in use stays in the cache."""
_PAIRS = ((0, 1), (0, 2), (1, 2))
_DIFFERENCES = ((0.5**0.5, 1 / 6**0.5), (-(0.5**0.5), 1 / 6**0.5), (0.0, -2 / 6**0.5))
"""Orthonormal coordinates of three numbers whose sum is 0."""
# A fixed rotation of the coordinates.
_TURN = Constant(qr(torch.tensor([[5.0, 1, -2, 3], [-1, 4, 3, 2], [2, -3, 5, 1], [3, 2, 1, -4]], dtype=torch.float64))[0])


def equations(
    model: Float[Tensor, "*#batch 3 4"],
    p: Float[Tensor, "*#batch 3 3"],
    d: Float[Tensor, "*#batch 3 3"],
    X: Float[Tensor, "*#batch 3 3"],
) -> Float[Tensor, "*batch 15"]:
    """Fifteen equations of rank 12 in `[R | t]`: R'R = I, and `d x (R X + t - p) = 0` for each point, with unit d."""
    R, t = model[..., :3], model[..., 3]
    gram = R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)
    i, j = torch.triu_indices(3, 3, device=R.device)
    Y = X @ R.mT + t[..., None, :] - p
    u, Y = torch.broadcast_tensors(d / torch.linalg.vector_norm(d, dim=-1, keepdim=True), Y)  # type: ignore[no-untyped-call]
    sideways = torch.linalg.cross(u, Y, dim=-1).flatten(-2)
    shape = broadcast_shapes(gram.shape[:-2], sideways.shape[:-1])
    return torch.cat([e.expand(*shape, e.shape[-1]) for e in (gram[..., i, j], sideways)], -1)


def camera_gp3p(
    p: Float[Tensor, "*#batch 3 3"], d: Float[Tensor, "*#batch 3 3"], X: Float[Tensor, "*#batch 3 3"]
) -> Solutions[Float[Tensor, "*batch 8 3 4"]]:
    """The up to eight poses `[R | t]` of a rig that sees three points along rays, `R X_i + t = p_i + l_i d_i` with l_i > 0.

    Computed in float64 whatever comes in. Differentiable in all arguments. With all origins at one place this is the problem of
    `camera_p3p`, which is faster. Parallel rays leave the translation along them open; no slot is valid there, nor where
    the points are collinear or coincide, or anything is not finite.

    Args:
        p: Origins of the rays in the rig's frame.
        d: Directions of the rays in the rig's frame, of any length.
        X: The points in the world frame.

    Returns:
        Eight slots of `rig_from_world` and which of them are solutions.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(3, generator=g), torchsfm.random_poses(generator=g)
        >>> p = torch.eye(3, dtype=X.dtype)  # three cameras of a rig
        >>> poses = torchsfm.resection.camera_gp3p(p, pose.transform(X) - p, X)
        >>> bool((poses.model[poses.valid] - pose.matrix()).abs().amax((-2, -1)).min() < 1e-6)  # the true one is there
        True
    """
    batch = check_tensors(p=(p, "3 3"), d=(d, "3 3"), X=(X, "3 3"))
    with torch.no_grad():
        rows = [a.detach().double().expand(*batch, 3, 3).reshape(-1, 3, 3).permute(1, 2, 0) for a in (p, d, X)]
        some = portions(max(rows[0].shape[-1], 1), _CHUNK, d.device)
        parts = [_solve(torch.finfo(d.dtype).eps, *(r[..., part].contiguous() for r in rows)) for part in some]
        model, valid = (torch.cat(part) for part in zip(*parts, strict=True))
        model, valid = model.reshape(*batch, 8, 3, 4).to(d.dtype), valid.reshape(*batch, 8)
        # Numbers of this kind may be too small for them.
        held = torch.isfinite(model).flatten(-2).all(-1)
        valid, model = valid & held, torch.where(held[..., None, None], model, 0)
    if wants_derivative(p, d, X):
        model = attach_implicit(equations, model, *(for_slots(a, batch) for a in (p, d, X)), dims=2, valid=valid)
    return Solutions(model, valid)


def _solve(eps: float, p: Tensor, d: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (batch, 8, 12) and validity (batch, 8) of p, d and X (point, coordinate, batch)."""
    batch = X.shape[-1]
    finite = (torch.isfinite(p) & torch.isfinite(d) & torch.isfinite(X)).all(0).all(0)
    reach = d.abs().amax(1, keepdim=True)
    d = d / torch.where(reach > 0, reach, 1.0)
    d = d * combine_rows(d.unbind(1), d.unbind(1)).rsqrt()[:, None]
    edges = [X[i] - X[j] for i, j in _PAIRS]
    sides = [combine_rows(e, e) for e in edges]
    normal = _cross(edges[0], edges[1])
    longest = torch.maximum(torch.maximum(sides[0], sides[1]), sides[2])
    far = X.abs().amax(0).amax(0)
    # Twice the area of the triangle against what rounding of the coordinates makes of it.
    flat = combine_rows(normal, normal).sqrt() <= 8 * eps * longest.sqrt() * torch.maximum(longest.sqrt(), far)
    crossed = torch.stack([combine_rows(c, c) for c in (_cross(d[i], d[j]) for i, j in _PAIRS)]).amax(0)
    good = finite & ~flat & (crossed > 1e-24)
    # What keeps the solutions apart: depths are counted from where two rays are as far from each other as their points, their
    # differences in units of the triangle, their mean in units of that depth.
    depth = torch.where(good, _common_depth(p, d, sides), 0.0)
    origin, p = p, p + d * depth
    apart = torch.stack([combine_rows(e, e) for e in (p[i] - p[j] for i, j in _PAIRS)]).amax(0)
    unit = torch.where(good, torch.maximum(longest, apart).sqrt(), torch.nan)
    shift = (p - origin) / unit
    p, X = p / unit, X / unit
    turn = _TURN.on(p.device, p.dtype)
    mean = (depth / unit).clamp_min(1.0) / 3**0.5
    # The depths and 1 as linear forms of the four coordinates.
    depths = [turn[:, 0, None] * mean + (turn[:, 1] * a + turn[:, 2] * b)[:, None] for a, b in _DIFFERENCES]
    quadrics = []
    for (i, j), side in zip(_PAIRS, sides, strict=True):
        apart = p[i] - p[j]
        forms = depths[i][:, None] * d[i] - depths[j][:, None] * d[j] + turn[:, 3, None, None] * apart
        q = sum(product_of_forms(forms[:, c], forms[:, c]) for c in range(3))
        one = turn[:, 3, None].expand(4, batch)
        quadrics.append(q - (side / (unit * unit)) * product_of_forms(one, one))
    found = intersect_quadrics(*quadrics)
    item = found.item
    u = [combine_rows(found.point, [turn[k, i] for k in range(4)]) for i in range(4)]
    u[0] = u[0] * mean[item]
    l = torch.stack([u[0] + a * u[1] + b * u[2] for a, b in _DIFFERENCES]) / u[3]  # noqa: E741
    p, d, X, unit, shift = (take_columns(v, item) if v.ndim > 1 else v[item] for v in (p, d, X, unit, shift))
    l, met, turn = _refine(l, p, d, X)  # noqa: E741
    nearest = (l + combine_rows(shift.unbind(1), d.unbind(1))).amin(0)
    right = met & (nearest > NEAREST * l.abs().amax(0)) & (turn <= ASIDE * nearest)
    Y = p + d * l[:, None]
    pose = _motion(X, Y)
    pose = torch.cat((pose[:, :3], pose[:, 3:] * unit), 1)
    keep = (right & torch.isfinite(pose).all(0).all(0)).nonzero()[:, 0]
    item = item[keep]
    slot = torch.arange(len(item), device=item.device) - torch.searchsorted(item, item)
    keep, item, slot = keep[slot < 8], item[slot < 8], slot[slot < 8]
    model = torch.eye(3, 4, dtype=p.dtype, device=p.device).flatten().repeat(batch, 8, 1)
    valid = torch.zeros(batch, 8, dtype=torch.bool, device=p.device)
    model[item, slot] = pose[..., keep].flatten(0, 1).T
    valid[item, slot] = True
    return model, valid


def _common_depth(p: Tensor, d: Tensor, sides: list[Tensor]) -> Tensor:
    """The smallest depth at which two of the rays are as far from each other as their points.

    Points at different depths make this too large, which the smallest suffers least from.
    """
    depths = []
    for (i, j), side in zip(_PAIRS, sides, strict=True):
        e, f = d[i] - d[j], p[i] - p[j]
        a, b, c = combine_rows(e, e), combine_rows(e, f), combine_rows(f, f) - side
        depth = ((b * b - a * c).clamp_min(0).sqrt() - b) / a
        depths.append(torch.where(depth > 0, depth, torch.inf))
    least = torch.minimum(torch.minimum(depths[0], depths[1]), depths[2])
    return torch.where(torch.isfinite(least), least, 0.0)


def _refine(l: Tensor, p: Tensor, d: Tensor, X: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # noqa: E741
    """Newton steps on the three distances, which depths meet them, and how far those that do not take points off their rays."""
    sides = [combine_rows(e, e) for e in (X[i] - X[j] for i, j in _PAIRS)]
    left = torch.full_like(l, torch.inf)
    for step in range(3):
        Y = p + d * l[:, None]
        gaps = [Y[i] - Y[j] for i, j in _PAIRS]
        r = [combine_rows(e, e) - side for e, side in zip(gaps, sides, strict=True)]
        left = torch.stack([(a / side).abs() for a, side in zip(r, sides, strict=True)])
        if step == 2:
            break
        # Rows: (a0, a1, 0), (b0, 0, b2), (0, c1, c2).
        a0, a1 = 2 * combine_rows(gaps[0], d[0]), -2 * combine_rows(gaps[0], d[1])
        b0, b2 = 2 * combine_rows(gaps[1], d[0]), -2 * combine_rows(gaps[1], d[2])
        c1, c2 = 2 * combine_rows(gaps[2], d[1]), -2 * combine_rows(gaps[2], d[2])
        det = -(a0 * b2 * c1 + a1 * b0 * c2)
        s0 = (-r[0] * b2 * c1 - a1 * (r[1] * c2 - b2 * r[2])) / det
        s1 = (a0 * (r[1] * c2 - b2 * r[2]) - r[0] * b0 * c2) / det
        s2 = (-a0 * r[1] * c1 - a1 * b0 * r[2] + r[0] * b0 * c1) / det
        new = l - torch.stack((s0, s1, s2))
        l = torch.where(torch.isfinite(new).all(0), new, l)  # noqa: E741
    # Far away the distances are small differences.
    reach = torch.stack([torch.maximum(l[i].abs(), l[j].abs()) ** 2 / side for (i, j), side in zip(_PAIRS, sides, strict=True)])
    length = torch.stack(sides).sqrt()
    longest = length.amax(0)
    # Lengths that are wrong by so much, be it by rounding, turn the triangle.
    turn = ((left * length).amax(0) + 1e-15 * longest) * longest / length.amin(0)
    return l, (left <= 1e-9 + (1e-14 * reach).clamp_max(1e-5)).all(0), turn


def _motion(X: Tensor, Y: Tensor) -> Tensor:
    """`[R | t]` (3, 4, batch) that takes the triangle X to the congruent triangle Y (point, coordinate, batch)."""
    A, B = _triad(X), _triad(Y)
    R = torch.stack([torch.stack([sum(B[k][i] * A[k][j] for k in range(3)) for j in range(3)]) for i in range(3)])  # type: ignore[misc]
    middle, image = (X[0] + X[1] + X[2]) / 3, (Y[0] + Y[1] + Y[2]) / 3
    t = torch.stack([image[i] - combine_rows(R[i], middle) for i in range(3)])
    return torch.cat((R, t[:, None]), 1)


def _triad(X: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    a, b = X[1] - X[0], X[2] - X[0]
    a = a * combine_rows(a, a).rsqrt()
    n = _cross(a, b)
    n = n * combine_rows(n, n).rsqrt()
    return a, _cross(n, a), n


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))
