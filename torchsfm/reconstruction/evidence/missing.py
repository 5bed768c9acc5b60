"""Missing correspondences: what two cameras at one place should both see, and do not, says that they are at two.

A thing that occurs twice makes photographs of the two match, and folds a model: cameras at one place take their bearings from
the thing alone. What stands around it differs, and no match is wrong there: they are missing (Zach, Irschara & Bischof 2008,
2010). In a folded model, two such cameras share many points in one part of the image, and in another part each has points of
its own, seen by others, none of which the other camera sees though nothing stands before them.

That nothing stands before a point is judged in two ways. Where each camera misses what the other sees in one and the same part
of the image, no thing in front of it explains both. And where a camera sees only what is as far away as a point, or
farther, beside the place where it should see that point, nothing hides it.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry.intrinsic_parameters import row_from_camera
from torchsfm.geometry.projection import PixelProjection
from torchsfm.reconstruction.evidence.occupied import Occupied
from torchsfm.reconstruction.mapping.mapping import Mapping

MAX_ANGLE = 0.35
"""Rays farther apart than this (20 degrees) need not see the same, whatever the scene."""
MAX_ZOOM = 1.5
"""Nor do cameras in whose images it differs by more than this factor how many pixels a thing at the point is wide."""
CELLS = (6, 5)
"""Columns and rows into which the image is cut."""
FINE = (24, 20)
"""Columns and rows in which the depth of what an image sees is known."""
BEHIND = 0.95
"""A point is taken to be hidden by what lies at less than this fraction of its depth."""
SAME_PLACE = 0.005
"""Cameras whose distance is less than this part of that of what they see are at one place: copies of one photograph are."""
FINER = (48, 36)
"""Columns and rows in which it is known how far an image sees."""
FARTHER = 0.97
"""A camera that sees this fraction of a point's depth beside its place, and nothing nearer, sees the place itself."""
WRONG = 0.02
"""Share of points at which a wrong match is found where there can be no right one."""
BESIDE = ((7, 7), (-7, 7), (7, -7), (-7, -7))
"""Pixels by which places beside a predicted one are off, where an image point is found by chance alone."""
SIGNIFICANCE = 0.01
"""Chance that a right model has a conflict anywhere, were all its points equally easy to find again."""
PART = 1 / 12
"""Part of the places that a place is compared with by which one that is taken for another is refuted, at least: where there are
many, chance refutes some, as points next to each other are missed together."""
PLACES = 0.01
"""Part of all places that are refuted so in a folded model, at least: of many hundred beside each other chance refutes one."""
NEAREST = 48
"""Cameras with which each one is compared, the nearest, in large models."""


@dataclass(frozen=True)
class Conflicts:
    """Pairs of registered images, and the logarithm of the odds that they show two things taken for one.

    Attributes:
        pairs: Images that look at the same points from like viewpoints, according to the model, `i < j`.
        score: Log-likelihood ratio, summed over the parts of the image where each misses what the other sees.
        limit: What chance exceeds once in a hundred models.
        place: Where each image was taken; copies of one photograph have one number.
    """

    pairs: Int[Tensor, "q 2"]
    score: Float[Tensor, "q"]
    limit: float
    place: Int[Tensor, "v"]

    @property
    def refuted(self) -> Int[Tensor, "r 2"]:
        """The pairs that chance does not explain."""
        return self.pairs[self.score > self.limit]

    @property
    def folded(self) -> bool:
        """Whether two places pass for one.

        One pair may miss what something without features hides. A place taken for another is refuted from more than one other,
        and from a `PART` of those it is compared with; one folds a model, or a part of all `PLACES` where there are many.
        """
        refuting, compared = (
            torch.bincount(torch.unique(self.place[pairs].sort(dim=1).values, dim=0).flatten(), minlength=len(self.place))
            for pairs in (self.refuted, self.pairs)
        )
        taken_for_another = int(((refuting >= 2) & (refuting >= PART * compared)).sum())
        return taken_for_another >= max(1.0, PLACES * int((compared > 0).sum()))

    @property
    def strength(self) -> float:
        """By how much the refuted pairs exceed what chance does, together."""
        return float((self.score - self.limit).clamp(min=0).sum())


