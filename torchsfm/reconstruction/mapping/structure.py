"""Points of a growing model: triangulate new ones, complete their tracks, merge duplicates, drop what does not fit."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.triangulation import triangulate_points

MAX_SLOTS = 32
"""Views used to triangulate one point; longer tracks get the rest of their observations by completion."""


def triangulate_tracks(mapping: Mapping, *, threshold: float, min_angle: float) -> Mapping:
    """Make points of the tracks whose free image points in registered images agree on one.

    Two-view hypotheses from the pairs of rays that meet at the widest angles are scored on all views of the track, and the best
    is refined on its inliers; all tracks together.

    Args:
        mapping: The model so far.
        threshold: Largest reprojection error in pixels.
        min_angle: Smallest angle, in radians, between the two rays that fix a point.
    """
    graph = mapping.graph
    free = (mapping.track >= 0) & (mapping.point < 0) & mapping.registered[graph.view]
    node = free.nonzero()[:, 0]
    if len(node) < 2:
        return mapping
    d, valid = mapping.rays(node)
    node, d = node[valid], d[valid]
    order = torch.argsort(mapping.track[node], stable=True)
    node, d = node[order], d[order]
    _, group, size = torch.unique_consecutive(mapping.track[node], return_inverse=True, return_counts=True)
    slot = torch.arange(len(node)) - (size.cumsum(0) - size)[group]
    keep = (size[group] >= 2) & (slot < MAX_SLOTS)
    node, d, group, slot = node[keep], d[keep], group[keep], slot[keep]
    if not len(node):
        return mapping
    _, group = torch.unique_consecutive(group, return_inverse=True)
    p = int(group[-1]) + 1
    new_X: list[Tensor] = []
    new_node: list[Tensor] = []
    new_point: list[Tensor] = []
    made = 0
    # Tracks of like length together, so that short ones do not pay for the slots of the longest.
    length = torch.bincount(group, minlength=p)
    low = 1
    for high in (2, 4, 8, 16, MAX_SLOTS):
        chosen = (length > low) & (length <= high)
        low = high
        if not bool(chosen.any()):
            continue
        row = (chosen.cumsum(0) - 1)[group]
        member = chosen[group]
        index = torch.full((int(chosen.sum()), high), -1, dtype=torch.long)
        index[row[member], slot[member]] = member.nonzero()[:, 0]
        X, inlier = _triangulate_rows(mapping, node, d, index, threshold=threshold, min_angle=min_angle)
        good = inlier.sum(-1) >= 2
        X, inlier, index = X[good], inlier[good], index[good]
        rows, columns = inlier.nonzero(as_tuple=True)
        new_node.append(node[index[rows, columns]])
        new_point.append(rows + made)
        new_X.append(X)
        made += len(X)
    point = mapping.point.clone()
    point[torch.cat(new_node)] = torch.cat(new_point) + len(mapping.X)
    return replace(mapping, X=torch.cat([mapping.X, *new_X]), point=point)


def _triangulate_rows(
    mapping: Mapping,
    node: Int[Tensor, "k"],
    d: Float[Tensor, "k 3"],
    index: Int[Tensor, "p s"],
    *,
    threshold: float,
    min_angle: float,
) -> tuple[Float[Tensor, "p 3"], Tensor]:
    """Triangulate padded tracks robustly: the best two-view hypothesis, then least squares over its inliers."""
    visible = index >= 0
    safe = index.clamp(min=0)
    view = mapping.graph.view[node[safe]]
    poses = mapping.poses[view]
    focal = mapping.cameras[mapping.camera_index[view]].K[..., 0, 0]
    rays = d[safe]
    world = torch.nn.functional.normalize((poses.R.mT @ rays[..., None])[..., 0], dim=-1)
    centre = poses.centre
    # Image points of cameras without distortion and principal point.
    image = focal[..., None] * rays[..., :2] / rays[..., 2:].clamp(min=1e-6)
    P = poses.matrix() * torch.stack((focal, focal, torch.ones_like(focal)), -1)[..., None]
    cosine = world @ world.mT
    first, second = _widest_pairs(cosine, visible)
    rows = torch.arange(len(index))[:, None]
    X, angle = _midpoints(world[rows, first], world[rows, second], centre[rows, first], centre[rows, second])

    def errors(points: Float[Tensor, "p h 3"]) -> Float[Tensor, "p h s"]:
        # One product a track, coordinates apart: a product for each point in each view takes several times as long.
        y = (points @ P[..., :3].flatten(1, 2).mT).reshape(*points.shape[:2], -1, 3) + P[:, None, :, :, 3]
        u, v, depth = y.unbind(-1)
        ahead = depth.clamp(min=1e-12)
        error = torch.hypot(u / ahead - image[:, None, :, 0], v / ahead - image[:, None, :, 1])
        return torch.where((depth > 0) & visible[:, None], error, torch.inf)

    error = errors(X)
    score = (error / threshold).clamp(max=1).square().sum(-1)
    score = torch.where(angle >= min_angle, score, torch.inf)
    best = score.argmin(dim=-1)
    X = X[rows[:, 0], best]
    usable = score[rows[:, 0], best].isfinite()
    inlier = (error[rows[:, 0], best] < threshold) & usable[:, None]
    X = triangulate_points(image[:, :, None], P, visible=inlier[..., None]).model[:, 0]
    inlier = (errors(X[:, None])[:, 0] < threshold) & usable[:, None]
    wide = (inlier[:, :, None] & inlier[:, None] & (cosine < torch.cos(torch.tensor(min_angle)))).any(-1).any(-1)
    return X, inlier & wide[:, None]


def _widest_pairs(cosine: Float[Tensor, "p s s"], visible: Tensor) -> tuple[Int[Tensor, "p h"], Int[Tensor, "p h"]]:
    """The pairs of slots whose rays meet at the widest angles, at most 12, as two index tensors."""
    s = cosine.shape[1]
    i, j = torch.triu_indices(s, s, 1)
    apart = torch.where(visible[:, i] & visible[:, j], cosine[:, i, j], torch.inf)
    chosen = apart.topk(min(12, len(i)), dim=-1, largest=False).indices
    return i[chosen], j[chosen]


def _midpoints(d1: Tensor, d2: Tensor, c1: Tensor, c2: Tensor) -> tuple[Float[Tensor, "p h 3"], Float[Tensor, "p h"]]:
    """Points midway between two rays with unit directions, and the angle between the rays in radians."""
    b = c2 - c1
    cosine = (d1 * d2).sum(-1)
    sine2 = torch.linalg.cross(d1, d2).square().sum(-1)
    along1, along2 = (b * d1).sum(-1), (b * d2).sum(-1)
    scale = sine2.clamp(min=1e-18)
    s = (along1 - cosine * along2) / scale
    t = (cosine * along1 - along2) / scale
    X = 0.5 * (c1 + s[..., None] * d1 + c2 + t[..., None] * d2)
    return X, torch.atan2(sine2.sqrt(), cosine)


def complete_tracks(mapping: Mapping, *, threshold: float, rounds: int = 3) -> Mapping:
    """Give free image points to the points their matches belong to, where they fit."""
    for _ in range(rounds):
        node, point = _candidates(mapping, mapping.registered)
        if not len(node):
            break
        error = mapping.errors(point, node)
        good = error < threshold
        if not bool(good.any()):
            break
        mapping = mapping.assign(node[good], point[good], error[good])
    return mapping


def _candidates(mapping: Mapping, images: Tensor) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Free image points of the given images and the 3D points that their matches say they show; no pair twice."""
    match, point = mapping.graph.match, mapping.point
    free, known = (point < 0) & images[mapping.graph.view], point >= 0
    pairs = []
    for a, b in (match.unbind(1), match.flip(1).unbind(1)):
        use = (free[a] & known[b]).nonzero()[:, 0]
        pairs.append((a[use], point[b[use]]))
    a, b = (torch.cat(side) for side in zip(*pairs, strict=True))
    return _different(a, b, len(mapping.X))


