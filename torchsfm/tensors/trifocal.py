"""Three views: the trifocal tensor, the cameras it comes from and the cameras it allows (HZ chapters 15 and 17).

The layout is `T[..., i, j, k] = T_i^jk` of Hartley & Zisserman: i counts the coordinates of a point in the first image, j and k
those of lines in the second and third. With cameras [I | 0], [a_1 a_2 a_3 | a_4], [b_1 b_2 b_3 | b_4] each slice is the matrix
`T[i] = a_i b_4' - a_4 b_i'`, and a point x1 on lines l2, l3 through its other images has `x1^i l2_j l3_k T_i^jk = 0`.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.geometry.homogeneous import normalize_sphere
from torchsfm.geometry.rotations import cross_matrix
from torchsfm.linalg import adjugate_3x3, eigh, eigvalsh, null_vector, solve, svdvals
from torchsfm.tensors.minors import LAPLACE_SIGNS, cyclic_pairs, split_last, wedge


@dataclass(frozen=True)
class ProjectiveCameras:
    """Cameras in some projective frame of space, in the order of the views; the first is [I | 0].

    `P` are the cameras. `status` is OK, DEGENERATE (the input does not determine them) or NOT_FINITE; they are finite
    always, and mean something only where it is OK.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(10, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> found = torchsfm.tensors.cameras_from_trifocal(torchsfm.tensors.trifocal_from_cameras(*P))
        >>> x = torchsfm.project_points(P, X)
        >>> seen = torchsfm.triangulate_points(x, found.P)  # in the frame of these cameras
        >>> bool(torchsfm.project_points(found.P, seen.model).allclose(x)), torchsfm.Status(found.status.item()).name
        (True, 'OK')
    """

    P: Float[Tensor, "*batch v 3 4"]
    status: Int[Tensor, "*batch"]


def trifocal_from_cameras(
    P1: Float[Tensor, "*#batch 3 4"], P2: Float[Tensor, "*#batch 3 4"], P3: Float[Tensor, "*#batch 3 4"]
) -> Float[Tensor, "*batch 3 3 3"]:
    """The trifocal tensor of three cameras by 4x4 determinants (HZ 17.12): any projective or affine cameras.

    Args:
        P1: First cameras, of any scale.
        P2: Second cameras.
        P3: Third cameras.

    Returns:
        T with `T[i, j, k] = det(P1[i + 1], P1[i + 2], P2[j], P3[k])`, rows of P1 counted cyclically. Its scale is the product
        of those of the cameras, that of the first squared. Zero where all centres coincide.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P, X = torchsfm.random_poses(3, generator=g).matrix(), torchsfm.random_points(10, generator=g)
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.trifocal_ppp(T, *torchsfm.project_points(P, X)).abs().max() < 1e-9)
        True
    """
    check_tensors(P1=(P1, "3 4"), P2=(P2, "3 4"), P3=(P3, "3 4"))
    signs = torch.tensor(LAPLACE_SIGNS, dtype=P1.dtype, device=P1.device)
    rest = wedge(P2[..., :, None, :], P3[..., None, :, :]).flip(-1).flatten(-3, -2)
    return split_last((cyclic_pairs(P1) * signs) @ rest.mT, 3, 3)


def trifocal_tensors(P: Float[Tensor, "*batch v 3 4"], index: Int[Tensor, "m 3"]) -> Float[Tensor, "*batch m 3 3 3"]:
    """The trifocal tensors of listed triplets out of v cameras.

    Args:
        P: Cameras.
        index: Triplets (i, j, k) of camera numbers; the order matters, i is the view whose points are transferred.

    Returns:
        For each triplet the tensor of `trifocal_from_cameras`.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> torchsfm.tensors.trifocal_tensors(P, torch.tensor([[0, 1, 2], [1, 2, 3]])).shape
        torch.Size([2, 3, 3, 3])
    """
    check_tensors(P=(P, "v>=1 3 4"), index=(index, "m 3: int"))
    return trifocal_from_cameras(*(P[..., index[:, k], :, :] for k in range(3)))


def trifocal_epipoles(T: Float[Tensor, "*batch 3 3 3"]) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """The images of the first centre in the second and third view (HZ 15.1.2), as unit homogeneous points of either sign.

    The tensor nearest to T of the form a_i e3' - e2 b_i' has these epipoles (a_i and b_i being free): they maximise
    sum_i |T_i' e2|^2 + |T_i e3|^2 - (e2' T_i e3)^2, found by Newton's method from the null vectors of the pencil of slices and
    from starts all over the sphere.

    Args:
        T: Trifocal tensors of any scale.

    Returns:
        e2 and e3. Where T does not determine them (a first centre that coincides with another) some unit vectors, and
        (0, 0, 1) where T is not finite or zero. Differentiable.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> e2, e3 = torchsfm.tensors.trifocal_epipoles(torchsfm.tensors.trifocal_from_cameras(*P))
        >>> seen = P[1] @ torchsfm.geometry.camera_centre(P[0], homogeneous=True)  # the first centre in the second view
        >>> bool(torch.linalg.cross(e2, seen).norm() < 1e-9)
        True
    """
    check_tensors(T=(T, "3 3 3"))
    e2, e3, _ = epipoles_of_slices(unit_tensor(T, 3)[0])
    return e2, e3


def cameras_from_trifocal(T: Float[Tensor, "*batch 3 3 3"]) -> ProjectiveCameras:
    """Three projective cameras with trifocal tensor T (HZ 15.1).

    P1 = [I | 0], P2 = [A | e2] with A = (T_1 e3, T_2 e3, T_3 e3), P3 = [B | e3] with
    B = (e3 e3' - I)(T_1' e2, T_2' e2, T_3' e2) for unit epipoles. The tensor of these cameras is T / |T| if T is a trifocal
    tensor, else the nearest to it in the Frobenius norm.

    Args:
        T: Trifocal tensors of any scale, in coordinates of moderate size for those that have noise: the norm counts all entries
            alike.

    Returns:
        The cameras (*batch, 3 views, 3, 4), one representative of those that differ by a projective map of space, and the
        status: DEGENERATE where the first centre coincides with the second or third. Differentiable.

    Raises:
        ValueError: Wrong shape or dtype.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> found = torchsfm.tensors.cameras_from_trifocal(torchsfm.tensors.trifocal_from_cameras(*P))
        >>> canonical = torchsfm.tensors.canonical_cameras  # the frame in which cameras can be compared
        >>> found.P.shape, bool(canonical(found.P).allclose(canonical(P)))
        (torch.Size([3, 3, 4]), True)
    """
    check_tensors(T=(T, "3 3 3"))
    unit, finite = unit_tensor(T, 3)
    e2, e3, determined = epipoles_of_slices(unit)
    A = (unit @ e3[..., None, :, None])[..., 0].mT
    b = (unit.mT @ e2[..., None, :, None])[..., 0].mT
    B = e3[..., :, None] * (e3[..., None, :] @ b) - b
    P1 = torch.eye(3, 4, dtype=T.dtype, device=T.device).expand(*T.shape[:-3], 3, 4)
    P = torch.stack((P1, torch.cat((A, e2[..., None]), -1), torch.cat((B, e3[..., None]), -1)), -3)
    status = torch.where(determined, Status.OK, Status.DEGENERATE)
    return ProjectiveCameras(P, torch.where(finite, status, Status.NOT_FINITE).to(torch.int8))


def fundamentals_from_trifocal(T: Float[Tensor, "*batch 3 3 3"]) -> Float[Tensor, "*batch 3 3 3"]:
    """The fundamental matrices of the pairs of views (1, 2), (1, 3) and (2, 3) (HZ 15.1.3).

    Args:
        T: Trifocal tensors of any scale.

    Returns:
        F (*batch, pair, 3, 3) with norm 1, x_j' F x_i = 0 for the pair (i, j): zero where two centres coincide, without meaning
        where the first does with another. Differentiable.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> F = torchsfm.tensors.fundamentals_from_trifocal(torchsfm.tensors.trifocal_from_cameras(*P))
        >>> F23, truth = F[2], torchsfm.tensors.fundamental_from_cameras(P[1], P[2])
        >>> F.shape, round(float((F23 * truth).sum().abs() / truth.norm()), 6)  # 1: the same up to scale
        (torch.Size([3, 3, 3]), 1.0)
    """
    P = cameras_from_trifocal(T).P
    e2, e3 = P[..., 1, :, 3], P[..., 2, :, 3]
    F12, F13 = cross_matrix(e2) @ P[..., 1, :, :3], cross_matrix(e3) @ P[..., 2, :, :3]
    dual = cyclic_pairs(P[..., 2, :, :]).flip(-1)
    F23 = (dual * torch.tensor(LAPLACE_SIGNS, dtype=T.dtype, device=T.device)) @ cyclic_pairs(P[..., 1, :, :]).mT
    return split_last(normalize_sphere(torch.stack((F12, F13, -F23), -3).flatten(-2)), 3, 3)


def unit_tensor(T: Tensor, order: int) -> tuple[Tensor, Tensor]:
    """Tensors with Frobenius norm 1 and where they are finite; zero where T is not finite or zero."""
    flat = T.flatten(-order)
    finite = torch.isfinite(flat).all(-1)
    return split_last(normalize_sphere(flat), *(3,) * order), finite


def epipoles_of_slices(T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit epipoles e2 and e3 of tensors of norm 1, and where they are determined."""
    with torch.no_grad():
        base = T.detach().double()
        # adj(sum_i s_i T_i) has rows orthogonal to e2 and columns orthogonal to e3 for all s: its coefficients as a form in s.
        # The slices alone would not do: some are of rank 1 where the cameras do not turn.
        i, j = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
        single = adjugate_3x3(base)
        form = adjugate_3x3(base[..., i, :, :] + base[..., j, :, :]) - single[..., i, :, :] - single[..., j, :, :]
        left, right = form.flatten(-3, -2), form.mT.flatten(-3, -2)
        # The second singular values, in units of |T|^2.
        second = svdvals(torch.stack((left, right)))[0][..., 1]
        determined = (second > 64 * torch.finfo(T.dtype).eps).all(0)
        e2, e3 = _highest(base, null_vector(left)[0], null_vector(right)[0])
        e2, e3 = positive(e2), positive(e3)
    e2, e3 = _newton(T.double(), e2, e3)
    return e2.to(T.dtype), e3.to(T.dtype), determined


