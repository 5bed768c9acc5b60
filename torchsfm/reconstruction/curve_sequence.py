"""Cameras and curves of a sequence from its edges alone: a few frames at first, then one after the other, then all together."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypedDict

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Camera, Curve, rotation_angle
from torchsfm.images import Edges, track_curves
from torchsfm.reconstruction.curve_mapping import CurveMapping, add_pieces, prune, register, settle, track
from torchsfm.reconstruction.curve_start import FirstCameras, first_cameras
from torchsfm.reconstruction.curves import curves_of_edges, no_curves
from torchsfm.reconstruction.image_edges import ImageEdges
from torchsfm.reconstruction.model_curves import Curves
from torchsfm.reconstruction.report import Progress


class Ends(TypedDict):
    """When an adjustment ends; see `adjust`."""

    tolerance: float
    iterations: int


FEWEST = 4
"""Frames of the shortest sequence."""
_FIRST = 5
"""Frames of the start."""
_TRIES = 5
"""Places in the sequence where one is looked for."""
_LENGTH = 30.0
"""Shortest curves that are followed, in pixels."""
_CURVES = 100
"""Most of them."""
_GROWN = 1.3
"""All are adjusted when so many times the frames are placed."""
_GAP = 2
"""Frames are placed next to such that are no farther away."""
_LINKED = 2.0
"""Pixels between the ends of a closed chain, the most."""
_MOST = 0.5
"""Of the frames that must be placed for no other start to be tried."""
_NEIGHBOURS = 6
"""Frames in which curves are sought in the end."""
_ROUGH: Ends = {"tolerance": 1e-4, "iterations": 15}
"""When to end an adjustment on the way,"""
_FINE: Ends = {"tolerance": 1e-6, "iterations": 40}
"""and in the end."""
_LAST = 8
"""Times that cameras are adjusted then, and samples given up, the most,"""
_TOLD = 0.02
"""Standard deviation of the focal length, as a part of it, when a few frames are asked whether they agree."""
_STILL = 0.1
"""while cameras turn by more degrees."""


class Settled(NamedTuple):
    """A model to which nothing more is added."""

    mapping: CurveMapping
    moved: float
    """Degrees by which cameras turned the last time that samples were given up."""
    apart: Float[Tensor, "v"]
    """Degrees by which the frames around each one, by themselves, see its camera turned; infinite where they do not tell."""


@dataclass(frozen=True)
class Expected:
    """What is known of the camera beforehand."""

    camera: Camera
    """Without distortion."""
    free: tuple[str, ...]
    """Numbers that are not known."""
    sigma: dict[str, float]
    """Standard deviations of these, the focal length's as a part of it."""

    def terms(self, *, lens: bool) -> dict[str, Any]:
        """What a bundle adjusts, the lens' distortion or only the focal length."""
        free = self.free if lens else tuple(name for name in self.free if name == "focal")
        sigma = {name: self.sigma[name] for name in free if name in self.sigma}
        return {"free": free, "intrinsics_sigma": sigma, "intrinsics_mean": self.camera[(None,)]}


def map_sequence(
    edges: Sequence[ImageEdges], size: tuple[int, int], expected: Expected, progress: Progress
) -> tuple[Settled | None, str]:
    """Cameras and curves of consecutive frames.

    Args:
        edges: Of each frame.
        size: Height and width of the frames.
        expected: What is known of their camera.
        progress: Called as the work goes on.

    Returns:
        The model; or None, and why there is none.
    """
    v = len(edges)
    if v < FEWEST:
        return None, f"{v} frames: curves alone need {FEWEST}"
    best: CurveMapping | None = None
    reasons: list[str] = []
    for views in _windows(v):
        begun, refusal = _begin(edges, size, expected, views)
        if begun is None:
            reasons.append(refusal)
            continue
        grown = _grow(begun, expected, progress)
        if best is None or len(grown.known) > len(best.known):
            best = grown
        if len(best.known) >= _MOST * v:
            break
    if best is None:
        return None, max(set(reasons), key=reasons.count)
    return _together(best, expected, progress), ""


def _windows(v: int) -> Iterator[Int[Tensor, "w"]]:
    """Runs of frames to start with: the middle ones, then others."""
    width = min(_FIRST, v)
    firsts = dict.fromkeys(round(share * (v - width)) for share in (0.5, 0.25, 0.75, 0.0, 1.0, 0.375, 0.625))
    for first in list(firsts)[:_TRIES]:
        yield torch.arange(first, first + width)


def _begin(
    edges: Sequence[ImageEdges], size: tuple[int, int], expected: Expected, views: Tensor
) -> tuple[CurveMapping | None, str]:
    """A model of a few frames, or why there is none."""
    K = expected.camera.K
    first = _first(edges, K, expected.sigma["focal"], views)
    if first.refusal:
        return None, first.refusal
    zoomed = K.clone()
    zoomed[:2, :2] *= first.focal / K[0, 0]
    camera = replace(expected.camera, K=zoomed if "focal" in expected.free else K)
    mapping = CurveMapping.start(edges, size, camera).placed(views, first.poses)
    for view in views.tolist():
        mapping = add_pieces(mapping, view)
    for _ in range(2):
        mapping = settle(mapping, expected.terms(lens=False), **_ROUGH)
    if not len(mapping.curves):
        return None, "no curves stay in one place"
    return mapping, ""


