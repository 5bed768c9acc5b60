"""Windows of a few frames: what they agree on, chains of them in one world, and models that contradict them."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import Camera, Pose, Similarity, intrinsics, rotation_angle, rotation_from_rotvec
from torchsfm.geometry.distortion import Radial
from torchsfm.images import read_image
from torchsfm.reconstruction.curves.chains import chains
from torchsfm.reconstruction.curves.frames import Frames
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.curves.mapping import CurveMapping
from torchsfm.reconstruction.curves.sequence import Expected, Settled, apart
from torchsfm.reconstruction.curves.start import FirstCameras
from torchsfm.reconstruction.curves.windows import WIDTH, Window, contradictions, focal_of, telling, turns_of, window_at

F64 = torch.float64
FRAMES = 13
K = intrinsics(torch.tensor(400.0, dtype=F64), torch.tensor([199.5, 149.5], dtype=F64))


def arc(frames: int = FRAMES) -> Pose:
    """Cameras around the origin, five units away."""
    turn = math.radians(4.0) * torch.arange(frames, dtype=F64)[:, None] * torch.tensor([0.1, 1.0, 0.2], dtype=F64)
    t = torch.tensor([0.0, 0.0, 5.0], dtype=F64) + 0.1 * torch.stack([(turn[:, 1] * k).sin() for k in (2, 3, 4)], -1)
    return Pose(rotation_from_rotvec(turn), t)


def window(first: int, poses: Pose, X: Tensor, generator: torch.Generator, focal: float = 400.0) -> Window:
    """What these frames would say, in the world of their middle camera and a unit of their own."""
    views = torch.arange(first, first + WIDTH)
    middle = poses[first + WIDTH // 2]
    own = Similarity(0.1 + torch.rand((), dtype=F64, generator=generator), middle.R, middle.t)
    own = replace(own, t=own.scale * own.t)
    found = FirstCameras(own.transform_pose(poses[views]), torch.tensor(focal, dtype=F64), own.transform(X), "")
    return Window(views, found)


@pytest.fixture
def X(generator: torch.Generator) -> Tensor:
    return 2 * torch.rand(300, 3, dtype=F64, generator=generator) - 1


def test_windows_that_overlap_are_one_chain(X: Tensor, generator: torch.Generator) -> None:
    poses = arc()
    windows = [window(first, poses, X, generator) for first in (0, 2, 3, 5, 7, 8)]
    (chain,) = chains(windows)
    assert chain.views.tolist() == list(range(FRAMES))
    # The frames at both ends are those of one window each, and farthest from its middle.
    assert chain.begun()[0].tolist() == list(range(1, FRAMES - 1))
    middle = windows[0].found.poses
    scale = torch.linalg.vector_norm(middle.centre[1] - middle.centre[0]) / torch.linalg.vector_norm(
        poses.centre[1] - poses.centre[0]
    )
    world = Similarity(scale, poses.R[2], scale * poses.t[2])
    truth = world.transform_pose(poses)
    assert torch.allclose(chain.poses.R, truth.R, atol=1e-9)
    assert torch.allclose(chain.poses.t, truth.t, atol=1e-9)
    # In another world a frame that is not known there is where it is from the nearest that is.
    known = torch.arange(3, FRAMES - 2)
    guess = chain.carried(0, known, truth)
    assert guess is not None
    assert torch.allclose(guess.matrix(), truth[:1].matrix(), atol=1e-9)
    assert chain.carried(FRAMES, known, truth) is None


def test_a_chain_ends_where_windows_share_too_little_or_contradict_each_other(X: Tensor, generator: torch.Generator) -> None:
    poses = arc()
    apart = [window(first, poses, X, generator) for first in (0, 4, 6, 8)]
    assert [chain.begun()[0].tolist() for chain in chains(apart)] == [list(range(5, 12)), list(range(5))]
    shaken = 0.1 * torch.randn(WIDTH, 3, dtype=F64, generator=generator)
    wrong = apart[2].found.poses
    wrong = replace(apart[2].found, poses=Pose(rotation_from_rotvec(shaken) @ wrong.R, wrong.t))
    torn = [apart[1], Window(apart[2].views, wrong), apart[3]]
    assert [len(chain.begun()[0]) for chain in chains(torn)] == [WIDTH] * 3
    right = [window(first, poses, X, generator) for first in (0, 2, 4, 6, 8)]
    longest, other = chains([*right[:4], torn[1], right[4]])
    assert longest.begun()[0].tolist() == [1, 2, 3, 4, 5, 11]
    assert len(other.begun()[0]) == WIDTH
    nowhere = replace(apart[2].found, X=X[:0])
    assert len(chains([apart[1], Window(apart[2].views, nowhere)])) == 2


def test_turns_of_windows_hold_the_frames_that_are_placed(X: Tensor, generator: torch.Generator) -> None:
    """How sure they are is what windows that overlap agree on; what one has wrong lets go."""
    poses = arc()
    noise = math.radians(0.5)

    def shaken(one: Window) -> Window:
        found = one.found.poses
        turn = rotation_from_rotvec(noise * torch.randn(WIDTH, 3, dtype=F64, generator=generator))
        return Window(one.views, replace(one.found, poses=Pose(turn @ found.R, found.t)))

    windows = [shaken(window(first, poses, X, generator)) for first in range(FRAMES - WIDTH + 1)]
    turns = turns_of(windows)
    assert len(turns.index) == (WIDTH - 1) * len(windows)
    first, second = turns.index.unbind(1)
    off = rotation_angle(turns.poses.R @ (poses.R[second] @ poses.R[first].mT).mT)
    # Of both frames' noise, three numbers each.
    assert off.square().mean().sqrt() == pytest.approx(math.sqrt(6) * noise, rel=0.3)
    assert turns.sigma[:3] == pytest.approx(torch.full((3,), math.sqrt(2) * noise), rel=0.3)
    assert bool(turns.sigma[3:].isinf().all())
    placed = torch.arange(FRAMES) < 6
    zero = torch.zeros((), dtype=F64)
    expected = Expected(Camera(K, Radial(zero, zero)), ("focal",), {"focal": 0.5}, turns)
    (kept,) = expected.terms(placed)["priors"]
    assert len(kept.index) > 0
    assert bool((kept.index < 6).all())
    assert expected.terms()["priors"] == []
    one = turns_of(windows[:1])
    assert one.sigma[0] == pytest.approx(math.radians(1.0))


def test_the_focal_length_of_windows(X: Tensor, generator: torch.Generator) -> None:
    poses = arc()
    zooms = 1 + 0.1 * torch.randn(9, dtype=F64, generator=generator)
    zooms[3] = 3.0
    focal, sigma = focal_of([window(i, poses, X, generator, 400 * float(zoom)) for i, zoom in enumerate(zooms)])
    assert abs(float(focal) / 400 - 1) < 4 * sigma
    assert 0.02 <= sigma < 0.2
    assert focal_of([window(0, poses, X, generator)])[1] == 0.02


def test_frames_that_a_model_turns_otherwise_are_told(X: Tensor, generator: torch.Generator) -> None:
    poses = arc()
    windows = [window(first, poses, X, generator) for first in (0, 4)]
    there = torch.ones(FRAMES, dtype=torch.bool)
    apart = contradictions(windows, poses, there)
    assert apart[:9].amax() < 1e-5
    assert bool(apart[9:].isinf().all())
    bent = poses.R.clone()
    bent[6] = rotation_from_rotvec(torch.tensor([0.0, math.radians(3.0), 0.0], dtype=F64)) @ bent[6]
    apart = contradictions(windows, Pose(bent, poses.t), there)
    assert apart[:4].amax() < 1e-5
    assert torch.allclose(apart[4:9], torch.full((5,), 3.0, dtype=F64), atol=1e-6)
    refused = Window(windows[0].views, replace(windows[0].found, refusal="why"))
    assert bool(contradictions([refused], poses, there).isinf().all())


@pytest.mark.parametrize(("ratio", "said"), [(1.05, None), (0.86, 0.86), (1.2, 1.2)])
def test_a_focal_length_that_windows_contradict_is_told(ratio: float, said: float | None) -> None:
    zero = torch.zeros((), dtype=F64)
    camera = Camera(K, Radial(zero, zero))
    mapping = CurveMapping.start([], (300, 400), camera)
    expected = Expected(camera, ("focal", "k1", "k2"), {"focal": 0.5}).told(K[0, 0] / ratio, 0.025)
    settled = Settled(mapping, 0.0, zero[None], expected)
    assert settled.zoomed() == (said and pytest.approx(said))
    given = replace(expected, free=())
    assert settled._replace(told=given).zoomed() is None


def test_a_window_of_a_real_turntable_by_a_long_lens(data: Path) -> None:
    folder = data / "images" / "temple_ring"
    rows = {name: numbers for name, *numbers in map(str.split, (folder / "templeR_par.txt").read_text().splitlines()[1:])}
    names = [f"templeR{k:04d}.png" for k in range(23, 28)]
    numbers = torch.tensor([[float(n) for n in rows[name]] for name in names], dtype=F64)
    R = numbers[:, 9:18].unflatten(1, (3, 3))
    edges = [ImageEdges.of(read_image(folder / name).pixels) for name in names]
    guess = intrinsics(torch.tensor(768.0, dtype=F64), torch.tensor([319.5, 239.5], dtype=F64))
    # The focal length is twice the expected one; in a short window all that is far is almost seen in parallel.
    found = window_at(Frames(edges), 0, guess, 0.5).found
    assert found.refusal == ""
    assert rotation_angle(found.poses.R @ (R @ R[2].mT).mT).rad2deg().max() < 1.0
    assert abs(math.log(float(found.focal / numbers[0, 0]))) < 0.1


def test_models_share_no_frame() -> None:
    camera = Camera(K, Radial(K.new_zeros(()), K.new_zeros(())))
    nothing = CurveMapping.start([ImageEdges.none()] * 20, (300, 400), camera)
    poses = Pose.identity(20, dtype=F64)
    models = [
        nothing.placed(torch.tensor(views), poses[: len(views)])
        for views in ([12, 13, 14, 15], [*range(9)], [8, 9, 10, 11, 16], [17, 18, 19])
    ]
    assert [one.known.tolist() for one in apart(models)] == [[*range(9)], [12, 13, 14, 15]]
    assert [len(one.known) for one in apart(models[3:])] == [3]
    assert apart([]) == []


def test_frames_at_the_ends_that_show_too_little_are_left_out() -> None:
    assert telling([9, 9, 9, 9, 9]) == (0, 5)
    assert telling([2, 9, 9, 9, 1]) == (1, 4)
    assert telling([2, 9, 9, 7, 8]) == (1, 5)
    # What is beyond a frame that shows too little is not linked to the middle; of two frames nothing is told.
    assert telling([9, 1, 9, 9, 9]) == (2, 5)
    assert telling([9, 1, 9, 9, 1]) == (0, 5)
    assert telling([1, 1, 3, 1, 1]) == (0, 5)
