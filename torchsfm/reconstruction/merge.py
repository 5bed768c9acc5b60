"""Two models that share images become one."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import DISTORTION_MODELS, Camera, Distortion, Pose, Similarity, rotation_angle, similarity_from_points
from torchsfm.reconstruction.adjust import adjust, adjust_all
from torchsfm.reconstruction.alignment import align_models
from torchsfm.reconstruction.calibration import CameraPrior
from torchsfm.reconstruction.incremental import LAST_ITERATIONS, LAST_TOLERANCE
from torchsfm.reconstruction.mapping import Mapping
from torchsfm.reconstruction.reconstruction import Reconstruction
from torchsfm.reconstruction.similarities import robust_similarity
from torchsfm.reconstruction.structure import complete_tracks, filter_points, merge_points, triangulate_tracks
from torchsfm.reconstruction.tracks import build_tracks
from torchsfm.reconstruction.view_graph import ViewGraph

SAME = 0.5
"""Pixels within which two observations in one image are of one image point."""
BLOCK = 1024
"""Observations compared at once with all others of their image."""
GATE, GATE_SHARE = 8.0, 0.01
"""How far off the projection of a shared point may be before the adjustment: pixels, or a share of the image's longer side."""
LEAST_PAIRS, LEAST_CAMERAS = 15, 3
"""Points, or where there are fewer of them cameras, that both models must have."""
AGREEING = 0.5
"""The least share of what both have that must agree before the adjustment, and of the observations that must be left after."""
CAMERA_SHIFT, CAMERA_TURN = 0.1, 0.05
"""How far shared cameras may differ, where they alone tell: as a share of their extent, and radians."""
ERROR, ANGLE = 4.0, 0.026
"""Largest error of an observation, pixels, and least angle between the rays of a point, radians, as in a reconstruction."""
FOCAL_SIGMA = 0.05
"""How far the cameras of models are trusted before, where the images hardly tell."""
ROUNDS = 2


@dataclass(frozen=True)
class MergedModel:
    """Two models as one.

    Attributes:
        model: In the world frame of the first one; the first one alone where `fault` says why they cannot be merged.
        similarity: From the second one to the first one.
        shared_images: Images with a pose in both.
        shared_points: Points of both that were found to be one.
        status: Of the last adjustment.
        why: Why the models were not merged; empty where they were.

    See the example of `merge_models`.
    """

    model: Reconstruction
    similarity: Similarity
    shared_images: tuple[str, ...]
    shared_points: int
    status: Status
    why: str

    def summary(self) -> str:
        """One line for people."""
        error = float(self.model.residuals().mean()) if self.model.num_observations else 0.0
        count = f"{self.model.num_registered} images, {self.model.num_points} points"
        return f"{count}, {error:.3f} px; {len(self.shared_images)} images and {self.shared_points} points were in both"

    def fault(self) -> str:
        """Why the models were not merged; empty where they were."""
        return self.why


