"""Which segments of several views show one line? Lines of two views are proposed; further views bear them out or not."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Pose, camera_from_krt
from torchsfm.images.segment_matching import epipolar_overlap
from torchsfm.optim import Cauchy
from torchsfm.reconstruction.lines.stretch import places_on_lines, shared_stretch
from torchsfm.reconstruction.model.lines import fit_points
from torchsfm.tensors import fundamental_from_cameras
from torchsfm.triangulation import triangulate_lines

MIN_VIEWS = 3
"""Two views agree on a line whatever they show: the third one tells."""
PAIR_OVERLAP, OVERLAP = 0.3, 0.5
"""Least common part of two segments along epipolar lines, and least part of a segment within the image of its line."""
PAIR_SIMILARITY, SIMILARITY = 0.7, 0.6
"""Least cosines of descriptors: of a proposed pair, and of a further view and the first."""
MIN_ANGLE = 0.02
"""Least angle of planes of sight, radians."""
VAGUE, UNSURE = 0.05, 0.01
"""Largest standard deviation of an end across its line, over its distance from the cameras: of proposed and of final lines."""
IMPROBABLE = 1e-3
"""Segments, and lines, that are farther off each other than this share by noise alone do not belong together."""
ROUNDS = 4
"""Times that lines are fitted and segments left out."""
STEPS = 15
"""Most steps of the least squares of a line."""
CHUNK = 1 << 20
"""Pairs of lines and segments looked at together."""


@dataclass(frozen=True)
class ViewSegments:
    """The segments of all views one after the other, where an ideal camera would have seen them."""

    ends: Float[Tensor, "n 2 2"]
    """Pixels of pinhole cameras: lenses taken out."""
    descriptor: Float[Tensor, "n d"]
    view: Int[Tensor, "n"]
    weight: Float[Tensor, "n"]
    """Inverse variance across each segment."""
    first: Int[Tensor, "v"]
    """The first segment of each view, which are together."""
    count: Int[Tensor, "v"]

    def of(self, view: int) -> slice:
        """Those of a view."""
        return slice(int(self.first[view]), int(self.first[view] + self.count[view]))


@dataclass(frozen=True)
class Cameras:
    """The placed views: cameras without lenses, and how far from each its points are."""

    K: Float[Tensor, "v 3 3"]
    poses: Pose
    depth: Float[Tensor, "v 2"]
    """Nearest and farthest depth at which lines are looked for; NaN in views that are not placed."""
    neighbours: list[list[int]]
    """Views that see the same, of each view, the best first."""

    @property
    def P(self) -> Float[Tensor, "v 3 4"]:
        """Camera matrices."""
        return camera_from_krt(self.K, self.poses.R, self.poses.t)


@dataclass(frozen=True)
class LineTracks:
    """Lines and the segments that show them."""

    ends: Float[Tensor, "l 2 3"]
    segment: Int[Tensor, "k"]
    """Numbers of segments, sorted by line."""
    line: Int[Tensor, "k"]


def propose_lines(segments: ViewSegments, cameras: Cameras, pairs: int) -> tuple[Float[Tensor, "h 2 3"], Int[Tensor, "h"]]:
    """Lines of pairs of segments that look alike in neighbouring views, and the first segment of each.

    Args:
        segments: Of all views.
        cameras: The views.
        pairs: Neighbours of each view to compare it with.
    """
    P = cameras.P
    chosen = sorted({(min(i, j), max(i, j)) for i, some in enumerate(cameras.neighbours) for j in some[:pairs]})
    both = [_match(segments, i, j, fundamental_from_cameras(P[i], P[j])) for i, j in chosen]
    couple = torch.cat([torch.zeros(0, 2, dtype=torch.long), *both])
    if not len(couple):
        return P.new_zeros(0, 2, 3), couple[:, 0]
    found = _triangulate(segments, cameras, couple)
    keep = found.good & (found.spread < VAGUE) & (_inside(found.ends, segments.view[couple], cameras)).all(1)
    return found.ends[keep], couple[keep, 0]


def link_lines(
    ends: Float[Tensor, "h 2 3"], reference: Int[Tensor, "h"], segments: ViewSegments, cameras: Cameras, tolerance: float
) -> LineTracks:
    """Lines that three views or more agree on: those that most views show first, each segment given to one line.

    What is left of duplicates has no segments of its own, so that they vanish.

    Args:
        ends: Ends of proposed lines.
        reference: A segment of each.
        segments: Of all views.
        cameras: The views.
        tolerance: Largest distance of segments from the images of their lines, pixels.

    Returns:
        The lines by least squares from all their segments, and these, those that do not agree left out.
    """
    line, segment = _supporters(ends, reference, segments, cameras, tolerance)
    number, member = _share(line, segment, segments)
    if not len(member):
        return LineTracks(ends[:0], member, number)
    for _ in range(ROUNDS):
        found = _fit(number, member, segments, cameras)
        good = (found.good & (found.spread < VAGUE))[number] & (found.distance <= tolerance)
        good &= _consistent(found, number) & _shared(found, number, member, segments, cameras).within
        number, member = _of_enough_views(number[good], member[good], segments)
        if not len(member):
            return LineTracks(ends[:0], member, number)
    found = _fit(number, member, segments, cameras)
    shared = _shared(found, number, member, segments, cameras)
    keep = found.good & (found.spread < UNSURE) & shared.together & (_misfit(found, number)[0] >= IMPROBABLE)
    keep &= _every_view_in_front(shared.ends, number, segments.view[member], cameras)
    rows = keep[number]
    return LineTracks(shared.ends[keep], member[rows], (keep.cumsum(0) - 1)[number[rows]])


@dataclass(frozen=True)
class _Fit:
    ends: Tensor
    good: Tensor
    spread: Tensor
    """Standard deviation of the ends across the line, over their distance from the first camera."""
    distance: Tensor
    """Of each segment from the image of its line, pixels."""
    square: Tensor
    """The squared distances of its two points together, over their variance."""


@dataclass(frozen=True)
class _Shared:
    ends: Tensor
    """Of the stretch that enough views show."""
    together: Tensor
    """Whether that is most of what all show."""
    within: Tensor
    """Whether most of each segment, or of the stretch, is part of the other."""


def _match(segments: ViewSegments, i: int, j: int, F: Tensor) -> Tensor:
    """Each other's best among the segments that epipolar lines let be one, as numbers of segments (m, 2)."""
    a, b = segments.of(i), segments.of(j)
    if a.start == a.stop or b.start == b.stop:
        return torch.zeros(0, 2, dtype=torch.long)
    similarity = segments.descriptor[a] @ segments.descriptor[b].mT
    allowed = epipolar_overlap(segments.ends[a], segments.ends[b], F) >= PAIR_OVERLAP
    similarity = torch.where(allowed, similarity, -2.0)
    best, there = similarity.max(1)
    own = torch.arange(len(best))
    keep = (best >= PAIR_SIMILARITY) & (similarity.argmax(0)[there] == own)
    return torch.stack((own[keep] + a.start, there[keep] + b.start), 1)


