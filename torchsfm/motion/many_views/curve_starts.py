"""Which way round, and from where, do the images of one space curve run alike? Guesses, the likeliest first.

Samples equally far apart on two images of a curve are nearly an affine map of each other, if they run alike. All directions and
starts are tried for all pairs of images at once (the correlation theorem); the images of a curve are put together from the
nearest pair on, some guesses alive at a time, and those of all curves by how near their samples are to a matrix of rank four,
as distant cameras that all curves share would make it (Tomasi & Kanade 1992).
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.linalg import eigvalsh, qr

_GUESSES = 16
"""Of each curve that are kept."""
_TOGETHER = 64
"""Of all curves so far that are kept."""
_FLOOR = 1e-3
"""Differences of the relative misfit below this say nothing: cameras are near, and length along a curve is not affine."""
_TURNED = 1.0
"""What it costs that a curve is seen from behind, in logarithms of the misfit."""


class Runs(NamedTuple):
    """How images of curves run alike."""

    back: Bool[Tensor, "p g v c"]
    """Where a curve is to be taken from its other end."""
    start: Float[Tensor, "p g v c"]
    """At which share of the length it begins then."""


def guess_runs(
    samples: Float[Tensor, "p v c m 2"], there: Bool[Tensor, "p v c"], closed: Bool[Tensor, "p v c"], oriented: bool, most: int
) -> Runs:
    """The likeliest ways in which the images of each curve run alike.

    Args:
        samples: Equally far apart along the image curves, from the first sample of closed ones.
        there: Which images show which curve.
        closed: Closed curves, which may begin anywhere.
        oriented: Whether the directions are known to be alike.
        most: Guesses wanted.
    """
    p, v, c, m, _ = samples.shape
    cost = _pair_costs(samples, there, closed, oriented)
    far = cost.flatten(-2).amin(-1).sum(-1)
    far = far + far.mT
    order = _nearest_first(far)
    row = torch.arange(p, device=samples.device)
    # All images so far tell how the next one runs, the nearest most.
    back = torch.zeros(p, c, 1, 1, dtype=torch.long, device=samples.device)
    shift, total = back, torch.zeros(p, c, 1, dtype=samples.dtype, device=samples.device)
    ways = torch.arange(2 * m, device=samples.device)
    near = torch.exp(-(far - far.amin((-2, -1), keepdim=True)) / c)
    for k in range(1, v):
        told, weight = torch.zeros_like(total[..., None]), torch.zeros_like(total[:, 0, 0])
        for q in range(k):
            share = near[row, order[:, q], order[:, k]]
            turn, by = back[..., q, None], shift[..., q, None]
            way = (turn ^ (ways // m)) * m + (ways % m - by) * (1 - 2 * turn) % m
            pair = cost[row, order[:, q], order[:, k]].flatten(-2)
            told = told + share[:, None, None, None] * pair[:, :, None].expand(*way.shape[:3], -1).gather(-1, way)
            weight = weight + share
        told = total[..., None] + told / weight[:, None, None, None]
        told = told.reshape(*total.shape, 2, m)
        least = (told <= told.roll(1, -1)) & (told < told.roll(-1, -1))
        told = torch.where(least, told, torch.inf).flatten(2)
        total, index = told.topk(min(_GUESSES, told.shape[-1]), largest=False)
        guess, way = index // (2 * m), index % (2 * m)
        earlier = guess[..., None].expand(*guess.shape, k)
        back = torch.cat((back.gather(2, earlier), (way // m)[..., None]), -1)
        shift = torch.cat((shift.gather(2, earlier), (way % m)[..., None]), -1)
    given = order.argsort(-1)[:, None, None].expand_as(back)
    back, shift = back.gather(-1, given), shift.gather(-1, given)
    chosen = _together(samples, closed, back, shift, total < torch.inf, most)
    pick = chosen[..., None].expand(*chosen.shape, v)
    back, shift = (t.transpose(1, 2).gather(1, pick).transpose(2, 3) for t in (back, shift))
    return Runs(back > 0, shift.to(samples.dtype) / m)


def run(samples: Float[Tensor, "*b m 2"], back: Bool[Tensor, "*b"], closed: Bool[Tensor, "*b"]) -> Tensor:
    """Samples from the other end where asked for; closed curves keep their first one."""
    other = samples.flip(-2)
    other = torch.where(closed[..., None, None], other.roll(1, -2), other)
    return torch.where(back[..., None, None], other, samples)


def _pair_costs(samples: Tensor, there: Tensor, closed: Tensor, oriented: bool) -> Float[Tensor, "p v v c 2 m"]:
    """The logarithm of the part of each image's curve that no affine map of each other's explains, for all ways to run."""
    m = samples.shape[3]
    x = samples - samples.mean(-2, keepdim=True)
    basis, R, _ = qr(x)
    both = torch.stack((x, run(x, torch.ones_like(there), closed)), 3)
    first, second = torch.fft.rfft(basis, dim=-2), torch.fft.rfft(both, dim=-2)
    product = first.conj_physical()[:, :, None, :, None, :, :, None] * second[:, None, :, :, :, :, None, :]
    A = torch.fft.irfft(product, n=m, dim=-3)
    size = x.square().sum((-2, -1))[:, None, :, :, None, None]
    rest = (1 - A.square().sum((-2, -1)) / size.clamp_min(1e-300)).clamp(min=0)
    side = (R[..., 0, 0] * R[..., 1, 1])[:, :, None, :, None, None]
    turned = side * (A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] * A[..., 1, 0]) < 0
    cost = ((rest + _FLOOR) / _FLOOR).log() + _TURNED * turned
    pair = there[:, :, None] & there[:, None]
    ring = (closed[:, :, None] & closed[:, None] & pair)[..., None, None]
    way = torch.arange(2, device=x.device)[:, None]
    slot = torch.arange(m, device=x.device)
    free = (ring | (slot == 0)) & ((way == 0) | (pair[..., None, None] & (not oriented)))
    return torch.where(free, torch.where(pair[..., None, None], cost, 0), torch.inf)


def _nearest_first(far: Float[Tensor, "p v v"]) -> Int[Tensor, "p v"]:
    """The image that is nearest to all others, then always the one nearest to any so far (Prim 1957)."""
    p, v, _ = far.shape
    row, own = torch.arange(p, device=far.device), torch.eye(v, dtype=torch.bool, device=far.device)
    order = [far.masked_fill(own, 0).sum(-1).argmin(-1)]
    placed = torch.zeros(p, v, dtype=torch.bool, device=far.device)
    for _ in range(v - 1):
        placed = placed.index_put((row, order[-1]), torch.tensor(True, device=far.device))
        ahead = placed[:, :, None] & ~placed[:, None]
        order.append(torch.where(ahead, far.clamp(max=1e300), torch.inf).amin(1).argmin(-1))
    return torch.stack(order, 1)


def _together(samples: Tensor, closed: Tensor, back: Tensor, shift: Tensor, some: Tensor, most: int) -> Int[Tensor, "p g c"]:
    """Which guess of each curve, for the likeliest of all curves."""
    p, c, m = samples.shape[0], samples.shape[2], samples.shape[3]
    slot = torch.arange(m, device=samples.device)
    moments = []
    for k in range(back.shape[2]):
        turned = run(samples, back[:, :, k].transpose(1, 2) > 0, closed)
        index = (slot + shift[:, :, k].transpose(1, 2)[..., None]) % m
        x = turned.gather(-2, index[..., None].expand_as(turned))
        x = x.permute(0, 2, 3, 1, 4).flatten(3)
        x = torch.cat((x, torch.ones_like(x[..., :1])), -1)
        moments.append(x.mT @ x)
    G = torch.stack(moments, 2)
    chosen = torch.zeros(p, 1, 0, dtype=torch.long, device=samples.device)
    so_far = torch.zeros_like(G[:, :1, 0])
    for k in range(c):
        joint = so_far[:, :, None] + G[:, None, k]
        rest = torch.where(some[:, None, k], _beyond_affine(joint), torch.inf).flatten(1)
        number = min(most if k == c - 1 else _TOGETHER, rest.shape[1])
        index = rest.topk(number, largest=False).indices
        old, new = index // G.shape[2], index % G.shape[2]
        chosen = torch.cat((chosen.gather(1, old[..., None].expand(*old.shape, k)), new[..., None]), -1)
        so_far = joint.flatten(1, 2).gather(1, index[..., None, None].expand(*index.shape, *G.shape[-2:]))
    return chosen


def _beyond_affine(G: Float[Tensor, "*b k k"]) -> Float[Tensor, "*b"]:
    """What a matrix of rank four, one of its rows constant, leaves of samples with such moments."""
    number, mean = G[..., -1, -1], G[..., :-1, -1]
    spread = G[..., :-1, :-1] - mean[..., :, None] * mean[..., None, :] / number[..., None, None].clamp_min(1)
    values, _ = eigvalsh(spread)
    return values[..., :-3].clamp(min=0).sum(-1)
