"""The road that assumes nothing of the camera: projective structure and motion by factorisation, then autocalibration.

Tracks -> `factorize_points` -> projective bundle adjustment, with one radial distortion where it pays ->
`autocalibrate_points` -> a metric model, which then grows and is adjusted like any other. No fundamental matrix, no first
pair, no guess of the focal length.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, tensor_map
from torchsfm.autocalibration import Assumption, Autocalibration, autocalibrate_points
from torchsfm.bundle import bundle_adjust_projective
from torchsfm.geometry import Camera, Pose, krt_from_camera
from torchsfm.motion import factorize_points
from torchsfm.optim import Cauchy
from torchsfm.reconstruction.mapping.cameras import FOCAL_SIGMA
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import triangulate_tracks

MIN_VIEWS = 3
TRACKS_PER_VIEW = 150
"""Longest tracks of each image that take part: enough for its camera, few enough for the factorisation."""
TRACKS_FOR_DISTORTION = 300
WIDEST = 0.3
"""Largest change of the radius in the corner of the image that the search for distortion goes to."""
WORTHWHILE = 0.05
"""Part of the cost that a distortion must explain to be believed: less than that other faults of the observations do too."""
REFUSALS = {
    Status.DEGENERATE: "the motion and the scene do not determine the focal length",
    Status.NO_CONSENSUS: "no camera of the kind assumed fits",
    Status.BEHIND: "points would lie behind cameras",
    Status.TOO_FEW: "there are too few images or points",
    Status.NOT_FINITE: "the projective cameras are not usable",
}


@dataclass(frozen=True)
class ProjectiveStart:
    """What the projective road found of one component of images.

    `mapping` is the metric model to go on from, None where it was refused. `summary` says what was assumed, what came out and
    how well it is determined, or why nothing came out. `views` are the images that took part, `focal_sigma` the standard
    deviation of each camera's focal length as a fraction.
    """

    mapping: Mapping | None
    summary: str
    views: Int[Tensor, "k"]
    focal_sigma: Float[Tensor, "g"]

    def expected(self) -> Camera:
        """The cameras of `mapping` with centred principal points and without distortion: what later adjustments expect.

        Raises:
            ValueError: There is no mapping.
        """
        if self.mapping is None:
            raise ValueError("mapping: wanted a start that was not refused")
        cameras, index = self.mapping.cameras, self.mapping.camera_index
        K = cameras.K.clone()
        first = torch.stack([(index == g).nonzero()[0, 0] for g in range(len(K))])
        K[:, :2, 2] = (self.mapping.graph.image_size[first].to(K.dtype) - 1) / 2
        return Camera(K, tensor_map(torch.zeros_like, cameras.distortion))


@dataclass(frozen=True)
class _Problem:
    """The longest tracks of some images, as dense arrays."""

    view: Int[Tensor, "v"]
    x: Float[Tensor, "v n 2"]
    visible: Bool[Tensor, "v n"]
    image_size: Float[Tensor, "v 2"]


def projective_start(
    empty: Mapping, available: Bool[Tensor, "v"], *, threshold: float, min_angle: float
) -> ProjectiveStart | None:
    """Reconstruct the largest set of images that hang together, without calibration, and upgrade it.

    Args:
        empty: A mapping without registered images; of its cameras the distortion model and the sharing count, not the numbers.
        available: Images that may take part.
        threshold: Largest reprojection error of an observation in pixels.
        min_angle: Smallest angle between the rays of a point.

    Returns:
        The start, or None if fewer than three images hang together.
    """
    problem = _problem(empty, available)
    if problem is None:
        return None
    nothing = torch.zeros(0, dtype=problem.x.dtype)
    factors = factorize_points(problem.x, visible=problem.visible, robust=True)
    status = Status(int(factors.status))
    if status not in (Status.OK, Status.NOT_CONVERGED):
        words = (
            "the tracks do not determine the projective cameras"
            if status == Status.DEGENERATE
            else "too few tracks are long enough"
        )
        return ProjectiveStart(
            None, f"no projective reconstruction of {len(problem.view)} images: {words}", problem.view, nothing
        )
    used = factors.used_view.nonzero()[:, 0]
    kept = factors.used_point.nonzero()[:, 0]
    problem = _Problem(problem.view[used], problem.x[used][:, kept], problem.visible[used][:, kept], problem.image_size[used])
    P, X = factors.P[used], factors.X[kept]
    P, X, seen = _adjust(P, X, problem, problem.x, problem.visible, threshold)
    k = _distortion(P, X, problem, seen)
    x, _ = _straighten(problem, k)
    P, X, seen = _adjust(P, X, problem, x, problem.visible, threshold)
    shared = empty.camera_index[problem.view]
    one = bool((shared == shared[0]).all())
    varying = Assumption(varying=("focal",))
    found = autocalibrate_points(
        P, X, x, image_size=problem.image_size, visible=seen, assume=(Assumption(), varying) if one else (varying,)
    )
    summary = _summary(problem, found, k)
    if found.status != Status.OK:
        return ProjectiveStart(None, summary, problem.view, nothing)
    mapping = _metric(empty, problem, found, k)
    mapping = triangulate_tracks(mapping, threshold=2 * threshold, min_angle=min_angle)
    sigma = torch.full((len(mapping.cameras.K),), FOCAL_SIGMA["default"], dtype=problem.x.dtype)
    sigma[mapping.camera_index[problem.view]] = FOCAL_SIGMA["autocalibration"]
    return ProjectiveStart(mapping, summary, problem.view, sigma)


def _problem(empty: Mapping, available: Bool[Tensor, "v"]) -> _Problem | None:
    graph, track = empty.graph, empty.track
    v = len(graph.names)
    node = ((track >= 0) & available[graph.view]).nonzero()[:, 0]
    length = torch.bincount(track[node], minlength=int(track.max()) + 1 if len(track) else 1)
    node = node[length[track[node]] >= 3]
    if not len(node):
        return None
    member = _component(graph.view[node], track[node], v)
    node = node[member[graph.view[node]]]
    if int(member.sum()) < MIN_VIEWS:
        return None
    longest = node[torch.argsort(length[track[node]], descending=True, stable=True)]
    chosen = torch.zeros(len(length), dtype=torch.bool)
    for i in member.nonzero()[:, 0].tolist():
        chosen[track[longest[graph.view[longest] == i][:TRACKS_PER_VIEW]]] = True
    node = node[chosen[track[node]]]
    row = torch.where(member, member.cumsum(0) - 1, -1)
    column = torch.where(chosen, chosen.cumsum(0) - 1, -1)
    count = int(member.sum()), int(chosen.sum())
    x, visible = graph.x.new_zeros(*count, 2), torch.zeros(count, dtype=torch.bool)
    place = row[graph.view[node]], column[track[node]]
    x[place], visible[place] = graph.x[node], True
    return _Problem(member.nonzero()[:, 0], x, visible, graph.image_size[member].to(x.dtype))


def _component(view: Int[Tensor, "k"], track: Int[Tensor, "k"], v: int) -> Bool[Tensor, "v"]:
    """The largest set of images linked by pairs that share at least eight tracks."""
    _, track = torch.unique(track, return_inverse=True)
    seen = torch.zeros(v, int(track.max()) + 1)
    seen[view, track] = 1
    linked = (seen @ seen.T) >= 8
    linked.fill_diagonal_(True)
    reach = linked.float()
    for _ in range(max(1, v.bit_length())):
        reach = ((reach @ reach) > 0).float()
    return reach[int(reach.sum(-1).argmax())] > 0


def _adjust(
    P: Tensor, X: Tensor, problem: _Problem, x: Tensor, visible: Tensor, threshold: float, rounds: int = 2
) -> tuple[Tensor, Tensor, Tensor]:
    """Robust projective bundle adjustment and removal of what does not fit, in turns."""
    scale = (problem.image_size.amax() / 1600).clamp_min(1)
    limit = float(threshold * scale)
    seen = visible
    for step in range(rounds):
        view, point = seen.nonzero(as_tuple=True)
        loss = Cauchy(float(scale) * (2.0 if step == 0 else 1.0))
        result = bundle_adjust_projective(P, X, x[view, point], view, point, loss=loss, max_iterations=30)
        P, X = result.P, result.X
        fits = visible & (_errors(P, X, x) < limit)
        seen = fits & (fits.sum(0) >= 2)
    return P, X, seen


def _errors(P: Tensor, X: Tensor, x: Tensor) -> Tensor:
    h = torch.einsum("vij,nj->vni", P, X)
    error = (h[..., :2] / h[..., 2:] - x).norm(dim=-1)
    return torch.nan_to_num(error, torch.inf)


def _straighten(problem: _Problem, k: float) -> tuple[Tensor, Tensor]:
    """Image points with radial distortion removed, and how much a small length at each grows.

    The radius r, in units of that of the corner, becomes `r (1 + k r^2)`.
    """
    middle = (problem.image_size - 1)[:, None] / 2
    unit = problem.image_size.norm(dim=-1)[:, None, None] / 2
    d = (problem.x - middle) / unit
    s = d.square().sum(-1, keepdim=True)
    grown = ((1 + k * s) * (1 + 3 * k * s)).abs().sqrt()[..., 0]
    return middle + unit * d * (1 + k * s), grown


def _distortion(P: Tensor, X: Tensor, problem: _Problem, seen: Tensor) -> float:
    """The distortion that makes the projective reprojection error least; 0 where that is no clear gain."""
    longest = seen.sum(0).argsort(descending=True, stable=True)[:TRACKS_FOR_DISTORTION]
    seen, X = seen[:, longest], X[longest]
    part = replace(problem, x=problem.x[:, longest], visible=problem.visible[:, longest])
    few = seen.sum(-1) < 8
    seen = seen & ~few[:, None]
    view, point = seen.nonzero(as_tuple=True)
    start = P, X

    def cost(k: float) -> float:
        nonlocal start
        x, grown = _straighten(part, k)
        weights = 1 / grown[view, point].square().clamp_min(1e-3)
        result = bundle_adjust_projective(
            *start, x[view, point], view, point, weights=weights, loss=Cauchy(1.0), max_iterations=8, tolerance=1e-4
        )
        start = result.P, result.X
        return result.cost

    tried = {0.0: cost(0.0)}
    step = 0.02
    # Walk downhill with growing steps, then halve them.
    best = 0.0
    for way in (step, -step):
        reach = way
        while abs(best + reach) <= WIDEST:
            value = tried.setdefault(best + reach, cost(best + reach))
            if value >= tried[best]:
                break
            best, reach = best + reach, 1.5 * reach
        if best != 0:
            break
    start = P, X
    width = max(abs(best) / 3, step)
    for _ in range(5):
        width /= 2
        for k in (best - width, best + width):
            tried.setdefault(k, cost(k))
            if tried[k] < tried[best]:
                best = k
                break
    return best if tried[best] < (1 - WORTHWHILE) * tried[0.0] else 0.0


def _metric(empty: Mapping, problem: _Problem, found: Autocalibration, k: float) -> Mapping:
    """The mapping with the cameras found; a camera of its own for each image where focal lengths differ."""
    v = len(empty.graph.names)
    varying = bool(found.fits[int(found.assumption)].assumption.varying)
    index = torch.arange(v) if varying else empty.camera_index
    groups = int(index.max()) + 1
    size = empty.graph.image_size.to(problem.x.dtype)
    K = torch.zeros(groups, 3, 3, dtype=problem.x.dtype)
    # Images that did not take part are given the median camera; their own is found when they are registered.
    median = found.K[:, 0, 0].median()
    first = torch.stack([(index == g).nonzero()[0, 0] for g in range(groups)])
    K[:, 0, 0] = K[:, 1, 1] = median
    K[:, :2, 2] = (size[first] - 1) / 2
    K[:, 2, 2] = 1
    for row, image in enumerate(problem.view.tolist()):
        K[index[image]] = found.K[row]
    kind = type(empty.cameras.distortion)
    names = kind.parameter_names
    lens = torch.zeros(groups, len(names), dtype=K.dtype)
    if "k1" in names:
        # To first order the inverse of the change of radius, and what autocalibration found to be left of it, in units of the
        # focal length; and what the formula lacks of a tangent.
        corner, side = size[first].norm(dim=-1) / 2, size[first].amax(-1)
        focal = K[:, 0, 0]
        lens[:, names.index("k1")] = (
            kind.straight_k1 - k * (focal / corner).square() + found.distortion * (focal / side).square()
        )
    cameras = Camera(K, kind.from_parameters(lens))
    _, R, t = krt_from_camera(found.P)
    poses = Pose.identity(v, dtype=K.dtype)
    all_R, all_t, registered = poses.R.clone(), poses.t.clone(), torch.zeros(v, dtype=torch.bool)
    all_R[problem.view], all_t[problem.view], registered[problem.view] = R, t, True
    return replace(empty, cameras=cameras, camera_index=index, poses=Pose(all_R, all_t), registered=registered)


def _summary(problem: _Problem, found: Autocalibration, k: float) -> str:
    fit = found.fits[int(found.assumption)]
    words = [f"{len(problem.view)} images and {problem.x.shape[1]} tracks; assumed: {fit.assumption}"]
    K, deviation = found.K, found.deviation
    focal = K[:, 0, 0]
    spread = f"{float(focal[0]):.1f}" if not fit.assumption.varying else f"{float(focal.min()):.1f} to {float(focal.max()):.1f}"
    sure = [
        name
        for name, known in zip(("focal length", "principal point"), found.determined[0, [0, 3]].tolist(), strict=True)
        if known
    ]
    words.append(f"focal length {spread} +- {100 * float(deviation[:, 0].max()):.2f} %")
    words.append(
        f"principal point ({float(K[0, 0, 2]):.1f}, {float(K[0, 1, 2]):.1f}) +- {float(deviation[0, 3:].max()):.1f} px"
    )
    if k:
        words.append(f"radial distortion {100 * k:.1f} % in the corner removed first")
    words.append(f"determined by the images: {', '.join(sure) or 'nothing'}")
    kinds = {
        "a pure translation": found.motion.translation,
        "planar": found.motion.planar,
        "a rotation about one axis": found.motion.one_axis & ~found.motion.planar,
        "along a line": found.motion.collinear,
        "around one point": found.motion.orbital,
    }
    if near := [kind for kind, flag in kinds.items() if bool(flag)]:
        words.append(f"the motion is nearly {' and '.join(near)}")
    if found.status != Status.OK:
        words.append(f"refused: {REFUSALS.get(Status(int(found.status)), 'not solved')}")
    return "; ".join(words)
