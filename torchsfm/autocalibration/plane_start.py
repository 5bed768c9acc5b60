"""A first camera from homographies of a plane (Zhang 2000): each constrains the image of the absolute conic.

`h1' w h2 = 0` and `h1' w h1 = h2' w h2` are linear in the conic w.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.autocalibration.board_shape import NAMES
from torchsfm.geometry.intrinsic_parameters import CX, HEAD, intrinsic_matrix
from torchsfm.linalg import cross, nearest_rotation, null_vector
from torchsfm.motion import homography_dlt

_PAIRS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
"""Order of the six entries of a conic."""


@dataclass(frozen=True)
class CameraAndPoses:
    """What is calibrated: one camera and its poses before the plane."""

    row: Tensor
    """Of the camera, see `intrinsic_parameters`."""
    R: Tensor
    t: Tensor
    shape: Tensor
    """Of the board, see `board_shape`."""


def start_from_homographies(
    x: Tensor,
    X: Tensor,
    seen: Tensor,
    used: Tensor,
    size: tuple[float, float] | None,
    columns: Sequence[int],
    lens: int,
) -> CameraAndPoses:
    """The better of two: Zhang's linear intrinsics, and a focal length alone with the principal point in the middle."""
    w = seen.to(x.dtype)
    low = torch.where(seen[..., None], x, torch.inf).flatten(-3, -2).amin(-2)
    high = torch.where(seen[..., None], x, -torch.inf).flatten(-3, -2).amax(-2)
    some = seen.flatten(-2).any(-1)[..., None]
    low, high = torch.where(some, low, 0.0), torch.where(some, high, 1.0)
    middle = (low + high) / 2 if size is None else (torch.tensor(size, dtype=x.dtype, device=x.device) - 1) / 2 + 0 * low
    scale = (high - low).amax(-1).clamp_min(1e-9)
    y = (x - middle[..., None, None, :]) / scale[..., None, None, None]
    H = homography_dlt(X[..., None, :, :].expand(*x.shape[:-3], x.shape[-3], *X.shape[-2:]), y, w)
    H = torch.where(used[..., None, None], H, torch.eye(3, dtype=x.dtype, device=x.device))
    # Columns of one size, so that no view outweighs the others.
    H = H / H[..., :2].flatten(-2).norm(dim=-1)[..., None, None].clamp_min(1e-300)
    h1, h2 = H[..., 0], H[..., 1]

    def row(a: Tensor, b: Tensor) -> Tensor:
        terms = [a[..., i] * b[..., j] + (a[..., j] * b[..., i] if i != j else 0) for i, j in _PAIRS]
        return torch.stack(terms, -1) * used[..., None]

    rows = torch.cat((row(h1, h2), row(h1, h1) - row(h2, h2)), -2)
    # Square pixels and a centred principal point: w = diag(a, a, 1).
    A, r = rows[..., 0] + rows[..., 2], -rows[..., 5]
    a = (A * r).sum(-1) / A.square().sum(-1).clamp_min(1e-300)
    f = torch.where(a > 1e-4, a, 1.0).rsqrt()
    zero = torch.zeros_like(f)
    simple = torch.stack((f, torch.ones_like(f), zero, zero, zero), -1)
    # Without skew: w12 = 0.
    b, _ = null_vector(torch.nn.functional.pad(rows[..., [0, 2, 3, 4, 5]], (0, 0, 0, 5)))
    b = b * torch.where(b[..., :1] < 0, -1.0, 1.0)
    w11, w22, w13, w23, w33 = b.unbind(-1)
    fine = (w11 > 1e-9) & (w22 > 1e-9)
    d1, d2 = torch.where(fine, w11, 1.0), torch.where(fine, w22, 1.0)
    cx, cy = -w13 / d1, -w23 / d2
    rest = w33 - w13**2 / d1 - w23**2 / d2
    fine = fine & (rest > 0)
    rest = torch.where(fine, rest, 1.0)
    lengths = torch.stack(((rest / d1).sqrt(), (rest / d2).sqrt()), -1)
    full = torch.stack((lengths[..., 0], (d1 / d2).sqrt(), zero, cx, cy), -1)
    fine = fine & ((lengths > 0.05) & (lengths < 200)).all(-1) & (full[..., CX:].abs() < 5).all(-1)
    # What is not free stays where it is known to be.
    free = torch.zeros(HEAD, dtype=torch.bool, device=x.device).index_fill(0, torch.tensor(columns, device=x.device), True)
    full = torch.where(fine[..., None] & free, full, simple)

    candidates = []
    for intrinsics in (simple, full):
        K = intrinsic_matrix(intrinsics)
        R, t = _poses(K, H)
        image = (X[..., None, :, :] @ R[..., :2].mT + t[..., None, :]) @ K[..., None, :, :].mT
        error = ((image[..., :2] / image[..., 2:] - y).square().sum(-1).clamp_max(1.0) * w).sum((-2, -1))
        candidates.append((torch.nan_to_num(error, torch.inf), intrinsics, R, t))
    (first, *one), (second, *two) = candidates
    better = second < first
    chosen, R, t = (
        torch.where(better.reshape(*better.shape, *[1] * (a.ndim - better.ndim)), b, a) for a, b in zip(one, two, strict=True)
    )
    pixel, ratio = scale[..., None], torch.ones_like(scale[..., None])
    first_row = chosen * torch.cat((pixel, ratio, pixel, pixel, pixel), -1)
    none = pixel.new_zeros(*pixel.shape[:-1], lens)
    flat = pixel.new_zeros(*pixel.shape[:-1], len(NAMES))
    return CameraAndPoses(torch.cat((first_row[..., :CX], first_row[..., CX:] + middle, none), -1), R, t, flat)


def _poses(K: Tensor, H: Tensor) -> tuple[Tensor, Tensor]:
    """Poses of the plane whose homographies are H."""
    M = torch.linalg.solve_ex(K[..., None, :, :].expand_as(H), H).result
    # In front of the camera.
    M = M * torch.where(M[..., 2, 2] < 0, -1.0, 1.0)[..., None, None]
    size = 0.5 * (M[..., 0].norm(dim=-1) + M[..., 1].norm(dim=-1)).clamp_min(1e-300)
    M = torch.nan_to_num(M / size[..., None, None])
    r1, r2 = M[..., 0], M[..., 1]
    return nearest_rotation(torch.stack((r1, r2, cross(r1, r2)), -1)), M[..., 2]
