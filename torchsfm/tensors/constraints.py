"""Internal constraints: how far an array of numbers is from being a tensor of cameras. All are 0 exactly for those."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.linalg import adjugate_3x3, cross, determinant_3x3
from torchsfm.tensors.quadrifocal import cameras_from_quadrifocal, quadrifocal_from_cameras
from torchsfm.tensors.trifocal import unit_tensor


def fundamental_constraint(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Det F for |F| = 1, the one constraint on a fundamental matrix.

    Args:
        F: Matrices of any scale; zero or not finite ones give 0.

    Returns:
        The determinant.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.tensors.fundamental_constraint(torch.diag(torch.tensor([1.0, 1.0, 0.0])))
        tensor(0.)
    """
    check_tensors(F=(F, "3 3"))
    return determinant_3x3(unit_tensor(F, 2)[0])


def essential_constraints(E: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 10"]:
    """2 E E'E - tr(E E') E, nine cubics, and det E, for |E| = 1 (Demazure 1988).

    Args:
        E: Matrices of any scale; zero or not finite ones give 0.

    Returns:
        The ten residuals, all zero for two equal singular values and a third that is 0.

    Example:
        >>> import torch, torchsfm
        >>> E = torchsfm.tensors.essential_from_pose(torch.eye(3), torch.tensor([1.0, 2.0, 3.0]))
        >>> residuals = torchsfm.tensors.essential_constraints(E)
        >>> residuals.shape, bool(residuals.abs().max() < 1e-6)
        (torch.Size([10]), True)
    """
    check_tensors(E=(E, "3 3"))
    E = unit_tensor(E, 2)[0]
    square = E @ E.mT
    trace = square.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    return torch.cat(((2 * square @ E - trace * E).flatten(-2), determinant_3x3(E)[..., None]), -1)


def trifocal_constraints(T: Float[Tensor, "*batch 3 3 3"]) -> Float[Tensor, "*batch 64"]:
    """The extended rank constraints and the epipolar constraints on a trifocal tensor, for |T| = 1.

    Papadopoulo & Faugeras ("A new characterization of the trifocal tensor", ECCV 1998): det(s_i T_i) = 0 for all s, ten cubic
    equations; and the left null vectors of the three slices are in one plane, as are the right ones. The latter are written
    without null vectors: adj(T_i) is the product of the right and the left one, and the products of three such, antisymmetrised
    over the ones, are the determinant of those times all products of the others, 2 x 27 equations of degree 6.

    Args:
        T: Arrays of any scale; zero or not finite ones give 0.

    Returns:
        64 residuals: 10 for the rank, 27 for the left epipole e2 and 27 for the right epipole e3. Where slices have rank 1 (a
        camera that moves sideways without turning) the last 54 say less, though they are still 0 for trifocal tensors.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.trifocal_constraints(T).abs().max() < 1e-9)
        True
    """
    check_tensors(T=(T, "3 3 3"))
    T = unit_tensor(T, 3)[0]
    a, b, c = T.unbind(-3)
    adj = adjugate_3x3(T)
    A, B, C = adj.unbind(-3)
    rank = [determinant_3x3(T[..., i, :, :]) for i in range(3)]
    # The coefficients of s_i^2 s_j are tr(adj(T_i) T_j).
    rank += [(adj[..., i, :, :].mT * T[..., j, :, :]).sum((-2, -1)) for i in range(3) for j in range(3) if i != j]
    mixed = adjugate_3x3(a + b) - A - B
    rank.append((mixed.mT * c).sum((-2, -1)))
    epipolar = []
    for X, Y, Z in ((A, B, C), (A.mT, B.mT, C.mT)):
        # det of one row each of X, Y and Z.
        planes = cross(X[..., :, None, :], Y[..., None, :, :])
        epipolar.append((planes.flatten(-3, -2) @ Z.mT).flatten(-2))
    return torch.cat((torch.stack(rank, -1), *epipolar), -1)


def quadrifocal_constraints(Q: Float[Tensor, "*batch 3 3 3 3"]) -> Float[Tensor, "*batch 81"]:
    """What separates Q / |Q| from the nearest quadrifocal tensor (29 degrees of freedom among 81 numbers).

    The parameterisation by cameras stands in for the 51 polynomial constraints, which nobody writes down.

    Args:
        Q: Arrays of any scale; zero or not finite ones give 0.

    Returns:
        Q / |Q| less its orthogonal projection on the tensor of `cameras_from_quadrifocal(Q)`.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.quadrifocal_constraints(Q).norm() < 1e-6)
        True
    """
    check_tensors(Q=(Q, "3 3 3 3"))
    unit, _ = unit_tensor(Q, 4)
    nearest = unit_tensor(quadrifocal_from_cameras(*cameras_from_quadrifocal(Q).P.unbind(-3)), 4)[0].flatten(-4)
    flat = unit.flatten(-4)
    return flat - (flat * nearest).sum(-1, keepdim=True) * nearest
