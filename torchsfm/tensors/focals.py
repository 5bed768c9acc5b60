"""Focal lengths from one fundamental matrix, when the rest of both calibrations is known.

Principal points are given, pixels are square. Two unknown focal lengths: the closed form of Bougnoux ("From projective to
Euclidean space under any practical situation", ICCV 1998). One focal length common to both: the Kruppa equations, which are
then overdetermined and have a solution also in some poses where Bougnoux's formula is 0 / 0 (Sturm, "On focal length
calibration from two views", CVPR 2001).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.geometry.rotations import cross_matrix
from torchsfm.linalg.polynomial import cubic_rows
from torchsfm.tensors.bifocal import unit_epipole, unit_rank_2


@dataclass(frozen=True)
class Focals:
    """The focal lengths of two cameras in pixels, and how well F determines them.

    `sensitivity` is about the factor by which a relative error of F grows in the focal lengths. `status` is OK, DEGENERATE (the
    geometry does not determine them: sensitivity above 1 / sqrt(eps); or no real focal length fits) or NOT_FINITE; where it is
    not OK, `model` is 1 and `sensitivity` infinite.

    Example:
        >>> import torch, torchsfm
        >>> f, c = torch.tensor([800.0, 900.0], dtype=torch.float64), torch.tensor([320.0, 240.0], dtype=torch.float64)
        >>> poses = torchsfm.random_poses(2, generator=torch.Generator().manual_seed(1))
        >>> aligned = torchsfm.Pose(torch.eye(3).double().expand(2, 3, 3), torch.eye(3)[:2].double())  # both axes in one plane
        >>> P = torchsfm.intrinsics(f, c) @ torch.stack((poses.matrix(), aligned.matrix()))
        >>> F = torchsfm.tensors.fundamental_from_cameras(P[:, 0], P[:, 1])
        >>> found = torchsfm.tensors.focals_from_fundamental(F, c, c)
        >>> found.valid, found.model[0]  # where the axes meet, one equation is missing
        (tensor([ True, False]), tensor([800.0000, 900.0000], dtype=torch.float64))
    """

    model: Float[Tensor, "*batch 2"]
    sensitivity: Float[Tensor, "*batch"]
    status: Int8[Tensor, "*batch"]

    @property
    def valid(self) -> Bool[Tensor, "*batch"]:
        """Which elements have focal lengths."""
        return self.status == Status.OK


def focals_from_fundamental(
    F: Float[Tensor, "*#batch 3 3"], c1: Float[Tensor, "*#batch 2"], c2: Float[Tensor, "*#batch 2"], *, equal: bool = False
) -> Focals:
    """The focal lengths of two cameras with square pixels and known principal points, from their fundamental matrix.

    Not determined, and reported as such: where the optical axes meet (fixating cameras), unless `equal` and the cameras are at
    different distances from that point; where they are parallel or the cameras' centres and axes lie otherwise in a plane that
    makes F33 = 0; without baseline. Near such poses the sensitivity is high and noise decides: look at it.

    Args:
        F: Fundamental matrices, x2' F x1 = 0, of any scale; replaced by the nearest of rank 2.
        c1: Principal point of the first camera.
        c2: Principal point of the second camera.
        equal: The two focal lengths are known to be the same.

    Returns:
        Focal lengths (f1, f2) in pixels, sensitivity and status. Differentiable.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> poses = torchsfm.random_poses(2, generator=torch.Generator().manual_seed(1))
        >>> f, c = torch.tensor([800.0, 900.0], dtype=torch.float64), torch.tensor([320.0, 240.0], dtype=torch.float64)
        >>> P = torchsfm.intrinsics(f, c) @ poses.matrix()
        >>> F = torchsfm.tensors.fundamental_from_cameras(*P)
        >>> torchsfm.tensors.focals_from_fundamental(F, c, c).model
        tensor([800.0000, 900.0000], dtype=torch.float64)
    """
    batch = check_tensors(F=(F, "3 3"), c1=(c1, "2"), c2=(c2, "2"))
    F = F.expand(*batch, 3, 3)
    finite = torch.isfinite(F).all(-1).all(-1) & torch.isfinite(c1).all(-1) & torch.isfinite(c2).all(-1)
    keep = finite[..., None, None]
    F = torch.where(keep, F, 0)
    shift1, shift2 = (_shift(torch.where(finite[..., None], c, 0)) for c in (c1, c2))
    G = shift2.mT @ F @ shift1
    scale = _moderate_scale(G.detach())
    weights = torch.stack((scale, scale, torch.ones_like(scale)), -1)
    G = unit_rank_2(weights[..., :, None] * G * weights[..., None, :])
    squares, sensitivity = _equal(G) if equal else _different(G)
    good = finite & (squares.detach() > 0).all(-1) & (sensitivity < torch.finfo(F.dtype).eps ** -0.5)
    squares = torch.where(good[..., None], squares, 1)
    model = torch.where(good[..., None], squares.sqrt() * scale[..., None], 1)
    status = torch.where(finite, torch.where(good, Status.OK, Status.DEGENERATE), Status.NOT_FINITE).to(torch.int8)
    return Focals(model, torch.where(good, sensitivity, torch.inf), status)


def _shift(c: Tensor) -> Tensor:
    T = torch.eye(3, dtype=c.dtype, device=c.device).expand(*c.shape[:-1], 3, 3)
    return T + torch.nn.functional.pad(c[..., None], (2, 0, 0, 1))


def _moderate_scale(G: Tensor) -> Tensor:
    """A length in the image, such as a focal length, with which the entries of G are of about the same size."""
    largest = G.abs().amax((-2, -1))
    G = G / torch.where(largest > 0, largest, 1)[..., None, None]
    inner = G[..., :2, :2].abs().amax((-2, -1))
    edge = torch.maximum(G[..., 2, :2].abs().amax(-1), G[..., :2, 2].abs().amax(-1))
    square = (edge * edge + inner * G[..., 2, 2].abs()) / (inner * inner)
    good = torch.isfinite(square) & (square > 0)
    return torch.where(good, square, 1).sqrt()


def _safe_divide(a: Tensor, b: Tensor) -> Tensor:
    good = b != 0
    return torch.where(good, a / torch.where(good, b, 1), 0)


def _different(G: Tensor) -> tuple[Tensor, Tensor]:
    """Bougnoux's formula with both principal points at the origin: f1^2 and f2^2."""
    squares, sensitivity = [], torch.zeros_like(G[..., 0, 0])
    for M in (G, G.mT):
        e = unit_epipole(M.mT)
        a = torch.stack((-e[..., 1], e[..., 0]), -1)
        first = (a * M[..., :2, 2]).sum(-1)
        corner = M[..., 2, 2]
        below = (a[..., None, :] @ M[..., :2, :2] @ M[..., 2, :2, None])[..., 0, 0]
        squares.append(_safe_divide(-first * corner, below))
        parts = torch.stack((first, corner, below)).detach().abs()
        sensitivity = sensitivity + 0.5 * (1 / parts).sum(0)
    return torch.stack(squares, -1), sensitivity


