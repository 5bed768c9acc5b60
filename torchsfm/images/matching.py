"""Which points of two images look alike."""

from collections.abc import Sequence

import torch
from jaxtyping import Int, Shaped
from torch import Tensor

from torchsfm.images.features import Features

_BLOCK = 2048


def match_features(
    features: Sequence[Features],
    pairs: Int[Tensor, "p 2"],
    *,
    ratio: float = 0.8,
    mutual: bool = True,
    max_distance: float = 0.7,
) -> list[Int[Tensor, "k 2"]]:
    """Match the descriptors of pairs of images.

    Args:
        features: The features of every image.
        pairs: Which images to compare, as indices into `features`.
        ratio: The best distance must be below this share of the second best (Lowe's test); 1 switches the test off.
        mutual: Keep a match only where each point is the other's best.
        max_distance: The largest angle between unit descriptors that still makes a match, in radians.

    Returns:
        One tensor for each pair: rows (index in the first image, index in the second), sorted by the first.
    """
    unit = [unit_descriptors(f.descriptors) for f in features]
    options = {"ratio": ratio, "max_distance": max_distance}
    return [match_descriptors(unit[i], unit[j], mutual=mutual, **options) for i, j in pairs.tolist()]


def match_descriptors(
    descriptors1: Shaped[Tensor, "n d"],
    descriptors2: Shaped[Tensor, "m d"],
    *,
    ratio: float = 0.8,
    mutual: bool = True,
    max_distance: float = 0.7,
) -> Int[Tensor, "k 2"]:
    """Match two sets of descriptors by the angle between them; see `match_features`."""
    unit1, unit2 = unit_descriptors(descriptors1), unit_descriptors(descriptors2)
    n, m = unit1.shape[0], unit2.shape[0]
    if n == 0 or m == 0:
        return torch.zeros(0, 2, dtype=torch.long, device=unit1.device)
    best = torch.empty(n, dtype=unit1.dtype, device=unit1.device)
    second = torch.full_like(best, -1)
    match = torch.empty(n, dtype=torch.long, device=unit1.device)
    back = torch.full((m,), -2.0, dtype=unit1.dtype, device=unit1.device)
    back_index = torch.zeros(m, dtype=torch.long, device=unit1.device)
    for start in range(0, n, _BLOCK):
        similarity = unit1[start : start + _BLOCK] @ unit2.mT
        column, index = similarity.max(0)
        better = column > back
        back = torch.where(better, column, back)
        back_index = torch.where(better, index + start, back_index)
        value, where = similarity.max(1)
        best[start : start + _BLOCK] = value
        match[start : start + _BLOCK] = where
        if m > 1:
            second[start : start + _BLOCK] = similarity.scatter_(1, where[:, None], -2).amax(1)
    distance, runner_up = best.clamp(-1, 1).arccos(), second.clamp(-1, 1).arccos()
    keep = (distance <= max_distance) & ((distance < ratio * runner_up) | (ratio >= 1))
    rows = torch.arange(n, device=unit1.device)
    if mutual:
        keep &= back_index[match] == rows
    return torch.stack([rows, match], 1)[keep]


def unit_descriptors(descriptors: Shaped[Tensor, "n d"]) -> Tensor:
    """Descriptors as float unit vectors."""
    values: Tensor = descriptors if descriptors.is_floating_point() else descriptors.float()
    return values / values.norm(dim=-1, keepdim=True).clamp_min(1e-12)
