"""What cameras see of each other's points: in each part of an image how many of them there are, and how many are found again.

A point counts between two cameras if the one sees it distinctly, at least one camera at another place than these two does, and
the model says that it lies in the other's view, from nearly the same direction and distance, with nothing before it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry.intrinsic_parameters import row_from_camera
from torchsfm.geometry.projection import PixelProjection
from torchsfm.reconstruction.evidence.occupied import Occupied
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.view_graph import ViewGraph

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
BESIDE = ((7, 7), (-7, 7), (7, -7), (-7, -7))
"""Pixels by which places beside a predicted one are off, where an image point is found by chance alone."""
NEAREST = 48
"""Cameras with which each one is compared, the nearest, in large models."""


@dataclass(frozen=True)
class MutualSight:
    """A model's observations, sorted by point, and what each image sees where."""

    mapping: Mapping
    node: Int[Tensor, "m"]
    strong: Bool[Tensor, "m"]
    """Which are distinct."""
    sightings: Int[Tensor, "p"]
    """How many there are of each point,"""
    first: Int[Tensor, "p"]
    """where its first one is,"""
    sites: Int[Tensor, "p"]
    """and from how many places they are."""
    site: Int[Tensor, "v"]
    """Where each image was taken; copies of one photograph have one number."""
    occupied: Occupied
    nearest: "_DepthMap"
    farthest: "_DepthMap"
    beside: "_DepthMap"

    @classmethod
    def of(cls, mapping: Mapping) -> "MutualSight":
        """What does not depend on which images are compared."""
        node, v, weak = mapping.observations(), len(mapping.registered), mapping.graph.weak
        point, site = mapping.point[node], _places(mapping)
        strong = torch.ones_like(node, dtype=torch.bool) if weak is None else ~weak[node]
        sightings = torch.bincount(point, minlength=len(mapping.X))
        places = torch.unique(point * v + site[mapping.graph.view[node]])
        sites = torch.bincount(places.div(v, rounding_mode="floor"), minlength=len(mapping.X))
        seen = node, mapping.project(point, mapping.graph.view[node])[1]
        depths = [_DepthMap.of(mapping.graph, seen, *what) for what in ((FINE, "amin"), (FINER, "amax"), (FINER, "amin"))]
        first = sightings.cumsum(0) - sightings
        return cls(mapping, node, strong, sightings, first, sites, site, Occupied.of(mapping), *depths)

    def parts(
        self, pairs: Int[Tensor, "q 2"], *, by_chance: bool
    ) -> tuple[Float[Tensor, "k d cells"], Float[Tensor, "k d cells"], Float[Tensor, "k d cells"]]:
        """How many points of one image another should see, and how many of them it does.

        A point is found again where its track says so, or where the other image has a point that looks like it.

        Args:
            pairs: Images to compare, each pair in both directions: first `(i, j)`, then `(j, i)`.
            by_chance: Whether it is wanted how many chance would find, too: at places `BESIDE` those where points should be.

        Returns:
            Points, how many are found, and how many chance would find, if that is wanted. Of the points before which nothing
            lies, in each part of the image that has them, and of the other one; and of those that the other image sees, or what
            is behind them, in parts of the first.
        """
        directed = torch.cat([pairs, pairs.flip(1)])
        shape = 2 + by_chance, len(directed), CELLS[0] * CELLS[1]
        own, other, open_ = (torch.zeros(shape, dtype=torch.float64) for _ in range(3))
        mapping, node, site, v = self.mapping, self.node, self.site, len(self.mapping.registered)
        view, size = mapping.graph.view[node], mapping.graph.image_size
        low, high = _pictures(mapping)
        lens = PixelProjection(type(mapping.cameras.distortion), skew=bool((mapping.cameras.K[:, 0, 1] != 0).any()))
        cameras = row_from_camera(mapping.cameras).mT[:, mapping.camera_index]
        for a in torch.unique(directed[:, 0]).tolist():
            rows = (directed[:, 0] == a).nonzero()[:, 0]
            b = directed[rows, 1]
            mine = node[self.strong & (view == a)]
            p = mapping.point[mine]
            near, ray = _looked_at(mapping, p, a, b)
            # Observations are sorted by point.
            column = torch.arange(len(p)).repeat_interleave(self.sightings[p])
            step = torch.arange(len(column)) - (self.sightings[p].cumsum(0) - self.sightings[p])[column]
            seer = view[self.first[p][column] + step]
            seen = _seen_from(b, seer, column, len(p), v)
            there, which = torch.unique(site[b], return_inverse=True)
            from_there = _seen_from(there, site[seer], column, len(p), v)[which]
            # Seen from a third place.
            near &= self.sites[p] > 1 + (from_there & (site[b] != site[a])[:, None]).long()
            # Of the points that count, one row each: where the other camera should see them, and does if nothing hides them.
            k, n = near.nonzero(as_tuple=True)
            image, ray = b[k], ray.flatten(1).index_select(1, k * len(p) + n)
            x, depth = lens.pixels(ray, cameras[:, image]), ray[2]
            inside = ((x >= low[:, image]) & (x <= high[:, image])).all(0).nonzero()[:, 0]
            k, n, image, depth, x = k[inside], n[inside], image[inside], depth[inside], x[:, inside]
            fine, finer = (_cell(x.mT, size[image], grid) for grid in (FINE, FINER))
            bare = self.nearest.at(image, fine) >= BEHIND * depth
            through = (self.farthest.at(image, finer) > FARTHER * depth) & (self.beside.at(image, finer) > BEHIND * depth)
            open_to = (bare | through).nonzero()[:, 0]
            k, n, image, bare, through, x = *(t[open_to] for t in (k, n, image, bare, through)), x[:, open_to]
            like, found = mine[n], seen[k, n]
            place = x.round().long()
            rest = (~found).nonzero()[:, 0]
            found[rest] = self.occupied.at(image[rest], place[:, rest], like[rest])
            counts = [torch.ones_like(x[0]), found.double()]
            if by_chance:
                around = place[:, None] + torch.tensor(BESIDE).mT[:, :, None]
                counts.append(self.occupied.at(image, around, like).double().mean(0))
            weights = torch.stack(counts)
            first, second = _cell(mapping.graph.x[like], size[a]), _cell(x.mT, size[image])
            for table, cell, chosen in ((own, first, bare), (other, second, bare), (open_, first, through)):
                table[:, rows] = _summed(weights, k, cell, chosen, (len(b), shape[2]))
        return own, other, open_