def _different(a: Int[Tensor, "k"], b: Int[Tensor, "k"], count: int) -> tuple[Int[Tensor, "q"], Int[Tensor, "q"]]:
    """Pairs in ascending order, none of them twice; the second ones are less than the count."""
    key = torch.unique(a * count + b)
    return key.div(max(count, 1), rounding_mode="floor"), key % max(count, 1)


def visible_points(mapping: Mapping, images: Tensor) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """2D-3D correspondences of unregistered images: image points, and the 3D points their matches belong to."""
    return _candidates(mapping, images & ~mapping.registered)


def merge_points(mapping: Mapping, *, threshold: float) -> Mapping:
    """Join points that a match says are one, where one of the two fits all observations of both.

    Points seen in the same image are never joined. Each point takes part in one merge per call.
    """
    a, b = mapping.graph.match.unbind(1)
    p, q = mapping.point[a], mapping.point[b]
    use = (p >= 0) & (q >= 0) & (p != q)
    if not bool(use.any()):
        return mapping
    pair = torch.stack(_different(torch.minimum(p, q)[use], torch.maximum(p, q)[use], len(mapping.X)), 1)
    node = mapping.observations()
    length = torch.bincount(mapping.point[node], minlength=len(mapping.X))
    start = length.cumsum(0) - length
    # The longer track keeps its position; the shorter one must fit there.
    swap = length[pair[:, 1]] > length[pair[:, 0]]
    pair = torch.where(swap[:, None], pair.flip(1), pair)
    keep, gone = pair.unbind(1)
    owner = torch.arange(len(pair)).repeat_interleave(length[gone])
    step = torch.arange(len(owner)) - (length[gone].cumsum(0) - length[gone])[owner]
    member = node[start[gone][owner] + step]
    error = mapping.errors(keep[owner], member)
    v = len(mapping.graph.names)
    seen = torch.isin(keep[owner] * v + mapping.graph.view[member], mapping.point[node] * v + mapping.graph.view[node])
    worst = torch.zeros(len(pair), dtype=error.dtype).scatter_reduce(0, owner, error, "amax")
    clash = torch.zeros(len(pair), dtype=torch.long).index_add(0, owner, seen.long()) > 0
    order = torch.argsort(worst, stable=True)
    order = order[((worst < threshold) & ~clash)[order]]
    used = torch.zeros(len(mapping.X), dtype=torch.bool)
    target = torch.arange(len(mapping.X))
    for k, g in pair[order].tolist():
        if not used[k] and not used[g]:
            used[k] = used[g] = True
            target[g] = k
    point = torch.where(mapping.point >= 0, target[mapping.point.clamp(min=0)], -1)
    return replace(mapping, point=point).compacted()


