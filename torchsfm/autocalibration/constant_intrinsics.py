"""Intrinsics that are the same in all views, from projective cameras.

Two ways: K and the plane at infinity together, by least squares on the departure of `K^-1 (A - a p') K` from a multiple of a
rotation (Heyden & Astrom, "Euclidean reconstruction from constant intrinsic parameters", ICPR 1996), from several starts; and
the plane at infinity first, from the modulus constraint (Pollefeys & Van Gool, "Stratified self-calibration with the modulus
constraint", PAMI 1999), which says that the infinite homographies are similar to rotations, and then K from them.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status, check_tensors, tensor_map
from torchsfm.autocalibration.algebraic_fit import IntrinsicsEstimate, check_shared, fit_intrinsics
from torchsfm.autocalibration.focal_search import search_focal
from torchsfm.autocalibration.intrinsics_model import CONSTANT, Assumption
from torchsfm.autocalibration.projective_input import canonical_cameras
from torchsfm.autocalibration.rotating_camera import intrinsics_from_rotations
from torchsfm.autocalibration.upgrade_residual import departure, metric_blocks
from torchsfm.linalg import determinant_3x3
from torchsfm.optim import levenberg_marquardt

_STARTS = 8


@dataclass(frozen=True)
class _Canonical:
    P: Tensor
    X: Tensor
    seen: Tensor
    good: Tensor
    logs: Tensor
    planes: Tensor


def constant_intrinsics(
    P: Float[Tensor, "*#batch v 3 4"],
    X: Float[Tensor, "*#batch n 4"],
    *,
    image_size: tuple[float, float],
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    assume: Assumption = CONSTANT,
) -> IntrinsicsEstimate:
    """The intrinsics that all projective cameras share, by Heyden & Åström's constraints, all views alike.

    `autocalibrate_points` minimises the same with each view weighed by what its observations say, which is more accurate.

    Args:
        P: Cameras in pixels, of any scale and sign.
        X: Homogeneous points, which decide about signs.
        image_size: Width and height in pixels.
        visible: Which points each view sees.
        assume: What is free; nothing may vary.

    Returns:
        K and how far it is determined.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or the assumption lets intrinsics vary.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(8, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> projective = torchsfm.factorize_points(torchsfm.project_points(K @ poses.matrix(), X))
        >>> found = torchsfm.autocalibration.constant_intrinsics(projective.P, projective.X, image_size=(1000.0, 750.0))
        >>> bool((found.K - K).abs().max() < 1)
        True
    """
    batch, ready = _ready(P, X, image_size, visible, assume)
    q = len(assume.columns(1))
    starts = torch.cat((ready.logs[..., :1], ready.logs.new_zeros(*ready.logs.shape[:2], q - 1), ready.planes), -1)

    def constraints(K: Tensor, p: Tensor, P: Tensor, good: Tensor) -> Tensor:
        M = metric_blocks(P, K[..., None, :, :], K, p)
        return (departure(M) * good[..., None]).flatten(-2)

    size = starts.new_tensor(image_size).expand(len(starts), 2)
    count = 5 * (ready.good.sum(-1) - 1)
    found, _ = fit_intrinsics(constraints, starts, assume, (ready.P, ready.good), count, size)
    return tensor_map(lambda t: (t.to(P.dtype) if t.is_floating_point() else t).reshape(batch + t.shape[1:]), found)


def intrinsics_from_modulus(
    P: Float[Tensor, "*#batch v 3 4"],
    X: Float[Tensor, "*#batch n 4"],
    *,
    image_size: tuple[float, float],
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    assume: Assumption = CONSTANT,
) -> IntrinsicsEstimate:
    """The intrinsics that all projective cameras share: the plane at infinity by the modulus constraint, then K.

    One constraint for each pair of views on the three numbers of the plane, which needs four views; intrinsics play no part in
    it.

    Args:
        P: Cameras in pixels, of any scale and sign.
        X: Homogeneous points, which decide about signs.
        image_size: Width and height in pixels.
        visible: Which points each view sees.
        assume: What is free when K is found from the infinite homographies; nothing may vary.

    Returns:
        K and how far it is determined.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or the assumption lets intrinsics vary.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X = torchsfm.random_points(60, generator=g)
        >>> poses = torchsfm.random_poses(8, spread=3.0, wobble=1.0, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> projective = torchsfm.factorize_points(torchsfm.project_points(K @ poses.matrix(), X))
        >>> found = torchsfm.autocalibration.intrinsics_from_modulus(projective.P, projective.X, image_size=(1000.0, 750.0))
        >>> bool((found.K - K).abs().max() < 1)
        True
    """
    batch, ready = _ready(P, X, image_size, visible, assume)
    v = P.shape[-3]
    i, j = torch.triu_indices(v, v, 1, device=P.device)
    eye = torch.eye(3, dtype=ready.P.dtype, device=P.device)

    def homographies(p: Tensor, P: Tensor) -> Tensor:
        return P[..., :3] - P[..., 3:] * p[..., None, None, :]

    def modulus(p: Tensor, P: Tensor, good: Tensor) -> Tensor:
        B = homographies(p, P)
        inverse = torch.linalg.inv_ex(B + 1e-14 * eye).inverse
        M = B[..., j, :, :] @ inverse[..., i, :, :]
        d = determinant_3x3(M)
        root = d.sign() * d.abs().clamp_min(1e-30) ** (1 / 3)
        trace = M.diagonal(dim1=-2, dim2=-1).sum(-1)
        minors = 0.5 * (trace.square() - (M @ M).diagonal(dim1=-2, dim2=-1).sum(-1))
        # Eigenvalues s, s e^it, s e^-it: both are 1 + 2 cos t.
        r = minors / root.square() - trace / root
        bounded: Tensor = r / (1 + r.square()).sqrt()
        return (bounded * good[..., i] * good[..., j])[..., None]

    k = ready.planes.shape[1]
    many = [t[:, None].expand(t.shape[0], k, *t.shape[1:]) for t in (ready.P, ready.good)]
    result = levenberg_marquardt(modulus, ready.planes, *many, max_iterations=60)
    best = torch.nan_to_num(result.cost, torch.inf).argmin(-1)
    p = torch.nan_to_num(result.x[torch.arange(len(best), device=P.device), best])
    H = homographies(p, ready.P)
    # Back to pixels, where the rotating camera is solved.
    s = 1 / max(image_size)
    c = [(image_size[0] - 1) / 2, (image_size[1] - 1) / 2]
    T = H.new_tensor([[s, 0, -s * c[0]], [0, s, -s * c[1]], [0, 0, 1]])
    pixels = torch.linalg.solve_ex(T, H @ T).result
    turning = intrinsics_from_rotations(pixels[:, 1:], image_size=image_size, weights=ready.good[:, 1:], assume=assume)
    pairs = ready.good.sum(-1)
    status = torch.where(pairs * (pairs - 1) / 2 < 4, int(Status.TOO_FEW), turning.status).to(torch.int8)
    found = IntrinsicsEstimate(turning.K, turning.deviation, turning.cost, status)
    return tensor_map(lambda t: (t.to(P.dtype) if t.is_floating_point() else t).reshape(batch + t.shape[1:]), found)


def _ready(
    P: Tensor, X: Tensor, image_size: tuple[float, float], visible: Tensor | None, assume: Assumption
) -> tuple[torch.Size, _Canonical]:
    batch = check_tensors(P=(P, "v>=2 3 4"), X=(X, "n>=1 4"), visible=(visible, "?v n : bool"))
    check_shared(assume, image_size)
    v, n = P.shape[-3], X.shape[-2]
    flat_P = P.detach().double().expand(*batch, v, 3, 4).reshape(-1, v, 3, 4)
    flat_X = X.detach().double().expand(*batch, n, 4).reshape(-1, n, 4)
    seen = torch.ones(v, n, dtype=torch.bool, device=P.device) if visible is None else visible
    seen = seen.expand(*batch, v, n).reshape(-1, v, n)
    size = flat_P.new_tensor(image_size).expand(len(flat_P), v, 2)
    ready = canonical_cameras(flat_P, flat_X, seen, size)
    base = flat_P.new_zeros(len(flat_P), v, 5)
    good = ready.present.to(flat_P.dtype)
    any_view = ready.visible.any(-2).to(flat_P.dtype)
    logs, planes, _ = search_focal(ready.P, ready.X, any_view, base, good, varying=False, starts=_STARTS)
    return batch, _Canonical(ready.P, ready.X, any_view, good * ready.finite[:, None], logs, planes)