def _highest(T: Tensor, e2: Tensor, e3: Tensor) -> tuple[Tensor, Tensor]:
    """The highest maximum that is found from e2, from e3 and from all over both half spheres.

    Noise makes several maxima, the highest of them narrow at times. Each start takes the best other epipole, an eigenvector;
    then the epipoles are multiplied in turn by the matrix whose eigenvector each is, which only goes up, and the best few are
    refined.
    """
    slices = T[..., None, :, :, :]
    everywhere = half_sphere(12, T).expand(*T.shape[:-3], 12, 3)
    second, third = (torch.cat((e[..., None, :], everywhere), -2) for e in (e2, e3))
    e2 = torch.cat((second, eigh(_across(slices.mT, third))[1][..., -1]), -2)
    e3 = torch.cat((eigh(_across(slices, second))[1][..., -1], third), -2)
    for _ in range(12):
        e2 = normalize_sphere((_across(slices.mT, e3) @ e2[..., None])[..., 0])
        e3 = normalize_sphere((_across(slices, e2) @ e3[..., None])[..., 0])

    def height(e2: Tensor, e3: Tensor) -> Tensor:
        left = (slices.mT @ e2[..., None, :, None]).square().sum((-3, -2, -1))
        return left + (e3[..., None, :] @ _across(slices, e2) @ e3[..., None])[..., 0, 0]

    def chosen(index: Tensor) -> tuple[Tensor, Tensor]:
        index = index[..., None].expand(*index.shape, 3)
        return e2.gather(-2, index), e3.gather(-2, index)

    best = height(e2, e3).topk(3, -1).indices
    e2, e3 = chosen(torch.cat((torch.zeros_like(best[..., :1]), best), -1))
    for _ in range(8):
        e2, e3 = _newton(slices, e2, e3, shifted=True)
    # The first start is the true one if there is no noise.
    advantage = 1 + 1e-9 * (torch.arange(4, device=T.device) == 0).to(T.dtype)
    e2, e3 = chosen((advantage * height(e2, e3)).argmax(-1, keepdim=True))
    return e2[..., 0, :], e3[..., 0, :]


