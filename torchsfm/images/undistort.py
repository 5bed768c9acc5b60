"""Pictures as a pinhole camera in the same place would have taken them."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from torchsfm._types import broadcast_shapes, check_options, check_tensors, tensor_map
from torchsfm.geometry import Camera, Distortion, intrinsics

BORDER = 257
"""Places along each side of a picture at which the lens is asked where they come to lie."""


class Pinholes(NamedTuple):
    """Cameras without distortion, and the sizes of their pictures.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(60.0), torch.tensor([39.5, 29.5]))
        >>> camera = torchsfm.Camera(K, torchsfm.SimpleRadial(torch.tensor(-0.1)))
        >>> pinholes = torchsfm.images.undistorted_cameras(camera, torch.tensor([80, 60]))
        >>> image, size = torch.rand(1, 60, 80), tuple(pinholes.size.tolist())
        >>> straight = torchsfm.images.undistort_images(image, camera, pinholes.cameras, size)
        >>> straight.shape[:0:-1] == size, bool(straight.isfinite().all())
        (True, True)
    """

    cameras: Camera
    """Of the new pictures."""
    size: Int[Tensor, "*batch 2"]
    """Width and height in pixels."""


def undistorted_cameras(
    cameras: Camera, size: Int[Tensor, "*batch 2"], *, alpha: float = 0.0, centred: bool = False
) -> Pinholes:
    """Pinhole cameras that see what cameras with lenses see.

    Focal lengths in pixels stay what they are, so that the picture is as sharp as before in its middle; the size follows from
    what is to be seen.

    Args:
        cameras: The cameras.
        size: Width and height of their pictures.
        alpha: 0 for the largest picture without black borders, 1 for one that shows all that the old one shows, or what is
            between. Where a part of the old picture is beyond the radius at which the lens folds over, as in the corners of a
            fisheye's, no ray leads there, and black corners stay.
        centred: Put the principal point at the centre of the picture.

    Returns:
        The cameras, without skew too, and their sizes: at least one pixel, and no side farther from the optical axis than the
        old picture is wide and high, as no pinhole shows all that a very wide lens does.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(60.0), torch.tensor([39.5, 29.5]))
        >>> camera = torchsfm.Camera(K, torchsfm.SimpleRadial(torch.tensor(-0.1)))
        >>> pinholes = torchsfm.images.undistorted_cameras(camera, torch.tensor([80, 60]))
        >>> type(pinholes.cameras.distortion).__name__, bool((pinholes.size > 0).all())
        ('NoDistortion', True)
    """
    batch = check_tensors(size=(size, "2: int"))
    check_options(cameras=(cameras, Camera), alpha=(alpha, "0 <= float <= 1"), centred=(centred, bool))
    check_tensors(K=(cameras.K, "3 3"))
    if batch != cameras.shape:
        raise ValueError(f"size: wanted shape {(*cameras.shape, 2)}, one for each camera, got {tuple(size.shape)}")
    K = cameras.K.detach().double()
    f = K.diagonal(dim1=-2, dim2=-1)[..., :2]
    last = (size - 1).to(K)
    along = torch.linspace(0, 1, BORDER, dtype=K.dtype, device=K.device)
    ends = torch.stack([torch.zeros_like(along), torch.ones_like(along)])
    # Sides at x = 0, x = width - 1, y = 0, y = height - 1: the centres of the outermost pixels.
    sides = torch.stack([torch.stack([ends, along.expand(2, -1)], -1), torch.stack([along.expand(2, -1), ends], -1)])
    x = sides.reshape(-1, 2) * last[..., None, :]
    wide = _in_double(cameras)
    d, valid = wide.unproject(x)
    forward = valid & (d[..., 2] > 1e-6)
    flat = d[..., :2] / torch.where(forward, d[..., 2], 1.0)[..., None]
    flat = flat.reshape(*batch, 2, 2, BORDER, 2)
    # By axis and side, how far from the optical axis, outwards.
    away = torch.stack([flat[..., 0, :, :, 0], flat[..., 1, :, :, 1]], -3) * K.new_tensor([[-1.0], [1.0]])
    seen = forward.reshape(*batch, 2, 2, BORDER)
    near = torch.where(seen, away, torch.inf).amin(-1)
    far = torch.where(seen, away, -torch.inf).amax(-1)
    limit = (last / f)[..., None]
    # A side of which no ray is known is as far away as can be.
    near, far = (torch.where(side.isfinite(), side, limit).clamp(-limit, limit) for side in (near, far))
    if centred:
        near, far = near.amin(-1, keepdim=True).expand_as(near), far.amax(-1, keepdim=True).expand_as(far)
    first, end = torch.lerp(near, far, alpha).unbind(-1)
    # Against rounding where a picture stays as it is.
    pixels = (f * (first + end) + 1e-6).nan_to_num(0).floor().clamp(min=0)
    c = pixels / 2 if centred else f * first
    pinholes = Camera(intrinsics(f[..., 0], c, aspect=f[..., 1] / f[..., 0]).to(cameras.K))
    return Pinholes(pinholes, (pixels + 1).to(size.dtype))


def undistort_images(
    images: Float[Tensor, "*batch c h w"], cameras: Camera, pinholes: Camera, size: tuple[int, int]
) -> Float[Tensor, "*batch c h2 w2"]:
    """Pictures of pinhole cameras in the place of the cameras that took them, interpolated bilinearly.

    Args:
        images: The pictures, with any number of channels.
        cameras: The cameras that took them; one without batch dimensions took all, and costs the least.
        pinholes: The cameras of the new pictures, as `undistorted_cameras` finds them. Other cameras, with distortion of their
            own, do as well.
        size: Width and height of the new pictures.

    Returns:
        The new pictures; 0 where the old ones show nothing.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(60.0), torch.tensor([39.5, 29.5]))
        >>> camera = torchsfm.Camera(K, torchsfm.SimpleRadial(torch.tensor(-0.1)))
        >>> pinholes = torchsfm.images.undistorted_cameras(camera, torch.tensor([80, 60]))
        >>> width, height = pinholes.size.tolist()
        >>> image = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0))
        >>> torchsfm.images.undistort_images(image, camera, pinholes.cameras, (width, height)).shape == (3, height, width)
        True
    """
    check_tensors(images=(images, "c>=1 h>=1 w>=1"))
    check_options(cameras=(cameras, Camera), pinholes=(pinholes, Camera), size=(size, "2 int >= 1"))
    check_tensors(cameras=(cameras.K, "3 3"), pinholes=(pinholes.K, "3 3"))
    batch = images.shape[:-3]
    lenses = broadcast_shapes(cameras.shape, pinholes.shape)
    if broadcast_shapes(batch, lenses) != batch:
        raise ValueError(f"cameras: wanted batch dimensions that broadcast to {tuple(batch)} of images, got {tuple(lenses)}")
    (w2, h2), (h, w) = size, images.shape[-2:]
    rows, columns = (torch.arange(n, dtype=torch.float64, device=pinholes.K.device) for n in (h2, w2))
    pixel = torch.cartesian_prod(rows, columns).flip(-1)
    d, valid = _in_double(pinholes).unproject(pixel)
    lens = _in_double(cameras)
    x = lens.project(d)
    extent = x.new_tensor([w, h])
    # A pixel reaches half a pixel around its centre.
    shown = valid & lens.in_domain(d) & ((x > -0.5) & (x < extent - 0.5)).all(-1)
    # Half pixels count from the edge here, as in `grid_sample`; a place that is shown nothing of is somewhere, not NaN.
    grid = torch.where(shown[..., None], (2 * x + 1) / extent - 1, -1.0).to(images.dtype)
    grid, shown = grid.reshape(*lenses, h2, w2, 2), shown.reshape(*lenses, h2, w2)
    if not lenses:
        # One lookup serves all pictures, which then are channels of one.
        flat, grid = images.reshape(1, -1, h, w), grid[None]
    else:
        flat = images.reshape(-1, *images.shape[-3:])
        grid = grid.expand(*batch, h2, w2, 2).reshape(-1, h2, w2, 2)
    taken: Tensor = grid_sample(flat, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return taken.reshape(*images.shape[:-2], h2, w2) * shown.unsqueeze(-3)


def _in_double(cameras: Camera) -> Camera:
    """Coordinates of large pictures have more digits than single precision."""
    distortion: Distortion = tensor_map(lambda parameter: parameter.detach().double(), cameras.distortion)
    return Camera(cameras.K.detach().double(), distortion)
