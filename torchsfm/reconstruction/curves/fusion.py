"""Pieces of space curves from many images become one set of curves: what several images found, averaged, once, and linked."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.reconstruction.curves.pieces import Pieces
from torchsfm.reconstruction.mapping.mapping import first_of_each

_NEAR = 2.0
"""Samples of different images, that many pixels apart across the curve, are of the same curve."""
_BESIDE = 4.0
"""Samples as many pixels apart along the curve are neighbours."""
_ALONG = 0.9
"""Least cosine of the angle between curves that are one."""
_ROUNDS = 2
"""Samples move to the mean of their neighbours so many times."""
_GAP = 12.0
"""Ends of curves are linked over so many pixels."""


class FusedCurves(NamedTuple):
    """Space curves, sample by sample."""

    X: Float[Tensor, "n 3"]
    curve: Int[Tensor, "n"]
    """Which curve; those of one are in consecutive places, in order."""
    images: Int[Tensor, "n"]
    """From how many images' edges the sample was found."""
    source: Int[Tensor, "n"]
    """Of which sample of the pieces it is the mean with those near."""
    sigma: Float[Tensor, "n"]
    closed: Bool[Tensor, "c"]
    finders: Int[Tensor, "f 2"]
    """Samples, and images in which they were found; one more than once where more of its samples are near."""


def fuse_pieces(pieces: Pieces, *, least_images: int, shortest: int) -> FusedCurves:
    """The curves that pieces are of.

    Args:
        pieces: From all images.
        least_images: Images that must have found a sample.
        shortest: Samples of the shortest curve.
    """
    n = len(pieces.X)
    scale = _scale(pieces)
    tangent = piece_tangents(pieces.X, pieces.piece)
    a, b = _same(pieces, tangent)
    X = pieces.X

    def across(X: Tensor) -> Tensor:
        return _across(X[b] - X[a], tangent[a])

    weight = 1 / pieces.sigma[b].square().clamp_min(1e-12 * scale**2)
    own = 1 / pieces.sigma.square().clamp_min(1e-12 * scale**2)
    total = own.index_add(0, a, weight)
    for _ in range(_ROUNDS):
        moved = torch.zeros_like(X).index_add(0, a, weight[:, None] * across(X))
        X = X + moved / total[:, None]
    other = pieces.image[a] != pieces.image[b]
    images = 1 + count_different(a[other], pieces.image[b[other]], n)
    order = a.argsort(stable=True)
    a, b = a[order], b[order]
    first = torch.searchsorted(a, torch.arange(n + 1, device=X.device))
    runs = list(_once(pieces.piece, images >= least_images, first, b, shortest))
    links = _links([X[r] for r in runs], _GAP * scale)
    parts, closed = [], []
    for chain, around in _chained(len(runs), links):
        parts.append(torch.cat([runs[i] if forwards else runs[i].flip(0) for i, forwards in chain]))
        closed.append(around)
    index = torch.cat(parts) if parts else torch.zeros(0, dtype=torch.long, device=X.device)
    place = torch.full((n,), -1, device=X.device).index_copy(0, index, torch.arange(len(index), device=X.device))
    near = torch.cat((torch.stack((place[index], pieces.image[index]), -1), torch.stack((place[a], pieces.image[b]), -1)))
    curve = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor([len(p) for p in parts], dtype=torch.long))
    return FusedCurves(
        X[index],
        curve.to(X.device),
        images[index],
        index,
        pieces.sigma[index],
        torch.tensor(closed, dtype=torch.bool, device=X.device),
        near[near[:, 0] >= 0],
    )


def nearest_fused(pieces: Pieces, fused: FusedCurves) -> Int[Tensor, "n"]:
    """The sample of the curves that each sample of their pieces is of: the nearest one, -1 where none is near.

    Args:
        pieces: From all images.
        fused: What `fuse_pieces` made of them.
    """
    own = torch.arange(len(pieces.X), device=pieces.X.device)
    found = torch.full_like(own, -1).index_copy(0, fused.source, torch.arange(len(fused.X), device=own.device))
    a, b = _same(pieces, piece_tangents(pieces.X, pieces.piece))
    left = (found[a] < 0) & (found[b] >= 0)
    a, b = a[left], b[left]
    order = torch.linalg.vector_norm(pieces.X[b] - pieces.X[a], dim=-1).argsort(stable=True)
    order = order[first_of_each(a[order])]
    return found.index_copy(0, a[order], found[b[order]])