def _across(T: Tensor, e: Tensor) -> Tensor:
    """sum_i T_i' (I - e e') T_i."""
    left = (T.mT @ e[..., None, :, None])[..., 0]
    return (T.mT @ T).sum(-3) - left.mT @ left


def _newton(T: Tensor, e2: Tensor, e3: Tensor, shifted: bool = False) -> tuple[Tensor, Tensor]:
    """A Newton step on the product of spheres, uphill also where `shifted`; the last one carries the maximum's derivative."""
    U, V = tangent_basis(e2), tangent_basis(e3)
    right, left = (T @ e3[..., None, :, None])[..., 0], (T.mT @ e2[..., None, :, None])[..., 0]
    c = (right * e2[..., None, :]).sum(-1)
    S2, S3 = _across(T.mT, e3), _across(T, e2)
    mixed = -(right.mT @ left + (c[..., None, None] * T).sum(-3))
    g2, g3 = (S2 @ e2[..., None])[..., 0], (S3 @ e3[..., None])[..., 0]
    eye = torch.eye(2, dtype=T.dtype, device=T.device)
    H22 = U.mT @ S2 @ U - (g2 * e2).sum(-1)[..., None, None] * eye
    H33 = V.mT @ S3 @ V - (g3 * e3).sum(-1)[..., None, None] * eye
    H23 = U.mT @ mixed @ V
    H = torch.cat((torch.cat((H22, H23), -1), torch.cat((H23.mT, H33), -1)), -2)
    g = torch.cat((U.mT @ g2[..., None], V.mT @ g3[..., None]), -2)
    if shifted:
        values, _ = eigvalsh(H)
        slope = 0.1 * values.abs().amax(-1)
        wrong = values[..., -1] > -1e-3 * slope
        H = H - torch.where(wrong, values[..., -1] + slope, 0)[..., None, None] * torch.eye(4, dtype=H.dtype, device=H.device)
    # At a maximum H is negative definite.
    definite = torch.linalg.cholesky_ex(-H.detach())[1] == 0
    safe = torch.where(definite[..., None, None], H, -torch.eye(4, dtype=T.dtype, device=T.device))
    step, good = solve(safe, -g)
    keep = (definite & good)[..., None, None] & (step.detach().abs().amax((-2, -1), keepdim=True) < 0.5)
    step = torch.where(keep, step, 0)
    return normalize_sphere(e2 + (U @ step[..., :2, :])[..., 0]), normalize_sphere(e3 + (V @ step[..., 2:, :])[..., 0])


def half_sphere(n: int, like: Tensor) -> Float[Tensor, "n 3"]:
    """Unit vectors evenly over half a sphere: a spiral that turns by the golden angle."""
    k = torch.arange(n, dtype=like.dtype, device=like.device)
    z, angle = 1 - (k + 0.5) / n, math.pi * (3 - 5**0.5) * k
    r = (1 - z * z).sqrt()
    return torch.stack((r * angle.cos(), r * angle.sin(), z), -1)


def positive(e: Tensor) -> Tensor:
    """Vectors with the sign that makes their largest entry positive."""
    largest = e.gather(-1, e.detach().abs().argmax(-1, keepdim=True))
    return torch.where(largest < 0, -e, e)


def tangent_basis(e: Tensor) -> Tensor:
    """Two orthonormal columns orthogonal to unit vectors, without derivative: a Householder reflection."""
    e = e.detach()
    sign = torch.where(e[..., 2:] < 0, -1.0, 1.0).to(e.dtype)
    v = torch.cat((e[..., :2], e[..., 2:] + sign), -1)
    scale = (1 / (1 + e[..., 2:].abs()))[..., None]
    return torch.eye(3, 2, dtype=e.dtype, device=e.device) - scale * v[..., :, None] * v[..., None, :2]