def merge_models(a: Reconstruction, b: Reconstruction, *, fixed_cameras: bool = False) -> MergedModel:
    """Join two models that share images, by the names of these, and adjust them together.

    The similarity between the worlds is that of the shared cameras or of the shared points, which are those that have an
    observation at the same place in a shared image, whichever more of the shared points agree with; a single shared image is
    enough where it shows enough of them. Points that are one become one; cameras that took the same images are one, and begin
    as in the first model. Lines, conics and curves are left out.

    Args:
        a: The first model, whose world frame and scale stay.
        b: The second one.
        fixed_cameras: Hold the intrinsics; else those that the images determine are adjusted.

    Returns:
        The merged model. Models that have too little in common, or contradict each other in what they have, are not merged:
        `fault` says why.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(8, 150, 800, generator=g).truth, "model.npz")
        >>> whole = torchsfm.read_model("model.npz")
        >>> first, second = (torchsfm.reconstruction.part_of_model(whole, torch.arange(8) // 5 != k) for k in (1, 5))
        >>> second = torchsfm.reconstruction.part_of_model(whole, torch.arange(8) > 2)
        >>> merged = torchsfm.reconstruction.merge_models(first, second)
        >>> merged.fault(), merged.model.num_registered, len(merged.shared_images)
        ('', 8, 2)
    """
    a, b = (model.to("cpu", torch.float64) for model in (a, b))
    place = {name: i for i, name in enumerate(a.names)}
    both = [(place[name], j) for j, name in enumerate(b.names)
            if name in place and bool(a.registered[place[name]]) and bool(b.registered[j])]  # fmt: skip
    shared = tuple(a.names[i] for i, _ in both)
    nothing = Similarity(torch.ones((), dtype=a.X.dtype), torch.eye(3, dtype=a.X.dtype), torch.zeros(3, dtype=a.X.dtype))

    def refused(why: str, similarity: Similarity = nothing, points: int = 0) -> MergedModel:
        return MergedModel(a, similarity, shared, points, Status.DEGENERATE, why)

    if not both:
        return refused("the models have no image with a pose in common")
    unequal = [a.names[i] for i, j in both if a.image_size[i].tolist() != b.image_size[j].tolist()]
    if unequal:
        return refused(f"the image {unequal[0]} has another size in the second model")
    kind = _common_kind(type(a.cameras.distortion), type(b.cameras.distortion))
    if kind is None:
        names = (type(model.cameras.distortion).__name__ for model in (a, b))
        return refused(f"no camera model holds both {' and '.join(names)}")
    pairs = _same_observations(a, b, both)
    similarity, agree, why = _similarity(a, b, both, pairs)
    if why:
        return refused(why, similarity)
    mapping = _joined(a, b.transform(similarity), both, pairs[agree], kind)
    fused = int(torch.unique(a.point[pairs[agree, 0]] * len(b.X) + b.point[pairs[agree, 1]]).numel())
    start = mapping.point >= 0
    mapping = _adjusted(mapping, fixed_cameras)
    # Of the model of which less is left: one that is wrong in itself fits nothing, however large the other is.
    of_first = torch.arange(len(start)) < len(a.x)
    kept = mapping.point >= 0
    left = min(float((kept & start & of).sum()) / max(int((start & of).sum()), 1) for of in (of_first, ~of_first))
    if left < AGREEING and bool((start & ~of_first).any()):
        why = f"the models contradict each other: of one only {100 * left:.0f} % of the observations fit the other"
        return refused(why, similarity, fused)
    model = mapping.reconstruction()
    mine = torch.arange(len(model.names)) < len(a.names)
    mine[: len(a.names)] &= a.registered
    back = similarity_from_points(model.poses.centre[mine], a.poses.centre[a.registered])
    if back.status == Status.OK:
        model = model.transform(back)
    status = Status.OK if mapping.adjustment is None else mapping.adjustment.status
    return MergedModel(model, similarity, shared, fused, status, "")


def part_of_model(model: Reconstruction, images: Bool[Tensor, "v"]) -> Reconstruction:
    """Some images of a model, with the points that two of them see at least.

    Args:
        model: The model.
        images: Which of its images to keep. Lines, conics and curves are left out.

    See the example of `merge_models`.
    """
    kept = (images & model.registered)[model.view]
    enough = torch.bincount(model.point[kept], minlength=model.num_points) >= 2
    kept &= enough[model.point]
    number, view = enough.cumsum(0) - 1, images.cumsum(0) - 1
    return replace(
        model,
        names=tuple(name for name, keep in zip(model.names, images.tolist(), strict=True) if keep),
        image_size=model.image_size[images],
        camera_index=model.camera_index[images],
        poses=model.poses[images],
        registered=model.registered[images],
        X=model.X[enough],
        color=model.color[enough],
        x=model.x[kept],
        view=view[model.view[kept]],
        point=number[model.point[kept]],
        lines=None,
        conics=None,
        curves=None,
    )


def _common_kind(a: type[Distortion], b: type[Distortion]) -> type[Distortion] | None:
    """The first distortion model that holds those of both."""
    return next((kind for kind in DISTORTION_MODELS.values() if kind.includes(a) and kind.includes(b)), None)


