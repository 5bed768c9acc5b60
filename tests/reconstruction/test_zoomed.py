"""Images of one size that were taken with several focal lengths, and such that only look so."""

import torch
from torch import Tensor

from torchsfm.geometry import Camera, Radial, intrinsics
from torchsfm.reconstruction import SfmResult, reconstruct_tracks
from torchsfm.simulation import look_at, random_points, simulate_images

SIZE = (1000, 750)


def photographs(f: Tensor, c: tuple[float, float], k1: float, generator: torch.Generator) -> SfmResult:
    """A facade with relief, of which no file tells by what lens it was taken."""
    v, options = len(f), {"generator": generator, "dtype": torch.float64}
    X = random_points(150, kind="cube", **options) * torch.tensor([4.0, 3.0, 1.5])
    angle, distance = 1.6 * torch.rand(v, **options) - 0.8, 7 + 4 * torch.rand(v, **options)
    centre = torch.stack((distance * angle.sin(), torch.randn(v, **options), -distance * angle.cos()), -1)
    target = torch.randn(v, 3, **options) * torch.tensor([0.7, 0.4, 0.1])
    poses = look_at(centre, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    cameras = Camera(intrinsics(f, torch.tensor(c).double().expand(v, 2)), Radial(torch.full_like(f, k1), torch.zeros_like(f)))
    seen = simulate_images(
        X, poses, cameras, image_size=SIZE, noise=0.5, dropout=0.4, depth_range=(2.0, 25.0), generator=generator
    )
    view, track = seen.visible.nonzero(as_tuple=True)
    return reconstruct_tracks(seen.x[view, track], view, track, torch.tensor([SIZE] * v))


def test_a_zoom_lens(generator: torch.Generator) -> None:
    f = 800 * torch.logspace(0, 0.25, 7, dtype=torch.float64)[torch.randperm(7, generator=generator)]
    model = photographs(f, (499.5, 374.5), -0.05, generator).model
    assert model.registered.all()
    found = model.cameras.K[model.camera_index, 0, 0]
    assert (found.log() - f.log()).abs().max() < 0.03


def test_a_lens_that_distorts_and_is_off_the_middle(generator: torch.Generator) -> None:
    """The pairs look as if focal lengths differed."""
    model = photographs(torch.full((7,), 900.0, dtype=torch.float64), (559.5, 344.5), -0.2, generator).model
    assert model.registered.all()
    assert len(model.cameras.K) == 1
    assert abs(float(model.cameras.K[0, 0, 0]) / 900 - 1) < 0.03
