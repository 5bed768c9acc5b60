"""Textured scenes: surfaces with their textures, and the one that the demo looks at."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.simulation.surfaces import Box, Cylinder, Rectangle, Sphere, Surface
from torchsfm.simulation.textures import mip_pyramid, paint


@dataclass(frozen=True)
class Textured:
    """A surface with one mip pyramid for each of its texture sheets; level 0 has `texel` sized texels."""

    surface: Surface
    sheets: tuple[tuple[Float[Tensor, "3 _ _"], ...], ...]
    texel: float


@dataclass(frozen=True)
class TexturedScene:
    """What `render_sequence` renders: textured surfaces under a sun and an even sky, the z axis up.

    Example:
        >>> import torch
        >>> from dataclasses import replace
        >>> from torchsfm.simulation import courtyard_scene, render_sequence
        >>> scene = courtyard_scene(texel=0.1, generator=torch.Generator().manual_seed(0))
        >>> darker = replace(scene, ambient=0.5 * scene.ambient)
        >>> bright, dark = (render_sequence(s, views=1, width=32, height=24, points=10).images.mean() for s in (scene, darker))
        >>> bool(dark < bright), len(scene.objects) > 1
        (True, True)
    """

    objects: tuple[Textured, ...]
    """The surfaces with their textures."""
    sun: Float[Tensor, "3"]
    """Direction to the sun; any length."""
    ambient: float = 0.5
    """Light that reaches every surface, as a share of the light on a surface facing the sun."""
    gloss: float = 0.0
    """Brightness of the sun's mirror image on the surfaces: a highlight that moves with the viewpoint (Phong 1975)."""
    polish: float = 30.0
    """How small highlights are: the exponent of the cosine of the angle from the mirror direction."""


def texture_surface(surface: Surface, *styles: str, texel: float = 0.005, generator: torch.Generator | None = None) -> Textured:
    """Paint a surface.

    Args:
        surface: What to paint.
        *styles: Names from `textures.STYLES`, one for each sheet, repeated if they are fewer.
        texel: Size of a texel in the unit of the scene. About the size of a pixel seen from the nearest camera, or smaller.
        generator: Source of randomness; torch's own where none is given.
    """
    if not styles:
        raise ValueError("styles: wanted at least one")
    sheets = []
    for index, (width, height) in enumerate(surface.sheets()):
        image = paint(styles[index % len(styles)], width, height, texel=texel, generator=generator)
        sheets.append(mip_pyramid(image))
    return Textured(surface, tuple(sheets), texel)


def courtyard_scene(*, texel: float = 0.006, generator: torch.Generator | None = None) -> TexturedScene:
    """A corner of a courtyard, about 8 x 8 x 3 metres around the origin: ground, two walls, crates, a ball and a column.

    Cameras see it best from the side of +x, -y: azimuths from -90 to 0 degrees, 4 to 8 metres away.

    Args:
        texel: Size of a texel in metres; smaller textures look sharper from near and take longer to paint.
        generator: Source of randomness for the textures and small changes of the layout; torch's own where none is given.

    Example:
        >>> import torch
        >>> from torchsfm.simulation import courtyard_scene, render_sequence
        >>> scene = courtyard_scene(texel=0.1, generator=torch.Generator().manual_seed(0))
        >>> render_sequence(scene, views=1, width=32, height=24, points=10).images.shape
        torch.Size([1, 3, 24, 32])
    """
    device = generator.device if generator is not None else None
    wobble = torch.rand(16, generator=generator, dtype=torch.float32, device=device).tolist()

    def vector(*values: float) -> Tensor:
        return torch.tensor(values, dtype=torch.float64, device=device)

    def turned(angle: float) -> Tensor:
        c, s = math.cos(angle), math.sin(angle)
        return torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64, device=device)

    def box(x: float, y: float, z: float, size: tuple[float, float, float], angle: float) -> Box:
        half = vector(*size) / 2
        return Box(vector(x, y, z + size[2] / 2), turned(angle), half)

    a = [w - 0.5 for w in wobble]
    column_base = vector(-1.3 + 0.3 * a[0], -1.5 + 0.3 * a[1], 0.0)
    radius, height = 0.32 + 0.06 * a[2], 2.0 + 0.3 * a[3]
    lid = column_base + vector(-radius, -radius, height)
    ball = 0.5 + 0.1 * a[4]
    parts: tuple[tuple[Surface, tuple[str, ...]], ...] = (
        (Rectangle(vector(-2.8, -6.5, 0.0), vector(9.3, 0.0, 0.0), vector(0.0, 9.3, 0.0)), ("ground",)),
        (Rectangle(vector(-2.8, 2.8, 3.2), vector(8.5, 0.0, 0.0), vector(0.0, 0.0, -3.2)), ("bricks",)),
        (Rectangle(vector(-2.8, -5.5, 3.2), vector(0.0, 8.3, 0.0), vector(0.0, 0.0, -3.2)), ("plaster",)),
        (
            box(0.9 + 0.3 * a[5], 1.3 + 0.3 * a[6], 0.0, (1.3, 1.1, 1.2), 0.4 + a[7]),
            ("wood", "painted", "wood", "poster", "wood"),
        ),
        (box(1.0 + 0.3 * a[5], 1.2 + 0.3 * a[6], 1.2, (0.7, 0.7, 0.6), 1.1 + a[8]), ("painted", "poster", "marble", "plaster")),
        (box(-0.9 + 0.3 * a[9], 0.9, 0.0, (0.9, 0.9, 1.7), 0.2 + a[10]), ("mosaic", "marble", "painted", "poster", "marble")),
        (box(1.4 + 0.3 * a[11], -0.9 + 0.3 * a[12], 0.0, (1.0, 0.6, 0.45), -0.5 + a[13]), ("poster", "wood", "painted")),
        (Sphere(vector(0.1 + 0.3 * a[14], -0.5 + 0.3 * a[15], ball), ball), ("painted", "marble", "mosaic")),
        (Cylinder(column_base, turned(0.3), radius, height), ("marble",)),
        (Rectangle(lid, vector(2 * radius, 0.0, 0.0), vector(0.0, 2 * radius, 0.0), round=True), ("plaster",)),
    )
    objects = tuple(texture_surface(surface, *styles, texel=texel, generator=generator) for surface, styles in parts)
    return TexturedScene(objects, vector(0.55, -0.35, 0.85))
