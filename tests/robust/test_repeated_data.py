"""What repeats another datum is no evidence: a few correspondences, each many times, are few."""

import pytest
import torch
from robust_doors import DOORS, F64, SIZE, Door, Scene

from torchsfm._types import Status
from torchsfm.robust import Degeneracy, Located, ransac
from torchsfm.triangulation import PointEstimator

of_images = {name: door for name, door in DOORS.items() if name != "point"}
every_door = pytest.mark.parametrize("door", list(of_images.values()), ids=list(of_images))


def repeated(scene: Scene, times: int) -> Scene:
    return Scene(tuple(d.repeat_interleave(times, -2) for d in scene.data), scene.known)


@every_door
@pytest.mark.parametrize("noise", [0.0, 0.03, 0.3])
def test_a_sample_repeated_supports_nothing(door: Door, noise: float, generator: torch.Generator) -> None:
    scene = repeated(door.scene(20, door.sample_size, generator), 10).noisy(noise, 0, door.images, generator)
    found = door(scene, max_iterations=300)
    assert (found.status != Status.OK).all()
    none = found.status == Status.NO_CONSENSUS
    assert (found.degeneracy[none] == Degeneracy.TOO_FEW).all()


@every_door
@pytest.mark.parametrize("times", [2, 10])
def test_wrong_data_repeated_are_no_consensus(door: Door, times: int, generator: torch.Generator) -> None:
    scene = door.scene(20, 30, generator)
    data, last = list(scene.data), door.images - 1
    data[last] = SIZE * torch.rand(data[last].shape, generator=generator, dtype=F64)
    for noise in (0.0, 0.3):
        wrong = repeated(Scene(tuple(data), scene.known), times).noisy(noise, 0, door.images, generator)
        assert (door(wrong, max_iterations=300).status != Status.OK).all()


@every_door
def test_right_data_repeated_are_as_good_as_once(door: Door, generator: torch.Generator) -> None:
    scene = door.scene(20, door.sample_size + 20, generator).noisy(0.3, 0, door.images, generator)
    once, often = door(scene), door(repeated(scene, 10))
    assert (once.status == Status.OK).all()
    assert (often.status == Status.OK).all()
    assert torch.equal(often.degeneracy, once.degeneracy)


def test_equal_rows_are_one_where_nobody_says_where_data_are(generator: torch.Generator) -> None:
    def status(views: int) -> torch.Tensor:
        scene = repeated(DOORS["point"].scene(20, views, generator), 5)
        return ransac(PointEstimator(), *scene.data, threshold=2.0, generator=generator).status

    assert not isinstance(PointEstimator(), Located)
    assert (status(2) == Status.NO_CONSENSUS).all()
    assert (status(4) == Status.OK).all()


def test_many_rows_cost_memory_in_proportion(generator: torch.Generator) -> None:
    """All pairs of so many would not fit."""
    door = DOORS["homography"]
    scene = repeated(door.scene(1, 4, generator), 50_000).noisy(0.03, 0, 2, generator)
    assert (door(scene, max_iterations=64).status != Status.OK).all()


def test_alone_and_in_a_batch_the_same_count_as_repeated(generator: torch.Generator) -> None:
    door = DOORS["essential"]
    few = repeated(door.scene(3, 5, generator), 8)
    many = door.scene(3, 40, generator)
    both = Scene(tuple(torch.cat((a, b)) for a, b in zip(few.data, many.data, strict=True)))
    found = door(both, max_iterations=300)
    assert (found.status[:3] == Status.NO_CONSENSUS).all()
    assert (found.status[3:] == Status.OK).all()
    for i in range(6):
        assert door(both.at(i), max_iterations=300).status == found.status[i]
