"""Images of one size that were taken with several focal lengths, and such that only look so."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import Camera, Radial, intrinsics
from torchsfm.reconstruction import SfmResult, reconstruct_tracks
from torchsfm.reconstruction.mappers import growth, zoomed
from torchsfm.reconstruction.mappers.growth import Given, Growth, Wanted
from torchsfm.reconstruction.mappers.zoomed import part_zoomed
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.simulation import look_at, random_points, simulate_images

SIZE = (1000, 750)


def see(
    f: Tensor, c: tuple[float, float], k1: float, generator: torch.Generator, points: int = 150, noise: float = 0.5
) -> tuple[Tensor, Tensor, Tensor]:
    """Image points of a facade with relief, the image of each and its track."""
    v, options = len(f), {"generator": generator, "dtype": torch.float64}
    X = random_points(points, kind="cube", **options) * torch.tensor([4.0, 3.0, 1.5])
    angle, distance = 1.6 * torch.rand(v, **options) - 0.8, 7 + 4 * torch.rand(v, **options)
    centre = torch.stack((distance * angle.sin(), torch.randn(v, **options), -distance * angle.cos()), -1)
    target = torch.randn(v, 3, **options) * torch.tensor([0.7, 0.4, 0.1])
    poses = look_at(centre, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    cameras = Camera(intrinsics(f, torch.tensor(c).double().expand(v, 2)), Radial(torch.full_like(f, k1), torch.zeros_like(f)))
    seen = simulate_images(
        X, poses, cameras, image_size=SIZE, noise=noise, dropout=0.4, depth_range=(2.0, 25.0), generator=generator
    )
    view, track = seen.visible.nonzero(as_tuple=True)
    return seen.x[view, track], view, track


def photographs(f: Tensor, c: tuple[float, float], k1: float, generator: torch.Generator) -> SfmResult:
    """Photographs of which no file tells by what lens they were taken."""
    return reconstruct_tracks(*see(f, c, k1, generator), torch.tensor([SIZE] * len(f)))


def test_a_zoom_lens(generator: torch.Generator) -> None:
    f = 800 * torch.logspace(0, 0.25, 7, dtype=torch.float64)[torch.randperm(7, generator=generator)]
    model = photographs(f, (499.5, 374.5), -0.05, generator).model
    assert model.registered.all()
    found = model.cameras.K[model.camera_index, 0, 0]
    assert (found.log() - f.log()).abs().max() < 0.03


def test_models_decide_where_pairs_mislead(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lens that distorts and is off the middle makes pairs look as if focal lengths differed."""
    monkeypatch.setattr(growth, "part_zoomed", lambda graph, camera_index, *told: torch.arange(len(camera_index)))
    model = photographs(torch.full((7,), 900.0, dtype=torch.float64), (559.5, 344.5), -0.2, generator).model
    assert model.registered.all()
    assert len(model.cameras.K) == 1
    assert abs(float(model.cameras.K[0, 0, 0]) / 900 - 1) < 0.03


def test_what_files_tell_is_not_asked(generator: torch.Generator) -> None:
    f = 800 * torch.logspace(0, 0.25, 7, dtype=torch.float64)
    x, view, track = see(f, (499.5, 374.5), -0.05, generator)
    names, size = [str(i) for i in range(7)], torch.tensor([SIZE] * 7)
    graph, _ = graph_from_tracks(names, size, x, view, track, torch.zeros(len(x), 3), generator=generator)
    one, none = torch.zeros(7, dtype=torch.long), torch.zeros(7, dtype=torch.bool)
    parted = part_zoomed(graph, one, none)
    assert parted is not None
    assert parted.tolist() == list(range(7))
    assert part_zoomed(graph, one, ~none) is None
    # Two cameras, of which one is known: its images keep it, whatever their places.
    index = torch.tensor([0, 1, 0, 0, 1, 0, 0])
    parted = part_zoomed(graph, index, index == 1)
    assert parted is None or parted[1] == parted[4]


@pytest.mark.parametrize(("views", "asked"), [(7, True), (3, False)])
def test_models_are_asked_where_pairs_show_planes_alone(generator: torch.Generator, views: int, asked: bool) -> None:
    """Planes tell no focal length, but many images of one do, and two or three do not."""
    x, view, track = see(torch.full((views,), 900.0, dtype=torch.float64), (499.5, 374.5), 0.0, generator)
    names, size = [str(i) for i in range(views)], torch.tensor([SIZE] * views)
    graph, _ = graph_from_tracks(names, size, x, view, track, torch.zeros(len(x), 3), generator=generator)
    flat = replace(graph, homography_inliers=graph.fundamental_inliers)
    one, none = torch.zeros(views, dtype=torch.long), torch.zeros(views, dtype=torch.bool)
    parted = part_zoomed(flat, one, none)
    assert (parted is not None) is asked


