"""At which depths may the edge points of an image be? Where their images pass edges of many other images as the depth runs."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry.homogeneous import divide_safely
from torchsfm.linalg import inverse
from torchsfm.linalg.rows import inner
from torchsfm.reconstruction.curves.edge_maps import EdgeMaps

_NUMBERS = 1 << 22
"""Images of points that are looked up at a time."""
_DEPTHS = 64, 2048
"""Least and most depths of a ray; in between a step moves no image by more than a pixel."""
_NEAR = 20.0
"""Depths less than the baseline divided by this are not looked at."""
_REACH = 2.0
"""Distance of an edge, in pixels, that a pixel of the maps still feels."""
_LEAST = 1.0
"""Votes, at pixels, of a depth that is looked at more closely."""
_STEPS = 3
"""Gauss-Newton steps of a depth."""
_TURNED = 0.9
"""Least cosine of the angle between an edge and the image of the tangent that it agrees with."""
_EXCHANGED = 0.5
"""What an image counts in which the light and the dark side are exchanged."""
_TINY = 1e-30
"""Depth, over that of the ray, below which points are behind."""
_STEEP = 0.15
"""Sine of the angle between edge and epipolar line below which an edge says nothing of the depth."""


class Candidates(NamedTuple):
    """Depths of samples on rays of one image."""

    depth: Float[Tensor, "s c"]
    votes: Float[Tensor, "s c"]
    """Images that agree; 0 where there is no candidate."""
    tangent: Float[Tensor, "s c 3"]
    """Of the curve in space, a unit vector along the image curve."""
    blur: Float[Tensor, "s c"]
    """The step that moves an image by a pixel."""


class Rays(NamedTuple):
    """Samples of edges of one image: where from, whereto, and how the edge runs."""

    centre: Float[Tensor, "3"]
    direction: Float[Tensor, "s 3"]
    """Unit vectors."""
    along: Float[Tensor, "s 3"]
    """Unit vectors in the plane of sight of the tangent, across the rays, forwards."""


def sweep_depths(
    maps: EdgeMaps, closeness: Float[Tensor, "v h w"], P: Float[Tensor, "v 3 4"], rays: Rays, kept: int, threshold: float
) -> Candidates:
    """The depths of rays at which the most other images have an edge that runs as the image of the curve must.

    Args:
        maps: The edges of the other images.
        closeness: Of these maps.
        P: Their cameras.
        rays: The rays.
        kept: Candidates of each ray.
        threshold: Distance, in pixels, of an edge that an image still agrees with.
    """
    size = max(1, _NUMBERS // (len(P) * _DEPTHS[1]))
    parts = []
    for i in range(0, len(rays.direction), size):
        part = Rays(rays.centre, rays.direction[i : i + size], rays.along[i : i + size])
        q, step = _tops(closeness, P, part, kept)
        parts.append(_polished(maps, P, part, q, step, threshold))
    return Candidates(*(torch.cat(field) for field in zip(*parts, strict=True)))


def _tops(closeness: Tensor, P: Tensor, rays: Rays, kept: int) -> tuple[Float[Tensor, "s c"], Float[Tensor, "s"]]:
    """Inverse depths where most edges are near, and the step of inverse depths; 0 where there are no more."""
    A, B = _lines(P, rays)
    back, _ = inverse(P[..., :3])
    baseline = torch.linalg.vector_norm((back @ A[..., None])[..., 0], dim=-1).clamp_min(1e-300)
    low, high = _range(A, B, baseline, closeness.shape[-1], closeness.shape[-2])
    A, B, low, high = (t.to(closeness.dtype) for t in (A, B, low, high))
    ends = torch.stack((low, high), -1)
    y = divide_safely(*_image(A, B, ends))
    number = torch.linalg.vector_norm(y[..., 1, :] - y[..., 0, :], dim=-1).amax()
    depths = int(number.nan_to_num(nan=0, posinf=_DEPTHS[1]).clamp(*_DEPTHS))
    share = torch.linspace(0, 1, depths, dtype=low.dtype, device=low.device)
    grid = low[:, None] + (high - low)[:, None] * share
    total = _felt(closeness, A, B, grid)
    padded = torch.nn.functional.pad(total, (1, 1), value=-1.0)
    top = (total >= _LEAST) & (total > padded[:, :-2]) & (total >= padded[:, 2:]) & (high > low)[:, None]
    value, index = torch.where(top, total, 0).topk(min(kept, depths), dim=-1)
    return torch.where(value > 0, grid.gather(-1, index), 0).to(P.dtype), ((high - low) / (depths - 1)).to(P.dtype)


def _felt(
    closeness: Float[Tensor, "v h w"], A: Float[Tensor, "v 3"], B: Float[Tensor, "v s 3"], grid: Float[Tensor, "s d"]
) -> Float[Tensor, "s d"]:
    """What the maps hold at the pixels nearest to the images of points, all maps together; 0 outside and behind.

    Most of the time goes here: what is done to each number counts.
    """
    h, w = closeness.shape[1:]
    # Centres of the pixels of an image go from -1 to 1.
    scale = A.new_tensor([[2 / (w - 1), 0, -1], [0, 2 / (h - 1), -1], [0, 0, 1]])
    a, b = (A @ scale.mT).tolist(), B @ scale.mT
    # Coordinates by themselves: arithmetic on every other number is slow.
    place, depth, total = grid.new_empty(2, *grid.shape), torch.empty_like(grid), torch.zeros_like(grid)
    for j, own in enumerate(a):
        if not all(map(math.isfinite, own)):
            continue
        for k, out in enumerate((*place, depth)):
            torch.add(b[j, :, k, None], grid, alpha=own[k], out=out)
        # What is behind goes far outside.
        place.div_(depth.clamp_(min=_TINY)).clamp_(-2, 2)
        total += torch.nn.functional.grid_sample(
            closeness[None, j : j + 1], place.permute(1, 2, 0)[None], mode="nearest", padding_mode="zeros", align_corners=True
        )[0, 0]
    return total


def _lines(P: Tensor, rays: Rays) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "v s 3"]]:
    """The image of the point at inverse depth q is A q + B: the centre's image and the ray's vanishing point."""
    return P[..., :3] @ rays.centre + P[..., 3], rays.direction @ P[..., :3].mT


def _image(A: Tensor, B: Tensor, q: Float[Tensor, "s c"]) -> tuple[Float[Tensor, "v s c 2"], Float[Tensor, "v s c"]]:
    """Image points, homogeneous, and what they are divided by; points behind a camera are far outside."""
    # Coordinates by themselves: arithmetic on every other number is slow.
    y = A.T[:, :, None, None] * q + B.movedim(-1, 0)[..., None]
    front = y[2] > 0
    return torch.where(front, y[:2], -1e9).movedim(0, -1), torch.where(front, y[2], 1)


def _range(A: Tensor, B: Tensor, baseline: Tensor, width: int, height: int) -> tuple[Float[Tensor, "s"], Float[Tensor, "s"]]:
    """Inverse depths that two images see, or one where there is but one: the second of the least and of the largest."""
    sides = A.new_tensor([[0, 0, 1], [1, 0, 0], [-1, 0, width - 1], [0, 1, 0], [0, -1, height - 1]])
    a, b = (A @ sides.mT)[:, None].expand(*B.shape[:2], 5), B @ sides.mT
    at = -b / torch.where(a == 0, 1, a)
    low = torch.where(a > 0, at, torch.where((a == 0) & (b < 0), torch.inf, 0)).amax(-1).clamp(min=0)
    high = torch.minimum(torch.where(a < 0, at, torch.inf).amin(-1), (_NEAR / baseline)[:, None])
    seen = high > low
    k = min(2, len(A)) - 1
    first = torch.where(seen, low, torch.inf).sort(0).values[k]
    last = torch.where(seen, high, -torch.inf).sort(0, descending=True).values[k]
    some = torch.isfinite(first) & torch.isfinite(last) & (last > first)
    return torch.where(some, first, 0), torch.where(some, last, 0)


def _polished(maps: EdgeMaps, P: Tensor, rays: Rays, q: Float[Tensor, "s c"], step: Tensor, threshold: float) -> Candidates:
    """Candidates at the least squares of distances in the images that agree on position and direction."""
    A, B = _lines(P, rays)
    there = q > 0
    for last in (False,) * _STEPS + (True,):
        y, depth = _image(A, B, q)
        y = divide_safely(y, depth)
        near = maps.near(y)
        # The images move by so much as the inverse depth grows.
        motion = (A[:, None, None, :2] - y * A[:, None, None, 2:]) / depth[..., None]
        speed = motion[..., 1] * near.tangent[..., 0] - motion[..., 0] * near.tangent[..., 1]
        length = inner(motion, motion).sqrt()
        weight = (1 - (near.r / threshold).square()).clamp(min=0).square() * (speed.abs() > _STEEP * length)
        tangent, agrees = _space_tangents(P[..., :3], near.tangent, y, depth, rays, weight)
        weight = weight * agrees * there
        if not last:
            move = -(weight * near.r * speed).sum(0) / (weight * speed.square()).sum(0).clamp_min(1e-300)
            q = torch.where(there, (q + move.clamp(-step[:, None], step[:, None])).clamp_min(1e-300), 0)
    votes = weight.sum(0)
    depth = torch.where(there, 1 / torch.where(there, q, 1), 0)
    blur = depth.square() / length.amax(0).clamp_min(1e-300)
    return Candidates(depth, votes, tangent, blur)


def agreement(shown: Float[Tensor, "*batch 2"], edge: Float[Tensor, "*batch 2"], least: float) -> Float[Tensor, "*batch"]:
    """How well edges run along vectors: 1 where the cosine is more than the least, a part where they run against them.

    The darker side of an edge may be the brighter one in another image: what is behind an outline changes.
    """
    along, enough = inner(shown, edge), least * inner(shown, shown).sqrt()
    return torch.where(along > enough, 1.0, torch.where(along < -enough, _EXCHANGED, 0.0)).to(shown.dtype)


def _space_tangents(
    M: Float[Tensor, "v 3 3"],
    edge: Float[Tensor, "v s c 2"],
    y: Float[Tensor, "v s c 2"],
    depth: Float[Tensor, "v s c"],
    rays: Rays,
    weight: Float[Tensor, "v s c"],
) -> tuple[Float[Tensor, "s c 3"], Float[Tensor, "v s c"]]:
    """The tangent that lies in a given plane of sight and best in those of edges, and how well each image's edge agrees.

    In its plane it is `along` turned by less than a right angle, so that all images see it run forwards.
    """
    # Where a line of sight along each of both axes takes the image, across the edge.
    normal = torch.stack((-edge[..., 1], edge[..., 0]), -1)
    axes = torch.stack((rays.along, rays.direction))[:, :, None]
    image = torch.stack((rays.along @ M.mT, rays.direction @ M.mT))[..., None, :]
    motion = (image[..., :2] - y * image[..., 2:]) / depth[..., None]
    a, b = inner(motion, normal)
    size = inner(motion, motion).sqrt().sum(0).clamp_min(1e-300)
    a, b = a / size, b / size
    # The least of the sum of squares of a cos + b sin.
    aa, ab, bb = ((weight * t).sum(0) for t in (a * a, a * b, b * b))
    angle = 0.5 * torch.atan2(-2 * ab, bb - aa)
    cosine, sine = angle.cos(), angle.sin()
    shown = motion[0] * cosine[..., None] + motion[1] * sine[..., None]
    return cosine[..., None] * axes[0] + sine[..., None] * axes[1], agreement(shown, edge, _TURNED)