def _as_kind(cameras: Camera, kind: type[Distortion]) -> Camera:
    """The same cameras with a distortion model that holds theirs."""
    own = cameras.distortion
    count = len(cameras.K)
    values = dict(zip(own.parameter_names, own.parameters().reshape(count, own.num_parameters).unbind(-1), strict=True))
    zero = cameras.K.new_zeros(count)
    columns = [values.get(name, zero) for name in kind.parameter_names]
    numbers = torch.stack(columns, -1) if columns else cameras.K.new_zeros(count, 0)
    return Camera(cameras.K, kind.from_parameters(numbers))


def _same_observations(a: Reconstruction, b: Reconstruction, both: list[tuple[int, int]]) -> Int[Tensor, "k 2"]:
    """Pairs of observations, of a and of b, that are at the same place in a shared image, each the other's nearest.

    Where several are at the very same place (features of two orientations), the first of a is that of b, and so on.
    """
    found = [torch.zeros(0, 2, dtype=torch.long)]
    for i, j in both:
        first, second = (a.view == i).nonzero()[:, 0], (b.view == j).nonzero()[:, 0]
        if not len(first) or not len(second):
            continue
        mine, theirs = _numbered(a.x[first]), _numbered(b.x[second])
        distance, nearest = [], []
        back = torch.full((len(second),), torch.inf, dtype=a.x.dtype)
        owner = torch.zeros(len(second), dtype=torch.long)
        for start in range(0, len(first), BLOCK):
            gap = torch.cdist(mine[start : start + BLOCK], theirs, compute_mode="donot_use_mm_for_euclid_dist")
            least = gap.min(dim=1)
            distance.append(least.values)
            nearest.append(least.indices)
            column = gap.min(dim=0)
            owner = torch.where(column.values < back, start + column.indices, owner)
            back = torch.minimum(back, column.values)
        to, near = torch.cat(nearest), torch.cat(distance)
        good = (near <= SAME) & (owner[to] == torch.arange(len(first)))
        found.append(torch.stack((first[good], second[to[good]]), 1))
    return torch.cat(found)


def _numbered(x: Float[Tensor, "m 2"]) -> Float[Tensor, "m 3"]:
    """Image points with a third coordinate: how many at the very same place came before."""
    _, place, count = torch.unique(x, dim=0, return_inverse=True, return_counts=True)
    order = torch.argsort(place, stable=True)
    before = torch.empty_like(place)
    before[order] = torch.arange(len(x)) - (count.cumsum(0) - count)[place[order]]
    return torch.cat((x, before[:, None].to(x)), 1)


def _similarity(
    a: Reconstruction, b: Reconstruction, both: list[tuple[int, int]], pairs: Int[Tensor, "k 2"]
) -> tuple[Similarity, Bool[Tensor, "k"], str]:
    """From b to a, which of the shared observations agree with it, and why there is none."""
    cameras = align_models(b, a)
    tried = [cameras.similarity] if not cameras.fault() else []
    point = torch.unique(torch.stack((a.point[pairs[:, 0]], b.point[pairs[:, 1]]), 1), dim=0)
    if len(point) >= LEAST_PAIRS:
        by_points, _ = robust_similarity(b.X[point[:, 1]], a.X[point[:, 0]])
        if by_points.status == Status.OK:
            tried.append(by_points)
    none = torch.zeros(len(pairs), dtype=torch.bool)
    if not tried:
        what = f"{len(both)} images and {len(point)} points"
        return cameras.similarity, none, f"the models have too little in common, {what}"
    agreeing = [_agreeing(a, b, pairs, similarity) for similarity in tried]
    best = max(range(len(tried)), key=lambda k: int(agreeing[k].sum()))
    agree, similarity = agreeing[best], tried[best]
    if len(point) >= LEAST_PAIRS:
        share = float(agree.double().mean())
        if share < AGREEING:
            return similarity, none, f"the models contradict each other: {100 * share:.0f} % of their shared points agree"
        return similarity, agree, ""
    spread = float((a.poses.centre[[i for i, _ in both]] - a.poses.centre[both[0][0]]).norm(dim=-1).max())
    used = cameras.used
    if int(used.sum()) < LEAST_CAMERAS:
        what = f"{len(both)} images, of which {int(used.sum())} agree, and {len(point)} points"
        return similarity, none, f"the models have too little in common, {what}"
    i, j = torch.tensor(both).unbind(1)
    turned = rotation_angle(similarity.transform_pose(b.poses[j]).R @ a.poses.R[i].mT)[used]
    off = float(cameras.distance[used].max()) > CAMERA_SHIFT * spread or float(turned.max()) > CAMERA_TURN
    if 2 * int(used.sum()) < len(both) or off:
        return similarity, none, "the models contradict each other in where the shared cameras are"
    return similarity, agree, ""


