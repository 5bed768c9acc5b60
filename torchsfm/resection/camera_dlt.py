"""An uncalibrated camera from points and lines, by linear least squares (Hartley & Zisserman, 2nd edition, 7.1-7.2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.geometry import normalizing_similarity
from torchsfm.linalg import cross, eigvalsh, null_vector, svdvals, unit_scale, usable

FLAT = 1e-6
"""Singular value, over the largest, at which a second null vector is taken for exact (a plane, in float32 coordinates)."""
BLURRED = 3.0
"""How much larger than the smallest singular value, which is noise, the second smallest must be. The same holds of how far two
cameras are from the data in the image."""
RANK = 1e-6
"""Smallest singular value of a camera, over its largest, at which it is none: all it sees lies in a plane or on a line."""


@dataclass(frozen=True)
class CameraEstimate:
    """Cameras and whether the data determine them.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X = torch.stack([torchsfm.random_points(8, kind=kind, generator=g) for kind in ("ball", "plane")])
        >>> P = torchsfm.random_poses(generator=g).matrix()
        >>> found = torchsfm.resection.camera_dlt(torchsfm.project_points(P, X), X)
        >>> [torchsfm.Status(k).name for k in found.status.tolist()]  # a plane does not determine all of a camera
        ['OK', 'DEGENERATE']
        >>> bool((found.model[0] / found.model[0, 2, 3]).allclose(P / P[2, 3]))
        True
    """

    model: Float[Tensor, "*batch 3 4"]
    """P, finite always. |(P31, P32, P33)| = 1, and most of the structure has positive depth if det P[:, :3] > 0."""
    status: Int8[Tensor, "*batch"]
    """OK; NOT_FINITE: data with weight are not finite; TOO_FEW: fewer than 11 equations; DEGENERATE: the equations have more
    than one solution, or nearly so for their noise (coplanar structure, a twisted cubic through the centre)."""


def camera_dlt(
    x: Float[Tensor, "*#batch n 2"],
    X: Float[Tensor, "*#batch n 3"],
    l: Float[Tensor, "*#batch k 3"] | None = None,  # noqa: E741
    L: Float[Tensor, "*#batch k 6"] | None = None,
    *,
    weights: Float[Tensor, "*#batch n _"] | Float[Tensor, "*#batch n"] | None = None,
    line_weights: Float[Tensor, "*#batch k"] | None = None,
) -> CameraEstimate:
    """The 3x4 camera from n points and k lines with 2 n + 2 k >= 11 equations, normalised in the image and in the world.

    A point gives the two rows of `x ~ P X`, a line says of two of its points that they are seen on the image line.
    Least squares in algebraic error: the start for a refinement, not its replacement. Computed in float64; the
    derivative is that of the solution. The minimal case of 5 1/2 points is six points with the weight of one coordinate
    0.

    Args:
        x: Image points in pixels.
        X: The points in the world.
        l: Image lines as homogeneous 3-vectors, `l'x = 0`, of any scale.
        L: The lines in the world, Pluecker vectors (d, m), direction and moment `m = p x d`.
        weights: Of the points' squared errors, `(*batch, n)` or for each coordinate `(*batch, n, 2)`; 0 for absent.
        line_weights: Of the lines' squared errors.

    Returns:
        The cameras and their status.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit; only one of `l` and `L` is given; or fewer than 11 equations in all.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(10, generator=g), torchsfm.random_poses(generator=g).matrix()
        >>> found = torchsfm.resection.camera_dlt(torchsfm.project_points(P, X), X)
        >>> bool(torchsfm.geometry.camera_centre(found.model).allclose(torchsfm.geometry.camera_centre(P)))
        True
    """
    if (l is None) != (L is None) or (l is None and line_weights is not None):
        raise ValueError("l, L: wanted both or neither, and line_weights only with them")
    n = x.shape[-2] if isinstance(x, Tensor) and x.ndim > 1 else 0
    per_coordinate = isinstance(weights, Tensor) and weights.ndim > 1 and weights.shape[-1] == 2 and n != 2
    batch = check_tensors(
        x=(x, "n 2"),
        X=(X, "n 3"),
        l=(l, "?k 3"),
        L=(L, "?k 6"),
        weights=(weights, "?n 2" if per_coordinate else "?n"),
        line_weights=(line_weights, "?k"),
    )
    k = 0 if l is None else l.shape[-2]
    if 2 * (n + k) < 11:
        raise ValueError(f"x: wanted at least 11 equations (six points or lines), got {n} points and {k} lines")
    dtype = x.dtype
    w = torch.ones(n, dtype=dtype, device=x.device) if weights is None else weights
    w = w if per_coordinate else w[..., None].expand(*w.shape, 2)
    x, X, w, bad = _clean(batch, x, X, w)

    present = w.amax(-1)
    everything, both = X, present
    rows = []
    T = normalizing_similarity(x, present)
    if l is not None and L is not None:
        v = torch.ones(k, dtype=dtype, device=x.device) if line_weights is None else line_weights
        lines, space, v, bad_lines = _clean(batch, l, L, v[..., None])
        bad = bad | bad_lines
        directions = _unit(space[..., :3])
        feet = cross(directions, space[..., 3:] / _norm(space[..., :3]))
        both = torch.cat((present, v[..., 0]), -1)
        # The feet of the perpendiculars from the origin say where the lines are only if the origin is near them.
        middle = (torch.cat((X, feet), -2) * both[..., None]).sum(-2) / both.sum(-1, keepdim=True).clamp_min(1e-300)
        feet = feet + ((middle[..., None, :] - feet) * directions).sum(-1, keepdim=True) * directions
        everything = torch.cat((X, feet), -2)
        S = normalizing_similarity(everything, both)
        flat = lines @ torch.linalg.inv_ex(T)[0]
        rows.append(_line_rows(flat / _norm(flat[..., :2]), _apply(S, feet), directions, v))
    else:
        S = normalizing_similarity(X, present)
    rows.append(_point_rows(_apply(T, x), _apply(S, X), w))
    A = torch.cat(rows, -2)
    p, _ = null_vector(A)
    equations = (A.detach() != 0).any(-1).sum(-1)
    degenerate = ~_determined(A.detach(), p.detach()) | _blurred(A.detach())
    # A plane and one point off it: the matrix that takes the plane to nothing and the point to its image.
    sees = svdvals(p.detach().reshape(*batch, 3, 4))[0]
    degenerate = degenerate | (sees[..., 2] <= RANK * sees[..., 0])
    P = torch.linalg.solve_ex(T, p.reshape(*batch, 3, 4) @ S)[0]
    P = _scaled(P, everything, both).to(dtype)
    # Points so far away that numbers of this kind hold no camera that sees them.
    held = torch.isfinite(P).flatten(-2).all(-1) & (P != 0).flatten(-2).any(-1)
    degenerate, P = degenerate | ~held, torch.where(held[..., None, None], P, 0)

    status = torch.full(batch, int(Status.OK), dtype=torch.int8, device=x.device)
    for condition, code in ((degenerate, Status.DEGENERATE), (equations < 11, Status.TOO_FEW), (bad, Status.NOT_FINITE)):
        status = torch.where(condition, int(code), status)
    return CameraEstimate(P, status)


def _clean(batch: torch.Size, a: Tensor, b: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """In float64 and full batch shape, absent rows zero; and which elements have rows with weight that are not finite."""
    a, b, w = (t.double().expand(*batch, *t.shape[-2:]) for t in (a, b, w.expand(*w.shape[:-2], a.shape[-2], w.shape[-1])))
    good = usable(a).all(-1) & usable(b).all(-1) & usable(w).all(-1) & (w >= 0).all(-1)
    wanted = (w != 0).any(-1)
    use = (wanted & good)[..., None]
    return torch.where(use, a, 0.0), torch.where(use, b, 0.0), torch.where(use, w, 0.0), (wanted & ~good).any(-1)


def _norm(v: Tensor) -> Tensor:
    square = (v * v).sum(-1, keepdim=True)
    return torch.where(square > 0, square, 1.0).sqrt()


def _unit(v: Tensor) -> Tensor:
    return v / _norm(v)


def _apply(T: Tensor, x: Tensor) -> Tensor:
    """A similarity applied to points."""
    return x @ T[..., :-1, :-1].mT + T[..., None, :-1, -1]


def _homogeneous(X: Tensor) -> Tensor:
    return torch.cat((X, torch.ones_like(X[..., :1])), -1)


def _point_rows(x: Tensor, X: Tensor, w: Tensor) -> Tensor:
    """The two equations of each point, (*batch, 2 n, 12)."""
    # A zero weight must not meet the derivative of the square root at 0.
    root = torch.where(w > 0, torch.where(w > 0, w, 1.0).sqrt(), 0.0)
    # (1, 0, -u) and (0, 1, -v) times the point.
    covectors = torch.cat((torch.diag_embed(root), (-root * x)[..., None]), -1)
    return (covectors[..., None] * _homogeneous(X)[..., None, None, :]).flatten(-2).flatten(-3, -2)


def _line_rows(line: Tensor, feet: Tensor, directions: Tensor, w: Tensor) -> Tensor:
    """The two equations of each line, for a point and the direction, (*batch, 2 k, 12)."""
    root = torch.where(w > 0, torch.where(w > 0, w, 1.0).sqrt(), 0.0)
    ends = (_homogeneous(feet), torch.cat((directions, torch.zeros_like(directions[..., :1])), -1))
    return torch.cat([(line[..., :, None] * end[..., None, :]).flatten(-2) * root for end in ends], -2)


def _determined(A: Float[Tensor, "*batch m 12"], p: Float[Tensor, "*batch 12"]) -> Bool[Tensor, "*batch"]:
    """Whether the second smallest singular value is far from zero and from the smallest, whose vector p is.

    So it is where A'A stays positive with its least eigenvalue lifted and a square taken from all; no eigenvalue is needed.
    """
    N, v = A.mT @ A, p[..., None]
    # At least the largest eigenvalue, and not twice as much.
    largest = torch.linalg.vector_norm(N @ N, dim=(-2, -1)).sqrt()
    noise = (A @ v).square().sum((-2, -1))
    limit = torch.maximum(FLAT**2 * largest, BLURRED**2 * noise)
    lifted = N + (largest[..., None, None] * v) @ v.mT
    lifted.diagonal(dim1=-2, dim2=-1).sub_(limit[..., None])
    positive: Tensor = torch.linalg.cholesky_ex(lifted)[1] == 0
    return positive


def _blurred(A: Tensor) -> Tensor:
    """Whether cameras of two third rows are as near to the data, in the image."""
    distance, rounding = _squared_distances(A)
    return ~(distance[..., 1] > BLURRED**2 * torch.maximum(distance[..., 0], rounding))


def _squared_distances(A: Tensor) -> tuple[Tensor, Tensor]:
    """How near cameras of four third rows are to the data in the image, from the nearest on: mean squares of a coordinate.

    And what of them may be rounding: much, where points are nearly in a plane or on a line.

    Noise in the image enters every equation with its depth: of two solutions that of smaller depths leaves less of A p, however
    wrong it is. So what the best first two rows leave is measured by the depths.
    """
    N = A.mT @ A
    depths = N[..., :4, :4] + N[..., 4:8, 4:8]
    # Where the first fails the other one does: structure in a plane.
    half = torch.linalg.solve_triangular(torch.linalg.cholesky_ex(N[..., :8, :8])[0], N[..., :8, 8:], upper=False)
    left = N[..., 8:, 8:] - half.mT @ half
    unit = torch.linalg.inv_ex(torch.linalg.cholesky_ex(depths)[0])[0]
    rounding = 16 * torch.finfo(A.dtype).eps * N[..., 8:, 8:].diagonal(dim1=-2, dim2=-1).sum(-1)
    return eigvalsh(unit @ left @ unit.mT)[0], rounding * unit.square().sum((-2, -1))


def other_camera(
    x: Float[Tensor, "*#batch n 2"],
    X: Float[Tensor, "*#batch n 3"],
    present: Bool[Tensor, "*#batch n"],
    exact: Float[Tensor, "*#batch"],
    factor: float = BLURRED,
) -> Bool[Tensor, "*batch"]:
    """Whether a second camera is as near to points as the best is, in the image.

    Args:
        x: Image points.
        X: The points; both of moderate size around 0.
        present: Which of them count.
        exact: The least distance that is not rounding.
        factor: How much farther the second must be.
    """
    w = present.to(x.dtype)[..., None].expand(*present.shape, 2)
    x, X = (torch.where(present[..., None], t, 0) for t in (x, X))
    distance, rounding = _squared_distances(_point_rows(x, X, w))
    # A distance that is no number is known even less.
    return ~(distance[..., 1] > factor**2 * torch.maximum(distance[..., 0], torch.maximum(exact.square(), rounding)))


def _scaled(P: Tensor, X: Tensor, w: Tensor) -> Tensor:
    """|third row of the left part| = 1 (|P| = 1 for affine cameras), and most points at positive third coordinates."""
    P = P * unit_scale(P)
    third = torch.linalg.vector_norm(P[..., 2:, :3], dim=-1, keepdim=True)
    whole = torch.linalg.vector_norm(P, dim=(-2, -1), keepdim=True)
    size = torch.where(third.detach() > 1e-12 * whole.detach(), third, torch.where(whole.detach() > 0, whole, 1.0))
    depth = (X.detach() @ P.detach()[..., 2, :3, None])[..., 0] + P.detach()[..., 2, 3:]
    votes = (torch.sign(depth) * w.detach()).sum(-1)
    return P / size * torch.where(votes < 0, -1.0, 1.0)[..., None, None]
