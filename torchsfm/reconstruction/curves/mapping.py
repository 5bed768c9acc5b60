"""A growing model of cameras and curves: samples of curves in space, and the edges of the frames that show them."""

from collections.abc import Mapping as Named
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import BundleCovariance, bundle_adjust, bundle_covariance
from torchsfm.bundle.curves import edge_distances
from torchsfm.geometry import BundleProblem, Camera, Pose, rotation_from_rotvec, rotvec_from_rotation
from torchsfm.images.edge_field import EdgeField, edge_field
from torchsfm.reconstruction.curves.directions import across_own_curves, own_directions
from torchsfm.reconstruction.curves.edge_maps import EdgePoints, MapsOfImages
from torchsfm.reconstruction.curves.from_edges import no_curves
from torchsfm.reconstruction.curves.fusion import count_different, near_pairs
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.curves.noise import TRUSTED, edge_loss, usual_distance, weights_in_a_bundle
from torchsfm.reconstruction.curves.outlines import on_outlines
from torchsfm.reconstruction.curves.pieces import image_pieces
from torchsfm.reconstruction.curves.resection import Resection, pose_from_edges
from torchsfm.reconstruction.curves.tracks import track_samples
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.model.curves import Curves

NEAR = 2.0
"""Distance in pixels of an edge that still shows a sample."""
_AROUND = 5
"""Frames, besides its own, by which the depths of a frame's edges are found."""
_AGREE = 4
"""Frames, its own included, that must see a sample."""
_EVERY = 4
"""Of so many edge points of a frame one is followed."""
_SHORTEST = 6
"""Samples of the shortest piece."""
_SAMPLES = 350
"""Samples of a frame, the most."""
_STEPS = 3
"""Of an adjustment to the same edge points: images that go on along their curves leave these behind."""
_BESIDE = 8.0
"""Pixels along a curve, the most, from a sample to one of another frame's edge that is on the same curve,"""
_PARALLEL = 0.9
"""the least cosine between their tangents,"""
_CONFIRM = 2
"""and the number of frames with such samples."""
_SPEEDS = (1.0, 0.5, 1.5, 0.0, 2.0)
"""Of the motion before, with which a camera goes on."""
_SWINGS = (-24.0, -12.0, 0.0, 12.0, 24.0)
"""Pixels, along both axes, by which the image may be elsewhere then."""
_CLOSE = 4.0
"""Pixels by which samples may be away from their edges where a guess is good."""
_SHOWN = 0.5
"""Of the samples inside an image that must be on its edges,"""
_FEWEST = 40
"""and how many at least."""


class Sight(NamedTuple):
    """What a frame shows, as a camera without distortion sees it."""

    edges: ImageEdges
    """Those that the lens shows, as they are."""
    points: EdgePoints

    def field(self, size: tuple[int, int]) -> EdgeField:
        """Its edges, to be looked up; larger than all else, so it is not kept."""
        tangent = self.points.tangent
        bright = torch.stack((tangent[:, 1], -tangent[:, 0]), -1)
        chain = torch.unique(self.points.chain, return_inverse=True)[1]
        return edge_field(self.points.x, bright, chain, torch.zeros_like(chain, dtype=torch.bool), size)


