"""Where no one says which lens took the images, they do."""

from unittest.mock import Mock

import pytest
import torch
from chance import seeded
from torch import Tensor

from bench.doubt import camera_errors
from torchsfm.geometry import Camera, Pose, intrinsics
from torchsfm.geometry.distortion import DISTORTION_MODELS, Distortion
from torchsfm.reconstruction import SfmResult, reconstruct_tracks
from torchsfm.reconstruction.attempts import Attempt
from torchsfm.simulation import orbit_poses, random_points, simulate_images

SIZE, VIEWS, RADIUS = (1000, 750), 7, 4.0


def images(focal: float, lens: str, parameters: list[float], seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Pose]:
    """Image points, their images and tracks, and the true poses, of a scene that fills the images to their corners."""
    g = seeded(seed)
    poses = orbit_poses(VIEWS, radius=RADIUS, sweep=1.5)
    X = random_points(500, kind="ball", size=6.0, generator=g)
    distortion = DISTORTION_MODELS[lens].from_parameters(torch.tensor([parameters], dtype=torch.float64).expand(VIEWS, -1))
    centre = (torch.tensor(SIZE).double() - 1) / 2
    camera = Camera(intrinsics(torch.tensor(focal).double(), centre).expand(VIEWS, 3, 3), distortion)
    seen = simulate_images(X, poses, camera, image_size=SIZE, noise=0.3, generator=g)
    view, track = seen.visible.nonzero(as_tuple=True)
    return seen.x[view, track], view, track, poses


def reconstructed(focal: float, lens: str, parameters: list[float], **options: object) -> tuple[SfmResult, Tensor]:
    """What comes of them, nothing being known, and the errors of the poses in degrees."""
    x, view, track, poses = images(focal, lens, parameters)
    found = reconstruct_tracks(x, view, track, torch.tensor([SIZE] * VIEWS), **options)  # type: ignore[arg-type]
    return found, camera_errors(found.model.poses, poses, found.model.registered, RADIUS)


def lens_of(found: SfmResult) -> type[Distortion]:
    return type(found.model.cameras.distortion)


def test_a_fisheye_is_recognised() -> None:
    focal = 600.0
    found, error = reconstructed(focal, "fisheye", [0.02, -0.005, 0.0, 0.0])
    assert lens_of(found) is DISTORTION_MODELS["fisheye"]
    assert float(found.model.cameras.K[0, 0, 0]) == pytest.approx(focal, rel=5e-3)
    assert float(error.max()) < 0.1


def test_a_strong_polynomial_is_one() -> None:
    found, error = reconstructed(700.0, "radial", [-0.3, 0.11])
    assert lens_of(found) is DISTORTION_MODELS["radial"]
    assert float(error.max()) < 0.1


def test_lenses_that_hardly_bend_are_not_asked_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Mock(side_effect=Attempt.of)
    monkeypatch.setattr(Attempt, "of", made)
    found, _ = reconstructed(900.0, "radial", [-0.05, 0.02])
    assert lens_of(found) is DISTORTION_MODELS["radial"]
    assert made.call_count == 1


def test_who_says_which_lens_it_is_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Mock(side_effect=Attempt.of)
    monkeypatch.setattr(Attempt, "of", made)
    found, _ = reconstructed(700.0, "radial", [-0.3, 0.11], camera="simple_radial")
    assert lens_of(found) is DISTORTION_MODELS["simple_radial"]
    assert all(call.args[1].camera == "simple_radial" for call in made.call_args_list)


def test_a_polynomial_prescribed_for_a_fisheye_is_told() -> None:
    found, _ = reconstructed(600.0, "fisheye", [0.02, -0.005, 0.0, 0.0], camera="radial")
    assert "fisheye" in found.report.summary()
    for camera, focal, lens, parameters in (
        ("fisheye", 600.0, "fisheye", [0.02, -0.005, 0.0, 0.0]),
        ("radial", 900.0, "radial", [-0.05, 0.02]),
    ):
        found, _ = reconstructed(focal, lens, parameters, camera=camera)
        assert "fisheye" not in found.report.summary()
