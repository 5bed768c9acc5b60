"""How well models are supported, judged on more and more data for fewer and fewer models."""

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg.fused import fused
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.models import tensors_of
from torchsfm.robust.scores import Score

M = TypeVar("M")

NUMBERS = {True: 1 << 17, False: 1 << 24}
"""How many distances to compute at a time, on a CPU and elsewhere."""
PREFIXES = (64, 256, 1024)
"""Numbers of data on which hypotheses are judged before all data are looked at."""
KEPT = (16, 8, 4)
"""The fewest hypotheses that are kept after each."""
SHARE = 64
"""Of how many hypotheses one is kept after the first."""


def squared_residual(estimator: Estimator[M], model: M, *data: Float[Tensor, "*#batch n _"]) -> Float[Tensor, "*batch n"]:
    """The squared distance of data to models of as many batch dimensions: infinite or no number where a model is none."""
    model = _no_numbers_for_none(estimator, model, data[0].ndim - 2)
    direct = getattr(estimator, "squared_residual", None)
    if direct is None:
        residual = estimator.residual(model, *data)
        squared = residual * residual
    else:
        squared = direct(model, *data)
    return squared


def _no_numbers_for_none(estimator: Estimator[M], model: M, dims: int) -> M:
    """NaN in the place of what is no model: not finite, or zero where the estimator says that this is none."""
    with torch.no_grad():
        parts = [
            torch.linalg.vector_norm(t.flatten(dims) if t.ndim > dims else t[..., None], dim=-1) for t in tensors_of(model)
        ]
        size = parts[0] if len(parts) == 1 else torch.stack(parts).sum(0)
        # 1, but 0 / 0 or inf / inf; or 0, but inf - inf.
        one = size / size if getattr(estimator, "never_zero", False) else size - size + 1
    return tensor_map(lambda t: t * one.reshape(one.shape + (1,) * (t.ndim - dims)), model)


def losses(
    estimator: Estimator[M],
    models: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    counts: Tensor | None,
    score: Score,
) -> Float[Tensor, "g s"]:
    """The cost of `s` models of each problem, computed in portions that stay in the cache.

    Args:
        estimator: The problem, with a dimension of size 1 for the models.
        models: `(g, s, ...)`.
        data: `(g, 1, n, d)` each.
        limit: Squared threshold.
        counts: What the data count, `(g, n)`: a boolean or a weight; all alike if not given.
        score: How models are compared.
    """
    (first, *_) = tensors_of(models)
    g, s = first.shape[:2]
    each = s * data[0].shape[-2]
    portion = max(1, NUMBERS[first.device.type == "cpu"] // max(each, 1))
    if portion >= g > 0 or _costs.compiles(estimator):
        return _costs(estimator, models, data, limit, counts, score)
    rows = []
    for i in range(0, g, portion):
        some = slice(i, i + portion)
        own, of, at, edge, part = tensor_map(lambda t: t[some], (estimator, models, tuple(data), limit, counts))  # noqa: B023
        rows.append(_costs(own, of, at, edge, part, score))
    return torch.cat(rows) if rows else limit.new_zeros(g, s)


@fused("g 1", "g s", "g 1 n", "g", "g n")
def _costs(
    estimator: Estimator[Any], models: Any, data: Sequence[Tensor], limit: Tensor, counts: Tensor | None, score: Score
) -> Tensor:
    return score.cost(squared_residual(estimator, models, *data), limit, counts, estimator.codimension)


def stages(width: int, slots: int) -> list[tuple[int, int]]:
    """On how many data `slots` models are scored, stage by stage, and how many of the models are kept each time."""
    plan = []
    for level, (prefix, fewest) in enumerate(zip(PREFIXES, KEPT, strict=True)):
        keep = max(fewest, slots // SHARE) if level == 0 else fewest
        if 2 * prefix <= width and keep < slots:
            plan.append((prefix, keep))
            slots = keep
    return [*plan, (width, KEPT[-1])]


def smallest(score: Float[Tensor, "g s"], number: int) -> Int[Tensor, "g number"]:
    """The models with the smallest scores, best first.

    Of models that are equal but for rounding the first: else the number of columns, which is that of the fullest row, decides,
    and nonsense, of which nothing agrees with anything, feels its neighbours.
    """
    columns = score.shape[-1]
    later = torch.arange(columns, device=score.device, dtype=score.dtype).mul_(torch.finfo(score.dtype).eps).add_(1)
    return (score * later).topk(min(number, columns), dim=-1, largest=False).indices


def gather_valid(valid: Bool[Tensor, "g s"], least: int) -> tuple[Int[Tensor, "g _"], Bool[Tensor, "g _"]]:
    """Where the valid slots of each row are, in as few columns as the fullest row needs or `least`, and which are filled."""
    g, slots = valid.shape
    rank = valid.cumsum(-1)
    columns = max(int(rank[:, -1].max()) if valid.numel() else 0, least)
    index = torch.zeros(g, columns + 1, dtype=torch.long, device=valid.device)
    position = torch.where(valid, rank - 1, columns)
    index.scatter_(1, position, torch.arange(slots, device=valid.device).expand(g, slots))
    filled = torch.arange(columns, device=valid.device) < rank[:, -1:]
    return index[:, :columns], filled


def around_model(
    ratio: Float[Tensor, "*batch n"], counts: Shaped[Tensor, "*#batch n"], codimension: int
) -> Float[Tensor, "*batch"]:
    """How many data the threshold would take in if they were as dense there as between two and six thresholds from the model.

    Args:
        ratio: Squared distances in units of the squared threshold.
        counts: What the data count: a boolean or a weight.
        codimension: The number of dimensions across the model.
    """
    between = ((ratio > 4) & (ratio < 36)).mul(counts).sum(-1)
    expected: Tensor = (between + 0.5) / (6**codimension - 2**codimension)
    return expected


def beyond_chance(
    support: Float[Tensor, "p"], count: Shaped[Tensor, "p"], expected: Float[Tensor, "p"], size: int
) -> Bool[Tensor, "p"]:
    """Whether so much support is more than the best of all samples finds by chance (Moisan & Stival 2004, bounded by entropy).

    If a datum fits with probability p, a share q of n data does with probability exp(-n KL(q || p)) at most (Sanov's bound),
    and there are (n over size) samples to choose from.

    Args:
        support: Soft number of inliers.
        count: Number of data.
        expected: How many data would fit by chance.
        size: Number of data in a sample.
    """
    n = (count - size).to(support.dtype)
    q = ((support - size) / n.clamp(min=1)).clamp(1e-9, 1 - 1e-9)
    p = (expected / count).to(support.dtype).clamp(1e-4, 1 - 1e-9)
    entropy = torch.where(q > p, q * (q / p).log() + (1 - q) * ((1 - q) / (1 - p)).log(), 0)
    samples = torch.lgamma(n + size + 1.0) - torch.lgamma(n + 1.0) - math.lgamma(size + 1)
    # Where nearly all data agree, there is no other explanation, however few they are.
    return (n * entropy > samples) | (q > 0.9)
