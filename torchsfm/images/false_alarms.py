"""How many as good objects are to be expected in noise (Desolneux, Moisan & Morel 2000)?"""

import math

from jaxtyping import Bool, Float
from torch import Tensor

_ALIGNED = math.pi / 8
"""Largest angle between gradient and normal."""
CHANCE = 1 / 8
"""The share of all directions that are nearer to a normal; of a line of two normals it is twice as much."""


def aligned(across: Float[Tensor, "*#n"], gradient: Float[Tensor, "*#n 2"]) -> Bool[Tensor, "*n"]:
    """Whether gradients, whose parts along normals are `across`, point along the normals."""
    return across >= math.cos(_ALIGNED) * gradient.square().sum(-1).sqrt()


def log_tail(k: Float[Tensor, " n"], n: Float[Tensor, " n"], chance: float = CHANCE) -> Float[Tensor, " n"]:
    """Decimal logarithm of a bound of the chance that k or more of n directions are aligned (Hoeffding)."""
    share = (k / n.clamp_min(1)).clamp(chance, 1)
    rest = (1 - share).clamp_min(1e-300)
    return -n * (share * (share / chance).log() + rest * (rest / (1 - chance)).log()) / math.log(10)
