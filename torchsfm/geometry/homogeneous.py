"""Homogeneous coordinates: in, out, points at infinity, and the normalisation that linear solvers need."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.linalg import unit_scale
from torchsfm.linalg.magnitude import all_below


def to_homogeneous(x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d+1"]:
    """Append a coordinate 1 to every point.

    Args:
        x: Points as rows, of any dimension.

    Returns:
        The same points with one more coordinate, which is 1.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.geometry.to_homogeneous(torch.tensor([[3.0, 4.0]]))
        tensor([[3., 4., 1.]])
    """
    check_tensors(x=(x, "d"))
    return torch.nn.functional.pad(x, (0, 1), value=1.0)


def from_homogeneous(x: Float[Tensor, "*batch d"]) -> tuple[Float[Tensor, "*batch d-1"], Bool[Tensor, "*batch"]]:
    """Divide by the last coordinate and drop it.

    A point counts as infinite where its last coordinate is below the rounding error of the others (this does not depend on the
    scale of the homogeneous vector), or where it is not a number.

    Args:
        x: Homogeneous points as rows.

    Returns:
        The points, and the mask of those that are finite. Where the mask is False the point is zero, and so is its gradient.

    Example:
        >>> import torch, torchsfm
        >>> x, finite = torchsfm.geometry.from_homogeneous(torch.tensor([[2.0, 4.0, 2.0], [1.0, 0.0, 0.0]]))
        >>> x[0], finite
        (tensor([1., 2.]), tensor([ True, False]))
    """
    check_tensors(x=(x, "d>=2"))
    body, w = x[..., :-1], x[..., -1]
    largest = body.detach().abs().amax(-1)
    finite = (w.detach().abs() > torch.finfo(x.dtype).eps * largest) & torch.isfinite(largest) & torch.isfinite(w)
    body = torch.where(finite[..., None], body, 0.0)
    return body / torch.where(finite, w, 1.0)[..., None], finite


def normalize_sphere(x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
    """Scale vectors to length one, without changing their sign.

    Args:
        x: Vectors as rows (homogeneous points, rays, lines).

    Returns:
        Unit vectors. The zero vector and vectors with NaN or inf become zero, with zero gradient.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.geometry.normalize_sphere(torch.tensor([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]]))
        tensor([[0.0000, 0.6000, 0.8000],
                [0.0000, 0.0000, 0.0000]])
    """
    check_tensors(x=(x, "d"))
    # Dividing by the largest entry first keeps the squares inside the range of the dtype.
    largest = x.detach().abs().amax(-1, keepdim=True) if x.shape[-1] else x.detach().new_zeros((*x.shape[:-1], 1))
    good = (largest > 0) & torch.isfinite(largest)
    scaled = torch.where(good, x, 0.0) / torch.where(good, largest, 1.0)
    square = (scaled * scaled).sum(-1, keepdim=True)
    return scaled / torch.where(good, square, 1.0).sqrt()


def normalizing_similarity(
    x: Float[Tensor, "*#batch n d"], weights: Float[Tensor, "*#batch n"] | None = None
) -> Float[Tensor, "*batch d+1 d+1"]:
    """Find the similarity that moves the centroid to the origin and makes the root mean square distance from it sqrt(d).

    Solving linear systems in such coordinates is what makes them well conditioned (Hartley 1997, "In defence of the eight-point
    algorithm"; HZ 4.4.4). The root mean square is used rather than the mean distance, since it is smooth.

    Args:
        x: Points as rows, in the plane or in space.
        weights: Non-negative; 0 means absent. Points with NaN or inf are absent too.

    Returns:
        The transformation T, homogeneous, with `T (x, 1) = (x', 1)`. Where the points coincide, only the centroid is moved;
        where none is present, T is the identity.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[100.0, 200.0], [300.0, 200.0], [100.0, 400.0], [300.0, 400.0]])
        >>> T = torchsfm.geometry.normalizing_similarity(x)
        >>> torchsfm.geometry.transform_points(T, x)[0]
        tensor([-1., -1.])
    """
    check_tensors(x=(x, "n d>=1"), weights=(weights, "?n"))
    dimension = x.shape[-1]
    present = torch.isfinite(x).all(-1)
    w = present.to(x.dtype) if weights is None else torch.where(present & torch.isfinite(weights), weights.clamp(min=0), 0.0)
    w = w[..., None]
    x = torch.where(w > 0, x, 0.0)
    # A power of two, so that squares of very large and very small coordinates exist.
    unit = unit_scale(x)
    x, unit = x * unit, unit[..., 0]
    total = w.sum(-2, keepdim=True)
    w = w / torch.where(total > 0, total, 1.0)
    centroid = (w * x).sum(-2)
    variance = (w * (x - centroid[..., None, :]).square()).sum((-2, -1))[..., None]
    # Below this, what is left of the spread is rounding error of the centroid.
    floor = 16 * torch.finfo(x.dtype).eps * centroid.detach().abs().amax(-1, keepdim=True)
    spread = variance.detach() > floor.square()
    scale = torch.where(spread, math.sqrt(dimension) / torch.where(spread, variance, 1.0).sqrt(), 1 / unit)
    linear = (scale * unit)[..., None] * torch.eye(dimension, dtype=x.dtype, device=x.device)
    top = torch.cat([linear, -(scale * centroid)[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., -1] = 1
    return torch.cat([top, bottom], -2)


def transform_points(H: Float[Tensor, "*#batch h h"], x: Float[Tensor, "*#batch n d"]) -> Float[Tensor, "*batch n d"]:
    """Apply a projective transformation to points.

    Args:
        H: Homogeneous matrix, up to scale.
        x: Points as rows.

    Returns:
        The transformed points, finite always: a point sent to infinity is returned very far away, in its own direction
        (about 1 / machine epsilon), and a point with NaN or inf as the image of the origin.

    Example:
        >>> import torch, torchsfm
        >>> H = torch.tensor([[0.0, -1.0, 10.0], [1.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> torchsfm.geometry.transform_points(H, torch.tensor([[2.0, 4.0]]))
        tensor([[3., 1.]])
    """
    check_tensors(H=(H, "h h"), x=(x, "n d"))
    if H.shape[-1] != x.shape[-1] + 1:
        got = f"{tuple(H.shape)} and {tuple(x.shape)}"
        raise ValueError(f"H, x: wanted shapes (*batch, d + 1, d + 1) and (*batch, n, d), got {got}")
    y = finite_or_zero(x) @ H[..., :-1, :-1].mT + H[..., None, :-1, -1]
    w = (finite_or_zero(x) * H[..., -1:, :-1]).sum(-1) + H[..., -1:, -1]
    return divide_safely(y, w)


def finite_or_zero(x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
    """Replace the rows that have NaN or inf by zero, so that they reach neither values nor gradients of others."""
    # Sums of those that are larger overflow: they are past any use.
    return torch.where(all_below(x, torch.finfo(x.dtype).max / 4, 1)[..., None], x, 0.0)


def divide_safely(y: Float[Tensor, "*batch d"], w: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch d"]:
    """Divide rows by w, where |w| is held above the rounding error of y: the result and its gradient are finite always."""
    floor = torch.finfo(y.dtype).eps * y.detach().abs().amax(-1)
    value = w.detach()
    replacement = torch.where(floor > 0, floor, 1.0)
    replacement = torch.where(value < 0, -replacement, replacement)
    return y / torch.where(value.abs() > floor, w, replacement)[..., None]


def moderate_directions(d: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """The same directions, the largest coordinate of each 1 or -1: squares of them neither vanish nor overflow."""
    largest = d.detach().abs().amax(-1, keepdim=True)
    return d / torch.where((largest > 0) & (largest < torch.inf), largest, 1)
