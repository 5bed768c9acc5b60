"""The same edge curves through a sequence of images.

A piece of an edge chain is moved over the next image until its points lie on edges of their direction, first as it is, then by
an affine map; the chain on which most of them come to lie is the one it continues on (after Borgefors' chamfer matching, PAMI
1988). What of the piece is seen shrinks on the way: it is followed to its last image, then back to its first one, so that all
images show about the same piece.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.geometry.curves import Curve
from torchsfm.geometry.splines import fit_spline
from torchsfm.images.curve_prediction import predicted
from torchsfm.images.dense_motion import DenseMotion
from torchsfm.images.edge_field import EdgeField, edge_field
from torchsfm.images.edges import Edges
from torchsfm.linalg import solve
from torchsfm.linalg.devices import on_the_cpu

_LARGEST = 2**20
"""Sides of images, in pixels: an edge point farther away is none, whatever it says."""
_SAMPLES = 48
"""Of a piece that are moved."""
_STRIDE = 2.0
"""Of the search for its motion, in pixels."""
_FAR = 4.0
"""Distances beyond this, in pixels, are alike."""
_RADII = (4.0, 4.0, 3.0, 3.0, 3.0)
"""Within which points count when the affine map is fitted, in pixels."""
_SAME = 0.7
"""Of the points that must come to lie on one chain."""
_STRETCH = 0.35
"""Largest change of a piece's length from one image to the next, in logarithm."""
_CONTROLS = (6, 120)
"""Fewest and most control points of a smoothed curve."""


@dataclass(frozen=True)
class TrackedCurves:
    """Curves followed through images, as `factorize_curves` takes them.

    Example:
        >>> import torch, torchsfm
        >>> def paint(x):
        ...     disc = torchsfm.Ellipse(torch.tensor([x, 40.0]), torch.tensor([20.0, 14.0]), torch.tensor(0.3))
        ...     return torchsfm.simulation.paint_shapes([disc], torch.tensor([0.2, 0.9]), width=100, height=80)
        ...
        >>> tracked = torchsfm.track_curves(torchsfm.detect_edges(torch.stack([paint(x) for x in (40.0, 45.0, 51.0)])))
        >>> tracked.curves.x.shape[:2]  # three images of one outline
        torch.Size([3, 1])
        >>> tracked.curves.x[:, 0].mean(-2)[:, 0].round()  # where it is in each
        tensor([40., 45., 51.])
    """

    curves: Curve
    """Fields of shape (v, c, n, 2), (v, c, n), (v, c): smoothed, all images of a curve run in the same direction, with the
    bright side on the same hand, and begin at about the same point. One that an image does not show has no samples."""
    chain: Int[Tensor, "v c"]
    """The chain of the edges in each image; -1 where the curve is not shown."""


class _Pieces(NamedTuple):
    """Runs of chains of one image."""

    chain: Int[Tensor, " k"]
    first: Int[Tensor, " k"]
    """Rank in the chain."""
    number: Int[Tensor, " k"]
    alive: Bool[Tensor, " k"]

    def whole(self, field: EdgeField) -> Bool[Tensor, " k"]:
        """Which are closed chains."""
        return self.alive & field.closed[self.chain] & (self.number == field.length[self.chain])

    def curve(self, field: EdgeField) -> Curve:
        """The edge points; none of those that are not alive."""
        slot = torch.arange(int(self.number.max()) if len(self.number) else 0, device=field.x.device)
        valid = (slot < self.number[:, None]) & self.alive[:, None]
        if len(field.length) == 0:
            return Curve(field.x.new_zeros(*valid.shape, 2), valid, self.alive)
        length = field.length[self.chain][:, None]
        index = field.start[self.chain][:, None] + (self.first[:, None] + slot) % length
        return Curve(torch.where(valid[..., None], field.x[index], 0), valid, self.whole(field))


def _alive(chain: Tensor, first: Tensor, number: Tensor, alive: Bool[Tensor, " k"]) -> _Pieces:
    """Pieces of which only some are there; the others are one point, of a chain that every image with edges has."""
    return _Pieces(torch.where(alive, chain, 0), torch.where(alive, first, 0), torch.where(alive, number, 1), alive)


