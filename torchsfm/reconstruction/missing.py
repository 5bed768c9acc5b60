"""Missing correspondences: what two cameras at one place should both see, and do not, says that they are at two.

A thing that occurs twice makes photographs of the two match, and folds a model: cameras at one place take their bearings from
the thing alone. What stands around it differs, and no match is wrong there: they are missing (Zach, Irschara & Bischof 2008,
2010). In a folded model, two such cameras share many points in one part of the image, and in another part each has points of
its own, seen by others, none of which the other camera sees though nothing stands before them.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.reconstruction.mapping import Mapping

MAX_ANGLE = 0.35
"""Rays farther apart than this (20 degrees) need not see the same, whatever the scene."""
MAX_ZOOM = 1.5
"""Nor do cameras whose distances from a point differ by more than this factor."""
CELLS = (6, 5)
"""Columns and rows into which the image is cut."""
FINE = (24, 20)
"""Columns and rows in which the depth of what an image sees is known."""
BEHIND = 0.95
"""A point is taken to be hidden by what lies at less than this fraction of its depth."""
WRONG = 0.02
"""Share of points at which a wrong match is found where there can be no right one."""
SHIFT = 7
"""Pixels beside a predicted place, where an image point is found by chance alone."""
SIGNIFICANCE = 0.01
"""Chance that a right model has a conflict anywhere, were all its points equally easy to find again."""
NEAREST = 48
"""Cameras with which each one is compared, the nearest, in large models."""


@dataclass(frozen=True)
class Conflicts:
    """Pairs of registered images, and the logarithm of the odds that they show two things taken for one.

    Attributes:
        pairs: Images that look at the same points from like viewpoints, according to the model, `i < j`.
        score: Log-likelihood ratio, summed over the parts of the image where each misses what the other sees.
        limit: What chance exceeds once in a hundred models.
    """

    pairs: Int[Tensor, "q 2"]
    score: Float[Tensor, "q"]
    limit: float

    @property
    def refuted(self) -> Int[Tensor, "r 2"]:
        """The pairs that chance does not explain."""
        return self.pairs[self.score > self.limit]

    @property
    def folded(self) -> bool:
        """Whether two places pass for one.

        One pair may miss what something without features hides. A place taken for another is refuted by more than one camera,
        and folds the whole model.
        """
        return bool((torch.bincount(self.refuted.flatten(), minlength=1) >= 2).any())

    @property
    def strength(self) -> float:
        """By how much the refuted pairs exceed what chance does, together."""
        return float((self.score - self.limit).clamp(min=0).sum())


def missing_correspondences(mapping: Mapping) -> Conflicts:
    """Compare every two cameras with like viewpoints, point by point, in each part of the image.

    A point counts between two cameras if the one sees it, at least one camera besides these two does, and the model says that
    it lies in the other's view, from nearly the same direction and distance. The share that the other sees is the pair's own;
    a part of the image where it is zero, both for the points of the one camera and for those of the other, speaks against the
    pair with the likelihood of so many misses at that share.
    """
    v = len(mapping.registered)
    pairs = _like_viewpoints(mapping)
    # Both directions of each pair, those of one first camera together.
    directed = torch.cat([pairs, pairs.flip(1)])
    cells = CELLS[0] * CELLS[1]
    # In each part of the first, and of the second image: points, how many are found, how many chance would find.
    own, other = (torch.zeros(3, len(directed), cells, dtype=torch.float64) for _ in range(2))
    node = mapping.observations()
    point, view = mapping.point[node], mapping.graph.view[node]
    observed = Lookup(point * v + view)
    occupied, nearest = _Occupied.of(mapping), _NearestDepth.of(mapping)
    length = torch.bincount(point, minlength=len(mapping.X))
    for a in torch.unique(directed[:, 0]).tolist():
        rows = (directed[:, 0] == a).nonzero()[:, 0]
        b = directed[rows, 1]
        mine = node[view == a]
        p = mapping.point[mine]
        x, depth, near = _predicted(mapping, p, a, b)
        seen = observed.has(p * v + b[:, None])
        found = seen | occupied.at(b[:, None], x)
        chance = torch.stack([
            occupied.at(b[:, None], x + x.new_tensor(step)).double()
            for step in ((SHIFT, SHIFT), (-SHIFT, SHIFT), (SHIFT, -SHIFT), (-SHIFT, -SHIFT))
        ]).mean(0)  # fmt: skip
        hidden = nearest.at(b[:, None], x) < BEHIND * depth
        counts = near & ~hidden & (length[p] - seen.long() >= 2)
        first = _cell(mapping.graph.x[mine], mapping.graph.image_size[a]).expand(len(b), -1)
        second = _cell(x, mapping.graph.image_size[b][:, None])
        offset = torch.arange(len(b))[:, None] * cells
        for table, cell in ((own, first), (other, second)):
            index = (cell + offset)[counts]
            for k, weights in enumerate((torch.ones_like(chance), found.double(), chance)):
                flat = torch.zeros(len(b) * cells, dtype=torch.float64).index_add_(0, index, weights[counts].double())
                table[k, rows] = flat.reshape(-1, cells)
    total, hit, by_chance = own.sum(-1)
    share = ((hit + 1) / (total + 2)).clamp(max=0.95)[:, None]
    share_by_chance = ((by_chance + WRONG) / (total + 1)).clamp(min=WRONG)[:, None]

    def against(table: Tensor) -> Tensor:
        """Log-likelihood that only chance finds points in a part, over that they are found as in the rest of the pair."""
        n, k, c = table
        dead = ((c + 5 * share_by_chance) / (n + 5)).clamp(WRONG, 0.9)
        ratio = k * (dead / share).log() + (n - k) * ((1 - dead) / (1 - share)).log()
        return torch.where(dead < share, ratio, 0.0)

    swapped = torch.arange(len(directed)).roll(len(pairs))
    both = 2 * torch.minimum(against(own), against(other)[swapped]).clamp(min=0)
    score = both.sum(-1).reshape(2, -1).amax(0)
    limit = math.log(max(len(pairs), 1) * cells / SIGNIFICANCE)
    return Conflicts(pairs, score, limit)


class Lookup:
    """A set of whole numbers that is asked for many at a time."""

    def __init__(self, keys: Int[Tensor, "n"]) -> None:
        self.keys = torch.unique(keys)

    def has(self, key: Int[Tensor, "*k"]) -> Bool[Tensor, "*k"]:
        """Which of the numbers are in the set."""
        if not len(self.keys):
            return torch.zeros_like(key, dtype=torch.bool)
        at = torch.searchsorted(self.keys, key).clamp(max=len(self.keys) - 1)
        found: Tensor = self.keys[at] == key
        return found


@dataclass(frozen=True)
class _Occupied:
    """The pixels at or beside which each image has an image point."""

    cells: Lookup
    width: int
    height: int

    @classmethod
    def of(cls, mapping: Mapping) -> "_Occupied":
        width, height = (int(n) + 2 for n in mapping.graph.image_size.amax(0))
        x = mapping.graph.x.round().long() + 1
        step = torch.tensor([-1, 0, 1])
        column, row = x[:, 0, None, None] + step, x[:, 1, None, None] + step[:, None]
        return cls(Lookup(((mapping.graph.view[:, None, None] * height + row) * width + column).flatten()), width, height)

    def at(self, view: Int[Tensor, "*#k"], x: Float[Tensor, "*k 2"]) -> Bool[Tensor, "*k"]:
        """Whether an image has an image point at a place, within a pixel or so."""
        place = x.nan_to_num(-9.0).clamp(-9, max(self.width, self.height) + 9).round().long() + 1
        inside = (place >= 0).all(-1) & (place[..., 0] < self.width) & (place[..., 1] < self.height)
        return inside & self.cells.has((view * self.height + place[..., 1]) * self.width + place[..., 0])


@dataclass(frozen=True)
class _NearestDepth:
    """How near the points are that each image sees in and around each small part of it."""

    table: Float[Tensor, "v r c"]
    size: Int[Tensor, "v 2"]

    @classmethod
    def of(cls, mapping: Mapping) -> "_NearestDepth":
        node = mapping.observations()
        view = mapping.graph.view[node]
        _, depth = mapping.project(mapping.point[node], view)
        columns, rows = FINE
        size = mapping.graph.image_size
        place = (view * rows * columns) + _cell(mapping.graph.x[node], size[view], FINE)
        table = depth.new_full((len(size) * rows * columns,), torch.inf).scatter_reduce(0, place, depth, "amin")
        around = -torch.nn.functional.max_pool2d(-table.reshape(-1, 1, columns, rows), 3, 1, 1)[:, 0]
        return cls(around, size)

    def at(self, view: Int[Tensor, "k 1"], x: Float[Tensor, "k n 2"]) -> Float[Tensor, "k n"]:
        """The depth of the nearest point seen at or beside a place; infinite where none is."""
        return self.table.flatten(1)[view, _cell(x, self.size[view], FINE)]


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


def _predicted(
    mapping: Mapping, point: Int[Tensor, "n"], a: int, b: Int[Tensor, "k"]
) -> tuple[Float[Tensor, "k n 2"], Float[Tensor, "k n"], Bool[Tensor, "k n"]]:
    """Where and at which depth other cameras should see the points of one, and whether they look at them as it does."""
    X, poses = mapping.X[point], mapping.poses[b]
    X_cam = poses.transform(X.expand(len(b), -1, -1))
    x = mapping.cameras[mapping.camera_index[b]].project(X_cam)
    from_a, from_b = X - mapping.poses.centre[a], X - poses.centre[:, None]
    cosine = torch.nn.functional.cosine_similarity(from_a.expand_as(from_b), from_b, dim=-1)
    zoom = (from_a.norm(dim=-1) / from_b.norm(dim=-1).clamp(min=1e-12)).clamp(min=1e-12).log().abs()
    size = mapping.graph.image_size[b][:, None]
    inside = (X_cam[..., 2] > 0) & ((x >= 0) & (x <= size - 1)).all(-1)
    return x, X_cam[..., 2], inside & (cosine > math.cos(MAX_ANGLE)) & (zoom < math.log(MAX_ZOOM))


def _cell(x: Float[Tensor, "*batch 2"], size: Int[Tensor, "*#batch 2"], grid: tuple[int, int] = CELLS) -> Int[Tensor, "*batch"]:
    columns, rows = grid
    place = (x / size).nan_to_num(0.0).clamp(0, 1 - 1e-9)
    index: Tensor = (place[..., 0] * columns).long() * rows + (place[..., 1] * rows).long()
    return index
