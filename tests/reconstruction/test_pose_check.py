"""Poses that are given: right ones are not accused, wrong ones are told, and which images they are of."""

from dataclasses import replace

import pytest
import torch
from chance import seeded
from painted_box import SIZE, camera, orbit, photograph
from torch import Tensor

from torchsfm.geometry import Camera, Pose
from torchsfm.reconstruction.curves.foretold_edges import Foretold
from torchsfm.reconstruction.curves.from_edges import SeenEdges, curves_of_edges
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.curves.pose_check import PoseCheck, check_by_edges
from torchsfm.simulation import RenderedSequence, render_sequence

VIEWS, WIDTH, HEIGHT = 8, 320, 240
Photographs = tuple[list[ImageEdges], Camera, Pose]


@pytest.fixture(scope="module")
def rendered() -> Photographs:
    """Views of a courtyard."""
    found: RenderedSequence = render_sequence(views=VIEWS, width=WIDTH, height=HEIGHT, points=1, generator=seeded())
    return [ImageEdges.of(image) for image in found.images], found.cameras, found.poses


def checked(edges: list[ImageEdges], cameras: Camera, poses: Pose, size: tuple[int, int] = (HEIGHT, WIDTH)) -> PoseCheck:
    seen = SeenEdges.of(edges, size, cameras)
    curves = curves_of_edges(edges, size, cameras, poses, points=None, seen=seen, progress=lambda *_: None)
    return check_by_edges(seen, size, cameras, poses, curves, points=None)


def names(number: int) -> list[str]:
    return [f"view{i}" for i in range(number)]


def permuted(poses: Pose) -> Pose:
    return poses[torch.arange(len(poses.R)).roll(1).view(2, -1).flip(0).flatten()]


def inverted(poses: Pose) -> Pose:
    return Pose(poses.R.mT, poses.centre)


def other_axes(poses: Pose) -> Pose:
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=poses.R.dtype))
    return Pose(flip @ poses.R, poses.t @ flip)


def quarter_turn(poses: Pose) -> Pose:
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=poses.R.dtype)
    return Pose(turn @ poses.R, poses.t @ turn.mT)


def test_right_poses_are_not_accused(rendered: Photographs) -> None:
    check = checked(*rendered)
    assert not check.refuted
    assert check.doubts(names(VIEWS)) == []
    assert float(check.left_out.agreement) > 0.4
    assert check.images.agreement.amin() > 0.2


@pytest.mark.parametrize("wrong", [permuted, inverted, other_axes, quarter_turn])
def test_wrong_poses_are_told(rendered: Photographs, wrong: object) -> None:
    assert callable(wrong)
    edges, cameras, poses = rendered
    check = checked(edges, cameras, wrong(poses))
    assert not check.confirmed
    (told,) = check.doubts(names(VIEWS))
    assert told.startswith(("the poses do not fit the photographs: ", "nothing confirms the poses: "))
    assert all(check.image_doubts()) == check.refuted


def test_the_image_whose_pose_is_wrong_is_told(rendered: Photographs) -> None:
    edges, cameras, poses = rendered
    R, t = poses.R.clone(), poses.t.clone()
    R[3], t[3] = R[5], t[5]
    check = checked(edges, cameras, Pose(R, t))
    (told,) = check.doubts(names(VIEWS))
    assert told.startswith("doubtful: view3 (it shows ")


def test_few_images(rendered: Photographs) -> None:
    edges, cameras, poses = rendered
    for number in (4, 5):
        own = torch.arange(number)
        assert checked(edges[:number], cameras[own], poses[own]).confirmed, number
        (told,) = checked(edges[:number], cameras[own], quarter_turn(poses[own])).doubts(names(number))
        assert "the poses" in told, number
    # Two images place no curve that a third could confirm.
    check = checked(edges[:3], cameras[:3], poses[:3])
    assert check.followed == 0
    assert check.doubts(names(3)) == []


@pytest.fixture(scope="module")
def box() -> list[ImageEdges]:
    return [ImageEdges.of(image) for image in photograph(orbit(12))]


def other_K(x: float, y: float) -> Camera:
    known = camera(12)
    return replace(known, K=known.K * torch.tensor([[x, 1, 1], [1, y, 1], [1, 1, 1]], dtype=known.K.dtype))


def of_the_box(edges: list[ImageEdges], cameras: Camera, poses: Pose) -> list[str]:
    return checked(edges, cameras, poses, (SIZE, SIZE)).doubts(names(12))


def test_a_camera_around_an_object_tells_its_focal_length(box: list[ImageEdges]) -> None:
    """Such curves come out, of another size: edges are where they should be but for a part of a pixel."""
    assert of_the_box(box, camera(12), orbit(12)) == []
    for factor, word in ((0.95, "longer"), (1.05, "shorter")):
        (told,) = of_the_box(box, other_K(factor, factor), orbit(12))
        assert f"edges fit better with {word} ones" in told
    (told,) = of_the_box(box, other_K(1.0, 1.05), orbit(12))
    assert told.startswith("the photographs may be stretched: ")


def test_nothing_to_see_is_no_doubt() -> None:
    none = [ImageEdges.none()] * 4
    check = checked(none, camera(4), orbit(4), (SIZE, SIZE))
    assert not check.refuted
    assert check.camera is None
    assert check.doubts(names(4)) == []


def test_counts_are_of_samples(box: list[ImageEdges]) -> None:
    check = checked(box, camera(12), orbit(12), (SIZE, SIZE))
    for told in (check.left_out, check.images):
        assert bool((told.hits <= told.samples).all())
        assert bool((told.chance <= told.samples).all())
    small: Tensor = check.left_out.chance / check.left_out.samples
    assert float(small) < 0.1


@pytest.mark.parametrize(
    ("samples", "hits", "confirmed", "refuted"), [(1000, 60, False, True), (1000, 600, True, False), (100, 6, False, False)]
)
def test_few_samples_refute_nothing(samples: float, hits: float, confirmed: bool, refuted: bool) -> None:
    """Runs of ten samples, a twentieth of them at edges by chance."""
    told = Foretold(*(torch.tensor([float(n)], dtype=torch.float64) for n in (samples, hits, samples / 20, 10 * samples)))
    check = PoseCheck(1000, told, Foretold.none(4), None)
    assert (check.confirmed, check.refuted) == (confirmed, refuted)
    (line,) = check.doubts(names(4)) or [""]
    assert line.startswith("the poses do not fit the photographs" if refuted else "" if confirmed else "nothing confirms")
    assert all(check.image_doubts()) == refuted