def missing_correspondences(mapping: Mapping) -> Conflicts:
    """Compare every two cameras with like viewpoints, point by point, in each part of the image.

    A point counts between two cameras if the one sees it distinctly, at least one camera at another place than these two does,
    and the model says that it lies in the other's view, from nearly the same direction and distance. The share that is seen is
    the pair's own; a part of the image where it is zero speaks against the pair with the likelihood of so many misses at that
    share, if it is zero both for the points of the one camera and for those of the other, or if both miss points, each
    anywhere, at places that they see. A point is found again where its track says so, or where the other image has a point that
    looks like it.
    """
    v = len(mapping.registered)
    pairs = _like_viewpoints(mapping)
    # Both directions of each pair, those of one first camera together.
    directed = torch.cat([pairs, pairs.flip(1)])
    cells = CELLS[0] * CELLS[1]
    # In each part of the first, and of the second image: points, how many are found, how many chance would find.
    own, other, open_ = (torch.zeros(3, len(directed), cells, dtype=torch.float64) for _ in range(3))
    node = mapping.observations()
    point, view = mapping.point[node], mapping.graph.view[node]
    strong = torch.ones_like(node, dtype=torch.bool) if mapping.graph.weak is None else ~mapping.graph.weak[node]
    sightings = torch.bincount(point, minlength=len(mapping.X))
    first_sighting = sightings.cumsum(0) - sightings
    site = _places(mapping)
    sites = torch.bincount(torch.unique(point * v + site[view]) // v, minlength=len(mapping.X))
    occupied = Occupied.of(mapping)
    nearest, farthest = _DepthMap.of(mapping, FINE, "amin"), _DepthMap.of(mapping, FINER, "amax")
    beside = _DepthMap.of(mapping, FINER, "amin")
    low, high = _pictures(mapping)
    lens = PixelProjection(type(mapping.cameras.distortion), skew=bool((mapping.cameras.K[:, 0, 1] != 0).any()))
    rows_of_cameras = row_from_camera(mapping.cameras).mT
    for a in torch.unique(directed[:, 0]).tolist():
        rows = (directed[:, 0] == a).nonzero()[:, 0]
        b = directed[rows, 1]
        mine = node[strong & (view == a)]
        p = mapping.point[mine]
        near, ray = _looked_at(mapping, p, a, b)
        # Observations are sorted by point.
        column = torch.arange(len(p)).repeat_interleave(sightings[p])
        step = torch.arange(len(column)) - (sightings[p].cumsum(0) - sightings[p])[column]
        seer = view[first_sighting[p][column] + step]
        seen = _seen_from(b, seer, column, len(p), v)
        there, which = torch.unique(site[b], return_inverse=True)
        from_there = _seen_from(there, site[seer], column, len(p), v)[which]
        # Seen from a third place.
        near &= sites[p] > 1 + (from_there & (site[b] != site[a])[:, None]).long()
        # Of the points that count, one row each: where the other camera should see them, and does if nothing hides them.
        k, n = near.nonzero(as_tuple=True)
        image, ray = b[k], ray.flatten(1).index_select(1, k * len(p) + n)
        x, depth = lens.pixels(ray, rows_of_cameras[:, mapping.camera_index[image]]), ray[2]
        inside = ((x >= low[:, image]) & (x <= high[:, image])).all(0)
        fine, finer = (_cell(x.mT, mapping.graph.image_size[image], grid) for grid in (FINE, FINER))
        bare = nearest.at(image, fine) >= BEHIND * depth
        through = (farthest.at(image, finer) > FARTHER * depth) & (beside.at(image, finer) > BEHIND * depth)
        open_to = (inside & (bare | through)).nonzero()[:, 0]
        k, n, image, bare, through = (t[open_to] for t in (k, n, image, bare, through))
        x = x[:, open_to]
        like, found = mine[n], seen[k, n]
        place = x.round().long()
        rest = (~found).nonzero()[:, 0]
        found[rest] = occupied.at(image[rest], place[:, rest], like[rest])
        chance = occupied.at(image, place[:, None] + torch.tensor(BESIDE).mT[:, :, None], like).double().mean(0)
        first, second = _cell(mapping.graph.x[like], mapping.graph.image_size[a]), _cell(x.mT, mapping.graph.image_size[image])
        weights = torch.stack([torch.ones_like(chance), found.double(), chance])
        for table, cell, counts in ((own, first, bare), (other, second, bare), (open_, first, through)):
            flat = table.new_zeros(3, len(b) * cells).index_add_(1, (cell + k * cells)[counts], weights[:, counts])
            table[:, rows] = flat.reshape(3, -1, cells)
    expected = _Shares.of(own)
    swapped = torch.arange(len(directed)).roll(len(pairs))
    both = 2 * torch.minimum(expected.against(own), expected.against(other)[swapped]).sum(-1)
    each = _Shares.of(open_).against(open_).sum(-1)
    score = torch.maximum(both, torch.minimum(each, each[swapped])).reshape(2, -1).amax(0)
    limit = math.log(2 * max(len(pairs), 1) * cells / SIGNIFICANCE)
    return Conflicts(pairs, score, limit, site)


@dataclass(frozen=True)
class _Shares:
    """Which share of the points of one camera another finds again, and which it finds by chance."""

    found: Float[Tensor, "q 1"]
    by_chance: Float[Tensor, "q 1"]

    @classmethod
    def of(cls, table: Float[Tensor, "3 q cells"]) -> "_Shares":
        """Of tables of points, points found, and points that chance would find."""
        total, hit, by_chance = table.sum(-1)
        found, chance = ((hit + 1) / (total + 2)).clamp(max=0.95), ((by_chance + WRONG) / (total + 1)).clamp(min=WRONG)
        return cls(found[:, None], chance[:, None])

    def against(self, table: Float[Tensor, "3 q cells"]) -> Float[Tensor, "q cells"]:
        """Log-likelihood that only chance finds points in a part, over that they are found as in the rest of the pair."""
        n, k, c = table
        dead = ((c + 5 * self.by_chance) / (n + 5)).clamp(WRONG, 0.9)
        ratio = k * (dead / self.found).log() + (n - k) * ((1 - dead) / (1 - self.found)).log()
        return torch.where(dead < self.found, ratio, 0.0).clamp(min=0)


@dataclass(frozen=True)
class _DepthMap:
    """How near, or how far, the points are that each image sees in and around each small part of it."""

    table: Float[Tensor, "v columns rows"]

    @classmethod
    def of(cls, mapping: Mapping, grid: tuple[int, int], extreme: Literal["amin", "amax"]) -> "_DepthMap":
        node = mapping.observations()
        view = mapping.graph.view[node]
        _, depth = mapping.project(mapping.point[node], view)
        columns, rows = grid
        sign = 1 if extreme == "amax" else -1
        size = mapping.graph.image_size
        place = (view * rows * columns) + _cell(mapping.graph.x[node], size[view], grid)
        table = depth.new_full((len(size) * rows * columns,), -torch.inf).scatter_reduce(0, place, sign * depth, "amax")
        around = torch.nn.functional.max_pool2d(table.reshape(-1, 1, columns, rows), 3, 1, 1)[:, 0]
        return cls(sign * around)

    def at(self, view: Int[Tensor, "n"], cell: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """The depth in or beside a part of an image; infinite with the other sign where nothing is seen."""
        return self.table.flatten().index_select(0, view * self.table[0].numel() + cell)


def _places(mapping: Mapping) -> Int[Tensor, "v"]:
    """For each image the first one that was taken within `SAME_PLACE` of it, so that no chain of images is one place."""
    node = mapping.observations()
    point, view = mapping.point[node], mapping.graph.view[node]
    centre = mapping.poses.centre
    away = (mapping.X[point] - centre[view]).norm(dim=-1).log()
    reach = SAME_PLACE * away.new_zeros(len(centre)).scatter_reduce(0, view, away, "mean", include_self=False).exp()
    place = torch.arange(len(centre))
    open_ = mapping.registered.clone()
    for i in mapping.registered.nonzero()[:, 0].tolist():
        if bool(open_[i]):
            beside = open_ & ((centre - centre[i]).norm(dim=-1) < reach[i])
            beside[i] = True
            place[beside] = i
            open_ &= ~beside
    return place


def _seen_from(
    place: Int[Tensor, "k"], seer: Int[Tensor, "m"], column: Int[Tensor, "m"], points: int, views: int
) -> Bool[Tensor, "k n"]:
    """Which of some points are seen from some places, given for each sighting from where."""
    row = torch.full((views,), -1).index_copy_(0, place, torch.arange(len(place)))[seer]
    seen = torch.zeros(len(place), points, dtype=torch.bool)
    seen[row[row >= 0], column[row >= 0]] = True
    return seen


def _like_viewpoints(mapping: Mapping) -> Int[Tensor, "q 2"]:
    """Pairs of registered images, each with its nearest, that look into one direction more or less."""
    index = mapping.registered.nonzero()[:, 0]
    centre, axis = mapping.poses.centre[index], mapping.poses.R[index, 2]
    distance = torch.cdist(centre, centre)
    distance = torch.where(axis @ axis.T > 0.5, distance, torch.inf).fill_diagonal_(torch.inf)
    nearest = distance.topk(min(NEAREST, len(index)), largest=False)
    i, k = nearest.values.isfinite().nonzero(as_tuple=True)
    pair = torch.stack([index[i], index[nearest.indices[i, k]]], 1).sort(dim=1).values
    pairs: Tensor = torch.unique(pair, dim=0)
    return pairs


def _looked_at(
    mapping: Mapping, point: Int[Tensor, "n"], a: int, b: Int[Tensor, "k"]
) -> tuple[Bool[Tensor, "k n"], Float[Tensor, "3 k n"]]:
    """Whether other cameras, if they see the points of one, look at them as it does; and the points in their frames."""
    X, poses = mapping.X[point].mT, mapping.poses[b]
    ray = (poses.R.flatten(0, 1) @ X).view(len(b), 3, len(point)).movedim(1, 0) + poses.t.mT[:, :, None]
    from_a = X - mapping.poses.centre[a, :, None]
    # Several times as fast as norms along the first dimension, and as quotients.
    near, far = (torch.addcmul(torch.addcmul(x * x, y, y), z, z).sqrt_() for x, y, z in (from_a, ray))
    along = (from_a * X).sum(0) - poses.centre @ from_a
    f = mapping.cameras.K[mapping.camera_index, 0, 0]
    large, small = near * f[b, None], far * f[a]
    alike = (along > math.cos(MAX_ANGLE) * near * far) & (MAX_ZOOM * small > large) & (small < MAX_ZOOM * large)
    return alike & (ray[2] > 0), ray


def _cell(x: Float[Tensor, "*batch 2"], size: Int[Tensor, "*#batch 2"], grid: tuple[int, int] = CELLS) -> Int[Tensor, "*batch"]:
    columns, rows = grid
    place = (x / size).nan_to_num(0.0).clamp(0, 1 - 1e-9)
    index: Tensor = (place[..., 0] * columns).long() * rows + (place[..., 1] * rows).long()
    return index


def _pictures(mapping: Mapping) -> tuple[Float[Tensor, "2 v"], Float[Tensor, "2 v"]]:
    """The box in which images of the size of each one have any image points: bars beside a picture show nothing."""
    graph = mapping.graph
    _, kind = torch.unique(graph.image_size, dim=0, return_inverse=True)
    of_points = kind[graph.view].expand(2, -1)
    box = [
        graph.x.new_zeros(2, int(kind.max()) + 1).scatter_reduce(1, of_points, graph.x.mT, extreme, include_self=False)
        for extreme in ("amin", "amax")
    ]
    return box[0][:, kind], box[1][:, kind]
