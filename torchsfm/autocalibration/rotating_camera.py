"""A camera that only turns: its intrinsics from the homographies between its images.

`H = K R K^-1`, so that `H w* H' = w*` for the dual image of the absolute conic w* = K K', linear in w* when det H = 1 (Hartley,
"Self-calibration from multiple views with a rotating camera", ECCV 1994; HZ 19.6). Solved here by least squares in K.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors, tensor_map
from torchsfm.autocalibration.algebraic_fit import IntrinsicsEstimate, check_shared, fit_intrinsics, focal_starts, scaled
from torchsfm.autocalibration.intrinsics_model import CONSTANT, Assumption, inverse_intrinsics
from torchsfm.autocalibration.projective_input import image_scaling
from torchsfm.autocalibration.upgrade_residual import departure


def intrinsics_from_rotations(
    H: Float[Tensor, "*#batch m 3 3"],
    *,
    image_size: tuple[float, float],
    weights: Float[Tensor, "*#batch m"] | None = None,
    assume: Assumption = CONSTANT,
) -> IntrinsicsEstimate:
    """The intrinsics of a camera that turns about its centre.

    Not determined by rotations about the optical axis, and hardly by small ones; rotations about one axis leave one more
    unknown open than general ones do.

    Args:
        H: Homographies between images, `x_j ~ H x_i`, of any pairs and any scale.
        image_size: Width and height in pixels.
        weights: Of the homographies, for instance their numbers of inliers over the largest; 0 leaves one out.
        assume: What is free; nothing may vary.

    Returns:
        K and how far it is determined.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or the assumption lets intrinsics vary.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> R = torchsfm.geometry.rotation_from_rotvec(0.3 * torch.randn(5, 3, generator=g, dtype=torch.float64))
        >>> found = torchsfm.autocalibration.intrinsics_from_rotations(K @ R @ torch.linalg.inv(K), image_size=(1000.0, 750.0))
        >>> bool((found.K - K).abs().max() < 0.1)
        True
    """
    batch = check_tensors(H=(H, "m>=1 3 3"), weights=(weights, "?m"))
    check_shared(assume, image_size)
    m = H.shape[-3]
    flat = H.detach().double().expand(*batch, m, 3, 3).reshape(-1, m, 3, 3)
    w = flat.new_ones(flat.shape[:2]) if weights is None else weights.detach().double().expand(*batch, m).reshape(-1, m)
    good = torch.isfinite(flat).flatten(-2).all(-1) & torch.isfinite(w) & (w > 0)
    size = flat.new_tensor(image_size).expand(len(flat), 2)
    G = scaled(
        torch.where(good[..., None, None], flat, torch.eye(3, dtype=flat.dtype, device=flat.device)), image_scaling(size)
    )
    G = G / G.flatten(-2).norm(dim=-1)[..., None, None].clamp_min(1e-300)
    root = torch.where(good, w, 0.0).sqrt()

    def constraints(K: Tensor, _: Tensor, G: Tensor, root: Tensor) -> Tensor:
        M = inverse_intrinsics(K)[..., None, :, :] @ G @ K[..., None, :, :]
        return (departure(M) * root[..., None]).flatten(-2)

    starts = focal_starts(assume, len(flat), flat.new_zeros(1, 0))
    found, _ = fit_intrinsics(constraints, starts, assume, (G, root), 5.0 * good.sum(-1), size)
    return tensor_map(lambda t: (t.to(H.dtype) if t.is_floating_point() else t).reshape(batch + t.shape[1:]), found)