def test_an_image_of_something_else_does_not_make_them_more(generator: torch.Generator) -> None:
    x, view, track = see(torch.full((3,), 900.0, dtype=torch.float64), (499.5, 374.5), 0.0, generator, points=600, noise=0.2)
    for views in (3, 4):
        names, size = [str(i) for i in range(views)], torch.tensor([SIZE] * views)
        graph, _ = graph_from_tracks(names, size, x, view, track, torch.zeros(len(x), 3), generator=generator)
        one, none = torch.zeros(views, dtype=torch.long), torch.zeros(views, dtype=torch.bool)
        assert part_zoomed(graph, one, none) is not None
    graph = replace(graph, fundamental_inliers=torch.zeros_like(graph.fundamental_inliers))
    assert part_zoomed(graph, one, none) is None


@pytest.mark.parametrize("views", [3, 4])
def test_few_photographs_by_a_zoom_lens(generator: torch.Generator, views: int) -> None:
    f = 800 * torch.tensor([1.0, 1.7, 1.3, 1.5], dtype=torch.float64)[:views]
    x, view, track = see(f, (499.5, 374.5), -0.05, generator, points=600, noise=0.2)
    model = reconstruct_tracks(x, view, track, torch.tensor([SIZE] * views)).model
    assert model.registered.all()
    found = model.cameras.K[model.camera_index, 0, 0]
    assert (found.log() - f.log()).abs().max() < 0.1


def test_bends_are_told_by_the_noise_of_the_better_model(generator: torch.Generator) -> None:
    """From afar a wrong focal length moves image points by a fifth of a pixel, twice their noise."""
    options: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    X = random_points(600, kind="cube", **options) * torch.tensor([4.0, 3.0, 0.9])
    angle, f = torch.tensor([-0.2, 0.0, 0.2], dtype=torch.float64), 3500 * torch.tensor([1.0, 1.06, 1.12], dtype=torch.float64)
    centre = 30 * torch.stack((angle.sin(), 0.01 * torch.randn(3, **options), -angle.cos()), -1)
    poses = look_at(centre, 0.1 * torch.randn(3, 3, **options), torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    K = intrinsics(f, torch.tensor([499.5, 374.5], dtype=torch.float64).expand(3, 2))
    seen = simulate_images(
        X, poses, Camera(K), image_size=SIZE, noise=0.1, dropout=0.3, depth_range=(1.0, 99.0), generator=generator
    )
    view, track = seen.visible.nonzero(as_tuple=True)
    model = reconstruct_tracks(seen.x[view, track], view, track, torch.tensor([SIZE] * 3)).model
    assert model.registered.all()
    found = model.cameras.K[model.camera_index, 0, 0]
    assert (found.log() - f.log()).abs().max() < 0.04


@pytest.mark.parametrize(("spread", "cameras"), [(0.0, 1), (0.3, 5)])
def test_focal_lengths_that_are_about_one_must_explain_much_more(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch, spread: float, cameras: int
) -> None:
    """What is wrong in photographs, numbers of their own explain to a part, and make the model worse."""
    monkeypatch.setattr(growth, "part_zoomed", lambda graph, camera_index, *told: torch.arange(len(camera_index)))
    monkeypatch.setattr(zoomed, "support", lambda model, threshold, noise: 1 + 0.05 * (len(model.cameras.K) > 1))
    f = 900 * torch.linspace(-spread, spread, 5, dtype=torch.float64).exp()
    assert len(photographs(f, (499.5, 374.5), -0.05, generator).model.cameras.K) == cameras


def test_one_body_with_a_zoom_lens_that_files_tell_of(generator: torch.Generator) -> None:
    """Its principal points, 21 pixels off the middle, are found together; those of seven cameras are held there, or wander."""
    f, centre = 800 * torch.logspace(0, 0.25, 7, dtype=torch.float64), (516.5, 361.5)
    x, view, track = see(f, centre, -0.05, generator)
    names, size = [str(i) for i in range(7)], torch.tensor([SIZE] * 7)
    graph, _ = graph_from_tracks(names, size, x, view, track, torch.zeros(len(x), 3), generator=generator)

    def off(labels: list[str], shared: bool | None = None) -> float:
        wanted = Wanted(shared_camera=shared)
        given = Given(graph, labels, f.tolist())
        made = next(Growth.of(given, wanted, torch.Generator().manual_seed(0), lambda done, total: None).components())
        K = made.model.cameras.K[made.model.camera_index]
        return float((K[:, :2, 2] - torch.tensor(centre)).norm(dim=-1).mean())

    one = [f".|maker|model|{value:.3f}" for value in (f / SIZE[0]).tolist()]
    several = off([f".|maker|model {i}|1.0" for i in range(7)])
    # 1 to 9 pixels beside 12 to 17 over seven seeds, half as much at most.
    assert off(one) < 0.8 * several
    # Cameras that the caller says are several are not one.
    assert off(one, shared=False) == several
