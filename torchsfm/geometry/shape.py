"""The affine shape of a point configuration, and what of it a camera keeps (Sparr 1992, 1996).

With points as columns of X, homogeneous with last coordinate 1, the *affine shape* is the null space of X, the *depth space*
its row space; both are blind to affine changes of coordinates. A camera that sees the points with projective depths has
`X_image diag(depths) = P X`: the row space of the left side lies in that of X. Everything here is a subspace of R^n, so
nothing depends on coordinate systems or on the order of the points.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.homogeneous import finite_or_zero, normalizing_similarity, to_homogeneous
from torchsfm.linalg import eigh, qr, svdvals

_ROUNDS = 200
"""Fixed-point steps for the balanced frame; a few dozen do for points that are not nearly on a line."""


def depth_space(
    x: Float[Tensor, "*#batch n d"], depths: Float[Tensor, "*#batch n"] | None = None
) -> Float[Tensor, "*batch n d+1"]:
    """An orthonormal basis of the row space of the homogeneous points times their depths.

    Args:
        x: Points as rows. Rows with NaN or inf count as absent: zero.
        depths: Projective depth of each point, 1 if not given; 0 for a point that is absent.

    Returns:
        The basis as columns. Where the points do not span their space (fewer than d + 1 of them, on a line in the plane) the
        last columns are not determined.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
        >>> B = torchsfm.geometry.depth_space(x)
        >>> B.shape, bool((B.mT @ B).allclose(torch.eye(3), atol=1e-6))
        (torch.Size([4, 3]), True)
    """
    return normalize_shape(x, depths)[0]


def affine_shape(
    x: Float[Tensor, "*#batch n d"], depths: Float[Tensor, "*#batch n"] | None = None
) -> Float[Tensor, "*batch n n-d-1"]:
    """An orthonormal basis of the affine shape: the linear relations between the homogeneous points times their depths.

    Args:
        x: At least d + 1 points as rows. Rows with NaN or inf count as zero.
        depths: Projective depth of each point, 1 if not given.

    Returns:
        The basis as columns: the orthogonal complement of `depth_space`. Not differentiable; the projector on `depth_space` is.

    Raises:
        ValueError: Wrong shape, dtype or device, or fewer than d + 1 points.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])  # corners of a square: a - b - c + d = 0
        >>> s = torchsfm.geometry.affine_shape(x)
        >>> s[:, 0] / s[0, 0]
        tensor([ 1.0000, -1.0000, -1.0000,  1.0000])
    """
    _check_points(x, depths)
    with torch.no_grad():
        basis, _, _ = qr(_weighted(x, depths), complete=True)
    return basis[..., x.shape[-1] + 1 :]


def normalize_shape(
    x: Float[Tensor, "*#batch n d"], depths: Float[Tensor, "*#batch n"] | None = None
) -> tuple[Float[Tensor, "*batch n d+1"], Float[Tensor, "*batch d+1 d+1"]]:
    """Change coordinates such that the homogeneous points times their depths have orthonormal coordinates.

    Args:
        x: Points as rows. Rows with NaN or inf count as absent.
        depths: Projective depth of each point, 1 if not given.

    Returns:
        Points y as rows with `y' y = I`, and T with `y = depths (x, 1) T'`. T is upper triangular up to a translation to the
        centroid; where the points do not span their space it is finite, and its last rows mean nothing.

    Raises:
        ValueError: Wrong shape, dtype or device, or fewer than d + 1 points.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [3.0, 2.0]])
        >>> y, T = torchsfm.geometry.normalize_shape(x)
        >>> y.shape, bool((y.mT @ y).allclose(torch.eye(3), atol=1e-5))
        (torch.Size([5, 3]), True)
    """
    _check_points(x, depths)
    moved = normalizing_similarity(x.detach(), None if depths is None else depths.detach().abs())
    h = _weighted(x, depths) @ moved.mT
    basis, R, _ = qr(h)
    eye = torch.eye(R.shape[-1], dtype=x.dtype, device=x.device)
    pivots = R.diagonal(dim1=-2, dim2=-1).detach().abs()
    spans = pivots > 64 * torch.finfo(x.dtype).eps * pivots.amax(-1, keepdim=True).clamp_min(torch.finfo(x.dtype).tiny)
    R = torch.where(spans[..., None, :], R, eye)
    return basis, torch.linalg.solve_triangular(R, eye.expand_as(R), upper=True).mT @ moved


def principal_angles(A: Float[Tensor, "*#batch n p"], B: Float[Tensor, "*#batch n q"]) -> Float[Tensor, "*batch k"]:
    """The principal angles between the column spaces of two matrices, radians, largest first (Bjorck & Golub 1973).

    Small angles are found from their sines, large ones from their cosines, so that all are accurate to rounding.

    Args:
        A: Columns that span a space, linearly independent.
        B: Columns that span the other.

    Returns:
        min(p, q) angles between 0 and pi / 2: all zero where one space contains the other.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> A, B = torch.eye(3)[:, :2], torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
        >>> torchsfm.geometry.principal_angles(A, B).rad2deg()
        tensor([45.0000,  0.0000])
    """
    check_tensors(A=(A, "n p"), B=(B, "n q"))
    if A.shape[-1] > B.shape[-1]:
        A, B = B, A
    A, B = (qr(finite_or_zero(M))[0] for M in (A, B))
    # cos: singular values of B'A, descending. sin: of what B leaves of A, descending.
    cosine = svdvals(B.mT @ A)[0].flip(-1).clamp(max=1)
    sine = svdvals(A - B @ (B.mT @ A))[0].clamp(max=1)
    return torch.where(sine < 0.5**0.5, torch.arcsin(sine), torch.arccos(cosine))


def balanced_frame(
    x: Float[Tensor, "*#batch n d"], weights: Float[Tensor, "*#batch n"] | None = None
) -> tuple[Float[Tensor, "*batch d+1 d+1"], Bool[Tensor, "*batch"]]:
    """The projective change of coordinates in which points, as unit vectors, have equal second moments in all directions.

    In that frame, `sum w a a' = I sum w / (d + 1)` for `a = T (x, 1) / |T (x, 1)|` (Tyler 1987). Any projective change of the
    points' coordinates changes the frame by no more than a rotation: it belongs to the configuration. It exists if no flat
    holds too many of the points: of points in the plane, less than a third at one place and two thirds on one line.

    Args:
        x: Points as rows.
        weights: Non-negative; 0 means absent. Rows with NaN or inf are absent too.

    Returns:
        T, with |T| = 1 (Frobenius), without derivatives; and whether the points have such a frame. Where not, T is finite and
        makes the moments as equal as the iteration got.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[0.0, 0.0], [9.0, 0.0], [0.0, 1.0], [9.0, 1.0]])
        >>> T, balanced = torchsfm.geometry.balanced_frame(x)
        >>> a = torch.nn.functional.normalize(torchsfm.geometry.to_homogeneous(x) @ T.mT, dim=-1)
        >>> bool(balanced), bool((a.mT @ a).allclose(4 / 3 * torch.eye(3), atol=1e-3))
        (True, True)
    """
    batch = check_tensors(x=(x, "n d>=1"), weights=(weights, "?n"))
    with torch.no_grad():
        size = x.shape[-1] + 1
        present = torch.isfinite(x).all(-1).expand(*batch, x.shape[-2])
        w = present.to(x.dtype) if weights is None else torch.where(present, weights.clamp(min=0), 0)
        w = w * (size / w.sum(-1, keepdim=True).clamp_min(torch.finfo(x.dtype).tiny))
        T = normalizing_similarity(x, w)
        h = to_homogeneous(finite_or_zero(x)) @ T.mT
        frame = torch.eye(size, dtype=x.dtype, device=x.device).expand_as(T)
        done = torch.zeros(batch, dtype=torch.bool, device=x.device)
        tolerance = 64 * torch.finfo(x.dtype).eps
        for _ in range(_ROUNDS):
            a = torch.nn.functional.normalize(h @ frame.mT, dim=-1)
            values, vectors, _ = eigh((a * w[..., None]).mT @ a)
            step = (vectors * values.clamp(min=1e-3).rsqrt()[..., None, :]) @ vectors.mT
            moved = step @ frame
            moved = moved / torch.linalg.matrix_norm(moved)[..., None, None]
            frame = torch.where(done[..., None, None], frame, moved)
            done = done | ((values - 1).abs().amax(-1) < tolerance)
            if bool(done.all()):
                break
        # Points that nearly lack a frame come near it slowly: near is good enough for them.
        good = (values - 1).abs().amax(-1) < 1e-3
        T = frame @ T
        return T / torch.linalg.matrix_norm(T)[..., None, None], good


def _check_points(x: Tensor, depths: Tensor | None) -> None:
    check_tensors(x=(x, "n d>=1"), depths=(depths, "?n"))
    if x.shape[-2] <= x.shape[-1]:
        raise ValueError(f"x: wanted at least d + 1 points of d coordinates, got shape {tuple(x.shape)}")


def _weighted(x: Tensor, depths: Tensor | None) -> Tensor:
    h = torch.where(torch.isfinite(x).all(-1, keepdim=True), to_homogeneous(finite_or_zero(x)), 0)
    return h if depths is None else h * depths[..., None]
