"""Images placed by points whose camera is known, a little, or not at all."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import Camera, Pose, Radial, intrinsics
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.register import register_images
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.simulation import look_at, simulate_images

SIZE = (1000, 750)
FOCAL = 900.0


def beginning(
    guess: Tensor, camera: Tensor, generator: torch.Generator, *, flat: bool = False, wrong: float = 0.0
) -> tuple[Mapping, Pose]:
    """A model of two of six images of one place, and where all of them are; `guess` over the true focal length."""
    v, options = 6, {"generator": generator, "dtype": torch.float64}
    X = (torch.rand(300, 3, **options) - 0.5) * torch.tensor([4.0, 3.0, 0.0 if flat else 3.0])
    angle = torch.linspace(-0.5, 0.5, v, dtype=torch.float64) * (0.0 if flat else 1.0)
    aside = torch.linspace(-1, 1, v, dtype=torch.float64) * (1.0 if flat else 0.0)
    centre = torch.stack((8 * angle.sin() + aside, 0.3 * torch.randn(v, **options), -8 * angle.cos()), -1)
    target = centre * torch.tensor([1.0, 1.0, 0.0]) if flat else torch.zeros(v, 3, dtype=torch.float64)
    poses = look_at(centre, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    c, zero = torch.tensor([499.5, 374.5]).double(), torch.zeros(1, dtype=torch.float64)
    truth = Camera(intrinsics(torch.tensor([FOCAL]).double(), c[None]), Radial(zero, zero))
    seen = simulate_images(X, poses, truth, image_size=SIZE, noise=0.5, generator=generator)
    view, track = seen.visible.nonzero(as_tuple=True)
    x = seen.x[view, track]
    off = torch.rand(len(x), **options) < wrong
    x[off] = torch.rand(int(off.sum()), 2, **options) * torch.tensor(SIZE)
    names, size = tuple(f"{i}" for i in range(v)), torch.tensor([SIZE] * v)
    graph, tracks = graph_from_tracks(names, size, x, view, track, torch.zeros(len(x), 3).double(), generator=generator)
    g = len(guess)
    cameras = Camera(intrinsics(FOCAL * guess, c.expand(g, 2)), Radial(torch.zeros(g).double(), torch.zeros(g).double()))
    mapping = Mapping.start(graph, tracks, cameras, camera)
    number = torch.full((int(tracks.max()) + 1,), -1).index_copy_(0, tracks, track)
    point = torch.where(graph.view < 2, tracks, -1)
    return replace(mapping, poses=poses, registered=torch.arange(v) < 2, X=X[number], point=point).compacted(), poses


def test_known_focal_lengths_stay_beside_unknown_ones(generator: torch.Generator) -> None:
    guess = torch.tensor([1.0, 1.0, 0.6, 0.93, 1.5], dtype=torch.float64)
    mapping, truth = beginning(guess, torch.tensor([0, 0, 1, 2, 3, 4]), generator, wrong=0.2)
    sigma = torch.tensor([0.0, 0.05, 0.5, 0.2, 0.5], dtype=torch.float64)
    images = torch.tensor([2, 3, 4, 5])
    found, count, inliers = register_images(mapping, images, threshold=8.0, focal_sigma=sigma, generator=generator)
    assert found.registered.all()
    assert (inliers > 0.7 * count).all()
    focal = found.cameras.K[:, 0, 0] / FOCAL
    assert focal[:2].tolist() == [1.0, 1.0]
    assert (focal[2:] - 1).abs().max() < 0.03
    centre = found.poses.centre - truth.centre
    assert centre.norm(dim=-1).max() < 0.3


def test_images_of_one_camera_get_one_focal_length(generator: torch.Generator) -> None:
    mapping, truth = beginning(torch.tensor([1.0, 0.6]).double(), torch.tensor([0, 0, 1, 1, 1, 1]), generator)
    sigma = torch.tensor([0.0, 0.5], dtype=torch.float64)
    images = torch.tensor([2, 3, 4, 5])
    found, _, _ = register_images(mapping, images, threshold=8.0, focal_sigma=sigma, generator=generator)
    assert found.registered.all()
    assert abs(float(found.cameras.K[1, 0, 0]) / FOCAL - 1) < 0.03
    # Each has the pose that goes with it, not with what the image would have said alone.
    node = found.observations()
    assert found.errors(found.point[node], node).median() < 2.0
    assert (found.poses.centre - truth.centre).norm(dim=-1).max() < 0.3


@pytest.mark.parametrize("guess", [0.8, 1.25])
def test_a_plane_that_faces_the_camera_says_nothing(generator: torch.Generator, guess: float) -> None:
    mapping, _ = beginning(torch.tensor([1.0, guess]).double(), torch.tensor([0, 0, 1, 1, 1, 1]), generator, flat=True)
    sigma = torch.tensor([0.0, 0.2], dtype=torch.float64)
    found, _, _ = register_images(mapping, torch.tensor([3]), threshold=8.0, focal_sigma=sigma, generator=generator)
    assert bool(found.registered[3])
    assert abs(float(found.cameras.K[1, 0, 0]) / FOCAL / guess - 1) < 0.15
