"""Cameras and curves of a sequence from its edges alone: a few frames at a time, these as a chain, then all together."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.bundle import RelativePosePrior
from torchsfm.geometry import Camera, rotation_angle
from torchsfm.reconstruction.curves.chains import Chain, chains
from torchsfm.reconstruction.curves.frames import Frames
from torchsfm.reconstruction.curves.from_edges import curves_of_edges
from torchsfm.reconstruction.curves.guess import agrees_with_motion, guess_by_motion
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.curves.mapping import (
    NEAR,
    CurveMapping,
    add_pieces,
    adjust,
    prune,
    register,
    sampled,
    settle,
    track,
)
from torchsfm.reconstruction.curves.windows import (
    all_windows,
    contradictions,
    focal_of,
    turns_of,
    windows_by_themselves,
    with_one_focal,
)
from torchsfm.reconstruction.evidence.doubt import DEVIATIONS
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.model.curves import Curves

FEWEST = 4
"""Frames of the shortest sequence."""
_TRIES = 3
"""Chains of windows from which a model is begun, the most."""
_NEARER = (4.0, 3.0)
"""Pixels between samples and the edges that show them, in one adjustment of a chain after the other."""
_GROWN = 1.3
"""All are adjusted when so many times the frames are placed."""
_GAP = 2
"""Frames are placed next to such that are no farther away."""
_MOST = 0.5
"""Of the frames that must be placed for no other start to be tried."""
_NEIGHBOURS = 6
"""Frames in which curves are sought in the end."""
_ROUGH = 5
"""Rounds of an adjustment on the way,"""
FINE = 10
"""and in the end."""
OPTIMISM = 4.0
"""Focal lengths by the edges of all frames are about so many times farther off than these say, in rendered sequences: what is
wrong alike in all frames, as by shades beside edges and outlines that hardly move, none of them tells."""
_LAST = 3
"""Times that samples are found anew in the end, the most,"""
_STILL = 0.1
"""while cameras turn by more degrees."""


class Settled(NamedTuple):
    """A model to which nothing more is added."""

    mapping: CurveMapping
    moved: float
    """Degrees by which cameras turned when samples were found anew for the last time."""
    apart: Float[Tensor, "v"]
    """Degrees by which the frames around each one, by themselves, see its camera turned; infinite where they do not tell."""
    told: "Expected"
    """The camera as few frames at a time say it is."""

    @property
    def still(self) -> bool:
        """Whether cameras stood when samples were found anew for the last time."""
        return self.moved < _STILL

    def zoomed(self) -> float | None:
        """The focal length over the one that few frames at a time say; None where these do not contradict it."""
        if "focal" not in self.told.free:
            return None
        ratio = float(self.mapping.camera.K[0, 0] / self.told.camera.K[0, 0])
        return ratio if abs(math.log(ratio)) > DEVIATIONS * self.told.sigma["focal"] else None


@dataclass(frozen=True)
class Expected:
    """What is known of the camera beforehand."""

    camera: Camera
    """Without distortion."""
    free: tuple[str, ...]
    """Numbers that are not known."""
    sigma: dict[str, float]
    """Standard deviations of these, the focal length's as a part of it."""
    turns: RelativePosePrior | None = None
    """What is known of how cameras are turned from frame to frame."""
    held: tuple[str, ...] = ()
    """Numbers that are not known either, but which no edges tell."""

    def told(self, focal: Float[Tensor, ""], sigma: float) -> "Expected":
        """The same when the focal length is found to such a part of it."""
        if "focal" not in self.free:
            return self
        K = self.camera.K.clone()
        K[:2, :2] *= focal / K[0, 0]
        return replace(self, camera=replace(self.camera, K=K), sigma={**self.sigma, "focal": sigma})

    def steady(self) -> "Expected":
        """The same with the focal length held: some of the frames tell it worse, and what they say misplaces others."""
        return replace(self, free=tuple(name for name in self.free if name != "focal"))

    def beside_edges(self) -> "Expected":
        """The same with the focal length as sure, beside the edges of all frames, as it is worth."""
        return replace(self, sigma={**self.sigma, "focal": self.sigma["focal"] / OPTIMISM}) if "focal" in self.free else self

    def terms(self, placed: Bool[Tensor, "v"] | None = None) -> dict[str, Any]:
        """What a bundle adjusts of the camera, and what is known of it and of frames that are placed."""
        priors = []
        if placed is not None and self.turns is not None:
            both = placed[self.turns.index].all(-1)
            priors = [replace(self.turns, index=self.turns.index[both], poses=self.turns.poses[both])]
        sigma = {name: self.sigma[name] for name in self.free}
        return {"free": self.free, "intrinsics_sigma": sigma, "intrinsics_mean": self.camera[(None,)], "priors": priors}


