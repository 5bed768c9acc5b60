"""Chains of windows: cameras of all frames of windows that overlap and agree, in one world."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Pose, Similarity, rotation_angle
from torchsfm.linalg import nearest_rotation
from torchsfm.reconstruction.curves.windows import ONE_TURN, WIDTH, Window, shared_poses

_SHARED = WIDTH // 2 + 1
"""Frames that two windows of a chain share, at least: the middle one of each is among them."""
_BESIDE = 4.0
"""Pixels between samples of two windows that are on the same edge."""
_FEWEST = 20
"""Such samples that tell their scale."""


@dataclass(frozen=True)
class Chain:
    """Cameras of all frames of windows that overlap, in one world."""

    views: Int[Tensor, "k"]
    poses: Pose
    sure: Bool[Tensor, "k"]
    """Frames about which windows do not contradict each other, and of which not only the end of one tells."""

    def begun(self) -> tuple[Int[Tensor, "s"], Pose]:
        """The frames that are sure; all where these are too few."""
        there = self.sure if int(self.sure.sum()) >= WIDTH else torch.ones_like(self.sure)
        return self.views[there], self.poses[there]

    def carried(self, view: int, known: Int[Tensor, "n"], poses: Pose) -> Pose | None:
        """Where a frame is, seen from the nearest of those whose poses are known elsewhere; None where it tells of none."""
        own = (self.views == view).nonzero()[:, 0]
        near = torch.isin(self.views, known).nonzero()[:, 0]
        if not len(own) or not len(near):
            return None
        a = near[(self.views[near] - view).abs().argmin()]
        return self.poses[own] @ self.poses[a].inverse() @ poses[int(self.views[a])]


def chains(windows: Sequence[Window]) -> list[Chain]:
    """Cameras of windows that overlap and agree, the longest chain first.

    Args:
        windows: In the order of their frames, no two of the same, all with an answer.
    """
    placed: list[_Placed] = []
    contested = set[int]()
    for k, window in enumerate(windows):
        own = None
        # Of windows in order, only so many can share a frame with one.
        for before in reversed(placed[max(k - WIDTH, 0) :]):
            turn = _turn(window, before.window)
            if turn.off > ONE_TURN:
                contested |= {*window.views.tolist()} & {*before.window.views.tolist()}
            elif own is None and turn.off <= ONE_TURN and (step := _step(window, before.window, turn.R)) is not None:
                own = _Placed(window, before.chain, _after(before.world, step))
        placed.append(own or _Placed(window, k, _nowhere(window.found.poses)))
    runs = [[one for one in placed if one.chain == k] for k in dict.fromkeys(one.chain for one in placed)]
    return sorted((_joined(run, contested) for run in runs), key=lambda chain: -len(chain.begun()[0]))


class _Placed(NamedTuple):
    window: Window
    chain: int
    """Number of the window with which its chain begins."""
    world: Similarity
    """To that one's world from the window's own."""


def _nowhere(like: Pose) -> Similarity:
    """A world as it is."""
    return Similarity(like.t.new_ones(()), torch.eye(3, dtype=like.t.dtype), like.t.new_zeros(3))


def _joined(run: Sequence[_Placed], contested: set[int]) -> Chain:
    """Each frame as the window has it whose middle it is nearest to; the end of a single window is not sure of a frame."""
    frames: dict[int, tuple[int, Pose]] = {}
    confirmed = set[int]()
    for window, _, world in run:
        poses = world.transform_pose(window.found.poses)
        for k, view in enumerate(window.views.tolist()):
            away = abs(view - window.middle)
            if view in frames or away < WIDTH // 2:
                confirmed.add(view)
            if view not in frames or away < frames[view][0]:
                frames[view] = away, poses[k]
    views = sorted(frames)
    poses = Pose(*(torch.stack([getattr(frames[i][1], name) for i in views]) for name in ("R", "t")))
    return Chain(torch.tensor(views), poses, torch.tensor([i in confirmed - contested for i in views]))


class _Turn(NamedTuple):
    R: Float[Tensor, "3 3"]
    """From the world of a window to that of one before it."""
    off: float
    """Degrees by which a frame that both share departs from it; NaN where they share too few."""


def _turn(window: Window, before: Window) -> _Turn:
    """How one window's world is turned in another's."""
    a, b = shared_poses(window, before)
    if len(a.R) < _SHARED:
        return _Turn(torch.eye(3, dtype=a.R.dtype), math.nan)
    turns = b.R.mT @ a.R
    R = nearest_rotation(turns.mean(0))
    return _Turn(R, float(rotation_angle(turns @ R.mT).rad2deg().amax()))


def _step(window: Window, before: Window, R: Float[Tensor, "3 3"]) -> Similarity | None:
    """From the world of a window to that of one before it, which it is turned against; None where nothing tells its size."""
    scale = _scale(window, before)
    if scale is None:
        return None
    a, b = shared_poses(window, before)
    return Similarity(scale, R, (b.centre - scale * a.centre @ R.mT).mean(0))


def _scale(window: Window, before: Window) -> Float[Tensor, ""] | None:
    """How much larger the world of the window before is, by the depths of samples that are seen on the same edges."""
    looks = []
    for one in (window, before):
        Y = one.found.poses[int((one.views == window.middle).nonzero()[0, 0])].transform(one.found.X)
        Y = Y[Y[:, 2] > 0]
        looks.append((one.found.focal * Y[:, :2] / Y[:, 2:], Y[:, 2]))
    (x, depth), (y, other) = looks
    if not len(x) or not len(y):
        return None
    gap, nearest = torch.cdist(x, y).min(1)
    same = gap < _BESIDE
    if int(same.sum()) < _FEWEST:
        return None
    return (other[nearest][same] / depth[same]).median()


def _after(outer: Similarity, inner: Similarity) -> Similarity:
    """One map, then the other."""
    return Similarity(outer.scale * inner.scale, outer.R @ inner.R, outer.transform(inner.t[None])[0])
