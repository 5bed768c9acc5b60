"""Several models in one set of data: the data are grouped by what they have in common, which is the models they prefer.

Hypotheses are drawn from near neighbours, and from anywhere, and the best supported are optimised locally. A datum prefers the
hypotheses near it, by exp(-r / threshold). Two groups are as alike as their preferences (Tanimoto's distance), a group prefers
what all its members do, and groups merge until none prefers what another does (T-linkage: Magri & Fusiello 2014). All groups
that are nearest to each other merge at a time, so that few rounds do. Each group that is large enough has a model refined on
it; groups that an earlier model explains join it, and so do single data well inside a model.
"""

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, tensor_map
from torchsfm.linalg.portions import portion
from torchsfm.robust.estimator import Estimator, constant_weights
from torchsfm.robust.hypotheses import solve_samples, squared_residual
from torchsfm.robust.models import cast, join, tensors_of
from torchsfm.robust.problems import Flat, Problems, pack
from torchsfm.robust.samplers import Neighbours
from torchsfm.robust.sampling import draw_seed

M = TypeVar("M")

_NEIGHBOURS = (10, 20, 40)
"""From how many neighbours of a datum a quarter of the samples each is drawn; the last quarter is drawn from all."""
_REACH = 4.0
"""Squared distance, in units of the squared threshold, to which data prefer a hypothesis at all."""
_EXPLAINED = 0.6
"""Share of a group within the threshold of an earlier model that joins it."""
_INSIDE = 0.25
"""Squared distance within which single data join a model."""
_SHRINKING = (9.0, 4.0, 1.5, 1.0)
"""Squared distances within which data count in the steps of local optimisation."""
_REFINEMENTS = 6
_NUMBERS = 1 << 18
"""Distances to compute at a time, on a CPU."""


@dataclass(frozen=True)
class Structures(Generic[M]):
    """Models that together explain the data of each problem.

    Attributes:
        model: As many slots as were asked for, the model of most data first; empty slots hold copies of some model, or zero.
        valid: Which slots hold models.
        label: The slot that each datum belongs to, -1 for none.
        found: How many structures there were; more than slots means that the smallest are left out.
        status: `OK`; `TOO_FEW` data for a sample; `NOT_FINITE`: too few of the data are finite; `DEGENERATE`: no sample had a
            solution; `NO_CONSENSUS`: no group is large enough.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(70, 2, generator=g, dtype=torch.float64)
        >>> x2 = torch.cat((x1[:40] + 0.1, x1[40:60] * 0.8, torch.rand(10, 2, generator=g).double()))  # two motions, ten wrong
        >>> estimator = torchsfm.motion.HomographyEstimator()
        >>> found = torchsfm.find_structures(estimator, x1, x2, threshold=1e-3, hypotheses=200, kept=50, generator=g)
        >>> found.model[found.valid].shape, [int((found.label == k).sum()) for k in (0, 1, -1)]
        (torch.Size([2, 3, 3]), [40, 20, 10])
    """

    model: M
    valid: Bool[Tensor, "*batch s"]
    label: Int[Tensor, "*batch n"]
    found: Int[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]