def _triangulate(
    segments: ViewSegments, cameras: Cameras, members: Int[Tensor, "t m"], there: Tensor | None = None, steps: int = 0
) -> _Fit:
    """Lines of segments, a row of them each; two planes need no steps."""
    view = segments.view[members]
    x, weights = fit_points(segments.ends[members]), segments.weight[members]
    visible = torch.ones_like(view, dtype=torch.bool) if there is None else there
    P = cameras.P[view]
    found = triangulate_lines(
        x[:, :, None], P, visible=visible[:, :, None], weights=weights[:, :, None], loss=Cauchy(1.0), max_iterations=steps
    )
    ends = found.ends[:, 0]
    distance = (ends - cameras.poses.centre[view[:, 0], None]).norm(dim=-1).amin(1)
    spread = found.end_covariance[:, 0].diagonal(dim1=-2, dim2=-1).sum(-1).amax(-1).sqrt()
    # The adjustment of everything goes on where the steps end.
    status = found.status[:, 0]
    good = ((status == Status.OK) | (status == Status.NOT_CONVERGED)) & (found.angle[:, 0] > MIN_ANGLE)
    good = good & ends.isfinite().all(-1).all(-1) & ((ends[:, 1] - ends[:, 0]).norm(dim=-1) > 0)
    h = torch.nn.functional.pad(ends, (0, 1), value=1.0)[:, None] @ P.mT
    image = torch.linalg.cross(h[:, :, 0], h[:, :, 1])[:, :, None]
    away = _distance(segments.ends[members], image).abs().amax(-1)
    square = _distance(x, image).square().sum(-1) * weights
    return _Fit(ends, good, spread / distance, torch.where(visible, away, torch.inf), square)