_NO_FOCAL = 1e3
"""Focal lengths this far from the moderate scale, up or down, are not meant."""
_ROWS, _COLUMNS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]


def _equal(G: Tensor) -> tuple[Tensor, Tensor]:
    """The common f^2 = s that makes the Kruppa matrices F w F' and [e2]x w [e2]x', w = diag(s, s, 1), most nearly parallel.

    Their entries are linear in s, their 2x2 minors quadratic, the sum of the squares of the minors a quartic. Its minimum over
    s > 0 is at a root of a cubic; among several, the angle between the two decides.
    """
    C = cross_matrix(unit_epipole(G.mT))
    lines = []
    for M in (G, C):
        slope = (M[..., :, :2] @ M[..., :, :2].mT)[..., _ROWS, _COLUMNS]
        constant = (M[..., :, 2, None] * M[..., None, :, 2])[..., _ROWS, _COLUMNS]
        lines.append((constant, slope))
    (a0, a1), (b0, b1) = lines
    i, j = torch.triu_indices(6, 6, 1, device=G.device)

    def minors(a: Tensor, b: Tensor) -> Tensor:
        return a[..., i] * b[..., j] - a[..., j] * b[..., i]

    q0, q1, q2 = minors(a0, b0), minors(a0, b1) + minors(a1, b0), minors(a1, b1)
    # Half the derivative of |q0 + q1 s + q2 s^2|^2.
    c0, c1 = (q0 * q1).sum(-1), (q1 * q1).sum(-1) + 2 * (q0 * q2).sum(-1)
    c2, c3 = 3 * (q1 * q2).sum(-1), 2 * (q2 * q2).sum(-1)
    with torch.no_grad():
        roots, real = cubic_rows(c0, c1, c2, c3)
        # Both matrices can have rank 1 at s = 0 or infinity: a parallel pair that means nothing.
        real = real & (roots > _NO_FOCAL**-2) & (roots < _NO_FOCAL**2)
        s = torch.where(real, roots, 1)[..., None]
        size = ((a0 + a1 * s) ** 2).sum(-1) * ((b0 + b1 * s) ** 2).sum(-1)
        cost = ((q0 + q1 * s + q2 * s * s) ** 2).sum(-1) / size
        cost, order = torch.where(real, cost, torch.inf).sort(0)
        best = order[:1]
        found = real.gather(0, best)[0] & (cost[1] > (100 * torch.finfo(G.dtype).eps) ** 2)
        root, size = s[..., 0].gather(0, best)[0], size.gather(0, best)[0]
        curvature = c1 + root * (2 * c2 + root * 3 * c3)
        # How fast the angle opens per relative change of f = sqrt(s).
        opening = 2 * root * (curvature.clamp_min(0) / size).sqrt()
        found = found & (opening > 0)
    value = c0 + root * (c1 + root * (c2 + root * c3))
    # A Newton step of value zero, whose derivative is that of the root.
    root = root - torch.where(found, (value - value.detach()) / torch.where(found, curvature, 1), 0)
    root = torch.where(found, root, -1)
    return torch.stack((root, root), -1), torch.where(found, 1 / opening, torch.inf)