@on_the_cpu
def track_curves(
    edges: Edges,
    *,
    start: int | None = None,
    reach: float = 16.0,
    min_length: float = 40.0,
    min_images: int = 3,
    spacing: float = 4.0,
    max_curves: int = 200,
    motion: Sequence[DenseMotion] | None = None,
) -> TrackedCurves:
    """Follow the curves of edges through a sequence of images between which little moves, or as `motion` says.

    Edges that no surface carries, as the outline of a ball, are followed like any others: what they are is told by geometry.
    Of straight edges, the place along them is not known.

    Args:
        edges: Of all images in order, one batch dimension, as from `detect_edges`.
        start: The image whose chains are followed, to both sides; the middle one if not given.
        reach: How much farther than in the step before a curve may move from one image to the next, in pixels; from the first
            step on, any way.
        min_length: Shortest pieces that are followed, in pixels.
        min_images: Fewest images of a curve.
        spacing: Between control points of the smoothed curves, in pixels.
        max_curves: The longest chains are followed, so many of them.
        motion: Where what each image shows is in the next one, as from `detect_motion`: curves are sought where most of them is
            said to be, however far, and others as without it.

    Returns:
        The curves, those that most images show first, and of these the longest.

    Raises:
        ValueError: Wrong shape or option.

    Example:
        >>> import torch, torchsfm
        >>> disc = lambda x: torchsfm.Ellipse(torch.tensor([x, 40.0]), torch.tensor([20.0, 14.0]), torch.tensor(0.3))
        >>> paint = lambda x: torchsfm.simulation.paint_shapes([disc(x)], torch.tensor([0.2, 0.9]), width=100, height=80)
        >>> images = torch.stack([paint(x) for x in (40.0, 45.0, 51.0)])
        >>> tracked = torchsfm.track_curves(torchsfm.detect_edges(images))
        >>> tracked.chain.shape, bool(tracked.curves.closed.all())
        (torch.Size([3, 1]), True)
    """
    check_options(edges=(edges, Edges))
    if edges.x.ndim != 3:
        raise ValueError(f"edges: wanted those of images in one batch dimension, got x of shape {tuple(edges.x.shape)}")
    v = len(edges.x)
    check_options(
        start=(start, "?int >= 0"), reach=(reach, "0 <= float <= 200"), min_length=(min_length, "float > 0"),
        min_images=(min_images, "int >= 1"), spacing=(spacing, "float > 0"), max_curves=(max_curves, "int >= 1"),
    )  # fmt: skip
    if motion is not None and len(motion) != max(v - 1, 0):
        raise ValueError(f"motion: wanted one for each of {v} images and the next, got {len(motion)}")
    if start is not None and start >= v:
        raise ValueError(f"start: wanted one of {v} images, got {start}")
    with torch.no_grad():
        fields, numbers = _fields(edges)
        middle = v // 2 if start is None else start
        pieces = _whole_chains(fields[middle], min_length, max_curves) if v else None
        if pieces is None or len(pieces.chain) == 0:
            empty = edges.x.new_zeros(v, 0, 2, 2)
            none = edges.chain.new_zeros(v, 0)
            return TrackedCurves(Curve(empty, empty[..., 0] > 0, none > 0), none)
        shown = _there_and_back(fields, pieces, middle, reach, min_length, motion)
        curves = _smoothed(fields, shown, spacing)
        chain = torch.stack(
            [
                torch.where(p.alive, own[p.chain], -1) if len(own) else torch.full_like(p.chain, -1)
                for p, own in zip(shown, numbers, strict=True)
            ]
        )
        order = _kept(shown, fields, middle, min_images)
        picked = Curve(curves.x[:, order].to(edges.x.dtype), curves.valid[:, order], curves.closed[:, order])
        return TrackedCurves(picked, chain[:, order])


def _fields(edges: Edges) -> tuple[list[EdgeField], list[Int[Tensor, " k"]]]:
    """The edge points of each image, and the numbers of their chains."""
    inside = ((edges.x >= 0) & (edges.x < _LARGEST)).all(-1)
    good = edges.valid & inside & torch.isfinite(edges.gradient).all(-1)
    reach = torch.where(good[..., None], edges.x, 0).flatten(0, 1)
    # What is beyond the last edge of any image holds none.
    width, height = (int(t) + 3 for t in (reach.amax(0) if len(reach) else reach.new_zeros(2)).ceil())
    fields, numbers = [], []
    for i, at in enumerate(good):
        number, chain = torch.unique_consecutive(edges.chain[i, at], return_inverse=True)[:2]
        numbers.append(number)
        points, gradient = edges.x[i, at].double(), edges.gradient[i, at].double()
        fields.append(edge_field(points, gradient, chain, edges.closed[i, at], (height, width)))
    return fields, numbers


