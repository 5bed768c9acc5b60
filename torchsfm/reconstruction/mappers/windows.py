"""A film in windows: a model of each by itself, and all of them joined by what they share, also where the camera comes back.

What is mapped image by image drifts, and where the camera comes back the ends do not meet. Models of a few frames are too short
to drift; the similarities between those that share frames, and those whose images match, are averaged, and what each adds to
the drift is spread over the loop (`average_similarities`). The result is adjusted and finished like any other model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Camera, Pose, Similarity
from torchsfm.geometry.intrinsic_parameters import camera_from_row, row_from_camera
from torchsfm.motion import average_similarities
from torchsfm.reconstruction.mappers.global_start import WIDEST, complete, fill, largest, tighten
from torchsfm.reconstruction.mappers.incremental import MappingOptions, grow_model
from torchsfm.reconstruction.mapping.adjust import adjust
from torchsfm.reconstruction.mapping.initialize import MIN_POINTS
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import point_uncertainty
from torchsfm.reconstruction.model.similarities import four_places, robust_similarity

FRAMES, NEXT = 40, 25
"""Frames of a window, and from the first of one to the first of the next."""
SHARED = 15
"""Points that two windows must share to be joined."""
MOST_PLACES = 1000
"""Points by which two windows are joined, at most: more say little more."""
USABLE = (int(Status.OK), int(Status.NOT_CONVERGED))


@dataclass(frozen=True)
class Window:
    """The model of a few frames, in a world of its own.

    Attributes:
        model: Of its frames alone.
        images: Their numbers in the film.
        nodes: The numbers of their image points.
        deviation: How well each point is known, in its own world's unit, up to a factor that is the same for all.
    """

    model: Mapping
    images: Int[Tensor, "k"]
    nodes: Int[Tensor, "m"]
    deviation: Float[Tensor, "p"]


def window_start(mapping: Mapping, available: Bool[Tensor, "v"], options: MappingOptions) -> Mapping | None:
    """Poses and points of the largest part of a film whose windows hang together.

    Args:
        mapping: An empty mapping of images in the order in which they were taken.
        available: Images to consider.
        options: How models are made.

    Returns:
        The mapping with poses and points; None where no window has a model.
    """
    windows = map_windows(mapping, available, options)
    if not windows:
        return None
    mapping = replace(mapping, cameras=_common_cameras(windows))
    windows = [_with_cameras(window, mapping.cameras) for window in windows]
    world, kept = join_windows(windows, len(mapping.track), mapping.graph.match)
    start = _in_one_world(mapping, windows, world, kept)
    model = complete(fill(tighten(start, WIDEST, options), options), options)
    return model if len(model.X) >= MIN_POINTS else None


def map_windows(mapping: Mapping, available: Bool[Tensor, "v"], options: MappingOptions) -> list[Window]:
    """The models of windows that overlap, where there are such."""
    images, windows = available.nonzero()[:, 0], []
    for first in range(0, max(len(images) - FRAMES + NEXT, 1), NEXT):
        some = images[first : first + FRAMES]
        graph, nodes = mapping.graph.part(some)
        track = mapping.track[nodes]
        grown = grow_model(
            Mapping.start(graph, track, mapping.cameras, mapping.camera_index[some]), options, lambda done, total: None
        )
        if grown is not None and len(grown[0].X) >= MIN_POINTS:
            windows.append(Window(grown[0], some, nodes, point_uncertainty(grown[0])))
    return windows


def _common_cameras(windows: Sequence[Window]) -> Camera:
    """The median of each number of a camera over the windows that have seen with it."""
    cameras = windows[0].model.cameras
    rows = torch.stack([row_from_camera(window.model.cameras) for window in windows])
    used = torch.zeros(rows.shape[:2], dtype=torch.bool)
    for window, there in zip(windows, used, strict=True):
        there[window.model.camera_index[window.model.registered]] = True
    median = torch.where(used[..., None], rows, torch.nan).nanmedian(0).values
    return camera_from_row(torch.where(median.isfinite(), median, rows[0]), type(cameras.distortion))


def _with_cameras(window: Window, cameras: Camera) -> Window:
    """The model with other cameras, which are held."""
    model = adjust(replace(window.model, cameras=cameras), tolerance=1e-5)
    return replace(window, model=model, deviation=point_uncertainty(model))


def join_windows(windows: Sequence[Window], nodes: int, match: Int[Tensor, "k 2"]) -> tuple[Similarity, Bool[Tensor, "w"]]:
    """The similarities from windows to one world, and which of them hang together.

    Args:
        windows: Their models.
        nodes: Number of image points of the film.
        match: Verified matches between image points.
    """
    first = torch.tensor([0, *(len(window.model.X) for window in windows)]).cumsum(0)
    owner = torch.arange(len(windows)).repeat_interleave(first.diff())
    X, deviation = (torch.cat(parts) for parts in zip(*((w.model.X, w.deviation) for w in windows), strict=True))
    pairs = _shared_points(windows, first[:-1], nodes, match)
    a, b = owner[pairs].unbind(1)
    pairs = torch.where((a > b)[:, None], pairs.flip(1), pairs)
    pairs = torch.unique(pairs[a != b], dim=0)
    edge = owner[pairs[:, 0]] * len(windows) + owner[pairs[:, 1]]
    order = torch.argsort(edge, stable=True)
    edges, between, middles, deviations = [], [], [], []
    for some in torch.split(pairs[order], torch.unique_consecutive(edge[order], return_counts=True)[1].tolist()):
        if len(some) < SHARED:
            continue
        some = some[:: -(-len(some) // MOST_PLACES)]
        (P, Q), (known, there) = X[some].unbind(1), deviation[some].unbind(1)
        similarity, used = robust_similarity(P, Q, sigma=there + known * (there / known).median())
        if int(used.sum()) < SHARED or not bool(similarity.status == Status.OK):
            continue
        apart = (similarity.transform(P) - Q)[used]
        edges.append(owner[some[0]])
        between.append(similarity)
        middles.append(four_places(P[used]))
        deviations.append(apart.square().mean().sqrt() / len(apart) ** 0.5)
    if not edges:
        return _identities(len(windows), X), torch.arange(len(windows)) == int(first.diff().argmax())
    joined = average_similarities(
        Similarity(*(torch.stack([getattr(one, name) for one in between]) for name in ("scale", "R", "t"))),
        torch.stack(edges), models=len(windows), places=torch.stack(middles), deviation=torch.stack(deviations),
    )  # fmt: skip
    return joined.model, largest(joined.component, torch.isin(joined.status, torch.tensor(USABLE)))


def _identities(count: int, like: Tensor) -> Similarity:
    return Similarity(like.new_ones(count), torch.eye(3).to(like).expand(count, 3, 3), like.new_zeros(count, 3))


def _shared_points(
    windows: Sequence[Window], first: Int[Tensor, "w"], nodes: int, match: Int[Tensor, "k 2"]
) -> Int[Tensor, "q 2"]:
    """Points of different windows that are the same: those of one image point, and of image points that match.

    Points are numbered through all windows. An image point is in two of them at most.
    """
    home = torch.full((nodes, 2), -1, dtype=torch.long)
    for number, (window, offset) in enumerate(zip(windows, first.tolist(), strict=True)):
        has = window.model.point >= 0
        home[window.nodes[has], number % 2] = window.model.point[has] + offset
    a, b = match.unbind(1)
    both = [home, *(torch.stack((home[a, i], home[b, j]), 1) for i in (0, 1) for j in (0, 1))]
    pairs = torch.cat(both)
    return pairs[(pairs >= 0).all(1)]


def _in_one_world(mapping: Mapping, windows: Sequence[Window], world: Similarity, kept: Bool[Tensor, "w"]) -> Mapping:
    """The film's mapping with each image where the window has it in whose middle it is, and each track where these have it."""
    v = len(mapping.registered)
    R, t = mapping.poses.R.clone(), mapping.poses.t.clone()
    least, registered = torch.full((v,), torch.inf), torch.zeros(v, dtype=torch.bool)
    place, seen = torch.zeros(len(mapping.track), 3, dtype=mapping.X.dtype), torch.zeros(len(mapping.track), dtype=torch.bool)
    for number in kept.nonzero()[:, 0].tolist():
        window, model = windows[number], windows[number].model
        similarity = Similarity(world.scale[number], world.R[number], world.t[number])
        poses, X = similarity.transform_pose(model.poses), similarity.transform(model.X)
        middle = window.images.double()
        distance = (middle - middle.mean()).abs().float()
        better = model.registered & (distance < least[window.images])
        image = window.images[better]
        R[image], t[image], registered[image] = poses.R[better], poses.t[better], True
        least[image] = distance[better]
        mine = better[model.graph.view]
        seen[window.nodes[mine]] = model.point[mine] >= 0
        has = mine & (model.point >= 0)
        place[window.nodes[has]] = X[model.point[has]]
    node = (seen & (mapping.track >= 0)).nonzero()[:, 0]
    _, track, count = torch.unique(mapping.track[node], return_inverse=True, return_counts=True)
    X = torch.zeros(len(count), 3, dtype=place.dtype).index_add(0, track, place[node]) / count[:, None]
    point = torch.full_like(mapping.point, -1).index_copy(0, node, track)
    return replace(mapping, poses=Pose(R, t), registered=registered, X=X, point=point).compacted()
