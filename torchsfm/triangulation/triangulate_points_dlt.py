"""Linear triangulation: the point whose rays' planes it misses least."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.triangulation.observations import Observations, in_pieces, row_dot
from torchsfm.triangulation.symmetric import smallest_eigenvector, symmetric, tangent_step


def triangulate_points_dlt(
    x: Float[Tensor, "*#batch v n 2"],
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    weights: Float[Tensor, "*#batch v n"] | None = None,
    homogeneous: bool = False,
) -> Float[Tensor, "*batch n _"]:
    """Points from their images in any number of known views, by linear least squares.

    Every observation gives two planes through its camera's centre, `x p3 - p1` and `y p3 - p2`; the homogeneous point
    is the unit vector with the smallest sum of squared products with them (Hartley & Zisserman, 2nd edition, section
    12.2). The planes are scaled to unit vectors in a world moved and scaled to the cameras (their centres have mean 0
    and root-mean-square distance 1), so that the answer does not depend on the scale of the camera matrices or on the
    similarity frame of the world. Computed in float64 whatever comes in; the derivative is that of the solution.

    The result is always finite. It means nothing for a point with fewer than two observations or whose rays coincide;
    `triangulate_points` reports such things. An observation that is not finite, or of a camera that is not, counts as absent.

    Cameras per point (ragged tracks): let the points be the batch, `x (p, v, 1, 2)` and `P (p, v, 3, 4)`.

    Args:
        x: Image points, in the pixels of the cameras.
        P: Cameras, finite or not, of any scale and sign.
        visible: Which views see which point; all by default.
        weights: Factors of the squared distances, 0 for absent; negative or non-finite ones count as absent.
        homogeneous: Return unit homogeneous 4-vectors instead, which hold points at infinity. Their sign puts the point
            in front of most of the cameras.

    Returns:
        Points `(*batch, n, 3)`, or `(*batch, n, 4)`. Without `homogeneous` a point at infinity comes back very far away.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(100, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> bool(torchsfm.triangulation.triangulate_points_dlt(torchsfm.project_points(P, X), P).allclose(X))
        True
    """

    def solve(data: Observations) -> tuple[Tensor, ...]:
        X = linear_points(data)
        X = X * data.facing(X.detach())
        if homogeneous:
            world = data.world(X)
            return (world * (world * world).sum(0).rsqrt(),)
        return (euclidean(data, X),)

    (X,) = in_pieces(solve, x, P, visible, weights)
    return X.movedim(0, -1).to(x.dtype)


def euclidean(data: Observations, X: Tensor) -> Tensor:
    """Points (3, problem, point) in the caller's world from homogeneous ones in the moved world, always finite."""
    w = X[3]
    far = w.detach().abs() < 1e-15
    return X[:3] / torch.where(far, torch.where(w.detach() < 0, -1e-15, 1e-15), w) * data.scale + data.shift


def linear_points(data: Observations) -> Tensor:
    """Unit homogeneous points (4, problem, point) of the moved world."""
    a, b, s, t = _planes(data)
    with torch.no_grad():
        fixed = tuple(p.detach() for p in a), tuple(p.detach() for p in b), s.detach(), t.detach()
        N = _normal_matrix(*fixed)
        X = smallest_eigenvector(N)
        # The normal matrix has squared the condition number; residuals from the planes themselves undo that.
        X = _refine(X, N, *fixed)
    return _refine(X, N, a, b, s, t)


def _planes(data: Observations) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...], Tensor, Tensor]:
    """The two planes of every observation and the factors of their squares that make unit vectors of them."""
    p1, p2, p3 = data.P
    a = tuple(data.x[0] * r - q for q, r in zip(p1, p3, strict=True))
    b = tuple(data.x[1] * r - q for q, r in zip(p2, p3, strict=True))
    s, t = row_dot(a, a), row_dot(b, b)
    return a, b, data.w / torch.where(s.detach() > 0, s, 1.0), data.w / torch.where(t.detach() > 0, t, 1.0)


def _normal_matrix(a: tuple[Tensor, ...], b: tuple[Tensor, ...], s: Tensor, t: Tensor) -> Tensor:
    """The 4x4 sums of squares, (4, 4, problem, point)."""
    sa, tb = tuple(s * e for e in a), tuple(t * e for e in b)
    return symmetric({(i, j): torch.addcmul(sa[i] * a[j], tb[i], b[j]).sum(0) for i in range(4) for j in range(i, 4)})


def _refine(X: Tensor, N: Tensor, a: tuple[Tensor, ...], b: tuple[Tensor, ...], s: Tensor, t: Tensor) -> Tensor:
    """One Newton step for the eigenvector, its gradient from the planes."""
    e, f = s * row_dot(a, X), t * row_dot(b, X)
    g = torch.stack([torch.addcmul(e * p, f, q).sum(0) for p, q in zip(a, b, strict=True)])
    value = (X * g).sum(0).detach()
    diagonal = torch.eye(4, dtype=N.dtype, device=N.device)[..., None, None]
    return tangent_step(X, N - value * diagonal, g - value * X)[0]
