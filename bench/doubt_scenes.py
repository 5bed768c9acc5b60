"""Scenes that mislead: what is repeated looks the same from wrong places, and what is smooth gives little to hold on to.

Scenes 0 to 29 repeat themselves (facades along a street, houses and towers with like
sides, twins of one thing), 30 to 59 are smooth objects with a few painted curves, whose highlights move, under light that
changes, and whose outlines are no fixed curves in space. Larger numbers begin again with other random choices.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsfm.geometry import Camera, Pose
from torchsfm.geometry.cameras import intrinsics
from torchsfm.geometry.distortion import Radial
from torchsfm.simulation import look_at, render_sequence
from torchsfm.simulation.patterns import add_spots
from torchsfm.simulation.surfaces import Box, Cylinder, Ellipsoid, Rectangle, Surface
from torchsfm.simulation.textured_scene import Textured, TexturedScene, texture_surface
from torchsfm.simulation.textures import mip_pyramid, paint

WIDTH, HEIGHT = 480, 360
TEXEL = 0.012
KINDS = 60
"""After so many scenes the kinds come again."""


@dataclass(frozen=True)
class Misleading:
    """One scene: photographs and the truth about them."""

    kind: str
    images: Tensor
    poses: Pose
    focal: float
    reach: float
    """How far the cameras are from what they look at."""


class Draw:
    """Random choices of one scene."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, low: float, high: float) -> float:
        """A number between two."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def whole(self, low: int, high: int) -> int:
        """A whole number from low to high, both possible."""
        return int(torch.randint(low, high + 1, (), generator=self.generator))


def _vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _turned(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _repeated(surface: Surface, style: str, repeats: int, stain: float, draw: Draw) -> Textured:
    """Cover every sheet with copies of one module side by side; `stain` is the share of cells with a mark of their own."""
    width, height = surface.sheets()[0]
    module = paint(style, width / repeats, height, texel=TEXEL, generator=draw.generator)
    sheets = []
    for _ in surface.sheets():
        image = module.repeat(1, 1, repeats)
        if stain > 0:
            palette = ((0.2, 0.2, 0.25), (0.8, 0.75, 0.6), (0.5, 0.3, 0.2))
            add_spots(image, 0.25 / TEXEL, palette, density=stain, corners=True, generator=draw.generator)
        sheets.append(mip_pyramid(image))
    return Textured(surface, tuple(sheets), TEXEL)


def _ground(style: str, size: float, draw: Draw) -> Textured:
    surface = Rectangle(_vector(-size, -size, 0), _vector(2 * size, 0, 0), _vector(0, 2 * size, 0))
    ground = paint(style, 2 * size, 2 * size, texel=2 * TEXEL, generator=draw.generator)
    for cell in (0.3, 0.7):
        palette = ((0.8, 0.75, 0.6), (0.2, 0.2, 0.25), (0.6, 0.3, 0.2), (0.3, 0.45, 0.6))
        add_spots(ground, cell / (2 * TEXEL), palette, density=0.5, relief=0.2, corners=True, generator=draw.generator)
    return Textured(surface, (mip_pyramid(ground),), 2 * TEXEL)


def _ring(views: int, radius: float, height: float, sweep: float, middle: Tensor, draw: Draw) -> Pose:
    """Cameras on an arc around the middle, a little off it each."""
    start, whole = draw.uniform(0, 2 * math.pi), sweep >= 2 * math.pi - 1e-6
    centres = []
    for i in range(views):
        angle = start + sweep * i / (views if whole else views - 1) + draw.uniform(-0.03, 0.03)
        r, z = radius * draw.uniform(0.93, 1.07), height * draw.uniform(0.8, 1.2)
        centres.append(_vector(r * math.cos(angle), r * math.sin(angle), z))
    jitter = 0.05 * radius * (torch.rand(views, 3, generator=draw.generator, dtype=torch.float64) - 0.5)
    return look_at(torch.stack(centres), middle + jitter)


def street(draw: Draw) -> tuple[TexturedScene, Pose, float]:
    """A long facade of like bays, walked along."""
    bays, bay = draw.whole(5, 8), draw.uniform(1.6, 2.4)
    long = bays * bay
    wall = Rectangle(_vector(-long / 2, 0, 3.0), _vector(long, 0, 0), _vector(0, 0, -3.0))
    style = ("bricks", "plaster", "poster")[draw.whole(0, 2)]
    things = [_repeated(wall, style, bays, draw.uniform(0.05, 0.15), draw)]
    floor = Rectangle(_vector(-long, -8, 0), _vector(2 * long, 0, 0), _vector(0, 8, 0))
    things.append(texture_surface(floor, "ground", texel=2 * TEXEL, generator=draw.generator))
    # Pillars of one kind before the wall give it depth.
    pillar = None
    for k in range(bays + 1):
        surface = Box(_vector(-long / 2 + k * bay, -0.5, 1.0), _turned(0.0), _vector(0.15, 0.15, 1.0))
        pillar = pillar or _repeated(surface, "marble", 1, 0.0, draw)
        things.append(replace(pillar, surface=surface))
    views = draw.whole(13, 18)
    away = draw.uniform(3.2, 4.2)
    x = torch.linspace(-long / 2 + 1, long / 2 - 1, views, dtype=torch.float64)
    wobble = torch.rand(views, 4, generator=draw.generator, dtype=torch.float64) - 0.5
    centre = torch.stack((x + 0.3 * wobble[:, 0], -away + 0.6 * wobble[:, 1], 1.5 + 0.5 * wobble[:, 2]), -1)
    target = torch.stack((x + 1.2 * wobble[:, 3], torch.zeros_like(x), torch.full_like(x, 1.4)), -1)
    return TexturedScene(tuple(things), _vector(0.4, -0.8, 0.7)), look_at(centre, target), away


def house(draw: Draw) -> tuple[TexturedScene, Pose, float]:
    """A house whose four sides are alike, on ground that is not, with a few crates about."""
    half = draw.uniform(0.9, 1.2)
    body = Box(_vector(0, 0, 1.0), _turned(draw.uniform(0, 1)), _vector(half, half, 1.0))
    style = ("plaster", "bricks", "poster", "mosaic")[draw.whole(0, 3)]
    things = [_repeated(body, style, draw.whole(1, 2), draw.uniform(0.0, 0.1), draw), _ground("ground", 6.0, draw)]
    # A few things around it tell the sides apart.
    for _ in range(draw.whole(3, 7)):
        angle, r, size = draw.uniform(0, 2 * math.pi), draw.uniform(1.9, 2.8), draw.uniform(0.15, 0.35)
        crate = Box(_vector(r * math.cos(angle), r * math.sin(angle), size), _turned(angle), _vector(size, size, size))
        things.append(texture_surface(crate, "painted", "poster", texel=TEXEL, generator=draw.generator))
    middle = _vector(0, 0, 0.8)
    radius = draw.uniform(4.5, 5.5)
    poses = _ring(draw.whole(19, 24), radius, 1.8, 2 * math.pi, middle, draw)
    return TexturedScene(tuple(things), _vector(0.5, -0.4, 0.9)), poses, radius


def tower(draw: Draw) -> tuple[TexturedScene, Pose, float]:
    """A round tower that looks the same from every few degrees."""
    radius = draw.uniform(0.8, 1.1)
    side = Cylinder(_vector(0, 0, 0), _turned(0.0), radius, 2.0)
    style = ("poster", "painted", "mosaic", "bricks")[draw.whole(0, 3)]
    things = [_repeated(side, style, draw.whole(3, 6), draw.uniform(0.0, 0.1), draw), _ground("ground", 6.0, draw)]
    lid = Rectangle(_vector(-radius, -radius, 2.0), _vector(2 * radius, 0, 0), _vector(0, 2 * radius, 0), round=True)
    things.append(texture_surface(lid, "marble", texel=TEXEL, generator=draw.generator))
    middle = _vector(0, 0, 0.9)
    radius = draw.uniform(4.2, 5.2)
    poses = _ring(draw.whole(19, 24), radius, 2.0, 2 * math.pi, middle, draw)
    return TexturedScene(tuple(things), _vector(0.5, -0.4, 0.9)), poses, radius


def twins(draw: Draw) -> tuple[TexturedScene, Pose, float]:
    """Two houses of one kind at the two ends of a yard, each photographed from its front, and the yard between them."""
    apart = draw.uniform(4.5, 6.0)
    first = Box(_vector(-apart / 2, 0, 1.0), _turned(0.0), _vector(0.9, 0.9, 1.0))
    twin = _repeated(first, ("plaster", "bricks", "painted")[draw.whole(0, 2)], 1, 0.0, draw)
    second = Box(_vector(apart / 2, 0, 1.0), _turned(0.0), _vector(0.9, 0.9, 1.0))
    things = [twin, replace(twin, surface=second), _ground("ground", 9.0, draw)]
    for side in (-1, 1):
        wall = Rectangle(_vector(side * 7.0, 3.5, 2.5), _vector(-side * 6.8, 0.0, 0), _vector(0, 0, -2.5))
        things.append(texture_surface(wall, ("bricks", "plaster")[side > 0], texel=2 * TEXEL, generator=draw.generator))
    views = draw.whole(16, 20)
    t = torch.linspace(-1, 1, views, dtype=torch.float64)
    wobble = torch.rand(views, 3, generator=draw.generator, dtype=torch.float64) - 0.5
    centre = torch.stack((t * (apart / 2 + 1.2), -4.0 + 0.8 * t.square() + 0.5 * wobble[:, 1], 1.6 + 0.5 * wobble[:, 2]), -1)
    target = torch.stack((t * apart / 2 + 0.6 * wobble[:, 0], torch.zeros_like(t), torch.full_like(t, 0.9)), -1)
    return TexturedScene(tuple(things), _vector(0.3, -0.8, 0.8)), look_at(centre, target), 4.0


def _smooth_parts(draw: Draw) -> list[Surface]:
    """A body of ellipsoids: belly, and by chance neck, lid and handles."""
    upright = draw.uniform(0.7, 1.5)
    belly = _vector(draw.uniform(0.8, 1.1), draw.uniform(0.8, 1.1), 0.9 * upright)
    parts: list[Surface] = [Ellipsoid(_vector(0, 0, 0), _turned(draw.uniform(0, 3)), belly)]
    for _ in range(draw.whole(1, 3)):
        angle, z = draw.uniform(0, 2 * math.pi), draw.uniform(-0.4, 1.0) * float(belly[2])
        out = math.sqrt(max(1 - (z / float(belly[2])) ** 2, 0.0)) * 0.9
        at = _vector(out * math.cos(angle), out * math.sin(angle), z)
        radii = _vector(draw.uniform(0.2, 0.45), draw.uniform(0.2, 0.45), draw.uniform(0.2, 0.45))
        parts.append(Ellipsoid(at, _turned(draw.uniform(0, 3)), radii))
    return parts


def smooth(draw: Draw) -> tuple[TexturedScene, Pose, float]:
    """A glazed object with painted curves before an even background, all round or nearly."""
    things = []
    alike, fine = draw.uniform(0, 1) < 0.5, draw.uniform(2.0, 6.0)
    for part in _smooth_parts(draw):
        # The sheets are painted as larger ones and shrunk. Half of the objects have one pattern on opposite sides.
        size = part.sheets()[0][0] * fine
        sheets = [mip_pyramid(paint("curves", size, size, texel=TEXEL * fine, generator=draw.generator)) for _ in range(6)]
        things.append(Textured(part, tuple(sheets[k - k % 2] if alike else sheets[k] for k in range(6)), TEXEL))
    radius = draw.uniform(2.9, 3.3)
    sweep = math.radians(draw.uniform(200, 300)) if draw.uniform(0, 1) < 0.5 else 2 * math.pi
    views = max(12, min(20, round(sweep / math.radians(draw.uniform(15, 19)))))
    poses = _ring(views, radius, draw.uniform(0.8, 1.8), sweep, _vector(0, 0, 0), draw)
    scene = TexturedScene(tuple(things), _vector(0, 0, 1), gloss=draw.uniform(0.25, 0.6), polish=draw.uniform(15, 60))
    return scene, poses, radius


REPEATED: tuple[Callable[[Draw], tuple[TexturedScene, Pose, float]], ...] = (street, house, tower, twins)


def misleading(number: int) -> Misleading:
    """The photographs of a scene.

    Args:
        number: Which one; the same number gives the same photographs.
    """
    draw = Draw(1000 + number)
    make = REPEATED[number % len(REPEATED)] if number % KINDS < KINDS // 2 else smooth
    scene, poses, reach = make(draw)
    ratio = draw.uniform(0.95, 1.35)
    c = _vector((WIDTH - 1) / 2 + draw.uniform(-4, 4), (HEIGHT - 1) / 2 + draw.uniform(-4, 4))
    distortion = Radial(_vector(draw.uniform(-0.1, 0.05))[0], _vector(0.0)[0])
    camera = Camera(intrinsics(_vector(ratio * WIDTH)[0], c), distortion)
    # The smooth object turns before a lamp and a camera that stand: the light changes with the view.
    lamp = _vector(draw.uniform(-0.8, 0.8), draw.uniform(-1.2, -0.4), -1.0)
    images = []
    for i in range(len(poses.t)):
        light = scene
        if make is smooth:
            jitter = 0.3 * (torch.rand(3, generator=draw.generator, dtype=torch.float64) - 0.5)
            light = replace(scene, sun=poses.R[i].mT @ (lamp + jitter), ambient=draw.uniform(0.35, 0.55))
        view = render_sequence(
            light,
            poses=poses[i : i + 1],
            camera=camera,
            width=WIDTH,
            height=HEIGHT,
            noise=0.015,
            points=1,
            generator=draw.generator,
        )
        images.append(view.images)
    return Misleading(make.__name__, torch.cat(images), poses, ratio * WIDTH, reach)