def count_different(a: Int[Tensor, "k"], b: Int[Tensor, "k"], number: int) -> Int[Tensor, "n"]:
    """How many different `b`, which are not negative, stand beside each of so many `a`."""
    most = int(b.amax()) + 1 if len(b) else 1
    # One number for each pair: rows are told apart far more slowly.
    return torch.bincount(torch.unique(a * most + b) // most, minlength=number)


def _scale(pieces: Pieces) -> float:
    """The usual size of a pixel."""
    return float(pieces.pixel.median()) if len(pieces.X) else 1.0


def _same(pieces: Pieces, tangent: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Ordered pairs of samples that are near to each other on one curve."""
    scale = _scale(pieces)
    a, b = near_pairs(pieces.X, _BESIDE * scale)
    far = torch.linalg.vector_norm(_across(pieces.X[b] - pieces.X[a], tangent[a]), dim=-1)
    near = far < _NEAR * pieces.pixel[a].clamp(max=2 * scale)
    same = near & ((tangent[a] * tangent[b]).sum(-1).abs() > _ALONG)
    return a[same], b[same]


def _across(d: Float[Tensor, "k 3"], tangent: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """What of steps leads across a curve."""
    return d - (d * tangent).sum(-1, keepdim=True) * tangent


def piece_tangents(X: Float[Tensor, "n d"], piece: Int[Tensor, "n"]) -> Float[Tensor, "n d"]:
    """Unit tangents: from the sample two before to that two after in the same piece, or as far as it goes."""
    n = len(X)
    own = torch.arange(n, device=X.device)
    before, after = own, own
    for _ in range(2):
        back = (before - 1).clamp(min=0)
        before = torch.where(piece[back] == piece, back, before)
        on = (after + 1).clamp(max=max(n - 1, 0))
        after = torch.where(piece[on] == piece, on, after)
    return torch.nn.functional.normalize(X[after] - X[before], dim=-1)


def near_pairs(X: Float[Tensor, "n 3"], radius: float) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """All ordered pairs of different points no farther apart than a radius, by cells of that size."""
    cell = ((X - X.amin(0)) / radius).long() + 1 if len(X) else X.long()
    side = cell.amax(0) + 2 if len(X) else cell.new_ones(3)
    weights = torch.stack((side[1] * side[2], side[2], torch.ones_like(side[2])))
    key = (cell * weights).sum(-1)
    key, order = key.sort(stable=True)
    firsts, seconds = [], []
    steps = torch.arange(-1, 2, device=X.device)
    for step in torch.cartesian_prod(steps, steps, steps):
        wanted = key + (step * weights).sum()
        low, high = torch.searchsorted(key, wanted), torch.searchsorted(key, wanted, right=True)
        count = high - low
        i = torch.repeat_interleave(torch.arange(len(key), device=X.device), count)
        j = torch.arange(len(i), device=X.device) - (count.cumsum(0) - count)[i] + low[i]
        i, j = order[i], order[j]
        near = (X[i] - X[j]).square().sum(-1) <= radius**2
        firsts.append(i[near & (i != j)])
        seconds.append(j[near & (i != j)])
    return torch.cat(firsts), torch.cat(seconds)


def _once(piece: Tensor, good: Tensor, first: Tensor, neighbour: Tensor, shortest: int) -> Iterator[Tensor]:
    """Runs of good samples of pieces, the longest piece first, without what is near to samples of earlier runs."""
    _, number = torch.unique_consecutive(piece, return_counts=True)
    parts = torch.split(torch.arange(len(piece), device=piece.device), number.tolist())
    covered = ~good
    for i in number.argsort(descending=True, stable=True).tolist():
        part = parts[i]
        free = ~covered[part]
        edge = torch.nn.functional.pad(free.to(torch.int8), (1, 1)).diff()
        for start, end in zip((edge == 1).nonzero()[:, 0].tolist(), (edge == -1).nonzero()[:, 0].tolist(), strict=True):
            run = part[start:end]
            if len(run) < shortest:
                continue
            yield run
            covered[run] = True
            covered[torch.cat([neighbour[a:b] for a, b in zip(first[run].tolist(), first[run + 1].tolist(), strict=True)])] = (
                True
            )


def _links(runs: list[Tensor], gap: float) -> list[tuple[int, int]]:
    """Ends of runs that go on in one another, the nearest mutual ones; run i begins at end 2 i and stops at 2 i + 1."""
    if not runs:
        return []
    place = torch.stack([r[k] for r in runs for k in (0, -1)])
    out = torch.nn.functional.normalize(
        torch.stack([r[k] - r[max(-len(r), min(len(r) - 1, m))] for r in runs for k, m in ((0, 3), (-1, -4))]), dim=-1
    )
    d = place - place[:, None]
    far = torch.linalg.vector_norm(d, dim=-1)
    along = (d * out[:, None]).sum(-1)
    aside = (far.square() - along.square()).clamp(min=0).sqrt()
    good = (far < gap) & (out @ out.mT < -_ALONG) & (aside < 0.25 * gap) & (along > -0.25 * gap)
    good = good & good.mT & ~torch.eye(len(place), dtype=torch.bool, device=place.device)
    far = torch.where(good, far, torch.inf)
    best = far.argmin(-1)
    ends = torch.arange(len(best), device=place.device)
    mutual = (best[best] == ends) & (far.amin(-1) < torch.inf) & (ends < best)
    return [(int(i), int(best[i])) for i in mutual.nonzero()[:, 0]]


def _chained(number: int, links: list[tuple[int, int]]) -> Iterator[tuple[list[tuple[int, bool]], bool]]:
    """Runs one after another as their ends are linked, each with its direction, and whether the last goes on in the first."""
    partner = dict(links) | {b: a for a, b in links}
    left = set(range(number))
    # Chains with ends begin at one; what is left goes around.
    starts = [(i, forwards) for i in range(number) for forwards in (True, False) if 2 * i + (not forwards) not in partner]
    for i, forwards in [*starts, *((i, True) for i in range(number))]:
        if i not in left:
            continue
        chain: list[tuple[int, bool]] = []
        while i in left:
            left.remove(i)
            chain.append((i, forwards))
            end = 2 * i + forwards
            if end not in partner:
                break
            i, last = divmod(partner[end], 2)
            forwards = not last
        around = chain[0] == (i, forwards) and 2 * chain[-1][0] + chain[-1][1] in partner
        yield chain, around
