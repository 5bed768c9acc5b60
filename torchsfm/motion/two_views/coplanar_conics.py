"""Whether conics may lie in one plane: a homography then relates their images, and they say nothing of F beyond it.

Two conics of one plane have two projective invariants, tr(C1^-1 C2) and tr(C2^-1 C1) of matrices of determinant 1 (Forsyth et
al., "Invariant descriptors for 3D object recognition and pose", TPAMI 1991). Where all of them are the same in both images
but for noise, the plane is enough to explain the images.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg import inverse
from torchsfm.motion.two_views.normalised_conics import conic_of_six

LIMIT = 36.0
"""Squared deviations, in units of the noise, within which an invariant is the same: few residuals may tell too little noise."""


def may_be_coplanar(
    c1: Float[Tensor, "*batch m 6"],
    c2: Float[Tensor, "*batch m 6"],
    S1: Float[Tensor, "*batch m 6 6"],
    S2: Float[Tensor, "*batch m 6 6"],
    seen: Bool[Tensor, "*batch m"],
    noise: Float[Tensor, "*batch"],
) -> Bool[Tensor, "*batch"]:
    """Whether the invariants of all pairs of conics are the same in both images.

    Args:
        c1: Dual conics in the first image, as six numbers.
        c2: The same in the second image.
        S1: Covariances of the numbers in the first image.
        S2: The same in the second image.
        seen: Which conics count.
        noise: By how much to multiply the covariances.
    """
    (value1, variance1), (value2, variance2) = invariants(c1, S1), invariants(c2, S2)
    other = (value1 - value2).square() > LIMIT * noise[..., None, None] * (variance1 + variance2)
    both = seen[..., :, None] & seen[..., None, :]
    # An invariant with itself is 3 everywhere.
    both = both & ~torch.eye(c1.shape[-2], dtype=torch.bool, device=c1.device)
    return ~(other & both).any(-1).any(-1)


def invariants(
    c: Float[Tensor, "*batch m 6"], S: Float[Tensor, "*batch m 6 6"]
) -> tuple[Float[Tensor, "*batch m m"], Float[Tensor, "*batch m m"]]:
    """tr(D_i D_j^-1) of dual conics scaled to one determinant, and its variance, which is right off the diagonal."""
    D = conic_of_six(c)
    A = inverse(D)[0]
    det = torch.linalg.det(D)
    # Determinants of ellipses have the same sign.
    k = (det[..., None, :] / det[..., :, None]).abs().pow(1 / 3)
    value = k * torch.einsum("...iab,...jba->...ij", D, A)
    unit = conic_of_six(torch.eye(6, dtype=c.dtype, device=c.device))
    # Derivatives by the six numbers of either; the determinant's is the inverse.
    first = k[..., None] * torch.einsum("nab,...jba->...jn", unit, A)[..., None, :, :]
    own = torch.einsum("nab,...iba->...in", unit, A)
    first = first - value[..., None] / 3 * own[..., :, None, :]
    across = torch.einsum("...jab,...ibc,...jcd->...ijad", A, D, A)
    second = value[..., None] / 3 * own[..., None, :, :] - k[..., None] * torch.einsum("nab,...ijba->...ijn", unit, across)
    return value, _quadratic(first, S[..., :, None, :, :]) + _quadratic(second, S[..., None, :, :, :])


def _quadratic(g: Tensor, S: Tensor) -> Tensor:
    return (g[..., None, :] @ S @ g[..., None])[..., 0, 0]
