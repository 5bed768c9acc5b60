"""What a datum at some distance from a model costs, and what it weighs in local optimisation.

Distances come squared. A scoring says which of two models is better; the final refinement weighs the data by the noise it finds
(`noise.scale_of_noise`), whatever the scoring.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

MEDIANS = {1: 0.45494, 2: 1.38629, 3: 2.36597}
"""The median of chi-squared with so many degrees of freedom."""
EDGES = {1: 6.2, 2: 9.2, 3: 11.3}
"""Squared distance in units of the variance that nearly all inliers are nearer than (quantiles of about 0.99)."""
BLUNT = {2: 9.2103, 3: 11.3449, 4: 13.2767}
"""The quantile 0.99 of chi-squared."""


@runtime_checkable
class Scoring(Protocol):
    """How models are compared. Small frozen objects; `Msac()`, `Magsac()`, `InlierCount()`, `LeastMedian()`.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.robust import InlierCount, Magsac, Msac
        >>> squared = torch.tensor([[[0.1, 0.2, 30.0], [3.0, 3.5, 3.9]]])  # squared distances of three data to two models
        >>> for scoring in (InlierCount(), Msac(), Magsac()):  # which is better, where the threshold is 2?
        ...     print(type(scoring).__name__, scoring.cost(squared, torch.tensor([4.0]), None, 2).argmin().item())
        ...
        InlierCount 1
        Msac 0
        Magsac 0
    """

    needs_threshold: ClassVar[bool]
    """Whether the largest distance of an inlier must be known; otherwise `limit` estimates it."""

    def cost(
        self, squared: Float[Tensor, "g s n"], limit: Float[Tensor, "g"], weight: Tensor | None, codimension: int
    ) -> Float[Tensor, "g s"]:
        """The cost of models; the lower, the better.

        Args:
            squared: Squared distances of n data to s models each of g problems.
            limit: The squared threshold of each problem.
            weight: How much each datum counts, (g, n); None for all alike.
            codimension: How many independent numbers make a distance, see `Estimator`.
        """
        ...

    def weigh(self, ratio: Float[Tensor, "*batch n"], codimension: int) -> Float[Tensor, "*batch n"]:
        """The weight of data in local optimisation.

        Args:
            ratio: Squared distances over the squared threshold.
            codimension: How many independent numbers make a distance, see `Estimator`.
        """
        ...


def _total(loss: Tensor, weight: Tensor | None) -> Tensor:
    """The sum over the data; infinite with a distance that is not a number."""
    if weight is not None:
        loss = loss * weight[:, None]
    return loss.sum(-1).nan_to_num_(nan=torch.inf)


@dataclass(frozen=True)
class Msac:
    """The squared distance, at most the squared threshold (Torr & Zisserman 2000).

    Example:
        >>> import torch, torchsfm
        >>> squared = torch.tensor([[[0.0, 1.0, 9.0, 16.0]]])  # distances 0, 1, 3, 4 from one model, threshold 2
        >>> torchsfm.Msac().cost(squared, torch.tensor([4.0]), None, 1)  # 0 + 1 / 4 + 1 + 1
        tensor([[2.2500]])
    """

    needs_threshold: ClassVar[bool] = True

    def cost(self, squared: Tensor, limit: Tensor, weight: Tensor | None, codimension: int) -> Tensor:
        """The sum of truncated squared distances, in units of the squared threshold."""
        return _total((squared * limit.reciprocal().view(-1, 1, 1)).clamp_(max=1), weight)

    def weigh(self, ratio: Tensor, codimension: int) -> Tensor:
        """1 within the threshold."""
        return (ratio < 1).to(ratio.dtype)


@dataclass(frozen=True)
class InlierCount:
    """The number of data beyond the threshold (Fischler & Bolles 1981).

    Example:
        >>> import torch, torchsfm
        >>> squared = torch.tensor([[[0.0, 1.0, 9.0, 16.0]]])  # distances 0, 1, 3, 4 from one model, threshold 2
        >>> torchsfm.InlierCount().cost(squared, torch.tensor([4.0]), None, 1)  # two outliers
        tensor([[2.0000]])
    """

    needs_threshold: ClassVar[bool] = True

    def cost(self, squared: Tensor, limit: Tensor, weight: Tensor | None, codimension: int) -> Tensor:
        """The number of outliers, and a millionth of the sum of truncated distances to decide between equals."""
        ratio = squared * (1 / limit)[:, None, None]
        return _total((ratio >= 1).to(ratio.dtype) + 1e-6 * ratio.clamp(max=1), weight)

    def weigh(self, ratio: Tensor, codimension: int) -> Tensor:
        """1 within the threshold."""
        return (ratio < 1).to(ratio.dtype)


@dataclass(frozen=True)
class Magsac:
    """MAGSAC++: marginalised over the scale of the noise, evenly spread up to a largest one (Barath et al. 2020).

    The threshold is the distance beyond which not even the largest noise takes an inlier (quantile 0.99). With the squared
    distance y in units of twice the largest variance, K its value at the threshold and a = (dof - 1) / 2, the weight is
    Gamma(a, y) - Gamma(a, K) (upper incomplete) and the loss its integral.

    Attributes:
        dof: Degrees of freedom of the squared distance, 2, 3 or 4; 4 as published, for the coordinates of two points.

    Example:
        >>> import torch, torchsfm
        >>> squared = torch.tensor([[[0.0, 1.0, 9.0, 16.0]]])  # distances 0, 1, 3, 4 from one model, threshold 2
        >>> cost = torchsfm.Magsac().cost(squared, torch.tensor([4.0]), None, 1)
        >>> bool((cost > 2) & (cost < 3))  # two outliers, and a little of an inlier
        True
    """

    dof: int = 4

    needs_threshold: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.dof not in BLUNT:
            raise ValueError(f"dof: wanted 2, 3 or 4, got {self.dof}")

    def cost(self, squared: Tensor, limit: Tensor, weight: Tensor | None, codimension: int) -> Tensor:
        """The sum of the losses, each in units of the loss at the threshold."""
        end = BLUNT[self.dof] / 2
        y = (squared * (end / limit)[:, None, None]).clamp(max=end)
        upper, lower = self._gammas(y)
        edge, most = _at_threshold(self.dof)
        return _total((y * (upper - edge) + lower) * (1 / most), weight)

    def weigh(self, ratio: Tensor, codimension: int) -> Tensor:
        """Falling from 1 to 0 at the threshold."""
        end = BLUNT[self.dof] / 2
        edge, _ = _at_threshold(self.dof)
        top = math.gamma((self.dof - 1) / 2)
        upper, _ = self._gammas((ratio * end).clamp(max=end))
        return ((upper - edge) / (top - edge)).clamp(min=0).nan_to_num(nan=0.0)

    def _gammas(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Gamma(a, y), and the lower incomplete gamma function of a + 1."""
        decay = torch.exp(-y)
        if self.dof == 3:
            return decay, 1 - (1 + y) * decay
        root = y.sqrt()
        half = math.sqrt(math.pi) * torch.erfc(root)
        three = 0.5 * half + root * decay
        lower_three = 0.5 * math.sqrt(math.pi) - three
        if self.dof == 2:
            return half, lower_three
        return three, 1.5 * lower_three - y * root * decay