def map_sequence(frames: Frames, size: tuple[int, int], expected: Expected, progress: Progress) -> tuple[list[Settled], str]:
    """Cameras and curves of consecutive frames.

    Args:
        frames: Their edges, and the motion from each to the next.
        size: Height and width of the frames.
        expected: What is known of their camera.
        progress: Called as the work goes on.

    Returns:
        Models of frames that no two have in common, that of most frames first; or none, and why.
    """
    v = len(frames.edges)
    if v < FEWEST:
        return [], f"{v} frames: curves alone need {FEWEST}"
    frames = frames.seen_with(expected.camera.K)
    found = all_windows(frames, expected.camera.K, expected.sigma["focal"], progress)
    windows = [window for window in found if not window.found.refusal]
    if not windows:
        reasons = [window.found.refusal for window in found]
        return [], max(set(reasons), key=reasons.count)
    told = expected.told(*focal_of(windows))
    if "focal" in told.free:
        windows = with_one_focal(frames, windows, told.camera.K, progress)
    told = replace(told, turns=turns_of(windows))
    frames = frames.seen_with(told.camera.K)
    grown: list[CurveMapping] = []
    for chain in chains(windows)[:_TRIES]:
        if any(bool(other.registered[chain.begun()[0]].all()) for other in grown):
            continue
        begun = _begin(frames.edges, size, told.steady(), chain, progress)
        if not len(begun.curves):
            continue
        grown.append(_grow(begun, frames, chain, told.steady(), progress))
        if len(grown[-1].known) >= _MOST * v:
            break
    if not grown:
        return [], "no curves stay in one place"
    return [_together(one, frames, told, progress) for one in apart(grown)], ""


def apart(models: Sequence[CurveMapping]) -> list[CurveMapping]:
    """Models that share no frame: the one of most frames, of the others the one of most, and so on."""
    kept: list[CurveMapping] = []
    for one in sorted(models, key=lambda mapping: -len(mapping.known)):
        free = not any(bool((one.registered & other.registered).any()) for other in kept)
        if not kept or (free and len(one.known) >= FEWEST):
            kept.append(one)
    return kept


def _begin(
    edges: Sequence[ImageEdges], size: tuple[int, int], told: Expected, chain: Chain, progress: Progress
) -> CurveMapping:
    """A model of the frames of a chain of windows."""
    mapping = CurveMapping.start(edges, size, told.camera).placed(*chain.begun())
    for near in _NEARER:
        mapping = _anew(mapping, told, progress, near, rounds=_ROUGH)
    return mapping


def _anew(mapping: CurveMapping, known: Expected, progress: Progress, near: float = NEAR, *, rounds: int) -> CurveMapping:
    """The cameras adjusted to samples that are found anew.

    What was left out once may be right: where cameras are wrong, so are the samples that agree with them best. So samples are
    not given up one after the other while cameras move.
    """
    mapping = prune(track(sampled(mapping, progress, near), near), near)
    return adjust(mapping, known.terms(mapping.registered), near, rounds=rounds)


def _grow(mapping: CurveMapping, frames: Frames, chain: Chain, told: Expected, progress: Progress) -> CurveMapping:
    """Frame after frame, the nearest to those that are placed first."""
    v = len(mapping.edges)
    adjusted, failed = len(mapping.known), set[int]()
    while True:
        progress("map", len(mapping.known), v)
        away = (torch.arange(v)[:, None] - mapping.known).abs().amin(-1)
        waiting = [i for i in away.argsort(stable=True).tolist() if 0 < away[i] <= _GAP and i not in failed]
        if waiting:
            more = _next(mapping, waiting[0], frames, chain)
            if more is None:
                failed.add(waiting[0])
            else:
                mapping = add_pieces(more, waiting[0])
        count = len(mapping.known)
        if count > adjusted and (not waiting or count >= _GROWN * adjusted or count == v):
            # What did not fit may fit then.
            mapping, adjusted, failed = settle(mapping, told.terms(mapping.registered), rounds=_ROUGH), count, set()
        elif not waiting:
            return mapping


def _next(mapping: CurveMapping, view: int, frames: Frames, chain: Chain) -> CurveMapping | None:
    """The model with one more frame, if that is found and what moves does not contradict it."""
    carried = chain.carried(view, mapping.known, mapping.poses)
    more = register(mapping, view, (carried, guess_by_motion(mapping, view, frames)))
    if more is None or not len(frames.motion):
        return more
    right = agrees_with_motion(more, view, frames)
    # What neither a window nor the motion tells is found next to edges anywhere.
    return more if right or (right is None and carried is not None) else None


def _together(mapping: CurveMapping, frames: Frames, told: Expected, progress: Progress) -> Settled:
    """All cameras, from samples that are found anew."""
    views, known = mapping.known, told.beside_edges()
    mapping = _anew(mapping, known, progress, rounds=_ROUGH)
    for _ in range(_LAST):
        before, mapping = mapping, _anew(mapping, known, progress, rounds=FINE)
        turned = before.poses.R[views].mT @ mapping.poses.R[views]
        moved = float(rotation_angle(turned @ turned[len(views) // 2].mT).rad2deg().amax())
        if moved < _STILL:
            break
    seen = frames._replace(edges=[sight.edges for sight in mapping.sights])
    alone = windows_by_themselves(seen.seen_with(told.camera.K), told.camera.K)
    return Settled(prune(mapping), moved, contradictions(alone, mapping.poses, mapping.registered), told)


def all_curves(mapping: CurveMapping, progress: Progress) -> Curves:
    """The curves that the edges of all placed frames are images of."""
    known = mapping.known
    edges = [mapping.edges[i] for i in known.tolist()]
    cameras, poses = mapping.one_camera[known], mapping.poses[known]
    curves = curves_of_edges(
        edges, mapping.size, cameras, poses, points=mapping.curves.X, neighbours=_NEIGHBOURS, progress=progress
    )
    return replace(curves, view=known[curves.view])