@dataclass(frozen=True)
class CurveMapping:
    """Frames of one camera, those of which that are placed, and samples of curves."""

    edges: tuple[ImageEdges, ...]
    size: tuple[int, int]
    """Height and width of the frames."""
    camera: Camera
    poses: Pose
    registered: Bool[Tensor, "v"]
    curves: Curves
    home: Int[Tensor, "n"]
    """The frame whose edge each sample was."""
    sights: tuple[Sight, ...]

    @classmethod
    def start(cls, edges: Sequence[ImageEdges], size: tuple[int, int], camera: Camera) -> "CurveMapping":
        """Nothing is placed yet."""
        v = len(edges)
        poses = Pose.identity(v, dtype=torch.float64)
        none = no_curves(poses.R)
        sights = tuple(Sight(*own.seen_by(camera)) for own in edges)
        return cls(tuple(edges), size, camera, poses, torch.zeros(v, dtype=torch.bool), none, none.curve, sights)

    @property
    def known(self) -> Int[Tensor, "k"]:
        """The frames that are placed."""
        return self.registered.nonzero()[:, 0]

    @property
    def P(self) -> Float[Tensor, "v 3 4"]:
        """Camera matrices without distortion."""
        return self.camera.K @ self.poses.matrix()

    @property
    def one_camera(self) -> Camera:
        """The camera of each frame."""
        return self.camera[(None,)][torch.zeros(len(self.edges), dtype=torch.long)]

    def placed(self, views: Tensor, poses: Pose) -> "CurveMapping":
        """With poses for some frames."""
        R, t = self.poses.R.index_copy(0, views, poses.R), self.poses.t.index_copy(0, views, poses.t)
        return replace(self, poses=Pose(R, t), registered=self.registered.index_fill(0, views, True))

    def with_curves(self, curves: Curves, home: Tensor | None = None) -> "CurveMapping":
        """With other curves."""
        return replace(self, curves=curves, home=torch.zeros_like(curves.curve) if home is None else home)

    def maps(self) -> MapsOfImages:
        """What frames show, to be looked up; it is of this camera."""
        return MapsOfImages([sight.points for sight in self.sights], self.size)

    def problem(self) -> BundleProblem:
        """The cameras, without any points."""
        x = self.poses.t.new_zeros(0, 2)
        index = self.home[:0]
        one = torch.zeros(len(self.edges), dtype=torch.long)
        return BundleProblem(self.poses, self.camera[(None,)], one, self.poses.t[:0], x, index, index)


