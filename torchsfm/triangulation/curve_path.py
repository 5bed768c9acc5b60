"""Which of its candidate depths has each sample of a curve? Those of a curve that hangs together, by dynamic programming."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_LEAP, _LEAP_COST = 10.0, 0.3
"""A step in depth of so many steps across the rays is a leap, and what it costs, in votes; shorter ones in proportion."""
_AHEAD = 0.5
"""Votes that the path must be ahead of one that takes a sample elsewhere."""
_RUN = 4
"""Fewer sure samples in a row are no piece of a curve: curves that have nothing in common meet by chance."""
_APART = 3.0
"""Candidates farther apart than so many steps across the rays are different answers."""


class CurvePath(NamedTuple):
    """One candidate of each sample."""

    depth: Float[Tensor, "p m"]
    sure: Bool[Tensor, "p m"]
    """Whether the path is well ahead of any that takes the sample elsewhere, and runs on from it without a leap."""


def best_path(
    depth: Float[Tensor, "p m c"],
    votes: Float[Tensor, "p m c"],
    blur: Float[Tensor, "p m c"],
    direction: Float[Tensor, "p m 3"],
    kept: int,
) -> CurvePath:
    """The path of most votes through candidates (Viterbi 1967), and how far ahead it is at each sample.

    The total of the best path through a candidate is that of the best way to it and the best way from it (min-marginals).

    Args:
        depth: Depths of the samples' candidates along their rays.
        votes: Of each candidate; 0 or less where there is none.
        blur: Depths no farther apart are not told from each other by what the views see.
        direction: Unit directions of the rays.
        kept: Candidates of a sample that are looked at, those of most votes.
    """
    c = min(kept, depth.shape[-1])
    votes, order = torch.where(votes > 0, votes, -torch.inf).topk(c, dim=-1)
    depth, blur = depth.gather(-1, order), blur.gather(-1, order)
    found = votes[..., 0] > 0
    votes = torch.where(found[..., None], votes, 0)
    m = depth.shape[1]
    # How far a sample moves across the rays from one to the next, for a depth of 1.
    stride = torch.linalg.vector_norm(direction[:, 1:] - direction[:, :-1], dim=-1)
    known = found[:, 1:] & found[:, :-1]
    forth, came = [votes[:, 0]], []
    for k in range(1, m):
        best, index = (forth[-1][..., None] - _cost(depth, stride, known, k)).max(1)
        came.append(index)
        forth.append(best + votes[:, k])
    back = [torch.zeros_like(votes[:, 0])]
    for k in range(m - 1, 0, -1):
        back.append(((votes[:, k] + back[-1])[:, None] - _cost(depth, stride, known, k)).amax(2))
    chosen = [forth[-1].argmax(-1, keepdim=True)]
    for index in reversed(came):
        chosen.append(index.gather(-1, chosen[-1]))
    slot = torch.stack(chosen[::-1], 1)
    through = torch.stack(forth, 1) + torch.stack(back[::-1], 1)
    own = depth.gather(-1, slot)
    # The longer of the steps before and after.
    padded = torch.nn.functional.pad(stride, (1, 1))
    step = torch.maximum(padded[:, :-1], padded[:, 1:])
    linked = known & (_leap(own[:, :-1], own[:, 1:], stride[..., None])[..., 0] < 1)
    near = torch.maximum(_APART * step[..., None] * own, blur.gather(-1, slot))
    apart = (depth - own).abs() > near
    rival = torch.where(apart & (votes > -torch.inf), through, -torch.inf).amax(-1)
    before, after = own[:, :-2], own[:, 2:]
    # Where the candidate that belongs here is missing, another one stands out from both neighbours.
    spike = (2 * own[:, 1:-1] - before - after).abs() > 2 * near[:, 1:-1] + (after - before).abs()
    spike = torch.nn.functional.pad(spike[..., 0] & known[:, 1:] & known[:, :-1], (1, 1))
    sure = found & (through.gather(-1, slot)[..., 0] - rival > _AHEAD) & ~spike
    return CurvePath(own[..., 0], _in_long_runs(sure, linked, _RUN))


def _in_long_runs(sure: Bool[Tensor, "p m"], linked: Bool[Tensor, "p m-1"], least: int) -> Bool[Tensor, "p m"]:
    """Samples in runs of so many sure ones, each linked to the next."""
    breaks = torch.nn.functional.pad(~(linked & sure[:, 1:] & sure[:, :-1]), (1, 0), value=True)
    run = breaks.cumsum(-1) - 1
    size = torch.zeros_like(run).scatter_add(-1, run, sure.long())
    return sure & (size.gather(-1, run) >= least)


def _leap(before: Tensor, after: Tensor, stride: Tensor) -> Tensor:
    """The step from one depth to the next, 1 and more for a leap."""
    return (after - before).abs() / (_LEAP * stride * before).clamp_min(1e-300)


def _cost(depth: Tensor, stride: Tensor, known: Tensor, k: int) -> Float[Tensor, "p c c"]:
    """Of the step from each candidate of the sample before to each of the sample `k`."""
    leap = _leap(depth[:, k - 1, :, None], depth[:, k, None], stride[:, k - 1, None, None])
    return _LEAP_COST * leap.clamp(max=1) * known[:, k - 1, None, None]
