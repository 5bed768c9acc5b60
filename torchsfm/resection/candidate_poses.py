"""From candidates to the poses of a solver's slots: Newton's method where it is wanted, what is a solution, each once."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.linalg.portions import portions
from torchsfm.linalg.rows import take_columns
from torchsfm.optim import attach_implicit, for_slots, wants_derivative
from torchsfm.resection.points_and_lines import ROUNDING, Fit, Sample, equations, fit_of, newton_step, prepare, sure
from torchsfm.resection.vector_rows import length_rows

_STEPS = 3
_MET = 1e-9
"""What may be left of an equation between unit vectors."""
_TWICE = 1e-8
"""Distance of poses that are one."""
_CHUNK = 16384
"""Problems at a time."""


class Candidates(NamedTuple):
    """Poses that may be solutions; not finite where there is none."""

    item: Int[Tensor, " m"]
    """The problem of each."""
    slot: Int[Tensor, " m"]
    R: Float[Tensor, "3 3 m"]
    t: Float[Tensor, "3 m"]
    problem: Sample
    """What `Sample.of(item)` is."""
    normals: Float[Tensor, "3 k m"] | None = None
    """Of the planes of sight, turned into the world, where they are known."""
    anew: bool = False
    """They take the place of all that came before of these problems."""


def solve_poses(
    candidates: Callable[[Sample], Iterable[Candidates]],
    slots: int,
    batch: torch.Size,
    d: Tensor,
    X: Tensor,
    l: Tensor,  # noqa: E741
    L: Tensor,
) -> Solutions[Tensor]:
    """The poses that a solver's candidates lead to: (*batch, slots, 3, 4), and which of them are real."""
    dtype, number, data = L.dtype, batch.numel(), [t.expand(*batch, *t.shape[-2:]) for t in (d, X, l, L)]
    with torch.no_grad():
        flat = [t.detach().double().reshape(number, *t.shape[-2:]) for t in data]
        # One column more, for what is no solution.
        none = slots * number
        rows = torch.zeros(3, 4, none + 1, dtype=dtype, device=L.device)
        rows.diagonal(dim1=0, dim2=1).fill_(1)
        real = torch.zeros(none + 1, dtype=torch.bool, device=L.device)
        for some in portions(number, _CHUNK, L.device):
            sample = prepare([t[some].permute(2, 1, 0).contiguous() for t in flat], torch.finfo(dtype).eps)
            solved = _Solved(sample, slots, number, some.start, rows, real)
            # Each is done with while it is in the cache.
            for found in candidates(sample):
                solved.add(found)
            solved.polish()
            solved.take_repeated()
        model = rows[..., :none].view(3, 4, slots, *batch).movedim((2, 0, 1), (-3, -2, -1))
        valid = real[:none].view(slots, *batch).movedim(0, -1)
    if wants_derivative(*data):
        model = attach_implicit(equations, model, *(for_slots(t, batch) for t in data), dims=2, valid=valid)
    return Solutions(model, valid)


