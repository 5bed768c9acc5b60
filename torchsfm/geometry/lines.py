"""Lines of the plane as 3-vectors, lines of space as Pluecker 6-vectors: through what, seen as what, how far from what?

A line of the plane is `l` with `l'x = 0`. A line of space is `L = (d, m)`, direction and moment `m = p x d` of any of its
points p, so `d'm = 0`; its scale is arbitrary. A plane is `(n, w)` with `n'X + w = 0`.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_tensors
from torchsfm.geometry.homogeneous import normalize_sphere, to_homogeneous
from torchsfm.geometry.rotations import cross_matrix
from torchsfm.linalg import cross


def line_from_points(x1: Float[Tensor, "*#batch 2"], x2: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch 3"]:
    """The line through two points, scaled so that `l'x` is the signed distance of a point from it.

    The normal is a quarter turn from y to x ahead of the direction from the first point to the second: seen on the screen,
    distances are positive to the left. Points that coincide give zero.

    Args:
        x1: The first point.
        x2: The second, in the same unit; so are the distances.

    Example:
        >>> import torch, torchsfm
        >>> l = torchsfm.geometry.line_from_points(torch.tensor([0.0, 1.0]), torch.tensor([4.0, 1.0]))
        >>> torchsfm.geometry.point_line_distance(torch.tensor([2.0, 6.0]), l).abs()
        tensor(5.)
    """
    check_tensors(x1=(x1, "2"), x2=(x2, "2"))
    along = normalize_sphere(x2 - x1)
    normal = torch.stack((along[..., 1], -along[..., 0]), -1)
    # Of the two points the middle: the error of the normal then counts least.
    return torch.cat((normal, -(normal * (0.5 * (x1 + x2))).sum(-1, keepdim=True)), -1)


def point_line_distance(x: Float[Tensor, "*#batch 2"], l: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch"]:  # noqa: E741
    """The signed distance of a point of the plane from a line of any scale, positive on the side of its normal.

    Zero where the line is none: the line at infinity, and zero.

    Args:
        x: Points in an image, or any plane.
        l: Homogeneous lines: `l'x = 0` for points on them.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.geometry.point_line_distance(torch.tensor([3.0, 7.0]), torch.tensor([0.0, 2.0, -4.0]))  # y = 2
        tensor(5.)
    """
    check_tensors(x=(x, "2"), l=(l, "3"))
    return (x * l[..., :2]).sum(-1).add(l[..., 2]) * _inverse_length(l[..., :2])


def pluecker_from_points(X1: Float[Tensor, "*#batch 3"], X2: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 6"]:
    """The line through two points, its direction `X2 - X1`. Points that coincide give zero.

    Args:
        X1: The point that the line comes from.
        X2: The point that it goes to.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.geometry.pluecker_from_points(torch.tensor([0.0, 0.0, 2.0]), torch.tensor([1.0, 0.0, 2.0]))
        tensor([1., 0., 0., 0., 2., 0.])
    """
    check_tensors(X1=(X1, "3"), X2=(X2, "3"))
    d = X2 - X1
    return torch.cat((d, cross(X1, d)), -1)


def pluecker_from_planes(plane1: Float[Tensor, "*#batch 4"], plane2: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 6"]:
    """The line in which two planes meet, its direction the cross product of their normals.

    Planes that coincide give zero, parallel ones a line at infinity (d = 0).

    Args:
        plane1: Homogeneous planes: `plane' X = 0` for homogeneous points X on it.
        plane2: Others.

    Example:
        >>> import torch, torchsfm
        >>> floor, wall = torch.tensor([0.0, 0.0, 1.0, 0.0]), torch.tensor([1.0, 0.0, 0.0, -2.0])  # z = 0 and x = 2
        >>> torchsfm.geometry.pluecker_from_planes(floor, wall).tolist()  # along y
        [0.0, 1.0, 0.0, 0.0, 0.0, 2.0]
    """
    check_tensors(plane1=(plane1, "4"), plane2=(plane2, "4"))
    n1, w1, n2, w2 = plane1[..., :3], plane1[..., 3:], plane2[..., :3], plane2[..., 3:]
    return torch.cat((cross(n1, n2), w1 * n2 - w2 * n1), -1)


def nearest_pluecker(L: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 6"]:
    """The line nearest to a 6-vector that need not be one: the nearest point with `d'm = 0` (the Klein quadric).

    Args:
        L: Six numbers (d, m), as an estimate without constraint gives them.

    Example:
        >>> import torch, torchsfm
        >>> L = torchsfm.geometry.nearest_pluecker(torch.tensor([1.0, 0.0, 0.0, 0.1, 1.0, 0.0]))
        >>> bool((L[:3] @ L[3:]).abs() < 1e-6)
        True
    """
    check_tensors(L=(L, "6"))
    d, m = L[..., :3], L[..., 3:]
    product = 2 * (d * m).sum(-1, keepdim=True)
    size = (L * L).sum(-1, keepdim=True)
    # |product| <= size, and equality only where d = m or d = -m: there every line nearby is as near.
    root = (size * size - product * product).clamp_min(0)
    root = torch.where(root > 0, torch.where(root > 0, root, 1.0).sqrt(), 0.0)
    mu = product / torch.where(size > 0, size + root, 1.0)
    ambiguous = mu.detach().abs() >= 1
    mu = torch.where(ambiguous, 0.0, mu)
    corrected = torch.cat((d - mu * m, m - mu * d), -1) / (1 - mu * mu)
    axis = torch.nn.functional.one_hot(d.detach().abs().argmin(-1), 3).to(L.dtype)
    some = torch.cat((d, cross(d, axis)), -1)
    return torch.where(ambiguous, some, corrected)


def transform_lines(H: Float[Tensor, "*#batch 4 4"], L: Float[Tensor, "*#batch n 6"]) -> Float[Tensor, "*batch n 6"]:
    """Lines whose points a projective map of space moves: that through `H X1` and `H X2` of the line through X1 and X2.

    Args:
        H: Maps of homogeneous points of space.
        L: Lines in space (d, m), Pluecker coordinates.

    Example:
        >>> import torch, torchsfm
        >>> L = torchsfm.geometry.pluecker_from_points(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 2.0]]))
        >>> H = torch.diag(torch.tensor([1.0, 1.0, 2.0, 1.0]))  # twice as high
        >>> torchsfm.geometry.transform_lines(H, L)
        tensor([[1., 0., 0., 0., 4., 0.]])
    """
    check_tensors(H=(H, "4 4"), L=(L, "n 6"))
    d, m = L[..., :3], L[..., 3:]
    # X1 X2' - X2 X1' of homogeneous points.
    upper = torch.cat((-cross_matrix(m), -d[..., None]), -1)
    join = torch.cat((upper, torch.cat((d, torch.zeros_like(d[..., :1])), -1)[..., None, :]), -2)
    H = H[..., None, :, :]
    join = H @ join @ H.mT
    moment = torch.stack((join[..., 1, 2], join[..., 2, 0], join[..., 0, 1]), -1)
    return torch.cat((join[..., 3, :3], moment), -1)


def project_lines(P: Float[Tensor, "*#batch 3 4"], L: Float[Tensor, "*#batch n 6"]) -> Float[Tensor, "*batch n 3"]:
    """Images of lines, with the sign and the scale of `l = (P X1) x (P X2)` for a line through X1 and X2 with `d = X2 - X1`.

    A line through the camera's centre gives zero.

    Args:
        P: Cameras.
        L: Lines in space (d, m), Pluecker coordinates.

    Example:
        >>> import torch, torchsfm
        >>> L = torchsfm.geometry.pluecker_from_points(torch.tensor([[0.0, 2.0, 4.0]]), torch.tensor([[1.0, 2.0, 4.0]]))
        >>> l = torchsfm.geometry.project_lines(torch.eye(3, 4), L)[0]
        >>> l / l[1]  # the image line y = 1 / 2
        tensor([ 0.0000,  1.0000, -0.5000])
    """
    check_tensors(P=(P, "3 4"), L=(L, "n 6"))
    M, p = P[..., :3], P[..., 3]
    cofactors = torch.stack([cross(M[..., (i + 1) % 3, :], M[..., (i + 2) % 3, :]) for i in range(3)], -2)
    d = L[..., :3] @ M.mT
    return L[..., 3:] @ cofactors.mT + cross(p[..., None, :], d)


def viewing_planes(P: Float[Tensor, "*#batch 3 4"], l: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*batch n 4"]:  # noqa: E741
    """The planes of all points that a camera sees on image lines, `P'l`.

    Args:
        P: Cameras.
        l: Homogeneous image lines in pixels.

    Example:
        >>> import torch, torchsfm
        >>> l = torch.tensor([[0.0, 1.0, -0.5]])  # the image line y = 1 / 2
        >>> torchsfm.geometry.viewing_planes(torch.eye(3, 4), l)
        tensor([[ 0.0000,  1.0000, -0.5000,  0.0000]])
    """
    check_tensors(P=(P, "3 4"), l=(l, "n 3"))
    return l @ P


def intersect_line_plane(L: Float[Tensor, "*#batch 6"], plane: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The homogeneous point where a line meets a plane; zero where it lies in the plane.

    Args:
        L: A line in space (d, m), Pluecker coordinates of any scale.
        plane: Homogeneous planes: `plane' X = 0` for homogeneous points X on it.

    Example:
        >>> import torch, torchsfm
        >>> L = torchsfm.geometry.pluecker_from_points(torch.tensor([1.0, 2.0, 0.0]), torch.tensor([1.0, 2.0, 1.0]))
        >>> X = torchsfm.geometry.intersect_line_plane(L, torch.tensor([0.0, 0.0, 1.0, -3.0]))  # z = 3
        >>> X / X[3]
        tensor([1., 2., 3., 1.])
    """
    check_tensors(L=(L, "6"), plane=(plane, "4"))
    d, m, n, w = L[..., :3], L[..., 3:], plane[..., :3], plane[..., 3:]
    return torch.cat((cross(n, m) - w * d, (n * d).sum(-1, keepdim=True)), -1)


