"""Rendered images agree with the geometry they come with."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from chance import seeded
from torch import Tensor
from torch.nn import functional

from torchsfm.geometry.cameras import Camera, intrinsics
from torchsfm.geometry.distortion import KannalaBrandt, Radial
from torchsfm.geometry.poses import Pose
from torchsfm.images import read_image
from torchsfm.simulation import RenderedSequence, TexturedScene, courtyard_scene, look_at, orbit_poses, render_sequence
from torchsfm.simulation.rendering import default_camera
from torchsfm.simulation.surfaces import Rectangle, Sphere
from torchsfm.simulation.textured_scene import Textured, texture_surface

WIDTH, HEIGHT, VIEWS = 160, 120, 4


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.fixture(scope="module")
def scene() -> TexturedScene:
    return courtyard_scene(texel=0.02, generator=seeded(1))


@pytest.fixture(scope="module")
def rendered(scene: TexturedScene) -> RenderedSequence:
    return render_sequence(scene, views=VIEWS, width=WIDTH, height=HEIGHT, noise=0.0, points=1500, generator=seeded(2))


def sample(image: Tensor, x: Tensor) -> Tensor:
    """Bilinear values (n, c) of an image (c, h, w) at pixels (n, 2)."""
    size = torch.tensor([image.shape[2], image.shape[1]], dtype=x.dtype)
    grid = ((x + 0.5) * 2 / size - 1).to(image.dtype)
    return functional.grid_sample(image[None], grid[None, None], align_corners=False, padding_mode="border")[0, :, 0].T


def test_shapes_and_ranges(rendered: RenderedSequence) -> None:
    assert rendered.images.shape == (VIEWS, 3, HEIGHT, WIDTH)
    assert rendered.images.dtype == torch.float32
    assert rendered.images.min() >= 0
    assert rendered.images.max() <= 1
    assert rendered.cameras.shape == rendered.poses.shape == (VIEWS,)
    assert rendered.X.shape == (1500, 3)
    assert rendered.x.dtype == rendered.X.dtype == rendered.depth.dtype == torch.float64
    assert torch.isfinite(rendered.x).all()
    assert torch.equal(rendered.surface < 0, torch.isinf(rendered.depth))
    assert len(torch.unique(rendered.surface)) >= 10


def test_another_default_dtype_changes_nothing() -> None:
    def render() -> RenderedSequence:
        return render_sequence(views=1, width=64, height=48, points=20, generator=seeded(3))

    plain, usual = render(), torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        other = render()
    finally:
        torch.set_default_dtype(usual)
    assert torch.equal(other.X, plain.X)
    torch.testing.assert_close(other.images, plain.images, rtol=0, atol=1e-4)


def test_images_are_saved_in_order(rendered: RenderedSequence, tmp_path: Path) -> None:
    files = rendered.save(tmp_path / "new" / "photos")
    assert sorted((tmp_path / "new" / "photos").iterdir()) == files
    again = torch.stack([read_image(file).pixels for file in files])
    assert again.shape == rendered.images.shape
    # Eight bits.
    assert (again - rendered.images).abs().max() < 0.51 / 255


def test_points_have_the_depth_of_the_map(rendered: RenderedSequence) -> None:
    X_cam = rendered.poses.transform(rendered.X)
    for i in range(VIEWS):
        x, z = rendered.x[i], X_cam[i, :, 2]
        inside = (x >= 0).all(-1) & (x[:, 0] <= WIDTH - 1) & (x[:, 1] <= HEIGHT - 1) & (z > 0)
        at = x.round().long().clamp(min=0).minimum(torch.tensor([WIDTH - 1, HEIGHT - 1]))
        neighbourhood = torch.stack(
            [
                rendered.depth[i, (at[:, 1] + dy).clamp(0, HEIGHT - 1), (at[:, 0] + dx).clamp(0, WIDTH - 1)]
                for dy in (-1, 0, 1)
                for dx in (-1, 0, 1)
            ]
        )
        seen, hidden = rendered.visible[i], inside & ~rendered.visible[i]
        # A visible point's depth lies within the depths of the pixels around it; a hidden one is behind one of them.
        assert (z > neighbourhood.amin(0) - 1e-3)[seen & inside].float().mean() > 0.99
        assert (z < neighbourhood.amax(0) + 1e-3)[seen & inside].float().mean() > 0.99
        assert (z > neighbourhood.amin(0) + 1e-3)[hidden].all()
        assert hidden.sum() > 10
    assert 0.3 < rendered.visible.float().mean() < 0.95


def test_each_point_was_drawn_at_a_pixel_of_its_colour(rendered: RenderedSequence) -> None:
    whole = (rendered.x - rendered.x.round()).abs().amax(-1) < 1e-4
    found = torch.zeros(len(rendered.X), dtype=torch.bool)
    for i in range(VIEWS):
        at = rendered.x[i].round().long().clamp(min=0).minimum(torch.tensor([WIDTH - 1, HEIGHT - 1]))
        same = (rendered.color == rendered.images[i, :, at[:, 1], at[:, 0]].T).all(-1)
        found |= whole[i] & same & rendered.visible[i]
    assert found.float().mean() > 0.999


def test_a_point_has_one_colour_in_all_views(rendered: RenderedSequence) -> None:
    for i in range(VIEWS):
        seen = rendered.visible[i]
        value = sample(rendered.images[i], rendered.x[i][seen])
        difference = (value - rendered.color[seen]).abs().mean(-1)
        shuffled = (value - rendered.color[seen].roll(7, 0)).abs().mean(-1)
        assert difference.median() < 0.3 * shuffled.median()


def plane_pair(camera: Camera, shift: Tensor, supersample: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """Two views of a wall: the first image, the second one read where the truth says, and where that is possible."""
    wall = Rectangle(vector(-4.0, 4.0, 0.0), vector(8.0, 0.0, 0.0), vector(0.0, -8.0, 0.0))
    textured = texture_surface(wall, "plaster", texel=0.01, generator=seeded(3))
    scene = TexturedScene((textured,), vector(0.3, 0.2, 1.0))
    up = vector(0.0, 1.0, 0.0)
    centres = torch.stack((vector(0.2, -0.1, 3.0), vector(0.2, -0.1, 3.0) + shift))
    poses = look_at(centres, vector(0.1, 0.05, 0.0), up)
    r = render_sequence(
        scene, poses=poses, camera=camera, width=240, height=180, noise=0.0, supersample=supersample, generator=seeded(4)
    )
    y, x = torch.meshgrid(torch.arange(180.0), torch.arange(240.0), indexing="ij")
    d, valid = camera.unproject(torch.stack((x, y), -1).reshape(-1, 2).double())
    X = poses[0].inverse().transform(d * (r.depth[0].reshape(-1) / d[:, 2])[:, None])
    X_cam = poses[1].transform(torch.where(valid[:, None], X, 0.0))
    target = camera.project(X_cam)
    good = valid & camera.in_domain(X_cam) & ((target >= 1) & (target <= torch.tensor([238.0, 178.0]))).all(-1)
    second = sample(r.images[1].mean(0, keepdim=True), target).reshape(180, 240)
    return r.images[0].mean(0), second, good.reshape(180, 240)


CAMERAS = {
    "pinhole": Camera(intrinsics(vector(200.0)[0], vector(118.0, 92.0))),
    "radial": Camera(intrinsics(vector(200.0)[0], vector(118.0, 92.0)), Radial(vector(-0.25)[0], vector(0.05)[0])),
    "fisheye": Camera(intrinsics(vector(150.0)[0], vector(118.0, 92.0)), KannalaBrandt(*vector(0.02, -0.01, 0.0, 0.0))),
}


@pytest.mark.parametrize("name", sorted(CAMERAS))
def test_images_are_registered_to_a_few_hundredths_of_a_pixel(name: str) -> None:
    first, second, good = plane_pair(CAMERAS[name], vector(0.4, 0.25, -0.3))
    gy, gx = torch.gradient(first)
    good = functional.max_pool2d((~good).float()[None], 5, 1, 2)[0] == 0
    assert good.float().mean() > 0.5
    # The shift (and gain) that least squares asks for to make the two images equal.
    A = torch.stack((gx[good], gy[good], torch.ones_like(gx[good])), -1).double()
    shift = torch.linalg.lstsq(A, (second - first)[good].double()).solution
    assert shift[:2].abs().max() < 0.03
    assert (second - first)[good].abs().mean() < 0.25 * (first - first.roll(5, 1))[good].abs().mean()


def test_a_wall_has_the_depth_of_a_plane() -> None:
    wall = texture_surface(
        Rectangle(vector(-5.0, -5.0, 2.0), vector(10.0, 0.0, 0.0), vector(0.0, 10.0, 0.0)), "mosaic", texel=0.1
    )
    pose = Pose.identity(1, dtype=torch.float64)
    r = render_sequence(TexturedScene((wall,), vector(0.0, 0.0, -1.0)), poses=pose, width=64, height=48, generator=seeded())
    assert torch.allclose(r.depth, torch.full_like(r.depth, 2.0), rtol=1e-6)


def test_a_ball_has_its_depth_and_size() -> None:
    ball = texture_surface(Sphere(vector(0.0, 0.0, 5.0), 1.0), "marble", texel=0.05, generator=seeded())
    camera = Camera(intrinsics(vector(100.0)[0], vector(40.0, 40.0)))
    r = render_sequence(
        TexturedScene((ball,), vector(0.0, 0.0, -1.0)), poses=Pose.identity(1, dtype=torch.float64), camera=camera,
        width=81, height=81, generator=seeded(),
    )  # fmt: skip
    assert float(r.depth[0, 40, 40]) == pytest.approx(4.0, abs=1e-5)
    # The silhouette is the cone of half angle asin(1/5).
    radius = 100 * math.tan(math.asin(0.2))
    assert float(torch.isfinite(r.depth).sum()) == pytest.approx(math.pi * radius**2, rel=0.03)


def test_images_are_not_aliased(scene: TexturedScene) -> None:
    """A small image is the average of one four times as large."""
    poses = orbit_poses(2, radius=5.2, height=(0.8, 2.0), sweep=0.5, start=-0.9, target=(0.0, 0.0, 0.7))
    small_K = intrinsics(vector(110.0)[0], vector(59.5, 44.5))
    large_K = intrinsics(vector(440.0)[0], vector(4 * 60 - 0.5, 4 * 45 - 0.5))
    small = render_sequence(scene, poses=poses, camera=Camera(small_K), width=120, height=90, noise=0.0, generator=seeded())
    large = render_sequence(scene, poses=poses, camera=Camera(large_K), width=480, height=360, noise=0.0, generator=seeded())
    average = functional.avg_pool2d(large.images, 4)
    error = (small.images - average).square().mean().sqrt()
    picked = (large.images[:, :, 1::4, 1::4] - average).square().mean().sqrt()
    assert error < 0.03
    assert error < 0.5 * picked


def test_the_same_generator_gives_the_same_images(scene: TexturedScene) -> None:
    first, again, other = (render_sequence(scene, views=2, width=80, height=60, generator=seeded(s)) for s in (5, 5, 6))
    for name in ("images", "depth", "X", "x", "color"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert not torch.equal(first.images, other.images)
    assert torch.equal(first.depth, other.depth)
    assert not torch.equal(
        courtyard_scene(texel=0.1, generator=seeded()).objects[0].sheets[0][0], scene.objects[0].sheets[0][-1]
    )


def test_noise_has_the_deviation_asked_for(scene: TexturedScene) -> None:
    clean, noisy = (
        render_sequence(scene, views=1, width=80, height=60, noise=n, generator=seeded(5)).images for n in (0.0, 0.05)
    )
    bright = (clean > 0.35) & (clean < 0.65)
    assert float((noisy - clean)[bright].std()) == pytest.approx(0.05 * math.sqrt(0.75), rel=0.05)


def test_pixels_no_ray_reaches_are_black(scene: TexturedScene) -> None:
    # With k1 = -0.5 the image of the valid rays ends at a radius of 0.54 f.
    camera = Camera(intrinsics(vector(60.0)[0], vector(39.5, 29.5)), Radial(vector(-0.5)[0], vector(0.0)[0]))
    r = render_sequence(scene, views=1, camera=camera, width=80, height=60, noise=0.0, generator=seeded(5))
    assert (r.images[0, :, 0, 0] == 0).all()
    assert int(r.surface[0, 0, 0]) == -1
    assert int(r.surface[0, 30, 40]) >= 0
    assert (r.images[0, :, 30, 40] > 0).any()


def test_one_camera_for_each_view(scene: TexturedScene, rendered: RenderedSequence) -> None:
    each = render_sequence(
        scene, poses=rendered.poses, camera=rendered.cameras, width=WIDTH, height=HEIGHT, noise=0.0, generator=seeded(2)
    )
    assert torch.equal(each.images, rendered.images)


def test_results_are_records(rendered: RenderedSequence) -> None:
    assert replace(rendered, color=rendered.color / 2).color.max() <= 0.5


def test_wrong_arguments(scene: TexturedScene, rendered: RenderedSequence) -> None:
    with pytest.raises(ValueError, match="views: wanted at least 1"):
        render_sequence(scene, views=0)
    with pytest.raises(ValueError, match=r"poses: wanted batch shape \(views,\)"):
        render_sequence(scene, poses=rendered.poses[0])
    with pytest.raises(ValueError, match=r"camera: wanted batch shape \(\) or \(2,\)"):
        render_sequence(scene, poses=rendered.poses[:2], camera=rendered.cameras)
    with pytest.raises(ValueError, match="styles: wanted at least one"):
        texture_surface(Sphere(vector(0.0, 0.0, 0.0), 1.0))


def test_a_highlight_lies_where_the_sun_is_mirrored(generator: torch.Generator) -> None:
    ball = Sphere(torch.zeros(3, dtype=torch.float64), 1.0)
    grey = Textured(ball, tuple((torch.full((3, 8, 8), 0.3),) for _ in range(6)), 0.2)
    poses = orbit_poses(5, radius=4.0)
    camera = default_camera(160, 120)
    for _ in range(3):
        towards = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
        for pose in (poses[i : i + 1] for i in range(5)):
            # Somewhere on the camera's side.
            sun = towards + 1.5 * torch.nn.functional.normalize(pose.centre[0], dim=0)
            options = {"poses": pose, "camera": camera, "width": 160, "height": 120, "noise": 0.0, "points": 1}
            plain, glossy = (
                render_sequence(TexturedScene((grey,), sun, gloss=gloss, polish=200.0), **options).images[0].mean(0)
                for gloss in (0.0, 0.6)
            )
            gain = glossy - plain
            assert (gain >= 0).all()
            y, x = divmod(int(gain.argmax()), 160)
            d, _ = camera.unproject(torch.tensor([[x, y]], dtype=torch.float64))
            e = (pose.R[0].mT @ d[0])[:, None]
            s = ball.intersect(pose.centre[0][:, None], e)
            normal = (pose.centre[0][:, None] + s * e)[:, 0]
            middle = torch.nn.functional.normalize(sun, dim=0) - torch.nn.functional.normalize(e[:, 0], dim=0)
            assert torch.nn.functional.cosine_similarity(normal, middle, dim=0) > math.cos(0.05)