def _agreeing(a: Reconstruction, b: Reconstruction, pairs: Int[Tensor, "k 2"], similarity: Similarity) -> Bool[Tensor, "k"]:
    """Whether each model's points project near the other's image points."""
    i, j = a.view[pairs[:, 0]], b.view[pairs[:, 1]]
    gate = (GATE_SHARE * a.image_size[i].amax(-1)).clamp(min=GATE)
    good = torch.ones(len(pairs), dtype=torch.bool)
    inverse = similarity.inverse()
    for model, view, X, x in (
        (a, i, similarity.transform(b.X)[b.point[pairs[:, 1]]], a.x[pairs[:, 0]]),
        (b, j, inverse.transform(a.X)[a.point[pairs[:, 0]]], b.x[pairs[:, 1]]),
    ):
        seen = model.poses[view].transform(X[:, None])
        error = (model.cameras[model.camera_index[view]].project(seen)[:, 0] - x).norm(dim=-1)
        good &= (seen[:, 0, 2] > 0) & (error < gate)
    return good


def _joined(
    a: Reconstruction, b: Reconstruction, both: list[tuple[int, int]], same: Int[Tensor, "k 2"], kind: type[Distortion]
) -> Mapping:
    """Both models, which are in one world now, as one whose shared points are one.

    Args:
        a: The first model.
        b: The second one in its world.
        both: Shared images.
        same: Observations of a and b that are one.
        kind: The distortion model that holds all cameras.
    """
    place = {name: i for i, name in enumerate(a.names)}
    new = [j for j, name in enumerate(b.names) if name not in place]
    view_of = torch.tensor([place.get(name, -1) for name in b.names], dtype=torch.long)
    view_of[new] = len(a.names) + torch.arange(len(new))
    camera_index, cameras = _joined_cameras(a, b, both, new, kind)
    poses = Pose(torch.cat((a.poses.R, b.poses.R[new])), torch.cat((a.poses.t, b.poses.t[new])))
    registered = torch.cat((a.registered, b.registered[new]))
    late = b.registered & ~registered[view_of]  # in both, with a pose in the second model alone
    R, t = poses.R.clone(), poses.t.clone()
    R[view_of[late]], t[view_of[late]] = b.poses.R[late], b.poses.t[late]
    registered[view_of[late]] = True
    # An image point for each observation, one for those that are the same.
    m = len(a.x)
    node_of = torch.full((len(b.x),), -1, dtype=torch.long)
    node_of[same[:, 1]] = same[:, 0]
    own = (node_of < 0).nonzero()[:, 0]
    node_of[own] = m + torch.arange(len(own))
    links = torch.cat((_links(a.point), node_of[_links(b.point)]))
    links = links[links[:, 0] != links[:, 1]]
    view = torch.cat((a.view, view_of[b.view[own]]))
    none = torch.zeros(0, dtype=torch.long)
    graph = ViewGraph(
        names=(*a.names, *(b.names[j] for j in new)),
        image_size=torch.cat((a.image_size, b.image_size[new])),
        x=torch.cat((a.x, b.x[own])),
        view=view,
        color=torch.cat((a.color[a.point], b.color[b.point[own]])),
        pairs=torch.zeros(0, 2, dtype=torch.long),
        num_matches=none,
        F=a.X.new_zeros(0, 3, 3),
        H=a.X.new_zeros(0, 3, 3),
        fundamental_inliers=none,
        homography_inliers=none,
        match=links,
        match_pair=torch.zeros(len(links), dtype=torch.long),
    )
    mapping = Mapping.start(graph, build_tracks(view, graph.match), cameras, camera_index)
    mapping = replace(mapping, poses=Pose(R, t), registered=registered)
    # The points of a keep their observations; a point of b goes to the one of a that most of its observations share.
    votes, count = torch.unique(torch.stack((b.point[same[:, 1]], a.point[same[:, 0]]), 1), dim=0, return_counts=True)
    target = torch.full((len(b.X),), -1, dtype=torch.long)
    order = torch.argsort(count, stable=True)
    target[votes[order, 0]] = votes[order, 1]
    alone = target < 0
    target[alone] = len(a.X) + torch.arange(int(alone.sum()))
    X = torch.cat((a.X, b.X[alone]))
    mapping = replace(mapping, X=X, point=torch.cat((a.point, torch.full((len(own),), -1, dtype=torch.long))))
    point = target[b.point[own]]
    return mapping.assign(node_of[own], point, torch.zeros(len(own), dtype=X.dtype)).compacted()