def find_structures(
    estimator: Estimator[M],
    *data: Float[Tensor, "*#batch n _"],
    threshold: float | Float[Tensor, "*#batch"],
    mask: Bool[Tensor, "*#batch n"] | None = None,
    slots: int = 8,
    smallest: int | None = None,
    hypotheses: int = 2000,
    kept: int = 600,
    generator: torch.Generator | None = None,
) -> Structures[M]:
    """Find several models of one kind in each problem's data, and which data belong to which.

    Rows with NaN or infinite numbers are left out. Problems are worked on one after the other, each with its own number of
    data; the result for a problem is the same whatever else is in the batch. Time and memory grow with the square of the number
    of data.

    Args:
        estimator: The problem: what to solve, measure and refine.
        *data: The data, `(*batch, n, d)` each, equally many; batch dimensions broadcast. Neighbours are near in all of them.
        threshold: Largest distance of data from their model, in the unit of the estimator's residual; one number or one per
            problem. Two to four times the scale of the noise: structures are found by being dense, not by being exact.
        mask: Which data exist; all of them if not given.
        slots: Most structures to return.
        smallest: Least number of data of a structure; four more than a sample has if not given.
        hypotheses: Samples to draw for a problem.
        kept: Hypotheses to optimise and to group by.
        generator: Source of randomness; PyTorch's global one if not given.

    Returns:
        Models, labels and status of each problem. No derivatives.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(60, 2, generator=g, dtype=torch.float64)
        >>> x2 = torch.cat((x1[:30] + 0.1, x1[30:] * 0.8))  # two motions
        >>> estimator = torchsfm.motion.HomographyEstimator()
        >>> found = torchsfm.find_structures(estimator, x1, x2, threshold=1e-3, hypotheses=200, kept=50, generator=g)
        >>> int(found.found), found.label.bincount()
        (2, tensor([30, 30]))
    """
    flat = Flat.of(estimator, data, threshold, mask)
    m = estimator.sample_size
    smallest = m + 4 if smallest is None else smallest
    check_options(
        slots=(slots, "int >= 1"),
        smallest=(smallest, f"int >= {m}"),
        hypotheses=(hypotheses, "int >= 1"),
        kept=(kept, "int >= 1"),
    )
    dtype, seed = data[0].dtype, draw_seed(generator)
    with torch.no_grad():
        flat = cast(tensor_map(Tensor.detach, flat), torch.float64)
        p, n = flat.shape
        usable = flat.usable()
        enough = torch.isfinite(flat.bound) & (flat.bound > 0)
        enough = enough & (n >= m if usable is None else usable.sum(-1) >= m)
        model, status = flat.no_models(slots), flat.refused()
        label = torch.full((p, n), -1, device=flat.bound.device)
        found = torch.zeros_like(label[:, 0])
        for problems in pack(flat, usable, enough):
            for i, member in enumerate(problems.member.tolist()):
                one = problems.take(torch.tensor([i], device=label.device))
                one = one.narrowed(int(one.count))
                groups, models, solved = _Problem(one).solve(seed, hypotheses, kept, smallest)
                number = 0 if models is None else int(groups.max()) + 1
                label[member] = one.scatter(torch.where(groups < slots, groups, -1)[None], n, -1)[0]
                found[member] = number
                status[member] = int(Status.OK if number else Status.NO_CONSENSUS if solved else Status.DEGENERATE)
                if models is not None:
                    at = torch.arange(slots, device=label.device).clamp(max=number - 1)
                    for all_, own in zip(tensors_of(model), tensors_of(models), strict=True):
                        all_[member] = own[at]
        valid = torch.arange(slots, device=label.device) < found[:, None]
        return flat.unflatten(cast(Structures(model, valid, label, found, status), dtype))


