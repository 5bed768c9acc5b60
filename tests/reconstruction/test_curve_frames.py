"""Frames between which much moves: their windows by the motion of what is at edges, which are refused without it."""

import math
from dataclasses import replace

import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry import Camera, Pose, intrinsics, project_points, rotation_angle, rotation_from_rotvec
from torchsfm.geometry.distortion import Radial
from torchsfm.images import detect_motion
from torchsfm.reconstruction.curves.frames import Frames, as_motion, turns_between
from torchsfm.reconstruction.curves.guess import agrees_with_motion, guess_by_motion
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.curves.mapping import CurveMapping
from torchsfm.reconstruction.curves.windows import window_at
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.simulation import paint_shapes

F64 = torch.float64
V, ROWS, COLUMNS = 5, 4, 6
HEIGHT, WIDTH = 240, 320
K = intrinsics(torch.tensor(360.0, dtype=F64), torch.tensor([159.5, 119.5], dtype=F64))
MOVE = 0.9
"""From a frame to the next: 54 pixels where 48 are from a shape to the next one."""


class Scene:
    """Flat shapes without a corner in a grid, each in a plane and at a depth of its own; the camera goes sideways and turns."""

    def __init__(self, generator: torch.Generator) -> None:
        def rand(*shape: int) -> Tensor:
            return 2 * torch.rand(*shape, dtype=F64, generator=generator) - 1

        n = ROWS * COLUMNS
        t = torch.arange(72, dtype=F64) * (2 * math.pi / 72)
        r = 0.3 * (1 + 0.12 * (2 * t + 3 * rand(n, 1)).cos() + 0.05 * (3 * t + 3 * rand(n, 1)).cos())
        flat = torch.stack((r * t.cos(), r * t.sin(), 0 * r), -1)
        cell = torch.stack((torch.arange(n) % COLUMNS, torch.arange(n) // COLUMNS), -1).to(F64)
        place = 0.8 * (cell - torch.tensor([(COLUMNS - 1) / 2, (ROWS - 1) / 2], dtype=F64))
        shift = torch.cat((place, 0.8 * rand(n, 1)), -1)[:, None]
        self.shapes = flat @ rotation_from_rotvec(0.5 * rand(n, 3)).mT + shift
        k = torch.arange(V, dtype=F64)[:, None] - V // 2
        turn = math.radians(3.0) * k * torch.tensor([0.3, 1.0, 0.0], dtype=F64)
        R = rotation_from_rotvec(turn + 0.01 * rand(V, 3))
        along = torch.tensor([MOVE, 0.0, 0.0], dtype=F64)
        self.poses = Pose(R, torch.tensor([0.0, 0.0, 6.0], dtype=F64) + k * along + 0.1 * rand(V, 3))
        x = project_points(K @ self.poses.matrix(), self.shapes.flatten(0, 1)).unflatten(1, (n, -1))
        grey = torch.cat((torch.tensor([0.5], dtype=F64), 0.5 + 0.1 * rand(n).sign() + 0.35 * rand(n)))
        clean = torch.stack([paint_shapes(list(shapes), grey, width=WIDTH, height=HEIGHT, fine=3) for shapes in x])
        images = (clean + 0.005 * torch.randn(clean.shape, dtype=F64, generator=generator)).float()
        self.frames = Frames([ImageEdges.of(image) for image in images], detect_motion(images))

    def turned(self, R: Tensor) -> Tensor:
        """By how many degrees rotations from one frame to the next are wrong."""
        return rotation_angle(R @ (self.poses.R[1:] @ self.poses.R[:-1].mT).mT).rad2deg()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(seeded())


def test_a_window_between_whose_frames_much_moves(scene: Scene) -> None:
    found = window_at(scene.frames.seen_with(K), 0, K, 0.1)
    assert found.found.refusal == ""
    R = found.found.poses.R
    assert scene.turned(R[1:] @ R[:-1].mT).max() < 0.5
    # Curves that are sought where they were are others, or none.
    assert window_at(Frames(scene.frames.edges), 0, K, 0.1).found.refusal


def test_rotations_from_one_frame_to_the_next(scene: Scene) -> None:
    turns = turns_between(*scene.frames[:2], K)
    assert len(turns) == V - 1
    assert scene.turned(torch.stack([turn.R for turn in turns if turn is not None])).max() < 3.0
    # Where nothing is sure, nothing is told, and nothing is begun from it.
    one = scene.frames.motion[1]
    blind = [*scene.frames.motion[:1], replace(one, sure=one.sure & False), *scene.frames.motion[2:]]
    frames = Frames(scene.frames.edges, blind).seen_with(K)
    assert [turn is None for turn in frames.turns] == [False, True, False, False]
    assert frames.starts(torch.arange(V)) is None
    assert frames.starts(torch.arange(2, V)) is not None
    # What is saved and loaded is the same.
    saved = {name: torch.stack([getattr(motion, name) for motion in scene.frames.motion]) for name in ("shift", "sure")}
    assert torch.equal(as_motion(saved)[2].shift, scene.frames.motion[2].shift)


def test_a_guess_where_the_next_camera_is(scene: Scene) -> None:
    camera = Camera(K, Radial(K.new_zeros(()), K.new_zeros(())))
    X = scene.shapes.flatten(0, 1)
    curve = torch.arange(len(scene.shapes)).repeat_interleave(scene.shapes.shape[1])
    closed = torch.ones(len(scene.shapes), dtype=torch.bool)
    none = curve[:0]
    mapping = CurveMapping.start(scene.frames.edges, (HEIGHT, WIDTH), camera).placed(torch.tensor([1, 2]), scene.poses[1:3])
    curves = Curves(X, curve, closed, X, X[:, 0], X[:0, :2], X[:0, :2], X[:0, 0], X[:0, 0], none, none)
    mapping = mapping.with_curves(curves, torch.full_like(curve, 2))
    guess = guess_by_motion(mapping, 3, scene.frames)
    assert guess is not None
    assert rotation_angle(guess.R[0] @ scene.poses.R[3].mT).rad2deg() < 1.0
    back = guess_by_motion(mapping.with_curves(curves, torch.full_like(curve, 1)), 0, scene.frames)
    assert back is not None
    assert rotation_angle(back.R[0] @ scene.poses.R[0].mT).rad2deg() < 1.0
    # No neighbour is placed; nothing of it is in the model; no motion is known.
    assert guess_by_motion(mapping, 4, scene.frames) is None
    assert guess_by_motion(mapping, 0, scene.frames) is None
    assert guess_by_motion(mapping, 3, Frames(scene.frames.edges)) is None


def test_poses_that_the_motion_contradicts(scene: Scene) -> None:
    camera = Camera(K, Radial(K.new_zeros(()), K.new_zeros(())))
    frames = scene.frames.seen_with(K)
    mapping = CurveMapping.start(frames.edges, (HEIGHT, WIDTH), camera).placed(torch.arange(3), scene.poses[:3])
    assert agrees_with_motion(mapping, 2, frames)
    assert agrees_with_motion(mapping.placed(torch.tensor([3]), scene.poses[3:4]), 3, frames)
    turn = Pose(rotation_from_rotvec(torch.tensor([[0.1, 0.0, 0.0]], dtype=F64)), torch.zeros(1, 3, dtype=F64))
    assert agrees_with_motion(mapping.placed(torch.tensor([3]), turn @ scene.poses[3:4]), 3, frames) is False
    assert agrees_with_motion(mapping.placed(torch.tensor([4]), scene.poses[4:]), 4, frames) is None
    assert agrees_with_motion(mapping, 2, Frames(frames.edges)) is None
