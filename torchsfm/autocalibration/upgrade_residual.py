"""How far cameras are from metric ones, for given intrinsics and plane at infinity.

In the frame where the reference camera is [I | 0] and the plane at infinity is (p, 1), the metric cameras are
`[A - a p' | a] diag(K_ref, 1)`. So `M = K^-1 (A - a p') K_ref` must be a multiple of a rotation (Hartley & Zisserman 2004,
19.1; Heyden & Astrom 1996): M M' is compared with I by its five components without trace, over its norm.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.autocalibration.intrinsics_model import inverse_intrinsics
from torchsfm.geometry.intrinsic_parameters import intrinsics_slopes

_R2, _R6 = 1 / math.sqrt(2), 1 / math.sqrt(6)


def traceless_basis(like: Tensor) -> Float[Tensor, "5 3 3"]:
    """An orthonormal basis of the symmetric matrices without trace."""
    E = like.new_zeros(5, 3, 3)
    E[0, 0, 0], E[0, 1, 1] = _R2, -_R2
    E[1, 0, 0], E[1, 1, 1], E[1, 2, 2] = _R6, _R6, -2 * _R6
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)), 2):
        E[k, i, j] = E[k, j, i] = _R2
    return E


def metric_blocks(P: Tensor, K: Tensor, K_ref: Tensor, p: Tensor) -> Float[Tensor, "*batch v 3 3"]:
    """`M = K^-1 (A - a p') K_ref` of every view; K is `(*batch, v, 3, 3)`, p `(*batch, 3)`."""
    B = P[..., :3] - P[..., 3:] * p[..., None, None, :]
    M: Tensor = inverse_intrinsics(K) @ B @ K_ref[..., None, :, :]
    return M


def departure(M: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 5"]:
    """What is left of `M M' / |M M'|` without its trace."""
    S = M @ M.mT
    size = S.flatten(-2).norm(dim=-1, keepdim=True).clamp_min(torch.finfo(M.dtype).tiny)
    a, b, c = S[..., 0, 0], S[..., 1, 1], S[..., 2, 2]
    root = math.sqrt(2)
    parts = ((a - b) * _R2, (a + b - 2 * c) * _R6, root * S[..., 0, 1], root * S[..., 0, 2], root * S[..., 1, 2])
    g: Tensor = torch.stack(parts, -1) / size
    return g


@dataclass(frozen=True)
class Departures:
    """The departures of all views, and what their derivatives are made of."""

    g: Float[Tensor, "*batch v 5"]
    by_camera: Float[Tensor, "*batch v 5 12"]
    """Their derivatives with respect to the entries of each camera."""
    P: Float[Tensor, "*batch v 3 4"]
    K: Float[Tensor, "*batch v 3 3"]
    K_ref: Float[Tensor, "*batch 3 3"]
    M: Float[Tensor, "*batch v 3 3"]
    left: Float[Tensor, "*batch v 3 3"]
    """`M = left K_ref`."""
    Q: Float[Tensor, "*batch v 5 3 3"]
    """`dg = <Q, dM>`."""
    pulled: Float[Tensor, "*batch v 5 3 3"]
    """`K^-T Q`."""
    R: Float[Tensor, "*batch v 5 3 3"]
    """`K^-T Q K_ref'`."""

    def by_parameters(self) -> tuple[Tensor, Tensor, Tensor]:
        """Derivatives with respect to the view's own parameters (5, 5), those of the reference view (5, 5), and p (5, 3)."""
        own = -torch.einsum("...mij,...kij->...mk", self.pulled @ self.M.mT[..., None, :, :], intrinsics_slopes(self.K))
        slopes = intrinsics_slopes(self.K_ref)[..., None, :, :, :]
        reference = torch.einsum("...mij,...kij->...mk", self.left.mT[..., None, :, :] @ self.Q, slopes)
        return own, reference, -(self.R.mT @ self.P[..., None, :, 3:])[..., 0]


def departures(
    P: Float[Tensor, "*batch v 3 4"],
    K: Float[Tensor, "*batch v 3 3"],
    K_ref: Float[Tensor, "*batch 3 3"],
    p: Float[Tensor, "*batch 3"],
) -> Departures:
    """The departures of cameras with intrinsics K, in the frame where the plane at infinity is (p, 1)."""
    inverse = inverse_intrinsics(K)
    left = inverse @ (P[..., :3] - P[..., 3:] * p[..., None, None, :])
    Kr = K_ref[..., None, :, :]
    M = left @ Kr
    S = M @ M.mT
    size = S.flatten(-2).norm(dim=-1).clamp_min(torch.finfo(M.dtype).tiny)
    g = departure(M)
    Q = 2 * (
        traceless_basis(M) @ M[..., None, :, :] / size[..., None, None, None]
        - g[..., None, None] * (S @ M / size[..., None, None] ** 2)[..., None, :, :]
    )
    pulled = inverse.mT[..., None, :, :] @ Q
    R = pulled @ Kr[..., None, :, :].mT
    by_camera = torch.cat((R, -(R @ p[..., None, None, :, None])), -1).flatten(-2)
    return Departures(g, by_camera, P, K, K_ref, M, left, Q, pulled, R)