class _Solved:
    """The solutions of some problems, which are written to their places among those of all."""

    def __init__(self, sample: Sample, slots: int, number: int, start: int, rows: Tensor, real: Tensor) -> None:
        self.sample, self.slots, self.number, self.start, self.rows, self.real = sample, slots, number, start, rows, real
        self.world = torch.cat((sample.origin, torch.stack((sample.unit, sample.rounding, sample.sound.to(sample.unit.dtype)))))
        self.width = len(sample.unit)
        self.sums = sample.unit.new_full((slots * self.width + 1,), torch.nan)
        """Of some numbers of each pose, by slots."""
        self.rough: list[tuple[Candidates, Fit]] = []

    def add(self, found: Candidates) -> None:
        """Those of the candidates that are solutions, and what is to be polished later, many at once."""
        if found.anew:
            self.polish()
            self.sums[:-1].view(self.slots, self.width)[:, found.item] = torch.nan
            self.real[:-1].view(self.slots, self.number)[:, found.item + self.start] = False
        fit = fit_of(found.problem, found.R, found.t, found.normals)
        far = length_rows(found.t).clamp_min_(1.0)
        worst = fit.left.amax(0)
        self._write(found, fit, worst, far)
        (at,) = (worst > ROUNDING * far).nonzero(as_tuple=True)
        if len(at):
            R, t, *rest = (take_columns(v, at) for v in (found.R, found.t, *fit))
            item = found.item[at]
            self.rough.append((Candidates(item, found.slot[at], R, t, self.sample.of(item)), Fit(*rest)))

    def polish(self) -> None:
        """Newton's method where rounding has left something."""
        if not self.rough:
            return
        found, fits = zip(*self.rough, strict=True)
        self.rough = []
        item, slot, R, t = (torch.cat(v, -1) for v in zip(*(c[:4] for c in found), strict=True))
        fit = Fit(*(torch.cat(v, -1) for v in zip(*fits, strict=True)))
        problem, worst, enough = self.sample.of(item), fit.left.amax(0), ROUNDING * length_rows(t).clamp_min_(1.0)
        left = torch.arange(len(worst), device=worst.device)
        for _ in range(_STEPS):
            part = problem.of(left)
            new_R, new_t = newton_step(part, take_columns(R, left), take_columns(t, left))
            new = fit_of(part, new_R, new_t)
            after = new.left.amax(0)
            better = after < worst[left]
            place = left[better]
            R[..., place], t[..., place], worst[place] = new_R[..., better], new_t[..., better], after[better]
            for old_rows, rows in zip(fit, new, strict=True):
                old_rows[:, place] = rows[:, better]
            left = left[better & (after > enough[left])]
            if not len(left):
                break
        self._write(Candidates(item, slot, R, t, problem), fit, worst, length_rows(t).clamp_min_(1.0))

    def take_repeated(self) -> None:
        """Of poses of a problem that are one leave the first."""
        # Equal poses have equal sums of some of their numbers; few others do.
        sums, pairs = self.sums[:-1].view(self.slots, self.width), []
        for k in range(1, self.slots):
            first, item = ((sums[:k] - sums[k]).abs_() < 4 * _TWICE).nonzero(as_tuple=True)
            pairs.append(torch.stack((first, torch.full_like(first, k), item)))
        first, last, item = torch.cat(pairs, 1)
        if not len(item):
            return
        item = item + self.start
        one, other = (self.rows.flatten(0, 1)[:, k * self.number + item] for k in (first, last))
        # No closer than numbers of the caller's kind tell.
        same = (one - other).abs() <= _TWICE + torch.finfo(one.dtype).eps * one.abs()
        for k in range(1, self.slots):
            own = same.all(0) & (last == k) & self.real[first * self.number + item]
            self.real[k * self.number + item[own]] = False

    def _write(self, found: Candidates, fit: Fit, worst: Tensor, far: Tensor) -> None:
        """The world's poses to the slots of those that are solutions."""
        item, slot, R, t = found[:4]
        x, y, z, unit, rounding, sound = take_columns(self.world, item).unbind(0)
        # No comparison holds where anything is not finite.
        good = worst <= _MET * far
        good &= (sound > 0) & (slot < self.slots)
        good &= sure(found.problem, R, fit, far, rounding)
        shift = unit * t
        for column, v in zip(R.unbind(1), (x, y, z), strict=True):
            shift.addcmul_(column, v, value=-1)
        held, shift = R.to(self.rows.dtype), shift.to(self.rows.dtype)
        if held.dtype != R.dtype:
            # What passes for a number in float64 may be none here.
            good &= held.isfinite().flatten(0, 1).all(0) & shift.isfinite().all(0)
        place = torch.where(good, (slot * self.number).add_(item).add_(self.start), self.slots * self.number)
        self.rows[:, :3].scatter_(2, place.expand(3, 3, -1), held)
        self.rows[:, 3].scatter_(1, place.expand(3, -1), shift)
        self.real.index_fill_(0, place, True)
        total = R[0, 0] + 0.7 * R[1, 1] + 0.4 * R[1, 2] + 0.3 * t[2]
        self.sums.scatter_(0, torch.where(good, slot * self.width + item, self.slots * self.width), total)