def filter_points(mapping: Mapping, *, threshold: float, min_angle: float) -> Mapping:
    """Drop observations with errors beyond the threshold (pixels), and points without two rays at `min_angle` (radians)."""
    node = mapping.observations()
    if not len(node):
        return mapping
    bad = mapping.errors(mapping.point[node], node) > threshold
    mapping = mapping.without(node[bad])
    narrow = widest_angle(mapping) < min_angle
    node = mapping.observations()
    return mapping.without(node[narrow[mapping.point[node]]])


def widest_angle(mapping: Mapping) -> Float[Tensor, "p"]:
    """The angle in radians between the viewing rays of each point that are farthest apart, to within a factor of two.

    Measured from the ray of the first observation and from the ray farthest from that one, which costs one pass each instead of
    all pairs.
    """
    node = mapping.observations()
    point = mapping.point[node]
    n = len(mapping.X)
    ray = torch.nn.functional.normalize(mapping.X[point] - mapping.poses.centre[mapping.graph.view[node]], dim=-1)
    length = torch.bincount(point, minlength=n)
    reference = ray[(length.cumsum(0) - length).clamp(max=max(len(node) - 1, 0))]
    angle = ray.new_zeros(n)
    for _ in range(2):
        apart = torch.atan2(torch.linalg.cross(ray, reference[point]).norm(dim=-1), (ray * reference[point]).sum(-1))
        angle = ray.new_zeros(n).scatter_reduce(0, point, apart, "amax")
        farthest = torch.full((n,), len(node), dtype=torch.long)
        farthest = farthest.scatter_reduce(
            0, point, torch.where(apart >= angle[point], torch.arange(len(node)), len(node)), "amin"
        )
        reference = ray[farthest.clamp(max=max(len(node) - 1, 0))]
    return angle


def point_uncertainty(mapping: Mapping) -> Float[Tensor, "p"]:
    """How far off each point is per radian that its rays are off: the farther and the narrower the angle, the more."""
    node = mapping.observations()
    point = mapping.point[node]
    depth = mapping.project(point, mapping.graph.view[node])[1]
    total = torch.zeros_like(mapping.X[:, 0]).index_add(0, point, depth)
    return total / torch.bincount(point, minlength=len(mapping.X)).clamp(min=1) / widest_angle(mapping).clamp(min=1e-6)