def _fit(number: Tensor, member: Tensor, segments: ViewSegments, cameras: Cameras) -> _Fit:
    """Lines of tracks, distances in the order of their segments."""
    sizes = torch.bincount(number)
    place = torch.arange(len(number)) - (sizes.cumsum(0) - sizes)[number]
    table = torch.zeros(len(sizes), int(sizes.max()), dtype=torch.long)
    there = torch.zeros_like(table, dtype=torch.bool)
    table[number, place], there[number, place] = member, True
    # What is not there stands for any.
    found = _triangulate(segments, cameras, table, there, STEPS)
    return replace(found, distance=found.distance[number, place], square=found.square[number, place])


def _misfit(found: _Fit, number: Tensor) -> tuple[Tensor, Tensor]:
    """How probable it is that segments of one line are as far off it as they are, and the squares over those of the noise.

    Where cameras are less certain than segments the noise is what the distances say.
    """
    size = torch.bincount(number, minlength=len(found.ends))
    freedom = 2.0 * (size - 2).clamp_min(1)
    total = found.square.new_zeros(len(size)).index_add(0, number, found.square)
    # The median of chi-square, nearly.
    noise = (total / (freedom * (1 - 2 / (9 * freedom)) ** 3)).median().clamp_min(1.0)
    return torch.special.gammaincc(freedom.to(total.dtype) / 2, total / (2 * noise)), found.square / noise


def _consistent(found: _Fit, number: Tensor) -> Tensor:
    """Which segments may well be of their lines; of lines that are improbable not the one farthest off."""
    chance, square = _misfit(found, number)
    worst = square.new_zeros(len(chance)).scatter_reduce(0, number, square, "amax")
    keep: Tensor = (square <= -2 * math.log(IMPROBABLE)) & ~((chance < IMPROBABLE)[number] & (square == worst[number]))
    return keep


def _shared(found: _Fit, number: Tensor, member: Tensor, segments: ViewSegments, cameras: Cameras) -> _Shared:
    """The stretches of lines that enough views show."""
    view = segments.view[member]
    span = places_on_lines(segments.ends[member], cameras.P[view], found.ends[number])
    stretch, there = shared_stretch(number, view, span, MIN_VIEWS)
    length = (stretch[:, 1] - stretch[:, 0])[number]
    common = span[:, 1].minimum(stretch[number, 1]) - span[:, 0].maximum(stretch[number, 0])
    within = there[number] & (common >= OVERLAP * length.minimum(span[:, 1] - span[:, 0]))
    together = there & (stretch[:, 1] - stretch[:, 0] >= OVERLAP)
    first, last = found.ends[:, :1], found.ends[:, 1:]
    return _Shared(first + stretch[..., None] * (last - first), together, within)


def _distance(x: Float[Tensor, "*#n 2"], line: Float[Tensor, "*#n 3"]) -> Float[Tensor, "*n"]:
    value: Tensor = ((x * line[..., :2]).sum(-1) + line[..., 2]) / line[..., :2].norm(dim=-1).clamp_min(1e-300)
    return value


def _depth(ends: Float[Tensor, "n 2 3"], view: Int[Tensor, "n"], cameras: Cameras) -> Float[Tensor, "n 2"]:
    return (ends * cameras.poses.R[view, None, 2]).sum(-1) + cameras.poses.t[view, None, 2]


def _inside(ends: Float[Tensor, "n 2 3"], view: Int[Tensor, "n m"], cameras: Cameras) -> Bool[Tensor, "n m"]:
    """Whether lines are about as far away as the points that the views see."""
    depth = torch.stack([_depth(ends, some, cameras) for some in view.unbind(1)], 1)
    near, far = cameras.depth[view].unbind(-1)
    return ((depth > near[..., None]) & (depth < far[..., None])).all(-1)


def _every_view_in_front(ends: Tensor, number: Tensor, view: Tensor, cameras: Cameras) -> Tensor:
    behind = (_depth(ends[number], view, cameras) <= 0).any(-1)
    return torch.bincount(number, weights=behind.double(), minlength=len(ends)) == 0