@cache
def _at_threshold(dof: int) -> tuple[float, float]:
    upper, lower = Magsac(dof)._gammas(torch.tensor(BLUNT[dof] / 2, dtype=torch.float64))
    return float(upper), float(lower)


@dataclass(frozen=True)
class LeastMedian:
    """The median of the squared distances: needs no threshold, but more good data than bad (Rousseeuw 1984).

    The threshold follows from the median as the distance that nearly all inliers of Gaussian noise are nearer than.

    Example:
        >>> import torch, torchsfm
        >>> squared = torch.tensor([[[0.0, 1.0, 4.0, 900.0, 1600.0]]])  # of one model
        >>> torchsfm.LeastMedian().cost(squared, torch.tensor([4.0]), None, 1)
        tensor([[4.]])
    """

    needs_threshold: ClassVar[bool] = False

    def cost(self, squared: Tensor, limit: Tensor, weight: Tensor | None, codimension: int) -> Tensor:
        """The median over the data."""
        n = squared.shape[-1]
        if weight is None:
            return squared.nan_to_num(nan=torch.inf).kthvalue(n // 2 + 1, dim=-1).values
        there = weight > 0
        ordered, order = torch.where(there[:, None], squared, torch.inf).nan_to_num(nan=torch.inf).sort(dim=-1)
        if weight.dtype == torch.bool:
            rank = (there.sum(-1) // 2)[:, None, None].expand(-1, squared.shape[1], 1)
        else:
            # The first before which and with which there is more than half of the weight.
            below = weight[:, None].expand_as(squared).gather(-1, order).cumsum(-1)
            rank = (below <= 0.5 * weight.sum(-1)[:, None, None]).sum(-1, keepdim=True)
        return ordered.gather(-1, rank.clamp(max=n - 1))[..., 0]

    def weigh(self, ratio: Tensor, codimension: int) -> Tensor:
        """1 within the threshold."""
        return (ratio < 1).to(ratio.dtype)

    def limit(self, cost: Float[Tensor, "g s"], count: Int[Tensor, "g"], size: int, codimension: int) -> Float[Tensor, "g s"]:
        """The squared threshold that follows from the median of a model through a sample of `size` of `count` data.

        With the correction for few data of Rousseeuw & Leroy (1987, 5.1).
        """
        small = 1 + 5 / (count - size).clamp(min=1).to(cost.dtype)
        return cost * (small * small)[:, None] * (EDGES[codimension] / MEDIANS[codimension])


def limits(
    scoring: Scoring,
    cost: Float[Tensor, "g s"],
    limit: Float[Tensor, "g"],
    count: Int[Tensor, "g"],
    size: int,
    codimension: int,
) -> Float[Tensor, "g s"]:
    """The squared threshold for each of some models: the one given, or the one that follows from their cost."""
    if scoring.needs_threshold:
        return limit[:, None].expand_as(cost)
    found: Float[Tensor, "g s"] = scoring.limit(cost, count, size, codimension)  # type: ignore[attr-defined]
    # Exact data have no noise: the smallest threshold that is one.
    return found.nan_to_num(nan=0.0, posinf=1e30).clamp(min=1e-12)
