"""Ray casting: which surface each ray meets first, and the colour there, filtered to the footprint of a pixel."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from torchsfm.simulation.surfaces import Rectangle
from torchsfm.simulation.textured_scene import Textured, TexturedScene

PROBES = (1, 2, 4, 8)
"""How many texture lookups a footprint is cut into along its longer axis, as it is once, twice, ... as long as wide."""


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cast(
    scene: TexturedScene, origin: Float[Tensor, "3 #n"], d: Float[Tensor, "3 n"]
) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
    """Distance to the first surface in multiples of d (infinity where there is none) and its index (-1 where there is none)."""
    nearest = torch.full_like(d[0], math.inf)
    index = torch.full(d.shape[1:], -1, dtype=torch.int16, device=d.device)
    square = _dot(d, d)
    for i, thing in enumerate(scene.objects):
        if isinstance(thing.surface, Rectangle):
            s = thing.surface.intersect(origin, d)
            closer = s < nearest
            nearest = torch.where(closer, s, nearest)
            index.masked_fill_(closer, i)
            continue
        chosen = _near(thing, origin, d, square)
        start = origin if origin.shape[1] == 1 else origin.index_select(1, chosen)
        s = thing.surface.intersect(start, d.index_select(1, chosen))
        closer = (s < nearest.index_select(0, chosen)).nonzero()[:, 0]
        chosen = chosen.index_select(0, closer)
        nearest.index_copy_(0, chosen, s.index_select(0, closer))
        index.index_fill_(0, chosen, i)
    return nearest, index


def lit(scene: TexturedScene, X: Float[Tensor, "3 n"]) -> Bool[Tensor, "n"]:
    """Whether nothing stands between each point and the sun."""
    sun = scene.sun.to(X)
    sun = (sun / sun.norm())[:, None].expand_as(X)
    # Starting a little off the surface keeps a surface from shading itself.
    X = X + 1e-3 * sun
    free = torch.ones(X.shape[1:], dtype=torch.bool, device=X.device)
    square = torch.ones_like(X[0])
    for thing in scene.objects:
        if isinstance(thing.surface, Rectangle):
            free &= torch.isinf(thing.surface.intersect(X, sun))
            continue
        chosen = _near(thing, X, sun, square)
        s = thing.surface.intersect(X.index_select(1, chosen), sun.index_select(1, chosen))
        free.index_fill_(0, chosen.index_select(0, torch.isfinite(s).nonzero()[:, 0]), False)
    return free


def _near(thing: Textured, origin: Tensor, d: Tensor, square: Tensor) -> Tensor:
    """Which rays come near enough to a solid to be worth intersecting: those that meet the ball around it."""
    middle, radius = thing.surface.ball()
    o = middle.to(d)[:, None] - origin
    ahead = (o.T @ d)[0] if o.shape[1] == 1 else _dot(o, d)
    beyond = _dot(o, o) - radius**2
    inside = beyond <= 0
    return (inside | ((ahead > 0) & (ahead.square() >= beyond * square))).nonzero()[:, 0]


def shade(
    scene: TexturedScene,
    origin: Float[Tensor, "3 1"],
    d: Float[Tensor, "3 n"],
    dx: Float[Tensor, "3 n"],
    dy: Float[Tensor, "3 n"],
    distance: Float[Tensor, "n"],
    index: Int[Tensor, "n"],
    sunny: Bool[Tensor, "n"],
) -> Float[Tensor, "3 n"]:
    """Colour of what each ray meets.

    Args:
        scene: The scene.
        origin: Centre of projection.
        d: Directions of the rays.
        dx: Change of d from one sample of the image to the next in x.
        dy: The same in y.
        distance: From `cast`.
        index: From `cast`.
        sunny: From `lit`, at the points met.
    """
    color = torch.empty(d.shape, dtype=torch.float32, device=d.device)
    missed = (index < 0).nonzero()[:, 0]
    e = d[:, missed]
    up = e[2] / _dot(e, e).sqrt()
    color[:, missed] = torch.stack((0.55 - 0.25 * up, 0.70 - 0.20 * up, 0.86 - 0.08 * up)).to(torch.float32)
    sun = scene.sun.to(d)
    sun = sun / sun.norm()
    for i, thing in enumerate(scene.objects):
        chosen = (index == i).nonzero()[:, 0]
        if not len(chosen):
            continue
        e, s = d.index_select(1, chosen), distance.index_select(0, chosen)
        chart = thing.surface.chart(origin + s * e)
        normal = chart.normal
        facing = _dot(normal, e)
        steps = []
        for step in (dx.index_select(1, chosen), dy.index_select(1, chosen)):
            # Where the neighbouring ray meets the tangent plane.
            moved = s * (step - e * (_dot(normal, step) / facing))
            steps += [_dot(g, moved) / thing.texel for g in (chart.du, chart.dv)]
        footprint = torch.stack(steps).nan_to_num(0.0, 1e6, -1e6).to(torch.float32)
        texture = lookup(thing, chart.layer, (chart.uv / thing.texel).to(torch.float32), footprint)
        outside = -torch.sign(facing)
        light = scene.ambient * (0.8 + 0.2 * normal[2] * outside)
        light = light + (1 - scene.ambient) * 1.25 * ((sun @ normal) * outside).clamp_min(0) * sunny[chosen]
        seen = texture * light.to(torch.float32)
        if scene.gloss > 0:
            mirrored = 2 * (sun @ normal) * normal - sun[:, None]
            away = -_dot(mirrored, e) / _dot(e, e).sqrt()
            lit_side = sunny[chosen] & ((sun @ normal) * outside > 0)
            seen = seen + (scene.gloss * away.clamp_min(0) ** scene.polish * lit_side).to(torch.float32)
        color.index_copy_(1, chosen, seen)
    return color.clamp(0, 1)


def lookup(
    thing: Textured, layer: Int[Tensor, "n"], uv: Float[Tensor, "2 n"], footprint: Float[Tensor, "4 n"]
) -> Float[Tensor, "3 n"]:
    """Texture averaged over footprints, parallelograms with sides (du, dv) by a step in x and in y, all in texels.

    The footprint is cut along its longer axis into nearly square pieces, each read from the two nearest mip levels.
    """
    ux, vx, uy, vy = footprint
    long, short = ux.square() + vx.square(), uy.square() + vy.square()
    turn = short > long
    step = torch.stack((torch.where(turn, uy, ux), torch.where(turn, vy, vx)))
    # Length of the longer side, and the width across it.
    long = torch.maximum(long, short).sqrt().clamp_min(1e-6)
    wide = (ux * vy - uy * vx).abs() / long
    ratio = long / wide.clamp_min(1.0).minimum(long)
    color = torch.empty(3, uv.shape[1], dtype=uv.dtype, device=uv.device)
    wanted = layer * len(PROBES) + torch.log2(ratio).round().clamp(0, len(PROBES) - 1).long()
    for key in torch.bincount(wanted).nonzero()[:, 0].tolist():
        pyramid, probes = thing.sheets[key // len(PROBES)], PROBES[key % len(PROBES)]
        chosen = (wanted == key).nonzero()[:, 0]
        at, along = uv.index_select(1, chosen), step.index_select(1, chosen)
        level = torch.maximum(long.index_select(0, chosen) / probes, wide.index_select(0, chosen)).clamp_min(1.0).log2()
        shift = (torch.arange(probes, dtype=uv.dtype, device=uv.device) + 0.5) / probes - 0.5
        every = (at[:, None] + along[:, None] * shift[:, None]).reshape(2, -1)
        color.index_copy_(1, chosen, _trilinear(pyramid, every, level.repeat(probes)).reshape(3, probes, -1).mean(1))
    return color


def _trilinear(pyramid: tuple[Tensor, ...], uv: Tensor, level: Tensor) -> Tensor:
    """Read each point between two mip levels; coordinates in texels of level 0 from the sheet's corner."""
    level = level.clamp_max(len(pyramid) - 1)
    color = torch.zeros(3, uv.shape[1], dtype=uv.dtype, device=uv.device)
    for k in range(int(level.min()), math.ceil(float(level.max())) + 1):
        weight = (1 - (level - k).abs()).clamp_min(0)
        chosen = (weight > 0).nonzero()[:, 0]
        if not len(chosen):
            continue
        image = pyramid[k]
        size = uv.new_tensor([image.shape[2], image.shape[1]])
        grid = uv.index_select(1, chosen).T * (2.0 / 2**k / size) - 1
        value = functional.grid_sample(
            image[None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
        )[0, :, 0]
        color.index_add_(1, chosen, value * weight.index_select(0, chosen))
    return color