def _whole_chains(field: EdgeField, min_length: float, most: int) -> _Pieces:
    every = torch.arange(len(field.length), device=field.x.device)
    pieces = _Pieces(every, torch.zeros_like(every), field.length, every >= 0)
    if len(every) == 0:
        return pieces
    length = pieces.curve(field).length
    chosen = length.argsort(descending=True, stable=True)[:most]
    chosen = chosen[length[chosen] >= min_length]
    return _Pieces(*(t[chosen] for t in pieces))


def _there_and_back(
    fields: list[EdgeField],
    pieces: _Pieces,
    middle: int,
    reach: float,
    least: float,
    motion: Sequence[DenseMotion] | None,
) -> list[_Pieces]:
    """The pieces in all images: followed to their first image, from there to their last, and back."""
    v = len(fields)
    shown: list[_Pieces] = [_alive(*pieces[:3], torch.zeros_like(pieces.alive)) for _ in fields]
    shown[middle] = pieces
    for way in (range(middle, -1, -1), range(v), range(v - 1, -1, -1)):
        moved = fields[0].x.new_zeros(len(pieces.chain), 2)
        lost = torch.zeros_like(pieces.alive)
        for here, there in pairwise(way):
            step = None if motion is None else (motion[min(here, there)], there < here)
            found, moved = _followed(shown[here], fields[here], fields[there], moved, reach, least, step)
            # Where it was found before on the same chain; a curve that is lost stays lost.
            began = shown[here].alive & ~lost
            known = shown[there].alive
            agree = ~known | (found.chain == shown[there].chain)
            good = began & found.alive & agree
            # Before its first image a curve is not sought.
            lost = lost | (began & ~good)
            keep = known & ~began & ~lost
            chain, first, number = (torch.where(good, a, b) for a, b in zip(found[:3], shown[there][:3], strict=True))
            shown[there] = _alive(chain, first, number, good | keep)
    return shown


def _followed(
    pieces: _Pieces,
    here: EdgeField,
    there: EdgeField,
    guess: Float[Tensor, "k 2"],
    reach: float,
    least: float,
    motion: tuple[DenseMotion, bool] | None,
) -> tuple[_Pieces, Float[Tensor, "k 2"]]:
    """Pieces of one image in the next, and how far they moved; not alive where they were not found."""
    if not len(there.length) or not pieces.alive.any():
        return _alive(*pieces[:3], torch.zeros_like(pieces.alive)), guess
    curve = pieces.curve(here).resample(_SAMPLES)
    tangent = curve.tangents()
    x, normal = curve.x, torch.stack((tangent[..., 1], -tangent[..., 0]), -1)
    y = _fitted(x, normal, there, x + _moved(x, normal, there, guess, reach)[:, None])
    if motion is not None:
        other, facing, sure = predicted(x, *motion)
        other = other + _moved(other, facing, there, torch.zeros_like(guess), _FAR)[:, None]
        use = sure[:, None, None]
        y, normal = torch.where(use, _fitted(other, facing, there, other), y), torch.where(use, facing, normal)
    index, far = there.look_up(y, normal)
    hit = far < _RADII[-1]
    votes = far.new_zeros(len(x), len(there.length)).scatter_add_(1, there.chain[index], hit.to(far.dtype))
    most, chain = votes.max(-1)
    on = hit & (there.chain[index] == chain[:, None])
    slot = torch.arange(_SAMPLES, device=x.device)
    head = torch.where(on, slot, _SAMPLES).amin(-1).clamp(max=_SAMPLES - 1)
    tail = torch.where(on, slot, -1).amax(-1).clamp(min=0)
    rank = index - there.start[chain][:, None]
    first, last = (rank.gather(1, end[:, None])[:, 0] for end in (head, tail))
    length, around = there.length[chain], there.closed[chain]
    count = torch.where(around, (last - first) % length, last - first) + 1
    share = (tail - head) / (_SAMPLES - 1)
    whole = pieces.whole(here)
    back = (head / _SAMPLES * length).round().long()
    first = torch.where(whole, (first - back) % length, first)
    count, share = torch.where(whole, length, count), torch.where(whole, 1.0, share)
    stretch = (count.clamp(min=1) / (pieces.number * share).clamp(min=1)).log()
    good = pieces.alive & (most >= _SAME * _SAMPLES) & (stretch.abs() < _STRETCH) & (count >= 8)
    good = good & torch.where(whole, around, ~around | (count < length))
    found = _alive(chain, first, count, good)
    return _alive(*found[:3], good & (found.curve(there).length >= least)), (y - x).mean(1)


