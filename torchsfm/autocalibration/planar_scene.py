"""A planar scene: intrinsics from the homographies that it induces between views.

The plane meets the absolute conic in its two circular points, and their images lie on the image of that conic in every view
(Triggs, "Autocalibration from planar scenes", ECCV 1998). With the plane's normal in the first view as further unknown, the
circular points there are known up to what does not matter, and each further view gives two constraints.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors, tensor_map
from torchsfm.autocalibration.algebraic_fit import IntrinsicsEstimate, check_shared, fit_intrinsics, focal_starts, scaled
from torchsfm.autocalibration.intrinsics_model import Assumption, inverse_intrinsics
from torchsfm.autocalibration.projective_input import image_scaling
from torchsfm.linalg import cross

_STARTS = 12


def intrinsics_from_plane(
    H: Float[Tensor, "*#batch m 3 3"],
    *,
    image_size: tuple[float, float],
    weights: Float[Tensor, "*#batch m"] | None = None,
    assume: Assumption | None = None,
) -> IntrinsicsEstimate:
    """The intrinsics of a camera that moved in front of an unknown plane.

    m further views give 2 m constraints for the intrinsics and two angles of the plane: a focal length alone needs two further
    views, with the principal point four in all. Views from directions that differ little, and planes parallel to the images,
    leave the focal length open.

    Args:
        H: Homographies from the first view to each further one, `x_i ~ H x_1`, of any scale.
        image_size: Width and height in pixels.
        weights: Of the homographies; 0 leaves one out.
        assume: What is free, the focal length alone by default; nothing may vary.

    Returns:
        K and how far it is determined.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or the assumption lets intrinsics vary.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> P = K @ torchsfm.random_poses(6, generator=g).matrix()
        >>> H = P[:, :, [0, 1, 3]]  # from the plane z = 0 to each image
        >>> found = torchsfm.autocalibration.intrinsics_from_plane(H[1:] @ torch.linalg.inv(H[0]), image_size=(1000.0, 750.0))
        >>> found.K[0, 0]
        tensor(900.0000, dtype=torch.float64)
    """
    batch = check_tensors(H=(H, "m>=1 3 3"), weights=(weights, "?m"))
    kind = Assumption(free=("focal",)) if assume is None else assume
    check_shared(kind, image_size)
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

    def constraints(K: Tensor, tilt: Tensor, G: Tensor, root: Tensor) -> Tensor:
        e1, e2 = _across(tilt)
        image = inverse_intrinsics(K)[..., None, :, :] @ G @ K[..., None, :, :]
        h1, h2 = ((image @ e[..., None, :, None])[..., 0] for e in (e1, e2))
        a, b = h1.square().sum(-1), h2.square().sum(-1)
        size = (a + b).clamp_min(1e-300)
        both = torch.stack(((a - b) / size, 2 * (h1 * h2).sum(-1) / size), -1)
        return (both * root[..., None]).flatten(-2)

    coarse = focal_starts(kind, len(flat), _normals(flat), tuple(0.3 * 1.35**i for i in range(12)))
    with torch.no_grad():
        q = len(kind.columns(1))
        K = torch.diag_embed(torch.stack((coarse[..., 0].exp(), coarse[..., 0].exp(), torch.ones_like(coarse[..., 0])), -1))
        value = constraints(K, coarse[..., q:], G[:, None], root[:, None]).square().sum(-1)
        best = torch.nan_to_num(value, torch.inf).argsort(-1)[:, :_STARTS]
        starts = coarse.gather(1, best[..., None].expand(*best.shape, coarse.shape[-1]))
    found, _ = fit_intrinsics(constraints, starts, kind, (G, root), 2.0 * good.sum(-1), size)
    return tensor_map(lambda t: (t.to(H.dtype) if t.is_floating_point() else t).reshape(batch + t.shape[1:]), found)


def _normals(like: Tensor) -> Tensor:
    """Tilts of normals over the half of the sphere that faces the camera."""
    tilts = [(0.0, 0.0)]
    for angle in (0.25, 0.5, 0.75, 1.0, 1.25):
        number = round(8 * math.sin(angle)) + 4
        tilts += [
            (angle * math.cos(2 * math.pi * i / number), angle * math.sin(2 * math.pi * i / number)) for i in range(number)
        ]
    return like.new_tensor(tilts)


def _across(tilt: Tensor) -> tuple[Tensor, Tensor]:
    """Two orthonormal directions across the normal that is tilted from the optical axis by a rotation vector (x, y, 0)."""
    x, y = tilt.unbind(-1)
    s2 = (x * x + y * y).clamp_min(1e-24)
    s = s2.sqrt()
    sinc, versine = s.sin() / s, (1 - s.cos()) / s2
    e1 = torch.stack((1 - versine * y * y, versine * x * y, -sinc * y), -1)
    e2 = torch.stack((versine * x * y, 1 - versine * x * x, sinc * x), -1)
    normal = cross(e1, e2)
    return e1, cross(normal, e1)
