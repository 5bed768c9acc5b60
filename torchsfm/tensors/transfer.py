"""Where a point or line of some views is in another view."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.homogeneous import divide_safely, normalize_sphere, to_homogeneous
from torchsfm.linalg import cross
from torchsfm.tensors.bifocal import unit_epipole
from torchsfm.tensors.minors import split_last
from torchsfm.tensors.trifocal import trifocal_epipoles, unit_tensor


def transfer_points_trifocal(
    T: Float[Tensor, "*#batch 3 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*batch n 2"]:
    """Points in the third view from their images in the first two (HZ 15.3.1).

    x3^k = x1^i l2_j T_i^jk with l2 the line through x2 at a right angle to the epipolar line of x1, so that a point x2 off
    that line counts as its foot on it. It works where transfer by epipolar lines fails, for points on the trifocal plane; it
    fails for points on the line of the first two centres alone.

    Args:
        T: Trifocal tensors of any scale.
        x1: Points in the first view.
        x2: Points in the second view.

    Returns:
        Points in the third view, in its pixels; finite always, far away for a point at infinity. Differentiable.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P, X = torchsfm.random_poses(3, generator=g).matrix(), torchsfm.random_points(10, generator=g)
        >>> x1, x2, x3 = torchsfm.project_points(P, X)
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.transfer_points_trifocal(T, x1, x2).allclose(x3))
        True
    """
    check_tensors(T=(T, "3 3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"))
    h1 = to_homogeneous(x1)
    T = unit_tensor(T, 3)[0]
    M = _slices(T, h1)
    e2, e3 = trifocal_epipoles(T)
    epipolar = cross(e2[..., None, :], (M @ e3[..., None, :, None])[..., 0])
    a, b = epipolar[..., 0], epipolar[..., 1]
    line = torch.stack(torch.broadcast_tensors(b, -a, a * x2[..., 1] - b * x2[..., 0]), -1)  # type: ignore[no-untyped-call]
    y = (line[..., None, :] @ M)[..., 0, :]
    return divide_safely(y[..., :2], y[..., 2])


def transfer_lines_trifocal(
    T: Float[Tensor, "*#batch 3 3 3"], l2: Float[Tensor, "*#batch n 3"], l3: Float[Tensor, "*#batch n 3"]
) -> Float[Tensor, "*batch n 3"]:
    """Lines in the first view from their images in the other two: l1_i = l2_j l3_k T_i^jk.

    Args:
        T: Trifocal tensors of any scale.
        l2: Lines in the second view, homogeneous.
        l3: Lines in the third view.

    Returns:
        Lines with unit normal, so that l1' x is a distance in pixels. Zero where both lines are epipolar lines of one plane:
        such lines leave the first open (any line of that plane).

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> L = torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.5, 0.0]], dtype=P.dtype)
        >>> l = torchsfm.geometry.project_lines(P, L)
        >>> l1 = torchsfm.tensors.transfer_lines_trifocal(torchsfm.tensors.trifocal_from_cameras(*P), l[1], l[2])
        >>> bool(torch.linalg.cross(l1, l[0]).norm() < 1e-9)
        True
    """
    check_tensors(T=(T, "3 3 3"), l2=(l2, "n 3"), l3=(l3, "n 3"))
    T = unit_tensor(T, 3)[0]
    return unit_normal(torch.einsum("...ijk,...nj,...nk->...ni", T, normalize_sphere(l2), normalize_sphere(l3)))


def homographies_from_trifocal(
    T: Float[Tensor, "*#batch 3 3 3"], l2: Float[Tensor, "*#batch n 3"]
) -> Float[Tensor, "*batch n 3 3"]:
    """The homographies x3 ~ H x1 by the planes of lines in the second view: H[k, i] = l2_j T_i^jk (HZ 15.3).

    A line l3 is brought into the first view by H' l3.

    Args:
        T: Trifocal tensors of any scale.
        l2: Lines in the second view, homogeneous.

    Returns:
        Homographies from the first to the third view, with the scale of the product of T and l2.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x1, x2, x3 = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> l2 = torchsfm.geometry.line_from_points(x2, x2 + 1)  # a line through x2: its plane holds the point
        >>> H = torchsfm.tensors.homographies_from_trifocal(torchsfm.tensors.trifocal_from_cameras(*P), l2)
        >>> bool(torchsfm.geometry.transform_points(H[0], x1).allclose(x3))
        True
    """
    check_tensors(T=(T, "3 3 3"), l2=(l2, "n 3"))
    return torch.einsum("...ijk,...nj->...nki", T, l2)


def transfer_points_quadrifocal(
    Q: Float[Tensor, "*#batch 3 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    x3: Float[Tensor, "*#batch n 2"],
) -> Float[Tensor, "*batch n 2"]:
    """Points in the fourth view from their images in the first three.

    Three lines l1, l2, l3 through the images span planes that meet in the point, whose image is x4^s = l1_p l2_q l3_r Q^pqrs.
    The horizontal and vertical lines through the three points give eight such vectors, which are averaged in proportion to
    their lengths.

    Args:
        Q: Quadrifocal tensors of any scale.
        x1: Points in the first view.
        x2: Points in the second view.
        x3: Points in the third view.

    Returns:
        Points in the fourth view, in its pixels; finite always, far away for a point at infinity.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P, X = torchsfm.random_poses(4, generator=g).matrix(), torchsfm.random_points(10, generator=g)
        >>> x1, x2, x3, x4 = torchsfm.project_points(P, X)
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.transfer_points_quadrifocal(Q, x1, x2, x3).allclose(x4))
        True
    """
    check_tensors(Q=(Q, "3 3 3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"), x3=(x3, "n 2"))
    L1, L2, L3 = (axis_lines(x) for x in (x1, x2, x3))
    y = torch.einsum("...pqrs,...nap,...nbq,...ncr->...nabcs", unit_tensor(Q, 4)[0], L1, L2, L3).flatten(-4, -2)
    longest = (y * y).sum(-1).argmax(-1)[..., None, None].expand(*y.shape[:-2], 1, 3)
    best = y.gather(-2, longest)
    best = ((y * best).sum(-1, keepdim=True) * y).sum(-2)
    return divide_safely(best[..., :2], best[..., 2])


def transfer_lines_quadrifocal(
    Q: Float[Tensor, "*#batch 3 3 3 3"], l1: Float[Tensor, "*#batch n 3"], l2: Float[Tensor, "*#batch n 3"]
) -> tuple[Float[Tensor, "*batch n 3"], Float[Tensor, "*batch n 3"]]:
    """Lines in the third and fourth view from their images in the first two: the null vectors of l1_p l2_q Q^pqrs.

    Args:
        Q: Quadrifocal tensors of any scale.
        l1: Lines in the first view, homogeneous.
        l2: Lines in the second view.

    Returns:
        Lines with unit normal in the third and in the fourth view.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> L = torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.5, 0.0]], dtype=P.dtype)
        >>> l = torch.nn.functional.normalize(torchsfm.geometry.project_lines(P, L), dim=-1)
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> l3, l4 = torchsfm.tensors.transfer_lines_quadrifocal(Q, l[0], l[1])
        >>> bool(torch.linalg.cross(l3, l[2]).norm() < 1e-9), bool(torch.linalg.cross(l4, l[3]).norm() < 1e-9)
        (True, True)
    """
    check_tensors(Q=(Q, "3 3 3 3"), l1=(l1, "n 3"), l2=(l2, "n 3"))
    M = torch.einsum("...pqrs,...np,...nq->...nrs", unit_tensor(Q, 4)[0], normalize_sphere(l1), normalize_sphere(l2))
    M = split_last(normalize_sphere(M.flatten(-2)), 3, 3)
    return unit_normal(unit_epipole(M.mT)), unit_normal(unit_epipole(M))


def axis_lines(x: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2 3"]:
    """The vertical and the horizontal line through a point: u - x = 0 and v - y = 0."""
    one, zero = torch.ones_like(x[..., 0]), torch.zeros_like(x[..., 0])
    rows = (torch.stack((one, zero, -x[..., 0]), -1), torch.stack((zero, one, -x[..., 1]), -1))
    return torch.stack(rows, -2)


def unit_normal(line: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Lines scaled so that their normal has length one; zero where there is none."""
    square = (line[..., :2] * line[..., :2]).sum(-1, keepdim=True)
    good = square > 0
    return torch.where(good, line / torch.where(good, square, 1).sqrt(), 0)


def _slices(T: Tensor, x: Tensor) -> Tensor:
    """x^i T_i for points x (*batch, n, 3)."""
    return torch.einsum("...ijk,...ni->...njk", T, x)