@dataclass(frozen=True)
class _Problem:
    """One problem, its data in as many slots."""

    problems: Problems

    @property
    def count(self) -> int:
        return self.problems.width

    def solve(self, seed: int, hypotheses: int, kept: int, smallest: int) -> tuple[Tensor, Any, bool]:
        """The group of each datum, largest first, -1 for none; the groups' models, if any; whether samples had solutions."""
        device = self.problems.count.device
        nothing = torch.full((self.count,), -1, device=device)
        zero = torch.zeros(1, dtype=torch.long, device=device)
        models, there = solve_samples(self.problems, zero, zero, zero + hypotheses, seed, Neighbours(_NEIGHBOURS))
        models = tensor_map(lambda t: t[there], models)
        if not bool(there.any()):
            return nothing, None, False
        models = self.best(models, kept)
        ratio = self.ratios(models)
        preference = torch.where(ratio < _REACH, torch.exp(-ratio.clamp(max=_REACH).sqrt()), 0)
        group = link(preference.mT)
        members = (group == group[:, None]).sum(-1)
        # The first member stands for its group; large groups first.
        heads = ((group == torch.arange(self.count, device=group.device)) & (members >= smallest)).nonzero()[:, 0]
        heads = heads[members[heads].argsort(descending=True, stable=True)]
        if len(heads) == 0:
            return nothing, None, True
        inside = group == heads[:, None]
        models = self.refined(models, ratio, inside)
        return self.joined(models, inside)

    def portion(self) -> int:
        """How many models to look at at a time."""
        return max(1, portion(_NUMBERS, self.problems.limit.device) // self.count)

    def ratios(self, models: Any) -> Float[Tensor, "h n"]:
        """Squared distances in units of the squared threshold."""
        wide = self.problems.spread()
        total, step = len(tensors_of(models)[0]), self.portion()
        rows = []
        for i in range(0, total, step):
            some = tensor_map(lambda t: t[None, i : i + step], models)  # noqa: B023
            rows.append(squared_residual(wide.estimator, some, *wide.data)[0] / wide.limit)
        return torch.cat(rows).nan_to_num(nan=torch.inf)

    def best(self, models: Any, kept: int) -> Any:
        """The best supported, locally optimised."""
        support = (1 - self.ratios(models).clamp(max=1)).sum(-1)
        chosen = support.argsort(descending=True, stable=True)[:kept]
        step, done = self.portion(), []
        for i in range(0, len(chosen), step):
            some = tensor_map(lambda t: t[chosen[i : i + step]], models)  # noqa: B023
            for factor in _SHRINKING:
                some = self.step(some, (self.ratios(some) < factor).double())
            done.append(some)
        return join(done)

    def step(self, models: Any, weights: Float[Tensor, "h n"]) -> Any:
        """A step of weighted refinement of each model."""
        wide = self.problems.spread()
        some = tensor_map(lambda t: t[None], models)
        moved = wide.estimator.step(some, *wide.data, weigh=constant_weights(weights[None]))
        return tensor_map(lambda t: t[0], moved)

    def refined(self, models: Any, ratio: Tensor, inside: Bool[Tensor, "g n"]) -> Any:
        """A model of each group: the best hypothesis for it, refined on its members."""
        loss = ratio.clamp(max=1) @ inside.to(ratio.dtype).mT
        group = tensor_map(lambda t: t[loss.argmin(0)], models)
        for _ in range(_REFINEMENTS):
            group = self.step(group, inside * (1 - self.ratios(group) / _REACH).clamp(min=0))
        return group

    def joined(self, models: Any, inside: Bool[Tensor, "g n"]) -> tuple[Tensor, Any, bool]:
        """Groups that an earlier model explains with it, and the data well inside a model."""
        ratio = self.ratios(models)
        home: list[int] = []
        heads: list[int] = []
        for k in range(len(inside)):
            explained = [bool((ratio[h][inside[k]] < 1).double().mean() > _EXPLAINED) for h in heads]
            if not any(explained):
                heads.append(k)
            home.append(explained.index(True) if any(explained) else len(heads) - 1)
        group = torch.full((self.count,), -1, dtype=torch.long, device=ratio.device)
        for k, h in enumerate(home):
            group[inside[k]] = h
        models = tensor_map(lambda t: t[heads], models)
        least, nearest = ratio[heads].min(0)
        group = torch.where((group < 0) & (least < _INSIDE), nearest, group)
        # Refined once more on all that belong, and the largest first.
        inside = group == torch.arange(len(heads), device=group.device)[:, None]
        models = self.refined(models, self.ratios(models), inside)
        order = inside.sum(-1).argsort(descending=True, stable=True)
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order), device=order.device)
        return torch.where(group < 0, -1, rank[group.clamp(min=0)]), tensor_map(lambda t: t[order], models), True


def link(preference: Float[Tensor, "n h"]) -> Int[Tensor, "n"]:
    """Group data by their preferences for hypotheses: the first member of the group of each datum.

    Groups that are each other's nearest merge, round by round, until no two have a preference in common.
    """
    preference = preference.clone()
    n = len(preference)
    head = torch.arange(n, device=preference.device)
    alive = head.clone()
    while len(alive) > 1:
        product = preference @ preference.mT
        size = product.diagonal()
        alike = product / (size[:, None] + size - product).clamp(min=1e-30)
        alike.fill_diagonal_(-1)
        most, nearest = alike.max(-1)
        here = torch.arange(len(alive), device=head.device)
        pair = (nearest[nearest] == here) & (here < nearest) & (most > 1e-9)
        first = pair.nonzero()[:, 0]
        if len(first) == 0:
            break
        second = nearest[first]
        preference[first] = torch.minimum(preference[first], preference[second])
        map_to = torch.arange(n, device=head.device)
        map_to[alive[second]] = alive[first]
        head = map_to[head]
        rest = torch.ones_like(here, dtype=torch.bool)
        rest[second] = False
        preference, alive = preference[rest], alive[rest]
    return head