def nearest_on_line(X: Float[Tensor, "*#batch 3"], L: Float[Tensor, "*#batch 6"]) -> Float[Tensor, "*batch 3"]:
    """The foot of the perpendicular from a point to a line; the point itself where the line is at infinity.

    Args:
        X: Points in space.
        L: A line in space (d, m), Pluecker coordinates of any scale.

    Example:
        >>> import torch, torchsfm
        >>> L = torchsfm.geometry.pluecker_from_points(torch.tensor([0.0, 0.0, 2.0]), torch.tensor([1.0, 0.0, 2.0]))
        >>> torchsfm.geometry.nearest_on_line(torch.tensor([5.0, 4.0, 1.0]), L)
        tensor([5., 0., 2.])
    """
    check_tensors(X=(X, "3"), L=(L, "6"))
    d, m = L[..., :3], L[..., 3:]
    scale = _inverse_length(d)[..., None]
    d, m = d * scale, m * scale
    return X + cross(d, m - cross(X, d))


def point_to_line_distance(X: Float[Tensor, "*#batch 3"], L: Float[Tensor, "*#batch 6"]) -> Float[Tensor, "*batch"]:
    """The distance in space between a point and a line; zero where the line is at infinity.

    Args:
        X: Points in space.
        L: A line in space (d, m), Pluecker coordinates of any scale.

    Example:
        >>> import torch, torchsfm
        >>> L = torchsfm.geometry.pluecker_from_points(torch.tensor([0.0, 0.0, 2.0]), torch.tensor([1.0, 0.0, 2.0]))
        >>> torchsfm.geometry.point_to_line_distance(torch.tensor([5.0, 3.0, 6.0]), L)
        tensor(5.)
    """
    foot = nearest_on_line(X, L)
    return _length(foot - X)