def _links(point: Int[Tensor, "m"]) -> Int[Tensor, "k 2"]:
    """Observations of one point, each with the next; they are sorted by it, or not."""
    order = torch.argsort(point, stable=True)
    next_one = point[order[1:]] == point[order[:-1]]
    return torch.stack((order[:-1][next_one], order[1:][next_one]), 1)


def _joined_cameras(
    a: Reconstruction, b: Reconstruction, both: list[tuple[int, int]], new: list[int], kind: type[Distortion]
) -> tuple[Int[Tensor, "v"], Camera]:
    """The cameras of all images: one of b is one of a where it took the same images of both."""
    met: dict[int, set[int]] = {}
    for i, j in both:
        met.setdefault(int(b.camera_index[j]), set()).add(int(a.camera_index[i]))
    mine, theirs = _as_kind(a.cameras, kind), _as_kind(b.cameras, kind)
    number, added = dict[int, int](), list[int]()
    for k in sorted({int(b.camera_index[j]) for j in new}):
        if len(met.get(k, ())) == 1:
            number[k] = next(iter(met[k]))
        else:
            number[k] = len(mine.K) + len(added)
            added.append(k)
    index = torch.tensor([number[int(b.camera_index[j])] for j in new], dtype=torch.long)
    parameters = [one.distortion.parameters().reshape(len(one.K), kind.num_parameters) for one in (mine, theirs)]
    numbers = torch.cat((parameters[0], parameters[1][added]))
    cameras = Camera(torch.cat((mine.K, theirs.K[added])), kind.from_parameters(numbers))
    return torch.cat((a.camera_index, index)), cameras


def _adjusted(mapping: Mapping, fixed_cameras: bool) -> Mapping:
    """The joined model at its minimum, with what does not fit left out and what fits taken in."""
    limits: dict[str, Any] = {"max_iterations": LAST_ITERATIONS, "tolerance": LAST_TOLERANCE}
    names = () if fixed_cameras else ("focal", *mapping.cameras.distortion.parameter_names, "principal_point")
    prior = CameraPrior.of(mapping, mapping.cameras, torch.full((len(mapping.cameras.K),), FOCAL_SIGMA, dtype=mapping.X.dtype))
    mapping = adjust(mapping, **limits)
    for _ in range(ROUNDS):
        mapping = filter_points(mapping, threshold=ERROR, min_angle=ANGLE)
        mapping = triangulate_tracks(mapping, threshold=ERROR, min_angle=ANGLE)
        mapping = complete_tracks(mapping, threshold=ERROR)
        mapping = merge_points(mapping, threshold=ERROR)
        if not len(mapping.X):
            return mapping
        mapping = adjust_all(mapping, names, prior, **limits) if names else adjust(mapping, **limits)
    return filter_points(mapping, threshold=ERROR, min_angle=ANGLE)