def _first(edges: Sequence[ImageEdges], K: Tensor, sigma: float, views: Tensor) -> FirstCameras:
    """Cameras of a few frames by what is followed through them."""
    tracked = track_curves(as_edges([edges[i] for i in views.tolist()]), min_length=_LENGTH, max_curves=_CURVES).curves
    curves = Curve(tracked.x.double(), tracked.valid, tracked.closed)
    return first_cameras(curves, len(views) // 2, K[0, 0], K[:2, 2], sigma)


def _contradictions(mapping: CurveMapping) -> Float[Tensor, "v"]:
    """Degrees by which the frames around each, by themselves, see its camera turned; infinite where they do not tell."""
    v = len(mapping.edges)
    apart = torch.full((v,), torch.inf, dtype=torch.float64)
    for first in sorted({*range(0, max(v - _FIRST, 0) + 1, _FIRST - 1), max(v - _FIRST, 0)}):
        views = torch.arange(first, min(first + _FIRST, v))
        if not bool(mapping.registered[views].all()):
            continue
        edges = [sight.edges for sight in mapping.sights]
        alone = _first(edges, mapping.camera.K, _TOLD, views)
        if alone.refusal:
            continue
        R = mapping.poses.R[views]
        off = rotation_angle(alone.poses.R @ (R @ R[len(views) // 2].mT).mT).rad2deg().amax()
        before = apart[views]
        apart[views] = torch.where(before.isfinite(), torch.maximum(before, off), off)
    return apart


def _grow(mapping: CurveMapping, expected: Expected, progress: Progress) -> CurveMapping:
    """Frame after frame, the nearest to those that are placed first."""
    v = len(mapping.edges)
    adjusted, failed = len(mapping.known), set[int]()
    while True:
        progress("map", len(mapping.known), v)
        away = (torch.arange(v)[:, None] - mapping.known).abs().amin(-1)
        waiting = [i for i in away.argsort(stable=True).tolist() if 0 < away[i] <= _GAP and i not in failed]
        if waiting:
            more = register(mapping, waiting[0])
            if more is None:
                failed.add(waiting[0])
            else:
                mapping = add_pieces(more, waiting[0])
        count = len(mapping.known)
        if count > adjusted and (not waiting or count >= _GROWN * adjusted or count == v):
            # What did not fit may fit then.
            mapping, adjusted, failed = settle(mapping, expected.terms(lens=False), **_ROUGH), count, set()
        elif not waiting:
            return mapping


def _together(mapping: CurveMapping, expected: Expected, progress: Progress) -> Settled:
    """All cameras, from samples that are found anew."""
    known = mapping.known
    mapping = mapping.with_curves(no_curves(mapping.poses.R))
    for done, view in enumerate(known.tolist()):
        progress("curves", done, len(known))
        mapping = add_pieces(mapping, view)
    progress("curves", len(known), len(known))
    mapping = prune(track(mapping))
    for _ in range(_LAST):
        before, mapping = mapping, settle(mapping, expected.terms(lens=True), **_FINE)
        turned = before.poses.R[known].mT @ mapping.poses.R[known]
        moved = float(rotation_angle(turned @ turned[len(known) // 2].mT).rad2deg().amax())
        if moved < _STILL:
            break
    return Settled(mapping, moved, _contradictions(mapping))


def all_curves(mapping: CurveMapping, progress: Progress) -> Curves:
    """The curves that the edges of all placed frames are images of."""
    known = mapping.known
    edges = [mapping.edges[i] for i in known.tolist()]
    cameras, poses = mapping.one_camera[known], mapping.poses[known]
    curves = curves_of_edges(
        edges, mapping.size, cameras, poses, points=mapping.curves.X, neighbours=_NEIGHBOURS, progress=progress
    )
    return replace(curves, view=known[curves.view])


def as_edges(found: Sequence[ImageEdges]) -> Edges:
    """The edges of frames as `track_curves` takes them."""
    n = max(1, *(len(own) for own in found))

    def slots(rows: Iterable[Tensor], empty: int = 0) -> Tensor:
        return torch.stack([torch.cat((r, r.new_full((n - len(r), *r.shape[1:]), empty))) for r in rows])

    x, normal, sigma, curvature = (slots(getattr(own, name) for own in found) for name in ("x", "normal", "sigma", "curvature"))
    chain, closed = slots((own.chain for own in found), -1), slots(_closed(own) for own in found)
    none = sigma.new_zeros(len(found))
    return Edges(x, -normal, sigma, torch.zeros_like(sigma), curvature, chain, closed, chain >= 0, none, none.long())


def _closed(own: ImageEdges) -> Bool[Tensor, "n"]:
    """Whether each edge point's chain ends next to where it begins."""
    if not len(own):
        return own.chain > 0
    _, index, number = torch.unique_consecutive(own.chain, return_inverse=True, return_counts=True)
    last = number.cumsum(0) - 1
    gap = torch.linalg.vector_norm(own.x[last] - own.x[last - number + 1], dim=-1)
    closed: Tensor = (gap < _LINKED) & (number > 2 * _LINKED)
    return closed[index]