def line_to_line_distance(L1: Float[Tensor, "*#batch 6"], L2: Float[Tensor, "*#batch 6"]) -> Float[Tensor, "*batch"]:
    """The distance in space between two lines, parallel ones too; zero where one is at infinity.

    Args:
        L1: A line in space (d, m), Pluecker coordinates of any scale.
        L2: Another one.

    Example:
        >>> import torch, torchsfm
        >>> L1 = torchsfm.geometry.pluecker_from_points(torch.tensor([0.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0]))
        >>> L2 = torchsfm.geometry.pluecker_from_points(torch.tensor([0.0, 0.0, 3.0]), torch.tensor([0.0, 1.0, 3.0]))
        >>> torchsfm.geometry.line_to_line_distance(L1, L2)
        tensor(3.)
    """
    check_tensors(L1=(L1, "6"), L2=(L2, "6"))
    s1, s2 = (_inverse_length(L[..., :3])[..., None] for L in (L1, L2))
    L1, L2 = L1 * s1, L2 * s2
    d1, m1, d2, m2 = L1[..., :3], L1[..., 3:], L2[..., :3], L2[..., 3:]
    across = cross(d1, d2)
    skew = (d1 * m2).sum(-1) + (d2 * m1).sum(-1)
    sine = (across * across).sum(-1)
    # What rounding leaves of the sine of parallel lines.
    parallel = sine.detach() <= (16 * torch.finfo(L1.dtype).eps) ** 2
    # A point of one, and its distance from the other.
    apart = _length(cross(d2, m2 - cross(cross(d1, m1), d2)))
    return torch.where(parallel, apart, skew.abs() * torch.where(parallel, 1.0, sine).rsqrt())