def add_pieces(mapping: CurveMapping, view: int, near: float = NEAR, maps: MapsOfImages | None = None) -> CurveMapping:
    """Samples of what the edges of a frame are images of, by the frames around; edges so many pixels away still show them."""
    known = mapping.known
    around = known[(known - view).abs().argsort(stable=True)]
    views = [view, *around[around != view][:_AROUND].tolist()]
    if len(views) < 3 or not len(mapping.sights[view].points.x):
        return mapping
    maps = maps or mapping.maps()
    found = image_pieces(
        view, [maps[j] for j in views], mapping.P[views], every=_EVERY, threshold=near,
        least_views=min(_AGREE, len(views)), shortest=_SHORTEST,
    )  # fmt: skip
    rank = torch.arange(len(found.X)) - torch.searchsorted(found.piece, found.piece)
    keep = rank % max(1, -(-len(found.X) // _SAMPLES)) == 0
    number, piece = torch.unique(found.piece[keep], return_inverse=True)
    old = mapping.curves
    curves = replace(
        old,
        X=torch.cat((old.X, found.X[keep])),
        curve=torch.cat((old.curve, piece + len(old))),
        closed=torch.cat((old.closed, torch.zeros_like(number, dtype=torch.bool))),
        color=torch.cat((old.color, torch.full_like(found.X[keep], 0.5))),
        sigma=torch.cat((old.sigma, found.sigma[keep])),
    )
    return mapping.with_curves(curves, torch.cat((mapping.home, torch.full_like(piece, view))))


def directions(mapping: CurveMapping) -> Float[Tensor, "n 3"]:
    """Which way curves run at samples: by the edges that show them, as of their neighbours' places each is known poorly."""
    r, _ = distances(mapping)
    trust = edge_loss(r).slope(r.square())
    return own_directions(mapping.curves.bundle(), mapping.poses, mapping.one_camera, trust)


def track(mapping: CurveMapping, near: float = NEAR) -> CurveMapping:
    """Which edges of all placed frames show the samples."""
    known = mapping.known
    seen = [mapping.sights[i] for i in known.tolist()]
    edges, maps = [s.edges for s in seen], MapsOfImages([s.points for s in seen], mapping.size)
    curves = track_samples(mapping.curves, directions(mapping), edges, maps, mapping.P[known], near)
    return replace(mapping, curves=replace(curves, view=known[curves.view]))


def distances(mapping: CurveMapping) -> tuple[Float[Tensor, "k"], float]:
    """Signed distances of samples from the edges that show them, and the standard deviation of most."""
    r = edge_distances(mapping.poses, mapping.one_camera, mapping.curves.bundle())
    return r, usual_distance(r)


def terms(mapping: CurveMapping) -> dict[str, Any]:
    """The samples as a part of a bundle, weighed by what is measured; edges much farther away than most have no say.

    Samples that fit badly as a whole have less.
    """
    r, _ = distances(mapping)
    loss = edge_loss(r)
    curves = weights_in_a_bundle(mapping.curves, r).bundle(loss=loss)
    return {"structure": (across_own_curves(curves, mapping.poses, mapping.one_camera, loss.slope(r.square())),)}


def adjust(mapping: CurveMapping, cameras: Named[str, Any], near: float = NEAR, *, rounds: int) -> CurveMapping:
    """Cameras and samples at the robust least squares of the distances of edges.

    Args:
        mapping: The model.
        cameras: What is adjusted and expected of the camera, as for `bundle_adjust`.
        near: Pixels between samples and the edges that show them.
        rounds: Times that these edges are looked for.
    """
    for _ in range(rounds):
        mapping = _stepped(track(mapping, near), cameras)
    return mapping


def _stepped(mapping: CurveMapping, cameras: Named[str, Any]) -> CurveMapping:
    """The model a few steps further, with its tracks."""
    if not len(mapping.curves.x):
        return mapping
    found = bundle_adjust(mapping.problem(), max_iterations=_STEPS, **terms(mapping), **cameras)
    if found.status == Status.INTERRUPTED:
        raise KeyboardInterrupt
    camera = found.cameras[0]
    sights = tuple(Sight(*own.seen_by(camera)) for own in mapping.edges)
    curves = mapping.curves.adjusted(found.structure[0])  # type: ignore[arg-type]
    return replace(mapping, poses=found.poses, camera=camera, curves=curves, sights=sights)


def covariance(mapping: CurveMapping, cameras: Named[str, Any]) -> BundleCovariance:
    """How well the cameras are known by the curves; `cameras` as for `adjust`.

    What edges weigh is measured: a unit that is estimated anew would undo how many of them are alike along a curve.
    """
    return bundle_covariance(mapping.problem(), sigma=1.0, **terms(mapping), **cameras)


def prune(mapping: CurveMapping, near: float = NEAR) -> CurveMapping:
    """Without samples that their frames do not show in one place, as those of outlines.

    These are told while all samples are there, by those beside them on their outline, of which most fit no place.
    """
    r, scale = distances(mapping)
    old = mapping.curves
    n = len(old.X)
    number = torch.bincount(old.sample, minlength=n)
    square = torch.zeros_like(old.X[:, 0]).index_add(0, old.sample, r.square())
    keep = (square < (TRUSTED * scale) ** 2 * (number - 2)) & (number >= _AGREE) & _confirmed(mapping, near)
    keep = keep & ~on_outlines(old, mapping.one_camera, mapping.poses)
    seen = old.seen_where(keep[old.sample])
    left, curve = torch.unique(old.curve[keep], return_inverse=True)
    curves = replace(
        seen, X=old.X[keep], curve=curve, closed=old.closed[left] & False, color=old.color[keep], sigma=old.sigma[keep],
        sample=(keep.cumsum(0) - 1)[seen.sample],
    )  # fmt: skip
    return mapping.with_curves(curves, mapping.home[keep])


def settle(mapping: CurveMapping, cameras: Named[str, Any], *, rounds: int) -> CurveMapping:
    """The cameras adjusted, and without samples that are of no curve; arguments as for `adjust`."""
    return prune(adjust(mapping, cameras, rounds=rounds))


def sampled(mapping: CurveMapping, progress: Progress, near: float = NEAR) -> CurveMapping:
    """All samples found anew, from the edges of all placed frames."""
    mapping = mapping.with_curves(no_curves(mapping.poses.R))
    known, maps = mapping.known.tolist(), mapping.maps()
    for done, view in enumerate(known):
        progress("curves", done, len(known))
        mapping = add_pieces(mapping, view, near, maps)
    progress("curves", len(known), len(known))
    return mapping


def _confirmed(mapping: CurveMapping, near: float) -> Bool[Tensor, "n"]:
    """Samples that lie on those of other frames' edges: of a surface's outline, each frame has another curve in space."""
    X, tangent, home = mapping.curves.X, mapping.curves.tangents(), mapping.home
    depth = (X * mapping.poses.R[home, 2]).sum(-1) + mapping.poses.t[home, 2]
    pixel = depth / mapping.camera.K[0, 0]
    a, b = near_pairs(X, _BESIDE * float(pixel.median()))
    d = X[b] - X[a]
    across = torch.linalg.vector_norm(d - (d * tangent[a]).sum(-1, keepdim=True) * tangent[a], dim=-1)
    same = (across < near * pixel[a]) & ((tangent[a] * tangent[b]).sum(-1) > _PARALLEL) & (home[a] != home[b])
    return count_different(a[same], home[b[same]], len(X)) >= _CONFIRM


def register(mapping: CurveMapping, view: int, guesses: Sequence[Pose | None] = ()) -> CurveMapping | None:
    """The model with one more frame; None where it does not show the curves that frames around it do.

    Args:
        mapping: The model.
        view: The frame.
        guesses: Where it may be, batch (1) each. Only their surroundings are looked at first: where things repeat
            themselves, other places fit as well.
    """
    known = mapping.known
    near = known[(known - view).abs().argsort(stable=True)]
    a, b = int(near[0]), int(near[1])
    use = torch.isin(mapping.home, near[:5])
    if int(use.sum()) < _FEWEST:
        return None
    X, tangent = mapping.curves.X[use], mapping.curves.tangents()[use]
    seen = (X, tangent, mapping.sights[view].field(mapping.size), mapping.size, mapping.camera.K)
    for guess in guesses:
        if guess is not None and (pose := _shown(pose_from_edges(*seen, guess, reach=_CLOSE))) is not None:
            return mapping.placed(torch.tensor([view]), pose)
    pose = _shown(pose_from_edges(*seen, _starts(mapping, X, a, b, (view - a) / (a - b))))
    return None if pose is None else mapping.placed(torch.tensor([view]), pose)


def _shown(found: Resection) -> Pose | None:
    """The pose whose frame shows the most samples, where these are enough."""
    k = int(found.near.argmax())
    return None if found.near[k] < max(_FEWEST, _SHOWN * float(found.inside[k])) else found.pose[k : k + 1]


def _starts(mapping: CurveMapping, X: Tensor, a: int, b: int, steps: float) -> Pose:
    """Where a camera may be that goes on from frame b over frame a, so many steps."""
    last = mapping.poses[a]
    turn = rotvec_from_rotation((last @ mapping.poses[b].inverse()).R)
    # What is seen goes on as it did.
    middle = X.median(0).values[None]
    here, before = last.transform(middle)[0], mapping.poses[b].transform(middle)[0]
    speed = steps * torch.tensor(_SPEEDS, dtype=X.dtype)
    swing = torch.cartesian_prod(*[torch.tensor(_SWINGS, dtype=X.dtype)] * 2).repeat(len(speed), 1)
    speed = speed.repeat_interleave(len(swing) // len(speed))[:, None]
    R = rotation_from_rotvec(speed * turn)
    aside = torch.cat((swing / mapping.camera.K[0, 0] * here[2], torch.zeros_like(speed)), -1)
    t = here + speed * (here - before) + aside - (R @ here)
    return Pose(R, t) @ last
