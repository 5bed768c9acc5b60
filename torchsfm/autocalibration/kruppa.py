"""The Kruppa equations: intrinsics from fundamental matrices alone, without cameras or a plane at infinity.

`F w* F' ~ [e'] w* [e']'` with w* = K K': the epipolar tangents to the image of the absolute conic correspond (Kruppa 1913;
Maybank & Faugeras 1992). With `F = U diag(r, s, 0) V'` both sides are 2x2 (Hartley, "Kruppa's equations derived from the
fundamental matrix", PAMI 1997). They are weaker than the absolute dual quadric: the plane at infinity is not the same for all
pairs.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors, tensor_map
from torchsfm.autocalibration.algebraic_fit import IntrinsicsEstimate, check_shared, fit_intrinsics, focal_starts, scaled
from torchsfm.autocalibration.intrinsics_model import CONSTANT, Assumption
from torchsfm.autocalibration.projective_input import image_scaling
from torchsfm.linalg import svd


def intrinsics_from_kruppa(
    F: Float[Tensor, "*#batch m 3 3"],
    *,
    image_size: tuple[float, float],
    weights: Float[Tensor, "*#batch m"] | None = None,
    assume: Assumption = CONSTANT,
) -> IntrinsicsEstimate:
    """The intrinsics that all views share, from the fundamental matrices of pairs.

    Two constraints a pair. Besides all critical motions of autocalibration, pure translations, and fixation of one point from
    one distance, leave them open.

    Args:
        F: Fundamental matrices `x2' F x1 = 0`, of any scale; replaced by the nearest of rank 2 in scaled coordinates.
        image_size: Width and height in pixels.
        weights: Of the pairs; 0 leaves one out.
        assume: What is free; nothing may vary.

    Returns:
        K and how far it is determined.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or the assumption lets intrinsics vary.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> P = K @ torchsfm.random_poses(6, spread=3.0, wobble=1.0, generator=g).matrix()
        >>> F = torchsfm.tensors.bifocal_tensors(P, torch.combinations(torch.arange(6)))
        >>> found = torchsfm.autocalibration.intrinsics_from_kruppa(F, image_size=(1000.0, 750.0))
        >>> bool((found.K - K).abs().max() < 1)
        True
    """
    batch = check_tensors(F=(F, "m>=1 3 3"), weights=(weights, "?m"))
    check_shared(assume, image_size)
    m = F.shape[-3]
    flat = F.detach().double().expand(*batch, m, 3, 3).reshape(-1, m, 3, 3)
    w = flat.new_ones(flat.shape[:2]) if weights is None else weights.detach().double().expand(*batch, m).reshape(-1, m)
    good = torch.isfinite(flat).flatten(-2).all(-1) & (flat != 0).flatten(-2).any(-1) & torch.isfinite(w) & (w > 0)
    size = flat.new_tensor(image_size).expand(len(flat), 2)
    safe = torch.where(good[..., None, None], flat, torch.eye(3, dtype=flat.dtype, device=flat.device))
    U, s, Vh, _ = svd(scaled(safe, image_scaling(size), inverse_left=False))
    s = s / s[..., :1].clamp_min(1e-300)
    left = U[..., :2].mT
    right = s[..., :2, None] * Vh[..., :2, :]
    root = torch.where(good, w, 0.0).sqrt()

    def constraints(K: Tensor, _: Tensor, left: Tensor, right: Tensor, root: Tensor) -> Tensor:
        diac = (K @ K.mT)[..., None, :, :]
        a = right @ diac @ right.mT
        c = left @ diac @ left.mT
        # [e'] turns the left directions by a right angle.
        b = torch.stack((c[..., 1, 1], -math.sqrt(2) * c[..., 0, 1], c[..., 0, 0]), -1)
        a = torch.stack((a[..., 0, 0], math.sqrt(2) * a[..., 0, 1], a[..., 1, 1]), -1)
        a, b = (t / t.norm(dim=-1, keepdim=True).clamp_min(1e-300) for t in (a, b))
        difference: Tensor = ((a - b) * root[..., None]).flatten(-2)
        return difference

    starts = focal_starts(assume, len(flat), flat.new_zeros(1, 0), tuple(0.3 * 1.5**i for i in range(9)))
    found, _ = fit_intrinsics(constraints, starts, assume, (left, right, root), 2.0 * good.sum(-1), size)
    return tensor_map(lambda t: (t.to(F.dtype) if t.is_floating_point() else t).reshape(batch + t.shape[1:]), found)