def unproject_onto_lines(
    x: Float[Tensor, "*#batch n 2"], P: Float[Tensor, "*#batch 3 4"], L: Float[Tensor, "*#batch n 6"]
) -> Float[Tensor, "*batch n 4"]:
    """Homogeneous points of lines that are seen at the feet of image points on the lines' images.

    That is where the plane through the image point and across the image line meets the line. Zero where the camera's centre
    lies on the line.

    Args:
        x: Image points in pixels.
        P: Cameras.
        L: Lines in space (d, m), Pluecker coordinates, one for each point.

    Example:
        >>> import torch, torchsfm
        >>> L = torchsfm.geometry.pluecker_from_points(torch.tensor([[0.0, 2.0, 4.0]]), torch.tensor([[1.0, 2.0, 4.0]]))
        >>> X = torchsfm.geometry.unproject_onto_lines(torch.tensor([[0.25, 0.51]]), torch.eye(3, 4), L)
        >>> (X / X[..., 3:]).round(decimals=3)  # the image line is y = 1 / 2
        tensor([[1., 2., 4., 1.]])
    """
    check_tensors(x=(x, "n 2"), P=(P, "3 4"), L=(L, "n 6"))
    l = project_lines(P, L)  # noqa: E741
    h = to_homogeneous(x).expand(*broadcast_shapes(l.shape[:-1], x.shape[:-1]), 3)
    # The line through the image point and the normal's direction.
    across = cross(h, torch.cat((l[..., :2], torch.zeros_like(l[..., :1])), -1))
    return intersect_line_plane(L, viewing_planes(P, across))


def _length(v: Tensor) -> Tensor:
    square = (v * v).sum(-1)
    return torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)


def _inverse_length(v: Tensor) -> Tensor:
    """One over the length, 0 for zero."""
    square = (v * v).sum(-1)
    return torch.where(square > 0, torch.where(square > 0, square, 1.0).rsqrt(), 0.0)