def _summed(
    weights: Float[Tensor, "k m"],
    row: Int[Tensor, "m"],
    cell: Int[Tensor, "m"],
    chosen: Bool[Tensor, "m"],
    size: tuple[int, int],
) -> Float[Tensor, "k rows cells"]:
    """Sums of what is chosen over each row and part of an image."""
    total = weights.new_zeros(len(weights), size[0] * size[1])
    return total.index_add_(1, (cell + row * size[1])[chosen], weights[:, chosen]).reshape(len(weights), *size)


@dataclass(frozen=True)
class _DepthMap:
    """How near, or how far, the points are that each image sees in and around each small part of it."""

    table: Float[Tensor, "v columns rows"]

    @classmethod
    def of(
        cls, graph: ViewGraph, seen: tuple[Int[Tensor, "m"], Float[Tensor, "m"]], grid: tuple[int, int], extreme: str
    ) -> "_DepthMap":
        """The nearest ("amin") or the farthest ("amax") of the image points seen, given with their depths."""
        node, depth = seen
        view = graph.view[node]
        columns, rows = grid
        sign = 1 if extreme == "amax" else -1
        size = graph.image_size
        place = (view * rows * columns) + _cell(graph.x[node], size[view], grid)
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


def like_viewpoints(mapping: Mapping) -> Int[Tensor, "q 2"]:
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
