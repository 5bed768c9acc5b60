"""Which way is up: known or guessed, it is one direction."""

import math
from dataclasses import replace

import pytest
import small_model
import torch

from torchsfm.geometry import Pose, Similarity, random_rotation, rotation_from_rotvec
from torchsfm.reconstruction import Reconstruction, align_upright, up_direction
from torchsfm.simulation import look_at, orbit_poses


@pytest.fixture
def model() -> Reconstruction:
    return small_model.make()


def turned(model: Reconstruction, R: torch.Tensor) -> Reconstruction:
    return model.transform(Similarity(torch.ones((), dtype=torch.float64), R, torch.zeros(3, dtype=torch.float64)))


def with_poses(model: Reconstruction, poses: Pose) -> Reconstruction:
    count = len(poses.t)
    return replace(
        model, names=tuple(map(str, range(count))), poses=poses, registered=torch.ones(count, dtype=torch.bool),
        image_size=model.image_size[:1].repeat(count, 1), camera_index=torch.zeros(count, dtype=torch.long),
    )  # fmt: skip


def test_up_is_up_whatever_the_frame(model: Reconstruction, generator: torch.Generator) -> None:
    R = random_rotation(generator=generator, dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert torch.allclose(up_direction(model), up, atol=1e-6)
    assert torch.allclose(up_direction(turned(model, R)), R @ up, atol=1e-6)
    # All the way round, looking steeply down, the mean of the cameras' up directions still finds it.
    orbit = with_poses(model, orbit_poses(9, radius=2.0, height=(2.0, 5.0), sweep=2 * math.pi))
    assert torch.allclose(up_direction(orbit), up, atol=1e-6)


def test_up_of_aerial_images_is_against_the_view(model: Reconstruction) -> None:
    angle = torch.arange(6, dtype=torch.float64) * math.pi / 3
    centre = torch.stack((angle.cos(), angle.sin(), torch.full_like(angle, 5.0)), -1)
    held = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)
    aerial = with_poses(model, look_at(centre, centre - torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), held))
    assert torch.allclose(up_direction(aerial), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), atol=1e-6)


def test_up_of_images_lying_on_their_side(model: Reconstruction) -> None:
    poses = orbit_poses(12, radius=4.0, height=(0.5, 1.0), sweep=2 * math.pi)
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    half = torch.arange(12)[:, None, None] < 7
    for turn in (quarter, quarter.mT, torch.where(half, quarter, quarter.mT)):
        lying = with_poses(model, Pose(turn @ poses.R, (turn @ poses.t[..., None])[..., 0]))
        assert torch.allclose(up_direction(lying), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), atol=0.02)


def test_one_camera_and_none_have_an_up(model: Reconstruction) -> None:
    one = with_poses(model, orbit_poses(1, radius=4.0, height=(0.0, 0.0)))
    assert torch.allclose(up_direction(one), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), atol=1e-6)
    none = replace(model, registered=torch.zeros(4, dtype=torch.bool))
    assert torch.allclose(up_direction(none), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def test_where_up_is_known_it_is_that(model: Reconstruction, generator: torch.Generator) -> None:
    """Rolled by hand, some on their side; also in another frame."""
    for _ in range(5):
        poses = orbit_poses(14, radius=4.0, height=(0.5, 1.5), sweep=2 * math.pi)
        roll = 0.03 * torch.randn(14, 1, generator=generator, dtype=torch.float64)
        roll[:3] += math.pi / 2
        held = rotation_from_rotvec(roll * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        some = with_poses(model, Pose(held @ poses.R, (held @ poses.t[..., None])[..., 0]))
        some = turned(some, random_rotation(generator=generator, dtype=torch.float64))
        level = align_upright(some)
        assert not level.fault()
        assert torch.equal(up_direction(some), level.similarity.R[2])