def _supporters(
    ends: Tensor, reference: Tensor, segments: ViewSegments, cameras: Cameras, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Lines and segments of the views around their first one that agree, as pairs."""
    P, lines, members = cameras.P, [reference.new_zeros(0)], [reference.new_zeros(0)]
    home = segments.view[reference]
    for i in torch.unique(home).tolist():
        own = (home == i).nonzero()[:, 0]
        for j in [i, *cameras.neighbours[i]]:
            some = segments.of(j)
            if some.start == some.stop:
                continue
            for part in own.split(max(1, CHUNK // (some.stop - some.start))):
                agree = _agree(ends[part], segments.ends[some], P[j], tolerance)
                agree &= segments.descriptor[reference[part]] @ segments.descriptor[some].mT >= SIMILARITY
                a, b = agree.nonzero().unbind(1)
                lines.append(part[a])
                members.append(b + some.start)
    return torch.cat(lines), torch.cat(members)


def _agree(ends: Float[Tensor, "h 2 3"], seen: Float[Tensor, "s 2 2"], P: Float[Tensor, "3 4"], tolerance: float) -> Tensor:
    """Whether segments are near the images of lines, and for the most part between their ends, (h, s)."""
    h = torch.nn.functional.pad(ends, (0, 1), value=1.0) @ P.mT
    front = (h[..., 2] > 0).all(-1)
    image = h[..., :2] / torch.where(h[..., 2:] > 0, h[..., 2:], 1.0)
    line = torch.linalg.cross(h[:, 0], h[:, 1])
    line = line / line[:, :2].norm(dim=-1, keepdim=True).clamp_min(1e-300)
    d = image[:, 1] - image[:, 0]
    length = d.norm(dim=-1).clamp_min(1e-9)
    d = d / length[:, None]
    ahead = torch.cat((d, -(image[:, 0] * d).sum(-1, keepdim=True)), -1)
    first, last = torch.nn.functional.pad(seen, (0, 1), value=1.0).unbind(1)
    near = (line @ first.mT).abs().maximum((line @ last.mT).abs()) <= tolerance
    a, b = ahead @ first.mT, ahead @ last.mT
    common = a.maximum(b).minimum(length[:, None]) - a.minimum(b).clamp_min(0)
    size = (seen[:, 1] - seen[:, 0]).norm(dim=-1).minimum(length[:, None])
    agree: Tensor = near & front[:, None] & (common >= OVERLAP * size)
    return agree


def _share(line: Tensor, segment: Tensor, segments: ViewSegments) -> tuple[Tensor, Tensor]:
    """Give each segment to the line that most views show, then that with most of segments; lines of too few views go."""
    views = _support(line, segments.view[segment], len(segments.first))
    length = segments.ends[:, 1].sub(segments.ends[:, 0]).norm(dim=-1)
    total = length.new_zeros(len(views)).index_add(0, line, length[segment])
    order = torch.argsort(total, descending=True, stable=True)
    order = order[torch.argsort(views[order], descending=True, stable=True)]
    rank = torch.empty_like(order).index_copy(0, order, torch.arange(len(order)))
    by_rank = torch.argsort(rank[line], stable=True)
    groups = torch.unique_consecutive(line[by_rank], return_counts=True)[1].tolist()
    used = torch.zeros(len(segments.view), dtype=torch.bool).numpy()
    of_view, table = segments.view.tolist(), segment[by_rank].tolist()
    number: list[int] = []
    member: list[int] = []
    start = 0
    for size in groups:
        left = [s for s in table[start : start + size] if not used[s]]
        start += size
        if len({of_view[s] for s in left}) >= MIN_VIEWS:
            used[left] = True
            number += [number[-1] + 1 if number else 0] * len(left)
            member += left
    return torch.tensor(number, dtype=torch.long), torch.tensor(member, dtype=torch.long)


def _support(line: Tensor, view: Tensor, views: int) -> Tensor:
    """Number of views of each line."""
    key = torch.unique(line * views + view)
    return torch.bincount(torch.div(key, max(views, 1), rounding_mode="floor"))


def _of_enough_views(number: Tensor, member: Tensor, segments: ViewSegments) -> tuple[Tensor, Tensor]:
    """The tracks that three views still show, numbered anew."""
    if not len(number):
        return number, member
    enough = _support(number, segments.view[member], len(segments.first)) >= MIN_VIEWS
    keep = enough[number]
    return torch.unique(number[keep], return_inverse=True)[1], member[keep]
