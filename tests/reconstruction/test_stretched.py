"""Images that were stretched along one side say so."""

from unittest.mock import Mock

import pytest
import torch
from chance import seeded
from torch import Tensor

from bench.doubt import camera_errors
from torchsfm.geometry import Camera, Pose, Radial, intrinsics
from torchsfm.reconstruction import SfmResult, attempts, reconstruct_tracks, stretched
from torchsfm.reconstruction.mapping.adjust import adjust
from torchsfm.reconstruction.stretched import apparent_aspect
from torchsfm.simulation import orbit_poses, random_points, simulate_images

VIEWS, RADIUS, FOCAL = 7, 4.0, 900.0


def images(aspect: float, views: int = VIEWS, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Pose, tuple[int, int]]:
    """Image points, their images and tracks, the true poses, and the size of images that were stretched along y."""
    g = seeded(seed)
    size = 1000, round(750 * aspect)
    poses = orbit_poses(views, radius=RADIUS, sweep=1.5)
    X = random_points(300, kind="ball", size=5.0, generator=g)
    centre = (torch.tensor(size).double() - 1) / 2
    K = intrinsics(torch.tensor(FOCAL).double(), centre, aspect=aspect).expand(views, 3, 3)
    k1, k2 = torch.full((views,), -0.05).double(), torch.zeros(views).double()
    seen = simulate_images(X, poses, Camera(K, Radial(k1, k2)), image_size=size, noise=0.3, generator=g)
    view, track = seen.visible.nonzero(as_tuple=True)
    return seen.x[view, track], view, track, poses, size


def reconstructed(aspect: float, views: int = VIEWS, seed: int = 0) -> tuple[SfmResult, Tensor]:
    """What comes of them, nothing being known, and the errors of the poses in degrees."""
    x, view, track, poses, size = images(aspect, views, seed)
    found = reconstruct_tracks(x, view, track, torch.tensor([size] * views), shared_camera=True)
    return found, camera_errors(found.model.poses, poses, found.model.registered, RADIUS)


def aspect_of(found: SfmResult) -> float:
    K = found.model.cameras.K[0]
    return float(K[1, 1] / K[0, 0])


@pytest.mark.parametrize("aspect", [0.85, 1.1])
def test_stretched_images_are_told_and_right(aspect: float) -> None:
    found, error = reconstructed(aspect)
    assert aspect_of(found) == pytest.approx(aspect, rel=3e-3)
    assert float(found.model.cameras.K[0, 0, 0]) == pytest.approx(FOCAL, rel=5e-3)
    assert float(error.max()) < 0.1
    (calibration,) = found.report.calibrations
    place = calibration.names.index("aspect")
    assert bool(calibration.estimated[0, place])
    assert abs(aspect_of(found) - aspect) < 4 * float(calibration.deviation[0, place])
    assert "stretched" in calibration.remark
    assert "stretched" in found.report.summary()


def test_square_pixels_are_square_and_known_cameras_are_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, adjusted = Mock(side_effect=apparent_aspect), Mock(side_effect=adjust)
    monkeypatch.setattr(attempts, "apparent_aspect", asked)
    monkeypatch.setattr(stretched, "adjust", adjusted)
    found, _ = reconstructed(1.0)
    assert aspect_of(found) == 1
    (calibration,) = found.report.calibrations
    assert "aspect" not in calibration.names
    assert not calibration.remark
    asked.assert_called_once()
    # Where a ratio hardly lowers the cost, nothing needs to be compared with it.
    adjusted.assert_called_once()
    x, view, track, _, size = images(1.1)
    K = intrinsics(torch.tensor(FOCAL).double(), (torch.tensor(size).double() - 1) / 2)
    known = reconstruct_tracks(x, view, track, torch.tensor([size] * VIEWS), K=K)
    assert aspect_of(known) == 1
    asked.assert_called_once()


def test_two_images_are_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their focal length is the first guess, and a ratio would make up for what that is off."""
    answers: list[float | None] = []
    monkeypatch.setattr(attempts, "apparent_aspect", lambda *given: answers.append(apparent_aspect(*given)))
    reconstructed(0.85, views=2)
    assert answers == [None]


def test_faults_of_another_kind_are_not_taken_for_a_stretch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the ratio is next to one, or explains little more, it stays one."""
    assert aspect_of(reconstructed(1.01)[0]) == 1
    monkeypatch.setattr(stretched, "MUST_GAIN", 1.0)
    assert aspect_of(reconstructed(0.95)[0]) == 1
