"""Real images of textured scenes, with the truth about cameras and surfaces: for tests and demonstrations."""

import math
import os
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry.cameras import Camera, intrinsics
from torchsfm.geometry.distortion import Radial
from torchsfm.geometry.poses import Pose
from torchsfm.images.reading import save_image
from torchsfm.simulation.randomness import drawn
from torchsfm.simulation.ray_casting import cast, lit, shade
from torchsfm.simulation.textured_scene import TexturedScene, courtyard_scene
from torchsfm.simulation.viewpoints import orbit_poses


@dataclass(frozen=True)
class RenderedSequence:
    """Images and everything that is true about them. Images and colours are float32, the rest has the poses' dtype.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> scene = torchsfm.render_sequence(views=2, width=64, height=48, points=50, generator=g)
        >>> x = torchsfm.project_points(scene.poses, scene.X, scene.cameras)  # where points are in both images, seen or hidden
        >>> x.shape, bool(x[scene.visible].allclose(scene.x[scene.visible]))
        (torch.Size([2, 50, 2]), True)
        >>> [file.name for file in scene.save("photographs")]
        ['view00.png', 'view01.png']
    """

    images: Float[Tensor, "v 3 h w"]
    """Red, green, blue in [0, 1]."""
    depth: Float[Tensor, "v h w"]
    """Depth (z in the camera's frame) at each pixel centre; infinity where there is no surface."""
    surface: Int[Tensor, "v h w"]
    """Index of the object seen at each pixel centre, -1 where there is none."""
    cameras: Camera
    """Batch (v,)."""
    poses: Pose
    """World to camera, batch (v,)."""
    X: Float[Tensor, "n 3"]
    """Points on the surfaces, each drawn at a random pixel of some image."""
    color: Float[Tensor, "n 3"]
    """Colour of each point, in the image where it was drawn, without noise."""
    x: Float[Tensor, "v n 2"]
    """Where the points project, in pixels; finite but meaningless where not visible."""
    visible: Bool[Tensor, "v n"]
    """Which points are inside each image and not hidden by a surface."""

    def save(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write the images as `view00.png`, `view01.png`, ... into a folder, which is made where there is none.

        Args:
            folder: Where to.

        Returns:
            The files, in the order of the images.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        files = [folder / f"view{i:02d}.png" for i in range(len(self.images))]
        for file, image in zip(files, self.images, strict=True):
            save_image(file, image)
        return files


def default_camera(
    width: int, height: int, *, dtype: torch.dtype = torch.float64, device: torch.device | None = None
) -> Camera:
    """An ordinary camera: 57 degrees across, square pixels, a principal point off the middle, mild barrel distortion."""
    f = torch.tensor(0.92 * width, dtype=dtype, device=device)
    c = torch.tensor([0.507 * width - 0.5, 0.494 * height - 0.5], dtype=dtype, device=device)
    k1, k2 = torch.tensor([-0.09, 0.02], dtype=dtype, device=device)
    return Camera(intrinsics(f, c), Radial(k1, k2))


def render_sequence(
    scene: TexturedScene | None = None,
    *,
    poses: Pose | None = None,
    camera: Camera | None = None,
    views: int = 12,
    width: int = 960,
    height: int = 720,
    noise: float = 0.01,
    points: int = 2000,
    supersample: int = 3,
    generator: torch.Generator | None = None,
) -> RenderedSequence:
    """Render a textured scene from several viewpoints, as a camera with lens distortion and sensor noise would see it.

    Textures are band-limited to each pixel's footprint; pixels on the outline of a surface or a shadow are supersampled.

    Args:
        scene: What to render; a `courtyard_scene` with texels to suit the width where none is given.
        poses: Viewpoints, batch (v,); an arc of `views` cameras around the courtyard where none are given.
        camera: Intrinsics and distortion of all views (batch of none) or of each (v,); `default_camera` where none is given.
        views: Number of viewpoints when `poses` is not given.
        width: Image width in pixels.
        height: Image height in pixels.
        noise: Standard deviation of the noise at full brightness; half its variance is shot noise, growing with brightness.
        points: How many surface points to draw for the truth.
        supersample: Rays per pixel and axis on outlines.
        generator: Source of randomness; torch's own where none is given. Everything is made on its device.

    Returns:
        Images and truth. Pixels outside the valid radius of the distortion are black, without depth.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> scene = torchsfm.render_sequence(views=2, width=64, height=48, points=50, generator=g)
        >>> scene.images.shape, scene.depth.shape, scene.X.shape
        (torch.Size([2, 3, 48, 64]), torch.Size([2, 48, 64]), torch.Size([50, 3]))
    """
    for name, value in (("views", views), ("width", width), ("height", height), ("supersample", supersample)):
        if value < 1:
            raise ValueError(f"{name}: wanted at least 1, got {value}")
    device = generator.device if generator is not None else None
    if scene is None:
        # Texels about as large as pixels at the distance of the nearer things.
        scene = courtyard_scene(texel=min(max(5.8 / width, 0.002), 0.03), generator=generator)
    if poses is None:
        poses = orbit_poses(
            views, radius=5.2, height=(0.6, 2.6), sweep=math.radians(75), start=math.radians(-82.5),
            target=(0.0, 0.0, 0.7), device=device,
        )  # fmt: skip
    if len(poses.shape) != 1:
        raise ValueError(f"poses: wanted batch shape (views,), got {tuple(poses.shape)}")
    count, dtype = poses.shape[0], poses.t.dtype
    if camera is None:
        camera = default_camera(width, height, dtype=dtype, device=poses.t.device)
    shape = camera.K.shape[:-2]
    if shape not in (torch.Size(), torch.Size([count])):
        raise ValueError(f"camera: wanted batch shape () or ({count},), got {tuple(shape)}")
    each = [camera if shape == torch.Size() else camera[i] for i in range(count)]
    y, x = torch.meshgrid(
        torch.arange(height, dtype=dtype, device=poses.t.device), torch.arange(width, dtype=dtype, device=poses.t.device),
        indexing="ij",
    )  # fmt: skip
    pixels = torch.stack((x.reshape(-1), y.reshape(-1)), -1)
    rays = _Rays.of(camera, pixels, height, width) if shape == torch.Size() else None
    results = []
    for i in range(count):
        own = rays if rays is not None else _Rays.of(each[i], pixels, height, width)
        results.append(_render_view(scene, poses[i], each[i], own, pixels, height, width, supersample))
    clean = torch.stack([r[0] for r in results])
    depth = torch.stack([r[1] for r in results])
    surface = torch.stack([r[2] for r in results])
    cameras = camera if shape else camera[(None,)][torch.zeros(count, dtype=torch.long, device=poses.t.device)]
    X, color = _draw_points(clean, depth, poses, each, points, generator)
    x_points, visible = _see_points(scene, X, poses, cameras, height, width)
    images = clean
    if noise > 0:
        grain = drawn(torch.randn, clean.shape, clean, generator)
        images = (clean + grain * noise * (0.5 + 0.5 * clean).sqrt()).clamp(0, 1)
    return RenderedSequence(images, depth, surface, cameras, poses, X, color, x_points, visible)


@dataclass(frozen=True)
class _Rays:
    """Rays of all pixels of a camera, in its own frame, and their change to the next pixel."""

    d: Tensor
    dx: Tensor
    dy: Tensor
    valid: Tensor

    @classmethod
    def of(cls, camera: Camera, pixels: Tensor, height: int, width: int) -> "_Rays":
        d, valid = camera.unproject(pixels)
        grid = d.T.reshape(3, height, width)
        steps = [torch.gradient(grid, dim=k)[0] if grid.shape[k] > 1 else torch.zeros_like(grid) for k in (2, 1)]
        d, dx, dy = (g.reshape(3, -1).to(torch.float32).contiguous() for g in (grid, *steps))
        return cls(d, dx, dy, valid)


def _render_view(
    scene: TexturedScene, pose: Pose, camera: Camera, rays: _Rays, pixels: Tensor, height: int, width: int, supersample: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Clean image (3, h, w), depth (h, w) and surface index (h, w) of one view."""
    origin, turn = pose.centre[:, None].to(torch.float32), pose.R.mT.to(torch.float32)
    d, dx, dy = turn @ rays.d, turn @ rays.dx, turn @ rays.dy
    distance, index = cast(scene, origin, d)
    distance, index = torch.where(rays.valid, distance, math.inf), torch.where(rays.valid, index, -1).to(torch.int16)
    sunny = _sunlight(scene, origin, d, distance)
    color = shade(scene, origin, d, dx, dy, distance, index, sunny)
    color = torch.where(rays.valid, color, 0.0)
    kind = (2 * index + sunny).reshape(height, width)
    edge = torch.zeros(height, width, dtype=torch.bool, device=d.device)
    across, down = kind[:, 1:] != kind[:, :-1], kind[1:] != kind[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    if supersample > 1:
        chosen = (edge.reshape(-1) & rays.valid).nonzero()[:, 0]
        step = ((torch.arange(supersample, device=d.device) + 0.5) / supersample - 0.5).to(d)
        ex, ey = dx[:, None, chosen], dy[:, None, chosen]
        e = d[:, None, chosen] + ex * step.repeat(supersample)[:, None] + ey * step.repeat_interleave(supersample)[:, None]
        ex, ey = ((g / supersample).expand_as(e).reshape(3, -1) for g in (ex, ey))
        e = e.reshape(3, -1)
        s, i = cast(scene, origin, e)
        fine = shade(scene, origin, e, ex, ey, s, i, _sunlight(scene, origin, e, s))
        color[:, chosen] = fine.reshape(3, supersample**2, -1).mean(1)
    depth = (distance * rays.d[2]).to(pixels.dtype)
    return color.reshape(3, height, width), depth.reshape(height, width), index.reshape(height, width)


def _sunlight(scene: TexturedScene, origin: Tensor, d: Tensor, distance: Tensor) -> Tensor:
    met = torch.isfinite(distance)
    return lit(scene, origin + torch.where(met, distance, 0.0) * d) & met


def _draw_points(
    clean: Tensor, depth: Tensor, poses: Pose, cameras: list[Camera], points: int, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """Random pixels with depth, as points in the world, and their colours."""
    view, y, x = torch.isfinite(depth).nonzero(as_tuple=True)
    many = points if len(view) else 0
    draw = torch.rand(many, generator=generator, dtype=torch.float64, device=depth.device)
    order = (draw * len(view)).long().clamp_max(max(len(view) - 1, 0)).sort().values
    view, y, x = view[order], y[order], x[order]
    X = torch.empty(many, 3, dtype=depth.dtype, device=depth.device)
    for i, camera in enumerate(cameras):
        own = view == i
        d, _ = camera.unproject(torch.stack((x[own], y[own]), -1).to(depth.dtype))
        z = depth[i, y[own], x[own]]
        X[own] = poses[i].inverse().transform(d * (z / d[:, 2])[:, None])
    return X, clean[view, :, y, x]


def _see_points(
    scene: TexturedScene, X: Tensor, poses: Pose, cameras: Camera, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """Projections of the points into every view, and whether each view sees them."""
    X_cam = poses.transform(X)
    x = cameras.project(X_cam)
    size = x.new_tensor([width, height])
    inside = ((x >= -0.5) & (x < size - 0.5)).all(-1) & cameras.in_domain(X_cam)
    for i in range(len(x)):
        origin = poses[i].centre[:, None]
        s, _ = cast(scene, origin, X.T - origin)
        inside[i] &= s > 1 - 1e-4
    return x, inside
