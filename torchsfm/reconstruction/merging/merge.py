"""Two models that share images become one."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Similarity, rotation_angle, similarity_from_points
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.mappers.incremental import LAST_ITERATIONS, LAST_TOLERANCE
from torchsfm.reconstruction.mapping.adjust import LOSS, adjust, adjust_all, adjust_by_tracks
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import complete_tracks, filter_points, merge_points, triangulate_tracks
from torchsfm.reconstruction.merging.joined_points import common_kind, joined_points, joined_views
from torchsfm.reconstruction.merging.joined_structure import with_structure
from torchsfm.reconstruction.model.alignment import align_models
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.model.same_observations import same_observations
from torchsfm.reconstruction.model.similarities import robust_similarity

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

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(8, 150, 800, generator=g).truth, "model.npz")
        >>> whole = torchsfm.read_model("model.npz")
        >>> first = torchsfm.reconstruction.part_of_model(whole, torch.arange(8) < 5)
        >>> second = torchsfm.reconstruction.part_of_model(whole, torch.arange(8) > 2)
        >>> larger = torchsfm.Similarity(torch.tensor(2.0).double(), torch.eye(3).double(), torch.zeros(3).double())
        >>> merged = torchsfm.reconstruction.merge_models(first, second.transform(larger))
        >>> merged.status.name, merged.shared_images, merged.similarity.scale.round(decimals=2)
        ('OK', ('000003', '000004'), tensor(0.5000, dtype=torch.float64))
        >>> merged.model.num_registered
        8
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


@on_the_cpu
def merge_models(a: Reconstruction, b: Reconstruction, *, fixed_cameras: bool = False) -> MergedModel:
    """Join two models that share images, by the names of these, and adjust them together.

    The similarity between the worlds is that of the shared cameras or of the shared points, which are those that have an
    observation at the same place in a shared image, whichever more of the shared points agree with; a single shared image is
    enough where it shows enough of them. Points that are one become one; cameras that took the same images are one, and begin
    as in the first model. Lines and ellipses become one where both models show them at the same places of images, curves where
    they run along each other; all are then fitted to the adjusted cameras.

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
    kind = common_kind(type(a.cameras.distortion), type(b.cameras.distortion))
    if kind is None:
        names = (type(model.cameras.distortion).__name__ for model in (a, b))
        return refused(f"no camera model holds both {' and '.join(names)}")
    pairs = same_observations(a.x, a.view, b.x, b.view, both)
    similarity, agree, why = _similarity(a, b, both, pairs)
    if why:
        return refused(why, similarity)
    moved = b.transform(similarity)
    mapping = joined_points(a, moved, both, pairs[agree], kind)
    fused = int(torch.unique(a.point[pairs[agree, 0]] * len(b.X) + b.point[pairs[agree, 1]]).numel())
    start = mapping.point >= 0
    mapping = _adjusted(mapping, fixed_cameras)
    # Of the model of which less is left: one that is wrong in itself fits nothing, however large the other is.
    of_first = torch.arange(len(start)) < len(a.x)
    of_second = ~of_first
    of_second[pairs[agree, 0]] = True
    kept = mapping.point >= 0
    left = min(float((kept & start & of).sum()) / max(int((start & of).sum()), 1) for of in (of_first, of_second))
    if left < AGREEING and bool((start & of_second).any()):
        why = f"the models contradict each other: of one only {100 * left:.0f} % of the observations fit the other"
        return refused(why, similarity, fused)
    model = with_structure(mapping.reconstruction(), a, moved, joined_views(a, b), threshold=ERROR, loss=LOSS)
    mine = torch.arange(len(model.names)) < len(a.names)
    mine[: len(a.names)] &= a.registered
    back = similarity_from_points(model.poses.centre[mine], a.poses.centre[a.registered])
    if back.status == Status.OK:
        model = model.transform(back)
    status = Status.OK if mapping.adjustment is None else mapping.adjustment.status
    return MergedModel(model, similarity, shared, fused, status, "")


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
    mapping = adjust_by_tracks(mapping, prior, **limits)
    return filter_points(mapping, threshold=ERROR, min_angle=ANGLE)