def _moved(
    x: Float[Tensor, "k m 2"], normal: Float[Tensor, "k m 2"], there: EdgeField, guess: Float[Tensor, "k 2"], reach: float
) -> Float[Tensor, "k 2"]:
    """The translation that brings curves nearest to edges of their directions, the least one of many alike."""
    steps = torch.arange(-int(reach / _STRIDE), int(reach / _STRIDE) + 1, device=x.device) * _STRIDE
    shift = torch.cartesian_prod(steps, steps).to(x.dtype)
    shift = shift[shift.norm(dim=-1) <= reach + 1e-9]
    some, facing = x[:, ::2], normal[:, ::2]
    best = torch.full_like(guess[:, 0], torch.inf)
    move = guess
    for s in shift:
        _, far = there.look_up(some + (guess + s)[:, None], facing)
        cost = far.clamp(max=_FAR).mean(-1) + 0.2 * s.norm() / max(reach, 1.0)
        move = torch.where((cost < best)[:, None], guess + s, move)
        best = torch.minimum(best, cost)
    return move


def _fitted(x: Tensor, normal: Tensor, there: EdgeField, start: Float[Tensor, "k m 2"]) -> Float[Tensor, "k m 2"]:
    """Curves moved on by the affine maps that bring them nearest to edges, across these."""
    centre = x.mean(1, keepdim=True)
    size = (x - centre).square().sum(-1).mean(-1).sqrt().clamp_min(1e-9)
    z = (x - centre) / size[:, None, None]
    z = torch.cat((z, torch.ones_like(z[..., :1])), -1)
    y = start
    # Nothing is far from a translation.
    stiff = torch.tensor([0.02, 0.02, 0.005] * 2, dtype=x.dtype, device=x.device) * x.shape[1]
    for radius in _RADII:
        index, far = there.look_up(y, normal)
        n = there.normal[index]
        near = (far < radius).to(x.dtype)[..., None]
        rows = (n[..., :, None] * z[..., None, :]).flatten(-2)
        gap = (n * (there.x[index] - start)).sum(-1, keepdim=True)
        A = rows.mT @ (near * rows) + torch.diag(stiff)
        b, _ = solve(A, rows.mT @ (near * gap))
        y = start + z @ b.reshape(-1, 2, 3).mT
    return y


def _smoothed(fields: list[EdgeField], shown: list[_Pieces], spacing: float) -> Curve:
    """Splines through the edge points, as many samples of each as the longest one has controls, (v, c, n)."""
    each = [p.curve(f) for p, f in zip(shown, fields, strict=True)]
    alive = torch.stack([p.alive for p in shown])
    closed = torch.stack([c.closed for c in each]) & alive
    length = torch.where(alive, torch.stack([c.length for c in each]), 0)
    controls = (length / spacing).round().long().clamp(*_CONTROLS)
    n = 2 * int(torch.where(alive, controls, _CONTROLS[0]).max())
    x = length.new_zeros(*alive.shape, n, 2)
    valid = torch.zeros(*alive.shape, n, dtype=torch.bool, device=x.device)
    for i, curve in enumerate(each):
        for around in (False, True):
            for number in sorted(set(controls[i][alive[i] & (closed[i] == around)].tolist())):
                at = (alive[i] & (closed[i] == around) & (controls[i] == number)).nonzero()[:, 0]
                spline, _ = fit_spline(Curve(curve.x[at], curve.valid[at], curve.closed[at]), number, closed=around)
                t = torch.arange(2 * number, dtype=x.dtype, device=x.device) / (2 * number - (0 if around else 1))
                x[i, at, : 2 * number] = spline.at(t.expand(len(at), -1))
                valid[i, at, : 2 * number] = True
    return Curve(x, valid, closed)


def _kept(shown: list[_Pieces], fields: list[EdgeField], middle: int, least: int) -> Int[Tensor, " c"]:
    """Curves that enough images show, those of most images first."""
    number = torch.stack([p.alive for p in shown]).sum(0)
    length = shown[middle].curve(fields[middle]).length
    order = (number + length / (1 + length)).argsort(descending=True, stable=True)
    return order[number[order] >= least]
