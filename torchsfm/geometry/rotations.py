"""Rotations of space: matrices outside, rotation vectors for tangents, quaternions and Euler angles at conversions."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.linalg.devices import drawn_on

SERIES = 1e-3
"""Squared angle below which power series replace quotients; four terms are then exact to float64 rounding."""


def cross_matrix(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Write the cross product with v as a matrix: `cross_matrix(v) @ a = v x a`.

    Args:
        v: The left factor of the product.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.geometry.cross_matrix(torch.tensor([1.0, 0.0, 0.0])) @ torch.tensor([0.0, 1.0, 0.0])
        tensor([0., 0., 1.])
    """
    check_tensors(v=(v, "3"))
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return _matrix([zero, -z, y, z, zero, -x, -y, x, zero], 3)


def rotation_from_rotvec(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotate by |w| radians about w (Rodrigues' formula, the exponential map of SO(3)).

    Differentiable everywhere any number of times, also at zero.

    Args:
        w: Axis times angle, radians.

    Returns:
        Rotation matrices.

    Example:
        >>> import torch, torchsfm
        >>> R = torchsfm.geometry.rotation_from_rotvec(torch.tensor([0.0, 0.0, torch.pi / 2]))
        >>> (R @ torch.tensor([1.0, 0.0, 0.0])).round(decimals=3).abs()
        tensor([0., 1., 0.])
    """
    check_tensors(w=(w, "3"))
    x, y, z = w.unbind(-1)
    t = x * x + y * y + z * z
    small = t < SERIES
    angle = torch.where(small, 1.0, t).sqrt()
    half = torch.sin(0.5 * angle) / (0.5 * angle)
    a = torch.where(small, 1 - t / 6 * (1 - t / 20 * (1 - t / 42)), torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - t / 24 * (1 - t / 30 * (1 - t / 56)), 0.5 * half * half)
    ax, ay, az = a * x, a * y, a * z
    bx, by, bz = b * x, b * y, b * z
    xy, xz, yz = bx * y, bx * z, by * z
    xx, yy, zz = bx * x, by * y, bz * z
    rows = [1 - (yy + zz), xy - az, xz + ay, xy + az, 1 - (xx + zz), yz - ax, xz - ay, yz + ax, 1 - (xx + yy)]
    return _matrix(rows, 3)


def rotvec_from_rotation(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Find axis times angle of a rotation (the logarithm of SO(3)).

    Smooth for angles below pi. At pi, where axis and opposite axis are the same rotation, one of the two is returned, to full
    accuracy, with the derivative of its own branch.

    Args:
        R: Rotation matrices.

    Returns:
        Rotation vectors, radians, of length at most pi.

    Example:
        >>> import torch, torchsfm
        >>> w = torch.tensor([0.1, -0.2, 0.3])
        >>> torchsfm.geometry.rotvec_from_rotation(torchsfm.geometry.rotation_from_rotvec(w))
        tensor([ 0.1000, -0.2000,  0.3000])
    """
    check_tensors(R=(R, "3 3"))
    w, *v = _quaternion(R)
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    # For small |v| the scalar part is near 1: angle / sin(angle / 2) from the series of the arctangent.
    small = square < SERIES * SERIES
    ratio = square / torch.where(small, w * w, 1.0)
    series = 2 / torch.where(small, w, 1.0) * (1 - ratio / 3 * (1 - 0.6 * ratio))
    length = torch.where(small, 1.0, square).sqrt()
    factor = torch.where(small, series, 2 * torch.atan2(length, w) / length)
    return torch.stack([factor * a for a in v], -1)


def rotation_from_quaternion_wxyz(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Turn quaternions into rotation matrices.

    Args:
        q: Quaternions (w, x, y, z) of any length; the zero quaternion gives the identity.

    Returns:
        Rotation matrices.

    Example:
        >>> import torch, torchsfm
        >>> half_turn = torch.tensor([0.0, 0.0, 0.0, 2.0])  # about z
        >>> torchsfm.geometry.rotation_from_quaternion_wxyz(half_turn).diagonal()
        tensor([-1., -1.,  1.])
    """
    check_tensors(q=(q, "4"))
    w, x, y, z = q.unbind(-1)
    square = (q * q).sum(-1)
    s = torch.where(square > 0, 2 / torch.where(square > 0, square, 1.0), 0.0)
    sx, sy, sz = s * x, s * y, s * z
    xx, yy, zz, xy, xz, yz = sx * x, sy * y, sz * z, sx * y, sx * z, sy * z
    wx, wy, wz = sx * w, sy * w, sz * w
    rows = [1 - (yy + zz), xy - wz, xz + wy, xy + wz, 1 - (xx + zz), yz - wx, xz - wy, yz + wx, 1 - (xx + yy)]
    return _matrix(rows, 3)


def quaternion_wxyz_from_rotation(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Turn rotation matrices into unit quaternions (w, x, y, z) with w >= 0.

    Each row of the symmetric matrix 4 q q' is linear in R and proportional to q; the one with the largest diagonal is accurate
    (Shepperd 1978). Accurate for every angle, also at pi.

    Args:
        R: Rotation matrices.

    Returns:
        Unit quaternions.

    Example:
        >>> import torch, torchsfm
        >>> half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # about x
        >>> torchsfm.geometry.quaternion_wxyz_from_rotation(half_turn).abs()
        tensor([0., 1., 0., 0.])
    """
    check_tensors(R=(R, "3 3"))
    return torch.stack(_quaternion(R), -1)


def _quaternion(R: Float[Tensor, "*batch 3 3"]) -> list[Float[Tensor, "*batch"]]:
    """The parts of the quaternions, each by itself: whole rows in one tensor would take several times as long."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R.flatten(-2).unbind(-1)
    wx, wy, wz = r21 - r12, r02 - r20, r10 - r01
    xy, xz, yz = r01 + r10, r02 + r20, r12 + r21
    ww, xx, yy, zz = 1 + r00 + r11 + r22, 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22
    first, second = ww >= xx, yy >= zz
    above = torch.where(first, ww, xx) >= torch.where(second, yy, zz)
    rows = zip((ww, wx, wy, wz), (wx, xx, xy, xz), (wy, xy, yy, yz), (wz, xz, yz, zz), strict=True)
    row = [torch.where(above, torch.where(first, w, x), torch.where(second, y, z)) for w, x, y, z in rows]
    length = (row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3]).sqrt()
    scale = torch.where(row[0] < 0, -1.0, 1.0).to(R.dtype) / length
    return [scale * part for part in row]


def rotation_from_euler(angles: Float[Tensor, "*batch k"], axes: str) -> Float[Tensor, "*batch 3 3"]:
    """Compose rotations about coordinate axes.

    Lower-case axes stay fixed in space and rotations are applied in the order written ("xyz" is Rz Ry Rx); upper-case axes move
    with the body ("XYZ" is Rx Ry Rz). This is SciPy's convention.

    Args:
        angles: One angle per axis, radians.
        axes: Axis names, all lower-case or all upper-case, such as "xyz" or "ZYX".

    Returns:
        Rotation matrices.

    Raises:
        ValueError: `axes` is not such a string or its length is not the number of angles.

    Example:
        >>> import torch, torchsfm
        >>> R = torchsfm.geometry.rotation_from_euler(torch.tensor([torch.pi / 2, 0.0]), "zx")
        >>> (R @ torch.tensor([1.0, 0.0, 0.0])).round(decimals=3).abs()
        tensor([0., 1., 0.])
    """
    check_tensors(angles=(angles, "k"))
    moving = isinstance(axes, str) and axes.isupper()
    if not isinstance(axes, str) or not axes or set(axes) - set("XYZ" if moving else "xyz"):
        raise ValueError(f"axes: wanted letters of 'xyz' or of 'XYZ', got {axes!r}")
    if angles.shape[-1] != len(axes):
        raise ValueError(f"angles: wanted shape (*batch, {len(axes)}) for axes {axes!r}, got {tuple(angles.shape)}")
    frame = torch.eye(3, dtype=angles.dtype, device=angles.device)
    R = frame.expand(*angles.shape[:-1], 3, 3)
    for angle, axis in zip(angles.unbind(-1), axes.lower(), strict=True):
        turn = rotation_from_rotvec(angle[..., None] * frame["xyz".index(axis)])
        R = R @ turn if moving else turn @ R
    return R


def random_rotation(
    *shape: int,
    generator: torch.Generator | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Float[Tensor, "*shape 3 3"]:
    """Draw rotations uniformly (Haar measure), as normal quaternions.

    Args:
        *shape: Batch dimensions; none gives one rotation.
        generator: Source of randomness.
        dtype: Floating-point type; torch's default if not given.
        device: Where the result lies; the generator's device if not given.

    Returns:
        Rotation matrices.

    Example:
        >>> import torch, torchsfm
        >>> R = torchsfm.geometry.random_rotation(100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> R.shape, bool((R @ R.mT).allclose(torch.eye(3, dtype=torch.float64)))
        (torch.Size([100, 3, 3]), True)
    """
    device = drawn_on(generator, device)
    return rotation_from_quaternion_wxyz(torch.randn(*shape, 4, generator=generator, dtype=dtype, device=device))


def rotation_angle(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Measure the angle of rotations, 0 to pi radians, accurate over the whole range.

    The angle between two rotations is `rotation_angle(R1.mT @ R2)`. The derivative at angle 0, where there is none, is 0.

    Args:
        R: Rotation matrices.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.geometry.rotation_angle(torch.diag(torch.tensor([1.0, -1.0, -1.0])))
        tensor(3.1416)
    """
    check_tensors(R=(R, "3 3"))
    axis = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    return torch.atan2(torch.linalg.vector_norm(axis, dim=-1), R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)


def _matrix(entries: list[Tensor], size: int) -> Tensor:
    """Stack entries, row after row, into square matrices."""
    return torch.stack(entries, -1).reshape(*entries[0].shape, size, size)
