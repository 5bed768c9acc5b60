"""All images of a component at once: rotations from pairs, then centres and points from rotations and rays.

Relative poses of the strongest pairs -> `average_rotations`, weighted by how well each pair determines its rotation -> tracks
of the pairs that agree -> `position_globally` -> a model that is adjusted, completed and finished like any other (Pan et al.,
"Global structure-from-motion revisited", ECCV 2024). Until cameras and focal lengths stand, this is the work of few pairs and
few tracks of each image; all matches are looked at once, in the end.
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust
from torchsfm.geometry import Pose
from torchsfm.motion import average_rotations, position_globally
from torchsfm.motion.many_views.triplets import turn_angle
from torchsfm.optim import Cauchy
from torchsfm.reconstruction.evidence.consistency import PairAgreement, pair_agreements
from torchsfm.reconstruction.evidence.groups import outvoted_groups
from torchsfm.reconstruction.mappers.incremental import STANDING, MappingOptions
from torchsfm.reconstruction.mappers.pair_poses import relative_poses, strongest_pairs
from torchsfm.reconstruction.mappers.torn import join_torn
from torchsfm.reconstruction.mapping.cameras import FOCAL_SIGMA
from torchsfm.reconstruction.mapping.initialize import MIN_POINTS
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import complete_tracks, filter_points, triangulate_tracks
from torchsfm.reconstruction.mapping.tracks import build_tracks
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS

TRACKS_PER_VIEW = 150
"""Longest tracks of each image that are positioned: enough for its centre."""
ROUNDS = 3
"""Adjustments with poses and points alone, at most, each with a loss half as wide as the last, while that exceeds a pixel."""
WIDEST = 16.0
"""Scale of the first of their losses in pixels, at most."""
ROUGH, ROUGHER, ROUGHEST = 1e-3, 1e-2, 0.1
"""Part of the cost that is left to what comes after: by rotations and the first adjustment of everything; by positions; by
adjustments of poses and points alone, which a focal length that is not the right one keeps from the minimum anyway."""
PLACED = 1e-5
"""Damping of the first step of adjustments from where rays put cameras: more would hold back long rows of them."""
RETURNS, CHANGED = 3, 0.05
"""Times that all is done again, where a focal length has changed by more than this part."""
TEARS = 3
"""Times that a model is closed where it is torn, at most."""
USABLE = (int(Status.OK), int(Status.NOT_CONVERGED))


def global_start(mapping: Mapping, available: Bool[Tensor, "v"], options: MappingOptions) -> Mapping | None:
    """Poses and points of the largest set of images that their pairs hold together.

    Relative rotations are in proportion to what the focal length is taken to be, more or less: with a wrong one, those along a
    ring of images do not add up to a turn, and the ring is torn or folded where it is weakest. What fits together locally still
    tells the focal length. Where adjusting has not mended what was torn, all is then done again with that one, until it stays.

    Args:
        mapping: An empty mapping; its cameras are taken as they are at first.
        available: Images to consider.
        options: How models are made.

    Returns:
        The mapping with poses, points and tracks of the pairs that agree; None where too little does.
    """
    sigma = options.focal_sigma
    model, told = _at_once(mapping, available, sigma, options), None
    for _ in range(RETURNS):
        if model is None:
            break
        used = torch.unique(model.camera_index[model.registered])
        before, after = (m.cameras.K[used, 0, 0] for m in (mapping, model))
        if not bool(((after / before).log().abs() > CHANGED).any()):
            break
        told = _agreements(model, options, poses_alone=False)
        if _holds(model, available, told[0]):
            break
        K = mapping.cameras.K.clone()
        K[used, :2, :2] = model.cameras.K[used, :2, :2]
        mapping = replace(mapping, cameras=replace(mapping.cameras, K=K))
        sigma = sigma.index_put((used,), sigma[used].clamp(max=FOCAL_SIGMA["autocalibration"]))
        again = _at_once(mapping, available, sigma, options)
        if again is None or int(again.registered.sum()) < int(model.registered.sum()):
            break
        model, told = again, None
    if model is None:
        return None
    model = complete(close_tears(*_filled(model, told, options), options), options)
    return model if len(model.X) >= MIN_POINTS else None


def _at_once(
    mapping: Mapping, available: Bool[Tensor, "v"], focal_sigma: Float[Tensor, "g"], options: MappingOptions
) -> Mapping | None:
    """The start with the cameras as they are, and as uncertain as they are said to be."""
    graph, v = mapping.graph, len(mapping.registered)
    chosen = _related(mapping, available)
    chosen = chosen[strongest_pairs(graph.pairs[chosen], graph.fundamental_inliers[chosen], v)]
    if not len(chosen):
        return None
    motion, deviation, good = relative_poses(mapping, chosen, options)
    # No rotation is known to a smaller part of its angle than the focal length is.
    part = focal_sigma[mapping.camera_index][graph.pairs[chosen]].amax(-1) * turn_angle(motion[..., :3])
    deviation = deviation + torch.diag_embed(part.square()[:, None].expand(-1, 3))
    chosen, motion, deviation = chosen[good], motion[good], deviation[good]
    turned = average_rotations(motion[..., :3], graph.pairs[chosen], views=v, deviation=deviation, tolerance=ROUGH)
    rotated = largest(turned.component, torch.isin(turned.status, torch.tensor(USABLE)))
    if int(rotated.sum()) < 2:
        return None
    agreeing = chosen[turned.inliers & rotated[graph.pairs[chosen]].all(-1)]
    kept = torch.zeros(len(graph.pairs), dtype=torch.bool).index_fill_(0, agreeing, True)
    own = kept[graph.match_pair]
    track = build_tracks(graph.view, graph.match[own], graph.fundamental_inliers[graph.match_pair[own]])
    node = _longest_tracks(track, graph.view, v)
    d, valid = mapping.rays(node)
    node, d = node[valid], d[valid]
    _, point = torch.unique(track[node], return_inverse=True)
    count = int(point.max()) + 1 if len(point) else 0
    placed = position_globally(d, graph.view[node], point, turned.model, points=count, tolerance=ROUGHER)
    registered = largest(placed.component, torch.isin(placed.status, torch.tensor(USABLE)) & rotated)
    if int(registered.sum()) < 2:
        return None
    R = torch.where(registered[:, None, None], turned.model, mapping.poses.R)
    t = torch.where(registered[:, None], -(turned.model @ placed.centres[..., None])[..., 0], mapping.poses.t)
    sure = placed.inliers & registered[graph.view[node]] & placed.valid[point]
    number = torch.full_like(graph.view, -1).index_copy_(0, node[sure], point[sure])
    start = replace(mapping, poses=Pose(R, t), registered=registered, X=placed.X, point=number).compacted()
    focal = mapping.cameras.K[mapping.camera_index[registered], 0, 0].median()
    return tighten(start, min(float(placed.scale * focal), WIDEST), options)


def _agreements(model: Mapping, options: MappingOptions, *, poses_alone: bool) -> tuple[PairAgreement, PairAgreement]:
    """How all pairs agree with a model, by the usual threshold and by twice that."""
    told = pair_agreements(model, (options.reprojection, 2 * options.reprojection), poses_alone=poses_alone)
    return told[0], told[1]


def _holds(model: Mapping, available: Bool[Tensor, "v"], agreement: PairAgreement) -> bool:
    """Whether all images have a place, and their pairs contradict neither that of one nor how groups of them stand."""
    pairs = _related(model, available)
    linked = torch.zeros_like(available).index_fill(0, model.graph.pairs[pairs].flatten(), True)
    if not bool(model.registered[linked].all()):
        return False
    outvoted = agreement.balance(len(available)) < 0
    return not bool((outvoted | outvoted_groups(agreement, model.registered)).any())


def _related(mapping: Mapping, available: Bool[Tensor, "v"]) -> Int[Tensor, "q"]:
    """The pairs of available images that have enough in common."""
    return ((mapping.graph.fundamental_inliers >= MIN_INLIERS) & available[mapping.graph.pairs].all(-1)).nonzero()[:, 0]


def largest(component: Int[Tensor, "v"], usable: Bool[Tensor, "v"]) -> Bool[Tensor, "v"]:
    """The usable members of the component that has most of them."""
    number = torch.bincount(component[usable], minlength=len(component))
    return usable & (component == number.argmax())


def _longest_tracks(track: Int[Tensor, "n"], view: Int[Tensor, "n"], views: int) -> Int[Tensor, "k"]:
    """The image points of tracks that are among the longest of an image."""
    node = (track >= 0).nonzero()[:, 0]
    length = torch.bincount(track[node])
    order = node[torch.argsort(length[track[node]], descending=True, stable=True)]
    order = order[torch.argsort(view[order], stable=True)]
    seen = torch.bincount(view[order], minlength=views)
    place = torch.arange(len(order)) - (seen.cumsum(0) - seen)[view[order]]
    wanted = torch.zeros_like(length, dtype=torch.bool)
    wanted[track[order[place < TRACKS_PER_VIEW]]] = True
    return node[wanted[track[node]]]


def tighten(model: Mapping, width: float, options: MappingOptions) -> Mapping:
    """Adjust poses and points with losses that become narrower, then the cameras, too: all of them, as all images are in."""
    for k in range(ROUNDS):
        if width / 2**k <= 1:
            break
        model = _adjust(model, width / 2**k)
    damping = PLACED if width > 1 else STANDING
    return options.adjust(model, last=True, max_iterations=20, tolerance=ROUGH, initial_damping=damping)


def fill(model: Mapping, options: MappingOptions) -> Mapping:
    """Poses with the points of all tracks of the pairs that agree with them."""
    return _filled(model, None, options)[0]


def _filled(
    model: Mapping, told: tuple[PairAgreement, PairAgreement] | None, options: MappingOptions
) -> tuple[Mapping, PairAgreement]:
    """The same, and how all pairs agree with the poses; both agreements are `told` or found out."""
    told = told or _agreements(model, options, poses_alone=True)
    strictly, loosely = (agreement.of_poses for agreement in told)
    model = replace(model, track=_tracks(model, loosely), X=model.X[:0], point=torch.full_like(model.point, -1))
    return triangulate_tracks(model, threshold=2 * options.reprojection, min_angle=options.min_angle), strictly


def close_tears(model: Mapping, agreement: PairAgreement, options: MappingOptions) -> Mapping:
    """The model with its tears closed, see `join_torn`, as long as that makes more matches agree with poses."""
    for _ in range(TEARS):
        joined = join_torn(model, agreement)
        if joined is None:
            break
        trial, tried = _filled(tighten(joined, WIDEST, options), None, options)
        if tried.explained <= agreement.explained:
            break
        model, agreement = trial, tried
    return model


def complete(model: Mapping, options: MappingOptions) -> Mapping:
    """All observations that fit, and none that does not."""
    model = complete_tracks(model, threshold=options.reprojection)
    model = triangulate_tracks(model, threshold=options.reprojection, min_angle=options.min_angle)
    return filter_points(model, threshold=options.reprojection, min_angle=options.min_angle)


def _tracks(model: Mapping, agreement: PairAgreement) -> Int[Tensor, "n"]:
    """Tracks of the pairs that agree with a model, and of those with images that have no place yet."""
    graph = model.graph
    kept = torch.ones(len(graph.pairs), dtype=torch.bool).index_copy_(0, agreement.index, agreement.supports)
    own = kept[graph.match_pair]
    return build_tracks(graph.view, graph.match[own], graph.fundamental_inliers[graph.match_pair[own]])


def _adjust(model: Mapping, width: float) -> Mapping:
    """The minimum of reprojection errors, without what then lies behind a camera or far off."""
    node = model.observations()
    problem = model.problem(node)
    limits: dict[str, Any] = {"max_iterations": 20, "tolerance": ROUGHEST, "initial_damping": PLACED}
    result = bundle_adjust(problem, loss=Cauchy(width), free=(), **limits)
    if result.status == Status.INTERRUPTED:
        raise KeyboardInterrupt
    moved = replace(model, poses=result.poses, X=result.X)
    return moved.without(node[moved.errors(problem.point, node) > 8 * width])
